"""One client's socket: limits, deadlines, and one line on its way out, never a queue.

The next line is made only when the last one has been handed to the kernel whole, and one that was
not asked for only when the kernel would send it on at once. So a slow client is sent fewer and
newer lines, and holds no memory.
"""

from __future__ import annotations

import select
import socket
import ssl
import struct
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass
from typing import Literal

from mushpipe.robot.clock import Clock
from mushpipe.robot.messages import CLIENT_TIMEOUT_S, MAX_LINE, Refusal
from mushpipe.robot.session import Outgoing, Session

BATCH = 16
SEND_BUFFER = 128 * 1024
_WOULD_BLOCK = (BlockingIOError, ssl.SSLWantReadError, ssl.SSLWantWriteError)

Kind = Literal["tx", "rx", "event"]
Observer = Callable[[Kind, int, bytes], None]
"""Is told of every line out and in, and of every beginning and end: kind, client, text."""


@dataclass(frozen=True)
class Limits:
    """What a client may do before it is cut off; times in seconds."""

    hello_s: float = 5.0
    line_s: float = 5.0
    idle_s: float = CLIENT_TIMEOUT_S
    write_s: float = 2.0
    drain_s: float = 1.0
    lines_per_s: float = 200.0


class Connection:
    """A client's socket and its session."""

    def __init__(
        self,
        sock: socket.socket,
        session: Session,
        number: int,
        limits: Limits,
        observe: Observer,
        clock: Clock,
    ) -> None:
        self.sock = sock
        self.session = session
        self.number = number
        self.gone = False
        self.busy = False
        self._limits = limits
        self._observe = observe
        self._clock = clock
        self._in = bytearray()
        self._scanned = 0
        self._out = memoryview(b"")
        self._expires: float | None = None
        self._full = False
        self._tls_wants_input = False
        self._eof = False
        self._draining: float | None = None
        now = clock.monotonic()
        self._opened = self._last_line = self._line_begun = self._progress = now
        self._tokens = limits.lines_per_s
        self._filled = now

    @property
    def wants_input(self) -> bool:
        """Whether bytes of this client would be read now."""
        if self._draining is not None:
            return True
        free = self._tls_wants_input or not (self._out or self.busy or self.throttled)
        return free and len(self._in) <= MAX_LINE

    @property
    def wants_output(self) -> bool:
        """Whether a line is on its way that the kernel did not take, or that it would not take."""
        return (bool(self._out) or self._full) and not self._tls_wants_input

    @property
    def throttled(self) -> bool:
        """Whether the client talks faster than it may."""
        return self._tokens < 1

    def serve(self) -> None:
        """Do all that can be done without waiting."""
        now = self._clock.monotonic()
        self._refill(now)
        if self._draining is not None:
            self._drain(now)
            return
        if self.wants_input:
            self._read(now)
        if not self.gone:
            self._pump()
        if not self.gone and self._draining is None:
            self._check(now)

    def _refill(self, now: float) -> None:
        rate = self._limits.lines_per_s
        self._tokens = min(rate, self._tokens + rate * (now - self._filled))
        self._filled = now

    def _read(self, now: float) -> None:
        try:
            data = self.sock.recv(MAX_LINE)
        except _WOULD_BLOCK:
            return
        except OSError as error:
            self.abort(f"lost: {error.strerror or error}")
            return
        finally:
            self._tls_wants_input = False
        if not data:
            self._eof = True
        if not self._in:
            self._line_begun = now
        self._in += data

    def _pump(self) -> None:
        """Send and answer, a bounded number of lines; ``busy`` says that more may be waiting."""
        self.busy = False
        for _ in range(BATCH):
            now = self._clock.monotonic()  # an age must be that of the line, not of the first one
            if self.gone or not self._flush(now):
                return
            if self.session.closing:
                self._finish(now)
                return
            outgoing = self.session.due(now) if self._room(now) else None
            if outgoing is None:
                line = self._take(now)
                if line is None:
                    if self._eof and not self.throttled:
                        self.abort("the client closed", reset=False)
                    return
                outgoing = self._answer(line, now)
            if outgoing is not None:
                self._send(outgoing, now)
        self.busy = True

    def _room(self, now: float) -> bool:
        """Return whether the kernel takes a line: in a queue behind others it would grow old."""
        poll = select.poll()
        poll.register(self.sock, select.POLLOUT)
        full = not poll.poll(0)
        if full and not self._full:
            self._progress = now
        self._full = full
        return not full

    def _send(self, outgoing: Outgoing, now: float) -> None:
        self._observe("tx", self.number, outgoing.data)
        self._out, self._progress = memoryview(outgoing.data), now
        # It was good when it was made; that nothing of it is taken then is the client's doing.
        self._expires = None if outgoing.expires is None else max(outgoing.expires, now)
        self._flush(now)

    def _take(self, now: float) -> bytes | None:
        """Return the next whole line, or what is already too long for one."""
        if self.throttled:
            return None
        end = self._line_end()
        if end < 0 and len(self._in) <= MAX_LINE:
            self._scanned = len(self._in)
            return None
        end = len(self._in) if end < 0 else end
        line = bytes(self._in[:end])
        del self._in[: end + 1]
        self._scanned = 0
        self._last_line = self._line_begun = now
        self._tokens -= 1
        return line

    def _answer(self, line: bytes, now: float) -> Outgoing | None:
        if len(line) > MAX_LINE:
            text = f"a line may have {MAX_LINE} bytes"
            return self.session.refuse(Refusal("line_too_long", text, fatal=True), now)
        line = line.rstrip(b"\r")
        if not line:
            return None
        self._observe("rx", self.number, line)
        return self.session.handle(line, now)

    def _line_end(self) -> int:
        marks = (self._in.find(mark, self._scanned) for mark in self.session.terminators)
        return min((place for place in marks if place >= 0), default=-1)

    def _flush(self, now: float) -> bool:
        """Hand the line on its way to the kernel; return whether all of it is gone."""
        while self._out:
            if self._expires is not None and now > self._expires:
                # What is left of it would be old, and half a line cannot be taken back.
                self.abort("too slow: its targets grew old on their way")
                return False
            try:
                sent = self.sock.send(self._out)
            except ssl.SSLWantReadError:
                self._tls_wants_input = True
                return False
            except _WOULD_BLOCK:
                return False
            except OSError as error:
                self.abort(f"lost: {error.strerror or error}")
                return False
            self._out = self._out[sent:]
            self._progress = now
        return True

    def silent_s(self, now: float) -> float:
        """Return for how long it has been connected without a hello, 0 once it said it."""
        return 0.0 if self.session.ready else now - self._opened

    def _check(self, now: float) -> None:
        """Cut off a client that is too slow in any way."""
        limits = self._limits
        if self._out or self._full:
            if now - self._progress > limits.write_s:
                self.abort("it does not read")
        elif self._eof:
            return
        elif self.silent_s(now) > limits.hello_s:
            self._refuse("no hello came in time", now)
        elif self._in and now - self._line_begun > limits.line_s and not self.throttled:
            self._refuse("a line was begun and not ended in time", now)
        elif now - self._last_line > limits.idle_s and not self.throttled:
            self._refuse("nothing was heard from the client for too long", now)

    def _refuse(self, text: str, now: float) -> None:
        line = self.session.refuse(Refusal("timeout", text, fatal=True), now)
        if line.data:
            self._send(line, now)
        self._pump()

    def _finish(self, now: float) -> None:
        """Say that nothing more comes, and let the client read the last line before the end."""
        self._draining = now
        with suppress(OSError):
            self.sock.shutdown(socket.SHUT_WR)
        self._drain(now)

    def _drain(self, now: float) -> None:
        # Closing a socket with unread input resets it, and the client would lose our last line.
        over = now - (self._draining or now) > self._limits.drain_s
        try:
            for _ in range(BATCH):
                if not self.sock.recv(MAX_LINE):
                    over = True
                    break
        except _WOULD_BLOCK:
            pass
        except OSError:
            over = True
        if over:
            self.abort("closed", reset=False)

    def abort(self, reason: str, reset: bool = True) -> None:
        """Close at once; with ``reset`` the kernel discards what the client did not take yet."""
        if self.gone:
            return
        self.gone = True
        if reset:
            with suppress(OSError):
                linger = struct.pack("ii", 1, 0)
                self.sock.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, linger)
        with suppress(OSError):
            self.sock.close()
        self._out = memoryview(b"")
        self._in.clear()
        self._observe("event", self.number, f"disconnected: {reason}".encode())
