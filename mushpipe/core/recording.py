"""Reading MCAP files; a damaged file is read as far as it goes."""

from __future__ import annotations

import math
import struct
from collections import Counter
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import NamedTuple

from mcap.exceptions import InvalidMagic, McapError
from mcap.reader import SeekingReader
from mcap.records import (
    Attachment,
    Channel,
    Chunk,
    ChunkIndex,
    DataEnd,
    McapRecord,
    Metadata,
    Schema,
)
from mcap.records import Message as McapMessage
from mcap.stream_reader import CRCValidationError, StreamReader, breakup_chunk
from zstandard import ZstdError

from mushpipe.core.chunks import by_log_time, side_by_side
from mushpipe.core.errors import InputError, UsageError
from mushpipe.core.paths import in_its_place
from mushpipe.core.summary import is_intact, require_complete
from mushpipe.core.truth import TABLE

# What mcap's reader raises on bytes that are not what they claim to be.
GARBAGE = (
    *(McapError, ValueError, struct.error, ZstdError, RuntimeError, MemoryError, TypeError),
    *(OverflowError, LookupError, OSError),
)
MAGIC = b"\x89MCAP0\r\n"
MANIFEST = "mushpipe.manifest"
SUMMARY = "mushpipe.summary"
GRAPH = "mushpipe.graph"

ZSTD = b"\x28\xb5\x2f\xfd"  # what Zstandard's frames begin with
CONVERT = "'rosbags-convert --src {} --dst NEW_FOLDER --dst-storage mcap'"
# What other recordings begin with: what they are, and what makes them readable.
_OTHERS = {
    b"rosbag2_": "what describes a bag: the file beside it that it names is the recording",
    b"SQLite f": f"a ROS 2 bag in SQLite: {CONVERT.format('ITS_FOLDER')} makes MCAP of it",
    b"#ROSBAG ": f"a bag of ROS 1: {CONVERT.format('FILE')} makes MCAP of it; one of Intel's "
    "viewer is played where its name ends with .bag",
    b"RRF": "a Rerun file: open it with 'rerun FILE'",
    ZSTD: "compressed as a whole: 'zstd -d FILE' unpacks it",
    b"\x1f\x8b": "compressed as a whole: 'gunzip FILE' unpacks it",
    b"PK\x03\x04": "a zip archive: 'unzip FILE' unpacks it",
    **dict.fromkeys(
        (b"\xff\xd8\xff", b"\x89PNG\r\n\x1a\n"),
        "an image: 'mushpipe record --source IMAGE -o FILE' makes a recording of one or a folder",
    ),
}


class Raw(NamedTuple):
    """A message as it stands in the file."""

    channel: Channel
    schema: Schema | None
    message: McapMessage

    @property
    def table(self) -> str:
        """Name of mushpipe's table that it is, by itself or as a subtype; or of its schema."""
        return _table(self.channel, self.schema)


@dataclass
class Index:
    """What a file holds, without its messages."""

    channels: dict[str, Channel] = field(default_factory=dict)
    by_id: dict[int, Channel] = field(default_factory=dict)
    schemas: dict[int, Schema] = field(default_factory=dict)
    counts: Counter[str] = field(default_factory=Counter)
    start_ns: int = 0
    end_ns: int = 0
    metadata: dict[str, dict[str, str]] = field(default_factory=dict)
    attachments: list[str] = field(default_factory=list)
    side_by_side: list[ChunkIndex] = field(default_factory=list)  # chunks, if they are

    def schema_name(self, topic: str) -> str:
        """Return the name of a topic's schema, empty where it has none."""
        schema = self.schemas.get(self.channels[topic].schema_id)
        return schema.name if schema else ""

    def table(self, topic: str) -> str:
        """Return the name of mushpipe's table that a topic holds, or of its schema."""
        channel = self.channels[topic]
        return _table(channel, self.schemas.get(channel.schema_id))


