"""Differences between two result recordings, message by message and field by field."""

from __future__ import annotations

import math
from collections import Counter, defaultdict
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from fnmatch import fnmatchcase
from itertools import zip_longest
from pathlib import Path
from types import MappingProxyType
from typing import Any, NamedTuple

import numpy as np
import orjson
from google.protobuf.message import DecodeError
from mcap_protobuf.decoder import DecoderFactory

from mushpipe.core import wire
from mushpipe.core.errors import InputError, UsageError
from mushpipe.core.recording import Raw, RecordingReader

Values = dict[tuple[int, ...], Any]
"""The values on one path of a message, by their indices in the lists on the way."""
Fields = dict[str, Any]
"""By path: the pixels of an image, else `Values`."""
_IMAGE, _COMPRESSED = "foxglove.RawImage", "foxglove.CompressedImage"
_PIXELS = {"mono8": "u1", "rgb8": "u1", "mono16": "<u2", "16UC1": "<u2", "32FC1": "<f4"}

# One for each schema: they know it by its id, which differs between recordings.
_DECODERS: dict[tuple[str, bytes], DecoderFactory] = defaultdict(DecoderFactory)


class Key(NamedTuple):
    """What two recordings must both hold to be compared there."""

    topic: str
    stamp_ns: int
    sequence: int
    occurrence: int


@dataclass(frozen=True)
class Difference:
    """One field of one message that is not the same; ``field`` is empty for a whole message."""

    topic: str
    field: str
    sequence: int
    text: str


@dataclass
class Comparison:
    """What was compared, and what differs."""

    messages: int = 0
    topics: set[str] = field(default_factory=set)
    differences: list[Difference] = field(default_factory=list)


def compare(
    a: Path,
    b: Path,
    tolerance: float = 0.0,
    topics: str = "*",
    limits: Mapping[str, float] = MappingProxyType({}),
) -> Comparison:
    """Compare two recordings; the time the stages took and what is drawn of results are left out.

    Messages belong together by topic, sensor time and sequence, in whatever order they stand.

    Args:
        a: A recording.
        b: Another.
        tolerance: Numbers x and y with a decimal point are the same where
            |x - y| <= tolerance (1 + |y|), images where at most this share of their pixels
            differs. 0 is exact, as are whole numbers, truth values and texts always.
        topics: Only topics that match, as in a shell.
        limits: By field, what its numbers may differ by, in their unit, in place of the tolerance.

    Raises:
        UsageError: There is no such file, or they hold nothing to compare.
        InputError: One of them cannot be read to its end, or a message of it not at all.
    """
    result = Comparison()
    readers = RecordingReader(a), RecordingReader(b)
    waiting: tuple[dict[Key, Raw], dict[Key, Raw]] = {}, {}
    for pair in zip_longest(*(_keyed(reader, topics) for reader in readers)):
        for side, keyed in enumerate(pair):
            if keyed is None:
                continue
            key, raw = keyed
            partner = waiting[1 - side].pop(key, None)
            if partner is None:
                waiting[side][key] = raw
                continue
            result.messages += 1
            result.topics.add(key.topic)
            ours, theirs = (raw, partner) if side == 0 else (partner, raw)
            result.differences += _of_messages(key, ours, theirs, (a, b), tolerance, limits)
    for reader, rest in zip(readers, waiting, strict=True):
        if reader.damage:
            raise InputError(f"{reader.path} is damaged: {'; '.join(reader.damage)}")
        text = f"only in {reader.path}"
        result.differences += [Difference(k.topic, "", k.sequence, text) for k in rest]
    if not result.messages and not result.differences:
        raise UsageError(f"{a} and {b} hold nothing on topics '{topics}': nothing was compared")
    return result


def _keyed(reader: RecordingReader, topics: str) -> Iterator[tuple[Key, Raw]]:
    seen: Counter[tuple[str, int, int]] = Counter()
    for raw in reader.messages():
        topic, message = raw.channel.topic, raw.message
        derived = raw.schema is not None and raw.schema.name in wire.DRAWINGS
        if derived or topic == wire.TIMING_TOPIC or not fnmatchcase(topic, topics):
            continue
        place = (topic, message.publish_time, message.sequence)
        yield Key(*place, seen[place]), raw
        seen[place] += 1


def _of_messages(
    key: Key,
    a: Raw,
    b: Raw,
    paths: tuple[Path, Path],
    tolerance: float,
    limits: Mapping[str, float],
) -> Iterator[Difference]:
    if a.message.data == b.message.data and a.channel.metadata == b.channel.metadata:
        return
    ours, theirs = (_read(raw, path) for raw, path in zip((a, b), paths, strict=True))
    for name, text in _of_fields(ours, theirs, tolerance, limits):
        yield Difference(key.topic, name, key.sequence, text)


def _read(raw: Raw, path: Path) -> Fields:
    """Return the fields of a message; a file that was written well may hold any bytes in it."""
    try:
        return _fields(raw)
    except (ValueError, KeyError, TypeError, DecodeError) as error:
        at = f"a message on {raw.channel.topic}, sequence {raw.message.sequence},"
        raise InputError(f"{path}: {at} cannot be read: {error}") from error


