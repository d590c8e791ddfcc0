"""Chunks of an MCAP file that lie side by side in time, as where each holds one topic."""

from __future__ import annotations

import heapq
from collections.abc import Callable, Iterable, Iterator
from operator import attrgetter
from pathlib import Path
from typing import BinaryIO

from mcap.data_stream import ReadDataStream
from mcap.records import Chunk, ChunkIndex, McapRecord, Message, MessageIndex

_HEAD = 9  # bytes of a record's opcode and length
Unpack = Callable[[Chunk], Iterable[McapRecord]]


def side_by_side(file: BinaryIO, chunks: Iterable[ChunkIndex]) -> list[ChunkIndex]:
    """Return the chunks where their order is not that of time, though it is on each channel.

    Where time goes back on a channel as well, a clock was set, and the order of the file is right.
    None are returned there, nor where the file does not say.
    """
    filled = [chunk for chunk in chunks if chunk.message_index_offsets]
    filled.sort(key=attrgetter("chunk_start_offset"))
    if _rises((chunk.message_start_time, chunk.message_end_time) for chunk in filled):
        return []
    spans: dict[int, list[tuple[int, int]]] = {}
    for chunk in filled:
        for channel, offset in chunk.message_index_offsets.items():
            file.seek(offset + _HEAD)
            times = [time for time, _ in MessageIndex.read(ReadDataStream(file)).records]
            if times:
                spans.setdefault(channel, []).append((min(times), max(times)))
    return filled if all(map(_rises, spans.values())) else []


def _rises(spans: Iterable[tuple[int, int]]) -> bool:
    """Return whether no span begins before one that stands in front of it ends."""
    latest = 0
    for first, last in spans:
        if first < latest:
            return False
        latest = max(latest, last)
    return True


def by_log_time(
    path: Path, chunks: Iterable[ChunkIndex], wanted: Callable[[ChunkIndex], bool], unpack: Unpack
) -> Iterator[McapRecord]:
    """Yield the records of the wanted chunks, messages by log time, a few chunks in memory.

    Args:
        path: The file.
        chunks: From `side_by_side`.
        wanted: Which of them are read.
        unpack: Gives the records of a chunk; of a corrupt one, none.
    """
    waiting: list[tuple[int, int, int, Message]] = []  # time, then the place in the file
    chosen = filter(wanted, chunks)
    with path.open("rb") as file:
        for chunk in sorted(chosen, key=lambda chunk: chunk.message_start_time):
            while waiting and waiting[0][0] < chunk.message_start_time:
                yield heapq.heappop(waiting)[-1]
            file.seek(chunk.chunk_start_offset + _HEAD)
            records = unpack(Chunk.read(ReadDataStream(file)))
            for place, record in enumerate(records):
                if isinstance(record, Message):
                    item = (record.log_time, chunk.chunk_start_offset, place, record)
                    heapq.heappush(waiting, item)
                else:
                    yield record
        while waiting:
            yield heapq.heappop(waiting)[-1]