def _table(channel: Channel, schema: Schema | None) -> str:
    return channel.metadata.get(TABLE) or (schema.name if schema else "")


class RecordingReader:
    """Reads an MCAP file from front to back, chunk by chunk, checking the CRC of each.

    Messages come in file order, sorted by log time within a chunk, and from chunk to chunk where
    these lie side by side in time. Afterwards ``damage`` says, in words, what could not be read,
    and ``unchecked`` whether messages had no CRC: bytes that changed in them show nowhere.

    Raises:
        UsageError: There is no such file, or it is a pipe.
        InputError: It is empty, or not MCAP at all.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self.damage: list[str] = []
        self.unchecked = False
        self._index: Index | None = None
        try:
            # what was read of a pipe is gone: the rest would pass for a damaged file
            if path.is_fifo():
                raise UsageError(
                    f"{path}: it is a pipe, and recordings are read more than once: save it as a "
                    "file; a graph plays what is piped into 'mushpipe run GRAPH --source -'"
                )
            if path.is_dir():
                raise UsageError(f"{path}: it is a folder{in_its_place(path)}")
            with path.open("rb") as file:
                magic = file.read(len(MAGIC))
        except FileNotFoundError:
            raise UsageError(f"{path}: there is no such recording") from None
        except OSError as error:
            raise InputError(f"{path}: cannot be read: {error.strerror}") from error
        if not magic:
            raise InputError(f"{path}: the file is empty")
        if magic != MAGIC:
            known = [what for begin, what in _OTHERS.items() if magic.startswith(begin)]
            what = f"it is {known[0]}" if known else f"it begins with {magic!r}"
            raise InputError(f"{path}: not an MCAP file ({what})")

    def messages(
        self,
        topics: set[str] | None = None,
        start_ns: int = 0,
        end_ns: int | None = None,
        as_written: bool = False,
    ) -> Iterator[Raw]:
        """Yield the messages of some topics (default all) with start_ns <= log_time < end_ns.

        They come by log time, see above; with ``as_written``, for what mushpipe wrote, in the order
        of the file within a chunk.
        """
        index, seen = self.index(), 0
        end = math.inf if end_ns is None else end_ns
        # A chunk that is skipped or corrupt may be the one that declares them.
        channels, schemas = dict(index.by_id), dict(index.schemas)

        def overlaps(chunk: Chunk | ChunkIndex) -> bool:
            return chunk.message_end_time >= start_ns and chunk.message_start_time < end

        turned = bool(index.side_by_side)  # mushpipe leaves none: another program wrote it anew
        records = self._by_log_time(overlaps) if turned else self._records(overlaps, as_written)
        for record in records:
            if isinstance(record, Schema):
                schemas[record.id] = record
            elif isinstance(record, Channel):
                channels[record.id] = record
            elif isinstance(record, McapMessage):
                seen += 1
                channel = channels.get(record.channel_id)
                inside = start_ns <= record.log_time < end
                if channel is None:
                    self._note("a message belongs to no channel")
                elif inside and (topics is None or channel.topic in topics):
                    yield Raw(channel, schemas.get(channel.schema_id), record)
        if not start_ns and end_ns is None and seen < index.counts.total() and not self.damage:
            self._note(f"{index.counts.total() - seen} of its messages are missing")

    def _records(
        self, wanted: Callable[[Chunk], bool], as_written: bool = False
    ) -> Iterator[McapRecord]:
        with self.path.open("rb") as file:
            limit = self.path.stat().st_size
            reader = StreamReader(
                file, emit_chunks=True, validate_crcs=True, record_size_limit=limit
            )
            in_summary = loose = False
            try:
                for record in reader.records:
                    # What the summary repeats was read already; it goes on to the last byte.
                    if isinstance(record, DataEnd):
                        in_summary = True
                        self.unchecked |= loose and not record.data_section_crc
                    if in_summary:
                        continue
                    if not isinstance(record, Chunk):
                        loose |= isinstance(record, McapMessage)
                        yield record
                    elif wanted(record):
                        yield from self._unpack(record, as_written)
                if behind := limit - file.tell():
                    self._note(f"{behind} bytes behind its end were not read: another recording?")
            except InvalidMagic:
                self._note("its last bytes are missing")
            except CRCValidationError:
                # Of all chunks and what stands between them; chunks have CRCs of their own.
                if loose:
                    self._note("bytes of it have changed (its CRC does not match)")
            except GARBAGE:
                self._note("it breaks off: the recorder did not close it, or bytes are missing")

    def _by_log_time(self, wanted: Callable[[ChunkIndex], bool]) -> Iterator[McapRecord]:
        try:
            yield from by_log_time(self.path, self.index().side_by_side, wanted, self._unpack)
        except GARBAGE as error:
            self._note(f"a chunk is not where its index says ({error})")

    def _unpack(self, chunk: Chunk, as_written: bool = False) -> list[McapRecord]:
        self.unchecked |= chunk.uncompressed_crc == 0  # by MCAP's specification, none is known
        try:
            if chunk.uncompressed_size > 2**32:
                raise ValueError("implausible size")
            records = breakup_chunk(chunk, validate_crc=True)
        except GARBAGE as error:
            self._note(f"a chunk is corrupt ({error})")
            return []
        if as_written:
            return records
        # Only messages move, and all to the end: a channel is always known before its messages.
        return sorted(records, key=lambda r: r.log_time if isinstance(r, McapMessage) else -1)

    def contents(self) -> str:
        """Return its topics as text, for messages, and what of it could not be read."""
        topics = ", ".join(sorted(self.index().channels)) or "nothing"
        return f"it holds {topics}{'; ' if self.damage else ''}{'; '.join(self.damage)}"

    def _note(self, text: str) -> None:
        if text not in self.damage:
            self.damage.append(text)

    def index(self) -> Index:
        """Return what the file holds; from its summary, or by reading it all if that is lost."""
        if self._index is None:
            try:
                self._index = self._index_from_summary()
            except GARBAGE:
                self._index = self._index_by_scan()
        return self._index

    def _index_from_summary(self) -> Index:
        with self.path.open("rb") as file:
            if not is_intact(file):
                self._note("its index is corrupt")
                raise ValueError("corrupt summary")
            file.seek(0)
            reader = SeekingReader(file, record_size_limit=self.path.stat().st_size)
            summary = reader.get_summary()
            if summary is None or summary.statistics is None:
                raise ValueError("no summary")
            require_complete(summary, summary.statistics)
            counts: Counter[str] = Counter()
            for channel_id, count in summary.statistics.channel_message_counts.items():
                counts[summary.channels[channel_id].topic] += count
            return Index(
                channels={c.topic: c for c in summary.channels.values()},
                by_id=dict(summary.channels),
                schemas=dict(summary.schemas),
                counts=counts,
                start_ns=summary.statistics.message_start_time,
                end_ns=summary.statistics.message_end_time,
                metadata={m.name: m.metadata for m in reader.iter_metadata()},
                attachments=[a.name for a in summary.attachment_indexes],
                side_by_side=side_by_side(file, summary.chunk_indexes),
            )

    def _index_by_scan(self) -> Index:
        index = Index()
        for record in self._records(lambda _: True):
            if isinstance(record, Schema):
                index.schemas[record.id] = record
            elif isinstance(record, Channel):
                index.by_id[record.id] = record
                index.channels[record.topic] = record
            elif isinstance(record, McapMessage) and record.channel_id in index.by_id:
                if not index.counts:
                    index.start_ns = record.log_time
                index.counts[index.by_id[record.channel_id].topic] += 1
                index.start_ns = min(index.start_ns, record.log_time)
                index.end_ns = max(index.end_ns, record.log_time)
            elif isinstance(record, Metadata):
                index.metadata[record.name] = record.metadata
            elif isinstance(record, Attachment):
                index.attachments.append(record.name)
        return index
