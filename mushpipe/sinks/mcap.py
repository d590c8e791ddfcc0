"""Sink `mcap`: records frames and every stage's output, each on its own topic."""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any, ClassVar, Literal

from pydantic import Field, PrivateAttr

from mushpipe import GraphPath, RunInfo, Sink, Trace
from mushpipe.core.recording import MANIFEST, SUMMARY, RecordingWriter
from mushpipe.sinks.messages import result_messages, timing_message


class McapSink(Sink):
    """Records a run as MCAP that opens in Foxglove and Rerun and can be played again.

    The manifest and the calibration stand first, so that a file cut short is still usable.
    """

    delivery: ClassVar[Literal["every", "latest"]] = "every"

    path: GraphPath = Field(description="file to write; {recording} is the name of the input")
    frames: bool = Field(True, description="record colour and depth beside the results")
    jpeg_quality: int | None = Field(
        None, ge=1, le=100, description="store colour as JPEG of this quality; lossless if not set"
    )
    drawings: bool = Field(
        True, description="record how viewers draw circles and picks, beside the tables"
    )
    timing: bool = Field(True, description="record the time each stage took")

    _writer: RecordingWriter | None = PrivateAttr(None)
    _unknown: set[type] = PrivateAttr(default_factory=set)

    def files(self, run: RunInfo) -> tuple[Path, ...]:
        """Return the file it writes."""
        return (run.path(self.path),)

    def open(self, run: RunInfo) -> None:
        """Create the file and write the manifest."""
        manifest = {"json": json.dumps(dict(run.manifest))}
        self._writer = RecordingWriter(run.path(self.path), {MANIFEST: manifest})

    def consume(self, trace: Trace) -> None:
        """Write one frame and its results."""
        writer, frame = self._writer, trace.frame
        if writer is None:
            raise RuntimeError("the sink is not open")
        if self.frames:
            writer.frame(frame, self.jpeg_quality)
        for topic, message in result_messages(trace, self._unknown, self.drawings):
            writer.write(topic, message, frame.header)
        if self.timing and trace.durations_ns:
            writer.write(*timing_message(trace), frame.header)

    def finish(self, summary: Mapping[str, Any]) -> None:
        """Write the run's counts at the end."""
        if self._writer is not None and self.timing:
            self._writer.metadata(SUMMARY, {"json": json.dumps(dict(summary))})

    def close(self) -> None:
        """Write index and footer."""
        if self._writer is not None:
            self._writer.close()
            self._writer = None
