"""Recorded messages to frames: decoded, paired, calibrated and numbered."""

from __future__ import annotations

import logging
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Set
from dataclasses import dataclass, replace
from itertools import starmap
from typing import Any, TypeVar

import numpy as np

from mushpipe.core import wire
from mushpipe.core.arrays import Bytes
from mushpipe.core.errors import InputError
from mushpipe.core.geometry import Camera
from mushpipe.core.recording import Raw
from mushpipe.core.types import Header, RgbdFrame
from mushpipe.sources.calibration import Calibration, Recorded
from mushpipe.sources.decoding import Decoder
from mushpipe.sources.images import decode_color, decode_depth
from mushpipe.sources.pairing import Pairing
from mushpipe.sources.recorded import RecordedSource
from mushpipe.sources.topics import Topics, says_aligned

T = TypeVar("T")
logger = logging.getLogger("mushpipe")
MOST_BESIDE = 256  # frames of which something waits that was recorded beside them
_ALIGN = (
    "depth must be aligned to colour; record aligned_depth_to_color, or play without depth: "
    "--set source.use_depth=false"
)


class Player:
    """Turns messages into frames, of one recording or stream.

    Args:
        settings: How to decode them.
        name: What messages call the recording.
        topics: Which messages are colour, depth and calibration.
        beside: Topics to pass on with the frame of the same stamp, as they are.
        numbered: Whether sequence numbers are the frames' own; else they are counted.
        counts: Where images without a partner and undecodable ones are counted.

    Attributes:
        calibration: That in force.
        error: The first message that could not be decoded, and why.
        frames: How many were made.
    """

    def __init__(
        self,
        settings: RecordedSource,
        name: str,
        topics: Topics,
        beside: Set[str],
        numbered: bool,
        counts: Counter[str],
    ) -> None:
        self.settings = settings
        self.name = name
        self.topics = topics
        self.beside = beside
        self.numbered = numbered
        self.counts = counts
        self.calibration = Calibration(settings, topics, self._warn)
        self.error = ""
        self.frames = 0
        self._first: tuple[int, ...] | None = None  # size of the first image
        self._size: tuple[int, ...] | None = None  # of the last
        self._decoder = Decoder()
        self._warned: set[str] = set()
        self._last: _Color | None = None
        self._found_beside: dict[tuple[int, int], dict[str, wire.Message]] = {}

    def wanted(self) -> set[str]:
        """Return the topics of the messages that `play` takes."""
        named = (self.topics.color, self.topics.depth, self.calibration.topic)
        return {topic for topic in named if topic is not None} | self.beside

    def play(self, messages: Iterable[Raw], hold: bool) -> Iterator[RgbdFrame]:
        """Yield the frames of some messages.

        Args:
            messages: Of the topics `wanted`, in order.
            hold: Whether to keep a frame back until the next image: what belongs to it may come
                after its images, as truth does, and in a bag of ROS its calibration. In a stream,
                it comes before them.
        """
        pairing: Pairing[_Color, _Depth] = Pairing(round(self.settings.pair_tolerance_ms * 1e6))
        ready: list[tuple[_Color, _Depth | None]] = []
        for raw in messages:
            if raw.channel.topic in self.beside:
                self._put_beside(raw)
                continue
            if raw.channel.topic == self.calibration.topic:
                self.calibrate(raw, "calibrations")
                continue
            yield from starmap(self._frame, ready)
            ready = list(self._take(raw, pairing))
            if not hold:
                yield from starmap(self._frame, ready)
                ready = []
        yield from starmap(self._frame, (*ready, *pairing.finish()))
        if min(pairing.color_alone, pairing.depth_alone) > self.frames / 2:
            self._warn(
                f"most colour and depth images are without a partner: their stamps differ by more "
                f"than source.pair_tolerance_ms, {self.settings.pair_tolerance_ms:g}, or they lie "
                f"more than {Pairing.PATIENCE} images apart in the file; where one of both is only "
                "later, set it higher; where one topic was written behind the other, sort the file "
                "by time ('mcap sort')"
            )
        self.counts["colour images without depth"] += pairing.color_alone
        self.counts["depth images without colour"] += pairing.depth_alone

    def _take(
        self, raw: Raw, pairing: Pairing[_Color, _Depth]
    ) -> Iterator[tuple[_Color, _Depth | None]]:
        number = raw.message.sequence if self.numbered else 0
        if raw.channel.topic == self.topics.depth:
            depth = self._decode(raw, self._depth)
            if depth:
                yield from pairing.add_depth(*depth, number)
            return
        self._last = color = self._decode(raw, self._color)
        if color and self.topics.depth is None:
            yield color, None
        elif color:
            yield from pairing.add_color(color.header.stamp_ns, color, number)

    def _put_beside(self, raw: Raw) -> None:
        given = raw.schema
        name, encoding, data = (given.name, given.encoding, given.data) if given else ("", "", b"")
        schema = wire.Schema(name, encoding, data, raw.channel.message_encoding)
        message = wire.Message("", schema, raw.message.data, raw.channel.metadata)
        place = (raw.message.publish_time, raw.message.sequence)  # stamps may stand still
        found = self._found_beside.setdefault(place, {})
        found[raw.channel.topic] = message

    def _with_beside(self, frame: RgbdFrame) -> RgbdFrame:
        place = (frame.header.stamp_ns, frame.header.sequence)
        attached = self._found_beside.get(place, {})
        # What came before it belongs to frames that are lost; stamps do not tell: they may go back.
        while len(self._found_beside) > MOST_BESIDE or place in self._found_beside:
            del self._found_beside[next(iter(self._found_beside))]
        return replace(frame, attached=attached) if attached else frame

    def calibrate(self, raw: Raw, what: str = "") -> Camera | None:
        """Decode a calibration, which holds from now on, also where it says that there is none.

        After one that cannot be decoded none is known; it is counted where ``what`` says as what.
        """

        def read(message: Any, raw: Raw) -> Camera | None:
            return self.calibration.read(message, *_stamp(message, raw))

        self.calibration.camera = self._decode(raw, read, what)
        self.calibration.stated = True
        # Drivers of ROS send it behind its image, mushpipe before.
        last = None if self.numbered else self._last
        if last and last.header.stamp_ns == self.calibration.stamp_ns:
            last.recorded = self.calibration.recorded()
        return self.calibration.camera

    def _warn(self, text: str) -> None:
        """Say something once."""
        if text not in self._warned:
            self._warned.add(text)
            logger.warning("%s: %s", self.name, text)

    def _decode(
        self, raw: Raw, decode: Callable[[Any, Raw], T | None], what: str = "images"
    ) -> T | None:
        """Decode a message, or return None and count it where ``what`` says as what."""
        try:
            return decode(self._decoder.decode(raw), raw)
        except Exception as error:  # whatever a decoder makes of foreign bytes
            if what:
                self.counts[f"{what} that could not be decoded"] += 1
            self.error = self.error or f"{raw.channel.topic}: {error}"
            return None

    def _color(self, message: Any, raw: Raw) -> _Color:
        stamp_ns, frame_id = _stamp(message, raw)
        header = Header(stamp_ns, raw.message.sequence, frame_id, raw.message.log_time)
        return _Color(header, decode_color(message), self.calibration.recorded())

    def _depth(self, message: Any, raw: Raw) -> tuple[int, _Depth]:
        stated = raw.channel.metadata.get("depth_scale")
        asked = self.settings.depth_scale
        scale = float(stated) if stated else asked
        # RealSense states its scale in single precision
        if asked is not None and scale and np.float32(scale) != np.float32(asked):
            text = f"it states a depth scale of {scale:g} m, which source.depth_scale ({asked:g})"
            self._warn(f"{text} does not change")
        stamp_ns, frame_id = _stamp(message, raw)
        return stamp_ns, (frame_id, *decode_depth(message, scale))

    def _frame(self, color: _Color, depth: _Depth | None) -> RgbdFrame:
        image, size = color.image, color.image.shape[:2]
        sequence = color.header.sequence if self.numbered else self.frames
        header = replace(color.header, sequence=sequence)
        self.frames += 1
        aligned = says_aligned(self.topics.depth or "", self.topics.color)
        if depth and depth[0] != header.frame_id and not aligned:
            raise InputError(
                f"{self.name}: depth ({self.topics.depth}) is in frame '{depth[0]}', "
                f"colour in '{header.frame_id}': {_ALIGN}"
            )
        if depth and depth[1].shape != size:
            (h, w), (high, wide) = depth[1].shape, size
            sizes = f"depth ({self.topics.depth}) is {w}x{h}, colour {wide}x{high}"
            raise InputError(f"{self.name}, frame {sequence}: {sizes}: {_ALIGN}")
        self._watch_size(size, sequence)
        try:
            native, scale = depth[1:] if depth else (None, 0.001)
            stated = (size, self._first or size, header.frame_id, color.recorded)
            frame = RgbdFrame(header, image, native, scale, self.calibration.of_image(*stated))
        except (ValueError, InputError) as error:
            raise InputError(f"{self.name}, frame {sequence}: {error}") from error
        return self._with_beside(frame)

    def _watch_size(self, size: tuple[int, ...], sequence: int) -> None:
        if self._size and self._size != size:
            old, new = (f"{s[1]}x{s[0]}" for s in (self._size, size))
            logger.warning("the frame size changes from %s to %s at frame %d", old, new, sequence)
        self._first, self._size = self._first or size, size


@dataclass
class _Color:
    """A colour image, and what was recorded as its calibration."""

    header: Header
    image: Bytes
    recorded: Recorded


_Depth = tuple[str, Any, float]


def beside_of(topics: Iterable[str], played: Topics) -> set[str]:
    """Return which topics are of the frames themselves, as truth and clocks, but no images."""
    images = {wire.COLOR_TOPIC, wire.DEPTH_TOPIC, wire.CAMERA_TOPIC, *vars(played).values()}
    return {t for t in set(topics) - images if not t.startswith(wire.RESULT_PREFIX)}


def _stamp(message: Any, raw: Raw) -> tuple[int, str]:
    """Return sensor time and frame; a stamp that was never set gives way to the publish time."""
    if hasattr(message, "header"):
        stamp = message.header.stamp
        nanoseconds, frame_id = stamp.sec * 10**9 + stamp.nanosec, message.header.frame_id
    else:
        stamp = message.timestamp
        nanoseconds, frame_id = stamp.seconds * 10**9 + stamp.nanos, message.frame_id
    return nanoseconds or raw.message.publish_time, frame_id
