"""Source `mcap`: plays mushpipe's own recordings and ROS 2 bags of realsense2_camera."""

from __future__ import annotations

import logging
from collections import Counter, deque
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any, TypeVar

from mcap_protobuf.decoder import DecoderFactory as ProtobufDecoders
from mcap_ros2.decoder import DecoderFactory as Ros2Decoders
from pydantic import BaseModel, ConfigDict, Field, PrivateAttr

from mushpipe.core.errors import InputError
from mushpipe.core.geometry import Camera
from mushpipe.core.recording import GRAPH, MANIFEST, Index, Raw, RecordingReader
from mushpipe.core.stage import GraphPath, ReplaySource
from mushpipe.core.types import Header, RgbdFrame
from mushpipe.sources.images import decode_camera, decode_color, decode_depth
from mushpipe.sources.pairing import Pairing
from mushpipe.sources.topics import Topics, choose_topics

T = TypeVar("T")
logger = logging.getLogger("mushpipe")
NO_DEPTH = "%s has no depth: positions, distances and diameters will be missing"
NO_CAMERA = "%s has no calibration: nothing can be measured in metres"


class Intrinsics(BaseModel):
    """A pinhole camera without distortion, for recordings that carry no calibration."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    fx: float = Field(gt=0, description="focal length along x, px")
    fy: float = Field(gt=0, description="focal length along y, px")
    cx: float = Field(description="principal point, x, px")
    cy: float = Field(description="principal point, y, px")


class McapSource(ReplaySource):
    """Plays an MCAP recording, losing nothing and in order.

    Reads Foxglove messages (mushpipe's own recordings) and ROS 2 ones (CDR). Depth must be
    aligned to colour. A damaged file is played as far as it goes and then reported (exit code 4).
    """

    path: GraphPath = Field(description="the recording")
    start: float = Field(0.0, ge=0, description="skip so many seconds of the recording")
    end: float | None = Field(None, gt=0, description="stop at this second of the recording")
    loop: int = Field(1, ge=0, description="how many times to play it; 0 is for ever")
    color_topic: str | None = Field(None, description="colour images; chosen by name if not given")
    depth_topic: str | None = Field(None, description="depth images aligned to colour")
    camera_topic: str | None = Field(None, description="calibration of the colour images")
    use_depth: bool = Field(True, description="false plays colour only")
    depth_scale: float | None = Field(
        None, gt=0, description="metres per unit of depth, where the recording does not say it"
    )
    pair_tolerance_ms: float = Field(
        15.0, ge=0, description="largest difference of the stamps of a colour and a depth image"
    )
    camera: Intrinsics | None = Field(
        None, description="intrinsics, in place of those of the recording"
    )

    _counts: Counter[str] = PrivateAttr(default_factory=Counter)
    _first_error: str = PrivateAttr("")

    def name(self) -> str:
        """Return the recording's file name without its suffix."""
        return self.path.stem

    def files(self) -> tuple[Path, ...]:
        """Return the recording."""
        return (self.path,)

    def open(self) -> None:
        """Check that the file is there and is MCAP.

        Raises:
            UsageError: There is no such file.
            InputError: It is empty or not MCAP.
        """
        RecordingReader(self.path)

    def counts(self) -> dict[str, int]:
        """Return how many images found no partner or could not be decoded."""
        return {name: count for name, count in sorted(self._counts.items()) if count}

    def frames(self) -> Iterator[RgbdFrame]:
        """Yield the frames of the recording.

        Raises:
            InputError: Not a recording, no colour images or no frame in the range; depth or
                calibration do not fit the images; or, after the last good frame, damage.
        """
        reader = RecordingReader(self.path)
        index = reader.index()
        if not index.counts and reader.damage:
            raise InputError(f"{self.path}: {'; '.join(reader.damage)}; nothing could be read")
        topics = choose_topics(
            index, self.path, self.color_topic, self.depth_topic, self.camera_topic
        )
        if not self.use_depth:
            topics = replace(topics, depth=None)
        yield from self._passes(_Player(self, reader, index, topics, self._counts), reader)

    def _passes(self, player: _Player, reader: RecordingReader) -> Iterator[RgbdFrame]:
        delivered = turn = shift = shift_ns = 0
        while turn < self.loop or self.loop == 0:
            first = last = None
            for frame in player.play():
                header = frame.header
                first, last = first or header, header
                if turn:
                    header = replace(
                        header,
                        stamp_ns=header.stamp_ns + shift_ns,
                        arrival_ns=header.arrival_ns + shift_ns,
                        sequence=header.sequence + shift,
                    )
                yield replace(frame, header=header)
                delivered += 1
            if first is None or last is None or reader.damage or player.error:
                break
            turn += 1
            # Numbers and time go on in the next turn, one average frame after the last one.
            shift += last.sequence - first.sequence + 1
            span = last.stamp_ns - first.stamp_ns
            shift_ns += span + span // max(1, player.frames - 1) if span else 33_333_333
        damage = [*reader.damage, *([player.error] if player.error else [])]
        if damage:
            raise InputError(
                f"{self.path} is damaged: {'; '.join(damage)}; {delivered} frames could be read"
            )
        if not delivered:
            raise InputError(f"{self.path}: there is no frame in the chosen range")


class _Player:
    """Plays a recording once."""

    def __init__(
        self,
        settings: McapSource,
        reader: RecordingReader,
        index: Index,
        topics: Topics,
        counts: Counter[str],
    ) -> None:
        self.settings = settings
        self.reader = reader
        self.topics = topics
        self.counts = counts
        self.numbered = MANIFEST in index.metadata or GRAPH in index.metadata
        # Without a start nothing is skipped, so that nothing can be lost unnoticed.
        self.start_ns = index.start_ns + round(settings.start * 1e9) if settings.start else 0
        end = settings.end
        self.end_ns = None if end is None else index.start_ns + round(end * 1e9)
        self.error = ""
        self.frames = 0
        self.size: tuple[int, ...] | None = None
        self._factories = (ProtobufDecoders(), Ros2Decoders())
        self.first_camera = self.camera = self._first_camera()
        if topics.depth is None:
            logger.warning(NO_DEPTH, settings.path.name)
        if self.camera is None and settings.camera is None:
            logger.warning(NO_CAMERA, settings.path.name)

    def play(self) -> Iterator[RgbdFrame]:
        tolerance_ns = round(self.settings.pair_tolerance_ms * 1e6)
        pairing: Pairing[_Color, _Depth] = Pairing(tolerance_ns)
        wanted = {t for t in vars(self.topics).values() if t is not None}
        self.frames = 0
        self.camera = self.first_camera
        for raw in self.reader.messages(wanted, self.start_ns, self.end_ns):
            if raw.channel.topic == self.topics.camera:
                self.camera = self._decode(raw, _calibration, "calibrations") or self.camera
            elif raw.channel.topic == self.topics.depth:
                depth = self._decode(raw, self._depth)
                if depth:
                    yield from self._frames(pairing.add_depth(depth[0], depth[1]))
            else:
                color = self._decode(raw, self._color)
                if color and self.topics.depth is None:
                    yield self._frame(color, None)
                elif color:
                    yield from self._frames(pairing.add_color(color[0].stamp_ns, color))
        yield from self._frames(pairing.finish())
        self.counts["colour images without depth"] += pairing.color_alone
        self.counts["depth images without colour"] += pairing.depth_alone

    def _first_camera(self) -> Camera | None:
        """Return the calibration in force at the start, which may be recorded after it."""
        if self.topics.camera is None:
            return None
        topic = {self.topics.camera}
        before = self.reader.messages(topic, 0, self.start_ns + 1) if self.start_ns else ()
        first = next(iter(deque(before, maxlen=1)), None)
        first = first or next(self.reader.messages(topic), None)
        return self._decode(first, _calibration, "") if first else None

    def _decode(
        self, raw: Raw, decode: Callable[[Any, Raw], T | None], what: str = "images"
    ) -> T | None:
        """Decode a message, or return None and count it where ``what`` says as what."""
        try:
            for factory in self._factories:
                decoder = factory.decoder_for(raw.channel.message_encoding, raw.schema)
                if decoder is not None:
                    return decode(decoder(raw.message.data), raw)
            raise ValueError(f"message encoding '{raw.channel.message_encoding}' is not supported")
        except Exception as error:  # whatever a decoder makes of foreign bytes
            if what:
                self.counts[f"{what} that could not be decoded"] += 1
            self.error = self.error or f"{raw.channel.topic}: {error}"
            return None

    def _color(self, message: Any, raw: Raw) -> _Color:
        stamp_ns, frame_id = _stamp(message, raw)
        header = Header(stamp_ns, raw.message.sequence, frame_id, raw.message.log_time)
        return header, decode_color(message)

    def _depth(self, message: Any, raw: Raw) -> tuple[int, _Depth]:
        stated = raw.channel.metadata.get("depth_scale")
        scale = self.settings.depth_scale or (float(stated) if stated else None)
        stamp_ns, frame_id = _stamp(message, raw)
        return stamp_ns, (frame_id, *decode_depth(message, scale))

    def _frames(self, pairs: Iterator[tuple[_Color, _Depth | None]]) -> Iterator[RgbdFrame]:
        return (self._frame(color, depth) for color, depth in pairs)

    def _frame(self, color: _Color, depth: _Depth | None) -> RgbdFrame:
        header, image = color
        sequence = header.sequence if self.numbered else self.frames
        header = replace(header, sequence=sequence)
        self.frames += 1
        if depth and depth[0] != header.frame_id and "aligned" not in (self.topics.depth or ""):
            raise InputError(
                f"{self.settings.path}: depth ({self.topics.depth}) is in frame '{depth[0]}', "
                f"colour in '{header.frame_id}': depth must be aligned to colour; record "
                "aligned_depth_to_color, or play without depth: --set source.use_depth=false"
            )
        self._watch_size(image.shape[:2], sequence)
        try:
            native, scale = depth[1:] if depth else (None, 0.001)
            return RgbdFrame(header, image, native, scale, self._camera(image.shape[:2]))
        except ValueError as error:
            raise InputError(f"{self.settings.path}, frame {sequence}: {error}") from error

    def _camera(self, size: tuple[int, ...]) -> Camera | None:
        given = self.settings.camera
        if given is None:
            return self.camera
        return Camera(size[1], size[0], given.fx, given.fy, given.cx, given.cy)

    def _watch_size(self, size: tuple[int, ...], sequence: int) -> None:
        if self.size not in (None, size) and self.size:
            old, new = (f"{s[1]}x{s[0]}" for s in (self.size, size))
            logger.warning("the frame size changes from %s to %s at frame %d", old, new, sequence)
        self.size = size


_Color = tuple[Header, Any]
_Depth = tuple[str, Any, float]


def _calibration(message: Any, raw: Raw) -> Camera | None:
    del raw
    return decode_camera(message)


def _stamp(message: Any, raw: Raw) -> tuple[int, str]:
    """Return sensor time and frame; a stamp that was never set gives way to the publish time."""
    if hasattr(message, "header"):
        stamp = message.header.stamp
        nanoseconds, frame_id = stamp.sec * 10**9 + stamp.nanosec, message.header.frame_id
    else:
        stamp = message.timestamp
        nanoseconds, frame_id = stamp.seconds * 10**9 + stamp.nanos, message.frame_id
    return nanoseconds or raw.message.publish_time, frame_id
