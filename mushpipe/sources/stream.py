"""Source `stream`: what `mushpipe record -o -` writes, from standard input."""

from __future__ import annotations

import json
import logging
import os
import select
import stat
import threading
from collections.abc import Iterable, Iterator
from dataclasses import replace
from io import BufferedReader, RawIOBase
from itertools import chain, islice
from pathlib import Path
from typing import Any

from mcap.exceptions import InvalidMagic
from mcap.records import Channel, McapRecord, Message, Metadata, Schema
from mcap.stream_reader import CRCValidationError, StreamReader
from pydantic import PrivateAttr

from mushpipe.core import wire
from mushpipe.core.errors import InputError, UsageError
from mushpipe.core.paths import real
from mushpipe.core.recording import GARBAGE, MANIFEST, Raw
from mushpipe.core.types import RgbdFrame
from mushpipe.sources.kinds import require_kind
from mushpipe.sources.pairing import Pairing
from mushpipe.sources.playing import Player, beside_of
from mushpipe.sources.recorded import NO_CAMERA, NO_DEPTH, RecordedSource
from mushpipe.sources.topics import NOT_CAMERA, Topics

logger = logging.getLogger("mushpipe")
_POLL_S = 0.1
_BUFFER = 1 << 20
_MOST_BEFORE = 100_000_000  # bytes without a colour image, some seconds: there will be none


class StreamSource(RecordedSource):
    """Frames from standard input, in MCAP: of a camera at another computer or another Python.

    `ssh farm mushpipe record -o - | mushpipe run graph.yaml --source -`. Where the sender has a
    camera, the newest frame is taken; a recording that is sent waits for the graph. Topics are
    mushpipe's own unless they are named.
    """

    _number: int = PrivateAttr(0)
    _records: Iterator[McapRecord] = PrivateAttr(default_factory=lambda: iter(()))
    _input: BufferedReader | None = PrivateAttr(None)
    _manifest: dict[str, str] = PrivateAttr(default_factory=dict)
    _interrupted: threading.Event = PrivateAttr(default_factory=threading.Event)

    @property
    def live(self) -> bool:
        """Whether the sender has a camera; known once the stream is open. A file has none."""
        saved = stat.S_ISREG(os.fstat(self._number).st_mode)
        return self._manifest.get("live") == "true" and not saved

    def files(self) -> tuple[Path, ...]:
        """Return the saved stream, where standard input is a file and not a pipe."""
        path = real(Path(f"/proc/self/fd/{self._number}"))
        return (path,) if path.is_file() else ()

    def name(self) -> str:
        """Return ``stream``."""
        return "stream"

    def open(self) -> None:
        """Wait for the head of the stream.

        Raises:
            UsageError: Nothing is piped into this program.
            InputError: Nothing came, or it is no MCAP.
        """
        if os.isatty(self._number):
            raise UsageError(
                "nothing is piped into this program: 'mushpipe record -o - | mushpipe run GRAPH "
                "--source -'"
            )
        raw = _Input(self._number, self._interrupted)
        self._input = BufferedReader(raw, _BUFFER)
        records = StreamReader(self._input, validate_crcs=True).records
        try:
            head = list(islice(records, 2))  # the header; the manifest, if mushpipe sends
        except InvalidMagic as error:
            raise InputError("standard input is not MCAP: send it with -o -") from error
        except GARBAGE as error:
            if self._interrupted.is_set():
                return
            what = f"ends after {raw.count} bytes" if raw.count else "is empty"
            raise InputError(f"standard input {what}: see what its sender says") from error
        for record in head:
            if isinstance(record, Metadata) and record.name == MANIFEST:
                self._manifest = record.metadata
        self._records = chain(head, records)

    def describe(self) -> dict[str, Any]:
        """Return what the sender says of its camera."""
        device = json.loads(self._manifest.get("json", "{}")).get("device", {})
        return device if isinstance(device, dict) else {}

    def interrupt(self) -> None:
        """Stop waiting for the sender."""
        self._interrupted.set()

    def frames(self) -> Iterator[RgbdFrame]:
        """Yield frames until the sender ends the stream.

        Raises:
            InputError: It broke off, no colour images came, or they do not fit the calibration.
        """
        topics = Topics(
            self.color_topic or wire.COLOR_TOPIC,
            (self.depth_topic or wire.DEPTH_TOPIC) if self.use_depth else None,
            self.camera_topic or wire.CAMERA_TOPIC,
        )
        reader = _Messages(self._records)
        messages = iter(reader)
        head = self._head(messages, reader, topics)
        _require_kinds(head, topics)
        first = topics
        if topics.depth not in {raw.channel.topic for raw in head}:
            first = replace(topics, depth=None)
            if head:
                logger.warning(NO_DEPTH, f"the stream{self._on(topics.depth, ',')}")
        beside = beside_of(reader.topics, topics) if self._manifest else set()
        player = Player(self, "the stream", first, beside, bool(self._manifest), self._counts)
        known = _of_interest(chain(head, messages), player, topics)
        for frame in player.play(known, hold=False):
            if frame.camera is None and player.frames == 1:
                why = f" ({player.error})" if player.error else self._on(topics.camera)
                logger.warning(NO_CAMERA, "the stream", why)
            yield frame
        if self._interrupted.is_set():
            return
        damage = player.error or reader.damage or self._behind()
        if damage:
            raise InputError(f"the stream {damage}; {player.frames} frames came")
        if not player.frames:
            raise InputError(self._nothing_on(topics.color, reader))

    def _head(self, messages: Iterator[Raw], reader: _Messages, topics: Topics) -> list[Raw]:
        """Return the messages up to colour and depth, or up to where there seems to be no depth.

        A recording that is sent can wait as long as its images would for their depth; the images
        of a camera would grow old.
        """
        head, size, colored, deep = list[Raw](), 0, 0, False
        most = 2 if self.live else Pairing.PATIENCE + 1
        for raw in messages:
            head.append(raw)
            size += len(raw.message.data)
            colored += raw.channel.topic == topics.color
            deep |= raw.channel.topic == topics.depth
            if colored and (deep or colored == (most if topics.depth else 2)):
                break
            if not colored and size > _MOST_BEFORE:
                raise InputError(self._nothing_on(topics.color, reader))
        return head

    def _behind(self) -> str:
        """Return what is amiss if something follows the end of the recording."""
        if self._input is None or not isinstance(self._input.raw, _Input):
            return ""
        self._input.raw.patient = False
        more = self._input.peek(1)
        return "goes on behind its end: send one recording at a time" if more else ""

    def _on(self, topic: str | None, comma: str = "") -> str:
        """Return where something was looked for in what another program sends."""
        return "" if self._manifest or topic is None else f"{comma} on {topic}{comma}"

    def _nothing_on(self, topic: str, reader: _Messages) -> str:
        found = ", ".join(sorted(reader.topics)) or "nothing"
        return (
            f"the stream has no colour images on {topic}, only {found}: where they are among "
            "these, name source.color_topic, source.depth_topic and source.camera_topic"
        )