def _of_fields(
    ours: Fields,
    theirs: Fields,
    tolerance: float,
    limits: Mapping[str, float] = MappingProxyType({}),
) -> Iterator[tuple[str, str]]:
    for name in ours | theirs:
        if name not in ours or name not in theirs:
            text: str | None = f"is only in the {'first' if name in ours else 'second'}"
        else:
            text = _difference(ours[name], theirs[name], tolerance, limits.get(name))
        if text:
            yield name, text


def _fields(raw: Raw) -> Fields:
    # such as the unit of a depth image
    beside = {f"metadata.{name}": {(): text} for name, text in raw.channel.metadata.items()}
    return beside | _content(raw)


def _content(raw: Raw) -> Fields:
    data = raw.message.data
    if raw.channel.message_encoding == "json":
        return _by_path(orjson.loads(data))
    message = _decoded(raw)
    if message is None:
        return {"bytes": {(): data}}
    name = raw.schema.name if raw.schema else ""
    if name == _IMAGE and message.encoding in _PIXELS:
        pixels = np.frombuffer(message.data, _PIXELS[message.encoding])
        return _image(pixels, message.width, message.height, message.encoding, message.frame_id)
    if name == _COMPRESSED and (decoded := _decompressed(message.data)) is not None:
        height, width = decoded.shape[:2]
        return _image(decoded.ravel(), width, height, message.format, message.frame_id)
    from google.protobuf.json_format import MessageToDict

    # A field that is zero stands in no protobuf message.
    return _by_path(MessageToDict(message, always_print_fields_with_no_presence=True))


def _image(
    values: np.ndarray[Any, Any], width: int, height: int, encoding: str, frame_id: str
) -> Fields:
    area = width * height
    pixels = values.reshape(area, -1) if area and len(values) % area == 0 else values
    beside = _by_path({"size": [width, height, encoding], "frame_id": frame_id})
    return {**beside, "pixels": pixels}


def _decompressed(data: bytes) -> np.ndarray[Any, Any] | None:
    """Return the pixels of a JPEG or PNG; None where it cannot be read."""
    import cv2

    encoded = np.frombuffer(data, np.uint8)
    return cv2.imdecode(encoded, cv2.IMREAD_UNCHANGED) if len(encoded) else None


def _decoded(raw: Raw) -> Any:
    if raw.schema is None:
        return None
    decoders = _DECODERS[raw.schema.name, raw.schema.data]
    decode = decoders.decoder_for(raw.channel.message_encoding, raw.schema)
    return decode(raw.message.data) if decode else None


def _by_path(value: Any) -> Fields:
    """Return all values of nested JSON by path, and those of one path by their indices."""
    found: dict[str, Values] = {}

    def walk(item: Any, path: str, at: tuple[int, ...]) -> None:
        if isinstance(item, dict) and item:
            for key, inner in item.items():
                walk(inner, f"{path}.{key}" if path else key, at)
        elif isinstance(item, list) and item:
            for index, inner in enumerate(item):
                walk(inner, path, (*at, index))
        else:
            found.setdefault(path, {})[at] = item

    walk(value, "", ())
    return found


def _difference(a: Any, b: Any, tolerance: float, limit: float | None = None) -> str | None:
    """Say how two fields differ; None where they do not."""
    if isinstance(a, np.ndarray):
        if len(a) != len(b):
            return f"{len(a)} pixels against {len(b)}"
        if a.shape != b.shape:
            return f"{a[0].size} channels against {b[0].size}"
        # unknown is the same only as unknown
        apart = (a != b) & ~((a != a) & (b != b))
        different = int(np.count_nonzero(apart.any(axis=tuple(range(1, apart.ndim)))))
        return f"{different} of {len(a)} pixels" if different > tolerance * len(a) else None
    if a.keys() != b.keys():
        number, other = _count(a), _count(b)
        return f"{number} values against {other}" if number != other else "nested in another way"
    apart = {at: _apart(a[at], b[at], tolerance, limit) for at in a}
    far = [at for at, distance in apart.items() if distance > 0]
    if not far:
        return None
    worst = max(far, key=lambda at: apart[at])
    place = "".join(f"[{index}]" for index in worst)
    where = f"{len(far)} of {len(a)} values, at worst {place}: " if place else ""
    return f"{where}{_short(a[worst])} against {_short(b[worst])}"


def _count(values: Values) -> int:
    return sum(value not in ([], {}) for value in values.values())


def _apart(x: Any, y: Any, tolerance: float, limit: float | None) -> float:
    """Return how far two values are apart, 0 where they are the same.

    The tolerance is for what was measured, and so has a decimal point: an id, a flag or a kind
    that is nearly right is another one.
    """
    kinds = {type(x), type(y)}
    if kinds in ({float}, {float, int}):
        apart = abs(x - y)
        allowed = tolerance * (1 + abs(y)) if limit is None else limit
        return apart if apart > allowed else 0.0
    return 0.0 if len(kinds) == 1 and x == y else math.inf


def _short(value: Any) -> str:
    text = str(value)
    return text if len(text) <= 60 else text[:57] + "..."
