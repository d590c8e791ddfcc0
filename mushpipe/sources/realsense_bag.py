"""How many images a `.bag` claims to hold, from its index.

librealsense's player stops without a word where a file is damaged; only this count tells.
The format is ROS bag 2.0: records of a header (fields ``name=value``) and data, each with its
length in front; behind the position that the first record names, one record per connection and
one per chunk.
"""

from __future__ import annotations

import struct
from collections import Counter
from pathlib import Path
from typing import BinaryIO

_MAGIC = b"#ROSBAG V2.0\n"
_CONNECTION, _CHUNK_INFO = b"\x07", b"\x06"


def count_color_images(path: Path) -> int:
    """Return the number of colour images, 0 where there is none.

    Raises:
        ValueError: The file has no index.
    """
    topics: dict[int, bytes] = {}
    counts: Counter[int] = Counter()
    try:
        with path.open("rb") as file:
            if file.read(len(_MAGIC)) != _MAGIC:
                raise ValueError("not a ROS bag")
            first, _ = _record(file)
            file.seek(*struct.unpack("<Q", first[b"index_pos"]))
            while file.peek(1):
                header, data = _record(file)
                if header[b"op"] == _CONNECTION:
                    topics[int.from_bytes(header[b"conn"], "little")] = header[b"topic"]
                elif header[b"op"] == _CHUNK_INFO:
                    for connection, count in struct.iter_unpack("<II", data):
                        counts[connection] += count
    except (struct.error, LookupError) as error:
        raise ValueError(f"no index: {error}") from error
    return sum(
        counts[number] for number, topic in topics.items() if b"/Color_0/image/data" in topic
    )


def _record(file: BinaryIO) -> tuple[dict[bytes, bytes], bytes]:
    fields, header = {}, _block(file)
    while header:
        (length,) = struct.unpack_from("<I", header)
        name, _, value = header[4 : 4 + length].partition(b"=")
        fields[name] = value
        header = header[4 + length :]
    return fields, _block(file)


def _block(file: BinaryIO) -> bytes:
    (length,) = struct.unpack("<I", file.read(4))
    return file.read(length)
