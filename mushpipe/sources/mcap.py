"""Source `mcap`: plays mushpipe's own recordings and ROS 2 bags of realsense2_camera."""

from __future__ import annotations

import logging
from collections import deque
from collections.abc import Iterable, Iterator
from dataclasses import replace
from functools import partial
from itertools import islice
from pathlib import Path

from pydantic import Field, PrivateAttr

from mushpipe.core.errors import InputError, UsageError
from mushpipe.core.geometry import Camera
from mushpipe.core.paths import GraphPath
from mushpipe.core.recording import GRAPH, MANIFEST, Index, Raw, RecordingReader
from mushpipe.core.stage import ReplaySource
from mushpipe.core.types import RgbdFrame
from mushpipe.sources.kinds import require_kind
from mushpipe.sources.playing import Player, beside_of
from mushpipe.sources.recorded import NO_CAMERA, NO_DEPTH, RecordedSource
from mushpipe.sources.topics import Topics, choose_topics, images_of, untold_images

logger = logging.getLogger("mushpipe")


class McapSource(RecordedSource, ReplaySource):
    """Plays an MCAP recording, losing nothing and in order.

    Reads Foxglove messages (mushpipe's own recordings) and ROS 2 ones (CDR). Depth must be
    aligned to colour. A damaged file is played as far as it goes and then reported (exit code 4).
    """

    path: GraphPath = Field(description="the recording")
    start: float = Field(
        0.0,
        ge=0,
        le=1e9,
        description="skip so many seconds of the recording, from its first colour image",
    )
    end: float | None = Field(None, gt=0, le=1e9, description="stop at this second, counted alike")
    loop: int = Field(1, ge=0, description="how many times to play it; 0 is for ever")

    _reader: RecordingReader | None = PrivateAttr(None)

    def files(self) -> tuple[Path, ...]:
        """Return the recording."""
        return (self.path,)

    def open(self) -> None:
        """Check that there is something to play, as far as its index tells.

        Raises:
            UsageError: There is no such file, or nothing lies between `start` and `end`.
            InputError: It is empty, not MCAP, or without the topics that are asked for.
        """
        self._reader = RecordingReader(self.path)
        index, topics = self._chosen(self._reader)
        length = (index.end_ns - self._begin_ns(self._reader, topics)) / 1e9
        if self.end is not None and self.end <= self.start:
            raise UsageError(f"{self.path}: end, {self.end:g} s, is not after start")
        if self.start > length:
            raise UsageError(
                f"{self.path}: it ends after {length:.3f} s, before start, {self.start:g} s"
            )

    def _chosen(self, reader: RecordingReader) -> tuple[Index, Topics]:
        """Return what a recording holds, and which of it is played; raises as `open` does."""
        index = reader.index()
        if not index.counts and reader.damage:
            raise InputError(f"{self.path}: {'; '.join(reader.damage)}; nothing could be read")
        first, images = partial(_firsts, reader, index), images_of(index)
        require_kind(str(self.path), "color", next(first(self.color_topic), None), first(*images))
        require_kind(str(self.path), "depth", next(first(self.depth_topic), None), first(*images))
        named = (self.color_topic, self.depth_topic, self.camera_topic)
        return index, choose_topics(index, self.path, *named, self.use_depth)

    def frames(self) -> Iterator[RgbdFrame]:
        """Yield the frames of the recording.

        Raises:
            InputError: Not a recording, no colour images or no frame in the range; depth or
                calibration do not fit the images; or, after the last good frame, damage.
        """
        reader = self._reader or RecordingReader(self.path)
        index, topics = self._chosen(reader)
        numbered = MANIFEST in index.metadata or GRAPH in index.metadata
        beside = beside_of(index.channels, topics) if numbered else set()
        if topics.depth is None:
            logger.warning(NO_DEPTH, self.path.name)
            if self.use_depth and (others := untold_images(index, topics.color)):
                logger.warning(
                    "where one of these is depth, aligned to colour, name it: %s",
                    " or ".join(f"--set source.depth_topic={topic}" for topic in others),
                )
        player = Player(self, str(self.path), topics, beside, numbered, self._counts)
        yield from self._passes(player, reader)

    def _begin_ns(self, reader: RecordingReader, topics: Topics) -> int:
        """Return when the first colour image was logged, for `start` and `end`.

        Calibrations and transforms may have been logged at any time before, be it 0.
        """
        asked = self.start or self.end is not None
        first = next(reader.messages({topics.color}), None) if asked else None
        return first.message.log_time if first else 0

    def _passes(self, player: Player, reader: RecordingReader) -> Iterator[RgbdFrame]:
        # Without a start nothing is skipped, so that nothing can be lost unnoticed.
        begin_ns = self._begin_ns(reader, player.topics)
        start_ns = begin_ns + round(self.start * 1e9) if self.start else 0
        end_ns = None if self.end is None else begin_ns + round(self.end * 1e9)
        camera = _first_camera(player, reader, start_ns)
        if camera is None and self.camera is None:
            logger.warning(NO_CAMERA, self.path.name, f" ({player.error})" if player.error else "")
        delivered = turn = shift = shift_ns = 0
        while turn < self.loop or self.loop == 0:
            first = last = None
            player.calibration.camera, player.frames = camera, 0
            # mushpipe writes frames in order, whatever their stamps; ROS sorts by what it logged
            messages = reader.messages(player.wanted(), start_ns, end_ns, player.numbered)
            played = player.play(messages, hold=True)
            for frame in played if turn else _watched(played, self.path):
                header = frame.header
                first, last = first or header, header
                if turn:
                    header = replace(
                        header,
                        stamp_ns=header.stamp_ns + shift_ns,
                        arrival_ns=header.arrival_ns + shift_ns,
                        sequence=header.sequence + shift,
                    )
                    # What was recorded beside it has the stamps of the first turn.
                    frame = replace(frame, header=header, attached={})
                yield frame
                delivered += 1
            if first is None or last is None or reader.damage or player.error:
                break
            turn += 1
            # Numbers and time go on in the next turn, one average frame after the last one.
            shift += last.sequence - first.sequence + 1
            span = last.stamp_ns - first.stamp_ns  # below 0 where a clock was set back
            shift_ns += span + (span // max(1, player.frames - 1) if span > 0 else 33_333_333)
        faults = [f"damaged: {text}" for text in reader.damage]
        faults += [f"not all can be decoded: {player.error}"] if player.error else []
        if faults:
            raise InputError(f"{self.path}: {'; '.join(faults)}; {delivered} frames could be read")
        if not delivered:
            raise InputError(f"{self.path}: there is no frame in the chosen range")


def _firsts(reader: RecordingReader, index: Index, *topics: str | None) -> Iterator[Raw]:
    """Yield the first message of each topic that has any."""
    for topic in topics:
        if topic is not None and index.counts[topic]:
            yield from islice(reader.messages({topic}), 1)


def _watched(frames: Iterable[RgbdFrame], path: Path) -> Iterator[RgbdFrame]:
    """Yield frames, and say where time first goes back: whether a clock was set, no file tells."""
    last_ns, in_time = 0, True
    for frame in frames:
        header = frame.header
        if in_time and header.stamp_ns < last_ns:
            in_time = False
            logger.warning(
                "%s: stamps go back by %.3f s at frame %d; frames are played in the order of the "
                "file, which is right where a clock was set: where parts of the file changed "
                "places, sort it by time first",
                *(path, (last_ns - header.stamp_ns) / 1e9, header.sequence),
            )
        last_ns = header.stamp_ns
        yield frame


def _first_camera(player: Player, reader: RecordingReader, start_ns: int) -> Camera | None:
    """Return the calibration in force at the start, which may be recorded after it."""
    if player.calibration.topic is None:
        return None
    topic = {player.calibration.topic}
    before = reader.messages(topic, 0, start_ns + 1) if start_ns else ()
    first = next(iter(deque(before, maxlen=1)), None)
    first = first or next(reader.messages(topic), None)
    return player.calibrate(first) if first else None
