"""A result recording as it was run: each frame again, with what every stage made of it."""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping
from dataclasses import replace
from itertools import groupby
from pathlib import Path
from types import MappingProxyType
from typing import Any

import orjson
from google.protobuf.message import DecodeError
from mcap_protobuf.decoder import DecoderFactory
from pydantic import ValidationError

from mushpipe.core.edges import limited
from mushpipe.core.errors import InputError, UsageError
from mushpipe.core.manifest import sha256
from mushpipe.core.recording import MANIFEST, Index, Raw, RecordingReader
from mushpipe.core.settings import told
from mushpipe.core.types import Header, Mask, RgbdFrame, Trace
from mushpipe.core.wire import COLOR_TOPIC, NO_DEPTH, RESULT_PREFIX, TIMING_TOPIC, decode_table

_PARTS = ("initial", "color", "depth")  # images of an output, each on a topic of its own
LOST = 256  # results of so many frames without images are kept, in case those come later


def read_manifest(path: Path) -> dict[str, Any]:
    """Return what the run that wrote a recording was made of; empty where it does not say.

    Raises:
        InputError: What it says is no JSON object.
    """
    return stated(path, RecordingReader(path).index(), MANIFEST)


def stated(path: Path, index: Index, name: str) -> dict[str, Any]:
    """Return what a recording whose index was read says of itself under a name, or nothing.

    Raises:
        InputError: It is no JSON object.
    """
    stored = index.metadata.get(name, {})
    try:
        content = json.loads(stored.get("json", "{}"))
    except ValueError:
        content = None
    if not isinstance(content, dict):
        raise InputError(f"{path}: its metadata '{name}' hold no JSON object")
    return content


def stage_times(message: bytes) -> dict[str, int]:
    """Return the ns that each stage took, from a message on the topic of times.

    Raises:
        ValueError: It says nothing of the kind.
    """
    content = orjson.loads(message)
    times = content.get("stages_ns") if isinstance(content, dict) else None
    if not isinstance(times, dict) or not all(isinstance(ns, int) for ns in times.values()):
        raise ValueError("expected {stages_ns: {stage: ns}}")
    return times


def source_recording(results: Path, manifest: Mapping[str, Any]) -> Path | None:
    """Return the recording that results were made from, where it is still to be found.

    It counts only with the SHA-256 that the manifest states.
    """
    source = Path(str(manifest.get("graph", {}).get("source", {}).get("path", "")))
    played = (manifest.get("recordings") or [{}])[0]
    for path in (source, results.parent / source, results.parent / source.name):
        if path.is_file() and sha256(path) == played.get("sha256"):
            return path
    return None


def has_results(path: Path) -> bool:
    """Return whether a recording holds what stages put out."""
    topics = RecordingReader(path).index().channels
    return any(t.startswith(RESULT_PREFIX) and t != TIMING_TOPIC for t in topics)


def read_traces(path: Path, played: Mapping[str, Any] = MappingProxyType({})) -> Iterator[Trace]:
    """Yield every frame of a recording with what the stages made of it, in order.

    The images are those in the file or else those of the recording it was made from. A recording
    without results yields its frames alone; so does a frame that no stage answered.

    Args:
        path: The recording.
        played: Settings of the source `mcap` to play it with.

    Raises:
        UsageError: The images are not to be found, or another source than `mcap` played them.
        InputError: After the last good frame: one of the two files is damaged.
    """
    from mushpipe.sources.mcap import McapSource

    manifest = read_manifest(path)
    images: dict[str, Any] = {"path": path}
    if COLOR_TOPIC not in RecordingReader(path).index().channels and has_results(path):
        found = source_recording(path, manifest)
        if found is None:
            name = (manifest.get("recordings") or [{"file": "its recording"}])[0]["file"]
            raise UsageError(
                f"{path} holds no images, and {name} is neither at its old place nor beside it"
            )
        # as they were played, but once and at once: what was cut, chosen and calibrated alike
        given = dict(manifest["graph"]["source"])
        images = {k: given[k] for k in given if k not in ("use", "speed", "loop")} | {"path": found}
    order = list(manifest.get("graph", {}).get("stages", {}))
    reader = RecordingReader(path)
    results = _Results(reader)
    try:
        source = McapSource.model_validate({**images, **played})
    except ValidationError as error:
        raise UsageError(
            f"{path} holds no images, and those of {images['path']} were not played by the source "
            f"'mcap' ({told(error)}): run it again with 'frames: true' in its sink 'mcap'"
        ) from error
    for frame in limited(source.frames(), source):
        try:
            trace = _trace(frame, results.take(frame.header), order)
        except (ValueError, KeyError, TypeError, DecodeError) as error:
            at = f"the results of frame {frame.header.sequence}"
            raise InputError(f"{path}: {at} cannot be read: {error}") from error
        yield trace
    if reader.damage:
        raise InputError(f"{path} is damaged: {'; '.join(reader.damage)}")


