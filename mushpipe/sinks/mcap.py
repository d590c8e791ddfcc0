"""Sink `mcap`: records frames and every stage's output, each on its own topic."""

from __future__ import annotations

import json
import re
from collections.abc import Mapping
from itertools import count, takewhile
from pathlib import Path
from typing import Any, ClassVar, Literal

from pydantic import ByteSize, Field, PrivateAttr, ValidationInfo, field_validator

from mushpipe import RunInfo, Sink, SinkPath, Trace
from mushpipe.core.errors import MushpipeError, UsageError
from mushpipe.core.paths import STDIO
from mushpipe.core.recorder import RecordingWriter
from mushpipe.core.recording import MANIFEST, SUMMARY
from mushpipe.core.transform import Transform, base_of
from mushpipe.sinks.messages import base_message, result_messages, timing_message


class McapSink(Sink):
    """Records a run as MCAP that opens in Foxglove and Rerun and can be played again.

    The manifest and the calibration stand first, so that a file cut short is still usable.
    """

    delivery: ClassVar[Literal["every", "latest"]] = "every"

    path: SinkPath = Field(description="file to write; {recording} is the name of the input")
    frames: bool | Literal["source"] = Field(
        True,
        description="record colour and depth beside the results, also those that stages made; "
        "`source` leaves the latter out: the graph makes them again",
    )
    jpeg_quality: int | None = Field(
        None, ge=1, le=100, description="store colour as JPEG of this quality; lossless if not set"
    )
    compression: Literal["zstd", "lz4"] = Field(
        "zstd", description="lz4 takes two thirds of the time and a third more room"
    )
    drawings: bool = Field(
        True, description="record how viewers draw circles and picks, beside the tables"
    )
    timing: bool = Field(True, description="record the time each stage took")
    split_size: ByteSize | None = Field(
        None, ge=1, description="begin a new file when one has this size, 2GB say; each is complete"
    )
    overwrite: bool = Field(True, description="false refuses to write over a file that is there")

    _run: RunInfo | None = PrivateAttr(None)
    _part: int = PrivateAttr(0)
    _writer: RecordingWriter | None = PrivateAttr(None)
    _ended: MushpipeError | None = PrivateAttr(None)  # why no further part could be begun
    _unknown: set[type] = PrivateAttr(default_factory=set)
    _base: Transform | None = PrivateAttr(None)

    @field_validator("path")
    @classmethod
    def _plays_again(cls, path: Path) -> Path:
        if path.name.lower().endswith(".bag"):  # by which --source tells Intel's
            raise ValueError("a recording is MCAP, and .bag one of Intel's viewer: name it .mcap")
        return path

    @field_validator("split_size")
    @classmethod
    def _of_a_file(cls, size: ByteSize | None, known: ValidationInfo) -> ByteSize | None:
        if size is not None and known.data.get("path") == STDIO:
            raise ValueError("standard output is one stream, which cannot be split")
        return size

    def files(self, run: RunInfo) -> tuple[Path, ...]:
        """Return the files it writes; of a split recording the first one and all there are."""
        if self.path == STDIO:
            return ()
        path = run.path(self.path)
        if self.split_size is None:
            return (path,)
        names = re.compile(
            rf"{re.escape(path.stem)}_(\d{{3}}|[1-9]\d{{3,5}}){re.escape(path.suffix)}"
        )
        parts = (other for other in path.parent.glob("*") if names.fullmatch(other.name))
        return tuple(sorted({part(path, 0), *parts}))

    def open(self, run: RunInfo) -> None:
        """Create the file and write the manifest; parts that a run before left go.

        Raises:
            UsageError: Of a split recording there is a later part without the first.
        """
        self._run, self._part, self._ended = run, 0, None
        if self.split_size is not None and self.overwrite:
            self._clear(run.path(self.path))
        self._base = base_of(run.manifest.get("graph", {}))
        self._writer = self._begin(run)

    def _clear(self, path: Path) -> None:
        """Delete the later parts of a recording whose first one will be written over."""
        old = [*takewhile(Path.exists, (part(path, number) for number in count(1)))]
        if old and not part(path, 0).exists():
            raise UsageError(
                f"{old[0]} is there, but no {part(path, 0).name} that it could go on from: as a "
                "part of this recording it would be deleted; give another name"
            )
        for each in old:
            each.unlink()

    def _begin(self, run: RunInfo) -> RecordingWriter:
        path = self.path if self.path == STDIO else run.path(self.path)
        if self.split_size is not None:
            path = part(path, self._part)
        manifest = {"json": json.dumps(dict(run.manifest))}
        if path == STDIO and run.live:
            manifest["live"] = "true"
        return RecordingWriter(path, {MANIFEST: manifest}, self.compression, self.overwrite)

    def consume(self, trace: Trace) -> None:
        """Write one frame and its results."""
        writer, frame = self._next_writer(), trace.frame
        if self.frames:
            writer.frame(frame, self.jpeg_quality)
        results = result_messages(trace, self._unknown, self.drawings, self.frames is True)
        for topic, message in results:
            writer.write(topic, message, frame.header)
        if self.drawings and self._base is not None:
            writer.write(*base_message(self._base, frame.header), frame.header)
        if self.timing and trace.durations_ns:
            writer.write(*timing_message(trace), frame.header)

    def _next_writer(self) -> RecordingWriter:
        """Return the writer of the part in work, or of a new one where that has its size."""
        writer, run = self._writer, self._run
        if self._ended is not None:
            raise self._ended
        if writer is None or run is None:
            raise RuntimeError("the sink is not open")
        if self.split_size is None or writer.size < self.split_size:
            return writer
        self._writer = None  # also where no new one can be begun
        writer.close()
        self._part += 1
        try:
            self._writer = self._begin(run)
        except MushpipeError as error:
            self._ended = error
            raise
        return self._writer

    def finish(self, summary: Mapping[str, Any]) -> None:
        """Write the run's counts at the end."""
        if self._writer is not None and self.timing:
            self._writer.metadata(SUMMARY, {"json": json.dumps(dict(summary))})

    def close(self) -> None:
        """Write index and footer."""
        if self._writer is not None:
            self._writer.close()
            self._writer = None


def part(path: Path, number: int) -> Path:
    """Return the name of a part of a split recording: ``row-7_000.mcap`` is the first."""
    return path.with_name(f"{path.stem}_{number:03d}{path.suffix}")
