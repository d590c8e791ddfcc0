"""Writing MCAP: to a file that survives its writer, or as a stream to standard output."""

from __future__ import annotations

import errno
import os
import sys
from collections.abc import Mapping
from functools import partial
from io import FileIO
from pathlib import Path
from types import EllipsisType, SimpleNamespace
from typing import IO, Any, Literal, cast

import mcap.writer
import zstandard
from mcap.writer import CompressionType, IndexType, Writer

from mushpipe.core import wire
from mushpipe.core.errors import MushpipeError, UsageError
from mushpipe.core.geometry import Camera
from mushpipe.core.overwriting import opened_alone
from mushpipe.core.paths import STDIO
from mushpipe.core.types import Header, RgbdFrame

# mcap's writer has no setting for the level. At zstandard's own, 3, images take three times as long
# and come out a sixth smaller.
_LEVEL = 1
EXISTS = "{} exists already: give the recording another name, or delete it"
mcap.writer.zstandard = SimpleNamespace(  # type: ignore[assignment, attr-defined]
    compress=partial(zstandard.compress, level=_LEVEL)
)


class RecordingError(MushpipeError):
    """A recording cannot be written any further: the disk is full, or nobody reads the stream."""


class RecordingWriter:
    """Writes MCAP of compressed chunks of 1 MiB with CRCs; a topic gets its channel on first use.

    A killed process loses at most the open chunk. To `STDIO` it writes a stream instead: without
    chunks or index, so that each message leaves at once.

    Raises:
        RecordingError: Also from every method: the output takes no more. What was written before
            stays readable.
        UsageError: Standard output is a terminal, another run writes the file, or it is there and
            not to be written over.
    """

    def __init__(
        self,
        path: Path,
        metadata: Mapping[str, Mapping[str, str]],
        compression: Literal["zstd", "lz4"] = "zstd",
        overwrite: bool = True,
    ) -> None:
        stream = path == STDIO
        self._output = _Output(_standard_output() if stream else _create(path, overwrite), path)
        self._writer = Writer(
            cast(IO[bytes], self._output),
            compression=CompressionType[compression.upper()],
            use_chunking=not stream,
            index_types=IndexType.NONE if stream else IndexType.ALL,
            enable_crcs=True,
            enable_data_crcs=stream,  # messages without a chunk have no CRC but that of them all
        )
        self._writer.start(profile="mushpipe", library="mushpipe")
        self._schemas: dict[tuple[str, str, bytes], int] = {}
        self._channels: dict[tuple[str, wire.Schema, tuple[tuple[str, str], ...]], int] = {}
        self._camera: Camera | EllipsisType | None = ...  # nothing was stated yet
        for name, values in metadata.items():
            self.metadata(name, values)

    @property
    def size(self) -> int:
        """Bytes that are written; the open chunk is not."""
        return self._output.tell()

    def metadata(self, name: str, values: Mapping[str, str]) -> None:
        """Write a metadata record at this place of the file."""
        self._writer.add_metadata(name, dict(values))

    def frame(self, frame: RgbdFrame, jpeg_quality: int | None = None) -> None:
        """Write the calibration, or that there is none, where it changes; what is attached; images.

        The images come last: who reads a stream has all of a frame when it has its images.
        """
        header = frame.header
        if frame.camera != self._camera:
            self._camera = frame.camera
            message = wire.encode_camera(frame.camera, frame.color.shape, header)
            self.write(wire.CAMERA_TOPIC, message, header)
        for topic, value in frame.attached.items():
            self.value(topic, value, header)
        self.write(wire.COLOR_TOPIC, wire.encode_color(frame, jpeg_quality), header)
        if frame.depth is not None:
            self.write(wire.DEPTH_TOPIC, wire.encode_depth(frame), header)

    def value(self, topic: str, value: Any, header: Header) -> None:
        """Write any value that has a wire form.

        Raises:
            TypeError: It has none.
        """
        encoder = wire.encoder_of(type(value))
        if encoder is None:
            raise TypeError(f"{type(value).__name__} has no wire form: it is no Columns type")
        for message in encoder(value, header):
            self.write(topic + message.suffix, message, header)

    def write(self, topic: str, message: wire.Message, header: Header) -> None:
        """Write a message: publish time is sensor time, log time is the host's arrival time."""
        self._writer.add_message(
            self._channel(topic, message),
            log_time=header.arrival_ns,
            data=message.data,
            publish_time=header.stamp_ns,
            sequence=header.sequence,
        )

    def _channel(self, topic: str, message: wire.Message) -> int:
        schema = message.schema
        key = (topic, schema, tuple(sorted(message.metadata.items())))
        if key not in self._channels:
            # Types of two plugins, and of two versions of one, may share a name.
            schema_key = (schema.name, schema.encoding, schema.data)
            if schema_key not in self._schemas:
                self._schemas[schema_key] = self._writer.register_schema(*schema_key)
            self._channels[key] = self._writer.register_channel(
                topic, schema.message_encoding, self._schemas[schema_key], dict(message.metadata)
            )
        return self._channels[key]

    def flush(self) -> None:
        """End the open chunk, so that a killed process loses none of it."""
        self._writer.flush()  # type: ignore[no-untyped-call]

    def close(self) -> None:
        """Write index and footer; the file is complete only after this, or broken before."""
        try:
            if self._output.broken is None:
                self._writer.finish()  # type: ignore[no-untyped-call]
        finally:
            self._output.close()


class _Output:
    """What mcap's writer writes to: without a buffer, in which a killed process loses a chunk."""

    def __init__(self, file: FileIO, path: Path) -> None:
        self._file = file
        self._path = path
        self._size = 0
        self.broken: RecordingError | None = None

    def write(self, data: bytes) -> None:
        """Write all of it.

        Raises:
            RecordingError: It does not fit; nothing can follow that would still be readable.
        """
        if self.broken is not None:
            raise self.broken
        rest = memoryview(data)
        try:
            while rest:
                written = self._file.write(rest)
                rest = rest[written:]
                self._size += written
        except OSError as error:
            self.broken = RecordingError(self._explain(error))
            raise self.broken from error

    def _explain(self, error: OSError) -> str:
        if error.errno == errno.EPIPE:
            return "the program that reads the stream has ended"
        if self._path == STDIO:
            return f"the stream cannot be written: {error.strerror}"
        kept = "it plays up to its last whole chunk; make room, or record elsewhere"
        return f"{self._path}: {error.strerror}; {kept}"

    def tell(self) -> int:
        return self._size

    def flush(self) -> None:
        """Do nothing: there is no buffer."""

    def close(self) -> None:
        self._file.close()


def _create(path: Path, overwrite: bool) -> FileIO:
    """Open a file that no other run is writing, and empty it."""
    try:
        file = opened_alone(path)
        if path.is_file() and path.stat().st_size:
            if not overwrite:
                file.close()
                raise UsageError(EXISTS.format(path))
            file.truncate(0)
    except OSError as error:
        raise RecordingError(f"{path}: cannot be written: {error.strerror}") from error
    return file


def _standard_output() -> FileIO:
    """Return standard output, and send to stderr what anybody else prints from now on."""
    if sys.stdout.isatty():
        raise UsageError(
            "a recording cannot be shown on a terminal: give -o a file, or pipe it into "
            "'mushpipe run GRAPH --source -'"
        )
    sys.stdout.flush()
    number = sys.stdout.fileno()
    stream = FileIO(os.dup(number), "wb")
    os.set_blocking(stream.fileno(), True)  # else nothing is written where a pipe is full
    os.dup2(sys.stderr.fileno(), number)
    return stream