def read_trace(path: Path, sequence: int) -> Trace:
    """Return the trace of the frame of that number.

    Raises:
        UsageError: There is no such frame, or the images are not to be found.
        InputError: The file is damaged before that frame.
    """
    seen = []
    for trace in read_traces(path):
        if trace.frame.header.sequence == sequence:
            return trace
        seen.append(trace.frame.header.sequence)
    raise UsageError(f"{path}: there is no frame {sequence}; it holds {seen[0]} to {seen[-1]}")


class _Results:
    """The results of a recording, frame by frame.

    They come as they were written, the frames by log time within a chunk, which may go back: what
    is read too early waits.
    """

    def __init__(self, reader: RecordingReader) -> None:
        topics = {t for t in reader.index().channels if t.startswith(RESULT_PREFIX)}
        messages = reader.messages(topics, as_written=True) if topics else ()
        self._groups = groupby(
            messages, lambda raw: (raw.message.sequence, raw.message.publish_time)
        )
        self._waiting: dict[tuple[int, int], list[Raw]] = {}
        self._read = self._asked = -1  # numbers of frames

    def take(self, header: Header) -> list[Raw]:
        """Return the messages of a frame, none where there are none; stamps may stand still."""
        wanted = header.sequence, header.stamp_ns
        if header.sequence < self._asked:  # numbers began anew, or frames are turned round
            self._read = -1
        self._asked = header.sequence
        while wanted not in self._waiting and self._read < header.sequence:
            key, group = next(self._groups, (None, ()))
            if key is None:
                break
            self._waiting.setdefault(key, []).extend(group)
            self._read = key[0]
            if len(self._waiting) > LOST:
                del self._waiting[next(iter(self._waiting))]
        return self._waiting.pop(wanted, [])


def _trace(frame: RgbdFrame, messages: list[Raw], order: list[str]) -> Trace:
    """Put the messages of one frame together again."""
    outputs: dict[str, tuple[Any, ...]] = dict.fromkeys(order, ())
    durations: dict[str, int] = {}
    images: dict[str, dict[str, Any]] = {}
    for raw in messages:
        stage, _, part = raw.channel.topic.removeprefix(RESULT_PREFIX).partition("/")
        schema = raw.schema.name if raw.schema else ""
        if raw.channel.topic == TIMING_TOPIC:
            durations = stage_times(raw.message.data)
        elif (decoded := decode_table(raw.table, raw.message.data)) is not None:
            outputs[stage] = (*outputs.get(stage, ()), decoded.table)
        elif schema == "foxglove.RawImage" and (image := _image(raw)) is not None:
            # what is not a stage's first output stands below its type
            name = part.rpartition("/")[2]
            images.setdefault(stage, {})[name if name in _PARTS else ""] = image
            if NO_DEPTH.items() <= raw.channel.metadata.items():
                images[stage]["depth"] = (None, frame.depth_scale)
    last = frame
    for stage, parts in images.items():
        values = list(_of_images(last, parts))
        last = next((value for value in values if isinstance(value, RgbdFrame)), last)
        outputs[stage] = (*values, *outputs.get(stage, ()))
    return Trace(frame, {stage: values for stage, values in outputs.items() if values}, durations)


def _image(raw: Raw) -> Any:
    from mushpipe.sources.images import decode_color, decode_depth

    decoder = DecoderFactory().decoder_for(raw.channel.message_encoding, raw.schema)
    if decoder is None:
        raise InputError(f"{raw.channel.topic}: {raw.channel.message_encoding} cannot be decoded")
    message = decoder(raw.message.data)
    if message.encoding in ("rgb8", "mono8"):
        return decode_color(message)
    scale = raw.channel.metadata.get("depth_scale")
    return None if scale is None else decode_depth(message, float(scale))


def _of_images(last: RgbdFrame, parts: Mapping[str, Any]) -> Iterator[Mask | RgbdFrame]:
    """Yield the mask a stage's images are, and the frame they make of the last one before it."""
    if "" in parts:  # else the mask was lost
        yield Mask(*(parts[name][..., 0] > 0 for name in ("", "initial") if name in parts))
    if "color" in parts or "depth" in parts:
        depth, scale = parts.get("depth", (last.depth, last.depth_scale))
        color = parts.get("color", last.color)
        yield replace(last, color=color, depth=depth, depth_scale=scale)
