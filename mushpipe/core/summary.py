"""Whether the summary of an MCAP file can be believed: else the whole file has to be read."""

from __future__ import annotations

import os
import struct
import zlib
from typing import BinaryIO

from mcap.opcode import Opcode
from mcap.records import Statistics
from mcap.summary import Summary

# opcode, length, start of the summary, start of its offsets, CRC of all from that start to here
_FOOTER = struct.Struct("<BQQQI")
_RECORD = struct.Struct("<BQ")  # opcode and length, before the content


def is_intact(file: BinaryIO) -> bool:
    """Return whether a file's summary has the CRC that is stated or, without one, its length.

    Raises:
        ValueError: There is no summary.
    """
    end = file.seek(-_FOOTER.size - 8, os.SEEK_END)
    start, _, crc = _FOOTER.unpack(file.read(_FOOTER.size))[2:]
    if not 0 < start <= end:
        raise ValueError("no summary")
    file.seek(start)
    if not crc:
        return _leads_to(file, start, end)
    return bool(zlib.crc32(file.read(end + _FOOTER.size - 4 - start)) == crc)


def _leads_to(file: BinaryIO, start: int, end: int) -> bool:
    """Return whether records fill a file from one place to another.

    Of a bag that stands twice in one file, the last footer names the summary of the first.
    """
    while start < end:
        file.seek(start)
        opcode, length = _RECORD.unpack(file.read(_RECORD.size))
        if opcode in (0, Opcode.FOOTER):
            return False
        start += _RECORD.size + length
    return start == end


def require_complete(summary: Summary, statistics: Statistics) -> None:
    """Raise ValueError where a summary leaves out what it may."""
    stated = {
        "counts": bool(statistics.channel_message_counts) or not statistics.message_count,
        "schemas": all(c.schema_id in (0, *summary.schemas) for c in summary.channels.values()),
        "metadata": statistics.metadata_count == len(summary.metadata_indexes),
        "attachments": statistics.attachment_count == len(summary.attachment_indexes),
    }
    if missing := [name for name, whole in stated.items() if not whole]:
        raise ValueError(f"the summary lacks {', '.join(missing)}")