def _require_kinds(head: list[Raw], topics: Topics) -> None:
    """Refuse a topic that holds the other kind of images: none would come for as long as it lasts.

    Raises:
        InputError: It does.
    """
    firsts = {raw.channel.topic: raw for raw in reversed(head)}
    images = [raw for topic, raw in firsts.items() if not topic.startswith(NOT_CAMERA)]
    require_kind("the stream", "color", firsts.get(topics.color), images)
    require_kind("the stream", "depth", firsts.get(topics.depth or ""), images)


def _of_interest(messages: Iterable[Raw], player: Player, topics: Topics) -> Iterator[Raw]:
    """Yield what a player wants; depth that begins later than colour counts from there on."""
    wanted = player.wanted()
    for raw in messages:
        if raw.channel.topic == topics.depth and player.topics.depth is None:
            logger.info("the stream has depth from frame %d on", player.frames)
            player.topics = topics
            wanted = player.wanted()
        if raw.channel.topic in wanted:
            yield raw


class _Messages:
    """The messages of a stream; ``damage`` says afterwards how it ended, if not as it should."""

    def __init__(self, records: Iterator[McapRecord]) -> None:
        self._records = records
        self.damage = ""
        self.topics: set[str] = set()

    def __iter__(self) -> Iterator[Raw]:
        channels: dict[int, Channel] = {}
        schemas: dict[int, Schema] = {}
        try:
            for record in self._records:
                if isinstance(record, Schema):
                    schemas[record.id] = record
                elif isinstance(record, Channel):
                    channels[record.id] = record
                    self.topics.add(record.topic)
                elif isinstance(record, Message):
                    channel = channels[record.channel_id]
                    yield Raw(channel, schemas.get(channel.schema_id), record)
        except CRCValidationError:
            self.damage = "has changed on its way: its CRC does not match"
        except GARBAGE as error:
            self.damage = f"broke off: its sender did not end it ({type(error).__name__})"


class _Input(RawIOBase):
    """A file descriptor, read without a lock that would hang the end of the program."""

    def __init__(self, number: int, interrupted: threading.Event) -> None:
        self._number = number
        self._interrupted = interrupted
        self.patient = True  # else what does not come soon is taken for the end
        self.count = 0  # bytes that came

    def readable(self) -> bool:
        return True

    def readinto(self, buffer: Any) -> int:
        while not self._interrupted.is_set():
            if select.select([self._number], [], [], _POLL_S)[0]:
                count = os.readv(self._number, [buffer])
                self.count += count
                return count
            if not self.patient:
                break
        return 0
