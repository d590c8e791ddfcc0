"""Sink `mcap`: records frames and every stage's output, each on its own topic."""

from __future__ import annotations

import json
import logging
from collections.abc import Mapping
from pathlib import Path
from typing import Any, ClassVar, Literal

from pydantic import Field, PrivateAttr

from mushpipe import GraphPath, RunInfo, Sink, Trace
from mushpipe.core import wire
from mushpipe.core.recording import MANIFEST, SUMMARY, RecordingWriter

logger = logging.getLogger("mushpipe")


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
        for stage in trace.durations_ns:
            for value in trace.outputs[stage]:
                self._write(writer, stage, value, trace)
        if self.timing and trace.durations_ns:
            content = {"stages_ns": dict(trace.durations_ns)}
            message = wire.json_message(wire.TIMING, frame.header, content)
            writer.write(wire.TIMING_TOPIC, message, frame.header)

    def _write(self, writer: RecordingWriter, stage: str, value: Any, trace: Trace) -> None:
        if wire.encoder_of(type(value)) is None:
            if type(value) not in self._unknown:
                self._unknown.add(type(value))
                logger.warning(
                    "%s is not recorded: %s is not a Columns type", stage, type(value).__name__
                )
            return
        # Several outputs of one stage need several topics; the first keeps the stage's own.
        own = "" if value is trace.outputs[stage][0] else f"/{type(value).__name__.lower()}"
        writer.value(f"{wire.RESULT_PREFIX}{stage}{own}", value, trace.frame.header)

    def finish(self, summary: Mapping[str, Any]) -> None:
        """Write the run's counts at the end."""
        if self._writer is not None and self.timing:
            self._writer.metadata(SUMMARY, {"json": json.dumps(dict(summary))})

    def close(self) -> None:
        """Write index and footer."""
        if self._writer is not None:
            self._writer.close()
            self._writer = None
