"""Every line out and in, written to MCAP on /robot/tx and /robot/rx, so that it can be replayed."""

from __future__ import annotations

import base64
import logging
import re
import threading
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from queue import Empty, SimpleQueue
from typing import Any

import orjson

from mushpipe.core import wire
from mushpipe.core.errors import InputError
from mushpipe.core.recorder import RecordingError, RecordingWriter
from mushpipe.core.recording import RecordingReader
from mushpipe.core.types import Header
from mushpipe.robot.clock import Clock
from mushpipe.robot.connection import Kind

logger = logging.getLogger("mushpipe")
PREFIX = "/robot/"
# A process that is killed loses no more than this of its last words.
FLUSH_S = 2.0
MOST_BYTES = 64 * 1024 * 1024
# A wrong token may be the right one of another server, or nearly that of this one.
_TOKEN = re.compile(rb'("token"\s*:\s*")(?:[^"\\]|\\.)*|(,TOKEN=)[^,]*')
SCHEMA = wire.json_schema(
    "mushpipe.RobotLine",
    {
        "client": {"type": "integer"},
        "line": {"type": "string"},
        "encoding": {"enum": ["utf-8", "base64"]},
        "monotonic_ns": {"type": "integer"},
    },
    "a line of the robot socket, without its line end",
)


@dataclass(frozen=True)
class Line:
    """One entry of a transcript; ``text`` has no line end, ``time_ns`` never jumps."""

    kind: Kind
    client: int
    text: bytes
    time_ns: int


class Transcript:
    """Writes what it is told from any thread in a thread of its own, and never blocks.

    Where the disk cannot follow, lines are left out, counted, and the gap stands in the file.
    """

    def __init__(self, path: Path, clock: Clock, secret: str = "") -> None:
        self.lost = self._told = 0
        self._clock = clock
        self._secret = secret.encode()
        self._writer = RecordingWriter(path, {})
        self._queue: SimpleQueue[tuple[Line, int] | None] = SimpleQueue()
        self._waiting = 0
        self._lock = threading.Lock()
        self._count = 0
        self._thread = threading.Thread(target=self._run, name="mushpipe-transcript", daemon=True)
        self._thread.start()

    def observe(self, kind: Kind, client: int, text: bytes) -> None:
        """Take a line; no token that a client tries is kept."""
        if kind == "rx":  # what goes out has none, and is long
            text = _TOKEN.sub(rb"\1\2***", text)
        if self._secret:
            text = text.replace(self._secret, b"***")
        with self._lock:
            if self._waiting + len(text) > MOST_BYTES:
                self.lost += 1
                return
            self._waiting += len(text)
        moment = round(self._clock.monotonic() * 1e9)
        self._queue.put((Line(kind, client, text, moment), self._clock.wall_ns()))

    def _run(self) -> None:
        try:
            while self._pass_on():
                pass
        except RecordingError as error:
            logger.error("the robot's transcript ends here: %s", error)
            with self._lock:
                self._waiting = MOST_BYTES + 1  # no more is taken

    def _pass_on(self) -> bool:
        """Write what comes for a while, then make it safe; False at the end."""
        until = self._clock.monotonic() + FLUSH_S
        with suppress(Empty):
            while (left := until - self._clock.monotonic()) > 0:
                item = self._queue.get(timeout=left)
                if item is None:
                    return False
                self._note_gap(*item)
                self._write(*item)
                with self._lock:
                    self._waiting -= len(item[0].text)
        self._writer.flush()  # of nothing, this writes nothing
        return True

    def _note_gap(self, line: Line, wall_ns: int) -> None:
        missing, self._told = self.lost - self._told, self.lost
        if missing:
            text = f"{missing} lines are missing here".encode()
            self._write(Line("event", 0, text, line.time_ns), wall_ns)

    def _write(self, line: Line, wall_ns: int) -> None:
        header = Header(wall_ns, self._count, "")
        self._count += 1
        text = line.text.rstrip(b"\r\n")
        content: dict[str, Any] = {"client": line.client, "monotonic_ns": line.time_ns}
        try:
            content |= {"line": text.decode(), "encoding": "utf-8"}
        except UnicodeDecodeError:
            content |= {"line": base64.b64encode(text).decode(), "encoding": "base64"}
        self._writer.write(PREFIX + line.kind, wire.json_message(SCHEMA, header, content), header)

    def close(self) -> None:
        """Write what waits, and the end of the file."""
        self._queue.put(None)
        self._thread.join()
        self._writer.close()
        if self.lost:
            logger.warning("%d lines are missing from the robot's transcript", self.lost)


def read_transcript(path: Path) -> tuple[list[Line], list[str]]:
    """Return the lines of a transcript in the order they were sent, and what of it is damaged.

    Raises:
        UsageError: There is no such file.
        InputError: It holds no transcript.
    """
    kinds: dict[str, Kind] = {f"{PREFIX}{kind}": kind for kind in ("tx", "rx", "event")}
    found: list[tuple[int, Line]] = []
    reader = RecordingReader(path)
    for raw in reader.messages(set(kinds)):
        kind = kinds[raw.channel.topic]
        try:
            found.append(_line(kind, orjson.loads(raw.message.data)))
        except (ValueError, TypeError, KeyError, AttributeError) as error:
            what = f"message {len(found)} on {raw.channel.topic} is no line of a robot: {error!r}"
            raise InputError(f"{path}: {what}") from error
    if not found:
        why = f"; the file is damaged: {'; '.join(reader.damage)}" if reader.damage else ""
        raise InputError(f"{path}: there is no transcript of a robot in it{why}")
    # File order follows the wall clock, which may have jumped; the sequence is the truth.
    return [line for _, line in sorted(found, key=lambda entry: entry[0])], reader.damage


def _line(kind: Kind, body: dict[str, Any]) -> tuple[int, Line]:
    """Return an entry and its number."""
    text = body["line"].encode()
    if body["encoding"] == "base64":
        text = base64.b64decode(text)
    return body["sequence"], Line(kind, body["client"], text, body["monotonic_ns"])
