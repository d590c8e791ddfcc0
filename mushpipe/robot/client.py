"""The reference client: docs/robot.md in a class that needs nothing but the standard library."""

from __future__ import annotations

import json
import math
import socket
import ssl
import time
from contextlib import suppress
from types import TracebackType
from typing import Any

Message = dict[str, Any]
# What waits in a computer that sleeps grows old, and CLOCK_MONOTONIC stands still meanwhile.
_CLOCK = getattr(time, "CLOCK_BOOTTIME", None)


def now_ms() -> float:
    """Return milliseconds that never jump, from an arbitrary start."""
    return 1000 * (time.monotonic() if _CLOCK is None else time.clock_gettime(_CLOCK))


class RobotClient:
    """A connection to the robot socket; use it in a ``with`` block.

    After ``timeout_s`` without a line the server counts as dead and every method raises OSError.
    ``late_ms`` is how much later the last line came than the quickest one since the last answer to
    a request of ours, or than that request: what a network or our own slowness held back, which in
    mode ``stream`` counts towards ``valid_ms``. Two clocks drift apart: there, `ping` each minute.

    Raises:
        OSError: The server cannot be reached, is silent, or has gone.
        PermissionError: It refused us; the text is the server's.
    """

    def __init__(
        self,
        host: str = "127.0.0.1",
        port: int = 5005,
        mode: str = "request",
        timeout_s: float = 3.0,
        tls: ssl.SSLContext | None = None,
        **hello: Any,
    ) -> None:
        begun_ms = now_ms()
        self._socket = socket.create_connection((host, port), timeout_s)
        self._socket.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        if tls is not None:
            self._socket = tls.wrap_socket(self._socket, server_hostname=host)
        self._lines = self._socket.makefile("rb")
        self._id = 0
        self._asked = 0, begun_ms  # the last request's id, and when it was made; 0 is hello's
        self._ahead_ms = math.inf  # our clock, before the server's t_ms
        self.late_ms = 0.0
        try:
            self.hello = self._greet(mode=mode, **hello)
        except BaseException:
            self.close()
            raise

    def _greet(self, **hello: Any) -> Message:
        """Return the server's hello, after it has taken ours."""
        try:
            first = self.receive()
        except TimeoutError:
            raise TimeoutError(
                f"no hello within {self._socket.gettimeout():g} s: is this the port for ABB, which "
                "waits to be spoken to, or does the server stand still?"
            ) from None
        if first["op"] == "hello" and not str(first.get("version")).startswith("1."):
            raise PermissionError(
                f"the server speaks version {first.get('version')}, this client 1.0"
            )
        self.send("hello", version="1.0", **hello)
        taken = first if first["op"] == "error" else self.receive()
        if taken["op"] == "error":
            raise PermissionError(f"{taken['code']}: {taken['message']}")
        return first

    def send(self, op: str, **fields: Any) -> None:
        """Send a line."""
        self._socket.sendall(json.dumps({"op": op, **fields}).encode() + b"\n")

    def receive(self) -> Message:
        """Return the next line, whatever it is."""
        line = self._lines.readline()
        if not line.endswith(b"\n"):
            raise ConnectionError("the server has gone")
        try:
            message: Message = json.loads(line)
            message["op"]
        except (ValueError, TypeError, KeyError):
            raise ConnectionError(
                f"this is no robot socket of mushpipe: it says {line[:60]!r}"
            ) from None
        if "t_ms" in message:
            ahead_ms = now_ms() - message["t_ms"]
            self._ahead_ms = min(self._ahead_ms, ahead_ms)
            if (0 if message["op"] == "hello" else message.get("id")) == self._asked[0]:
                self._ahead_ms = self._asked[1] - message["t_ms"]
            self.late_ms = ahead_ms - self._ahead_ms
        return message

    def ping(self) -> None:
        """Say that we live, and have the clocks compared by the pong among the lines to come."""
        self._request("ping")

    def ask(self, op: str, **fields: Any) -> Message:
        """Send a request and return its answer, passing over heartbeats and streamed targets."""
        number = self._request(op, **fields)
        while True:
            message = self.receive()
            if message.get("id") == number or message["op"] == "bye" or message.get("fatal"):
                return message

    def _request(self, op: str, **fields: Any) -> int:
        self._id += 1
        self._asked = self._id, now_ms()
        with suppress(BrokenPipeError, ConnectionResetError):  # why, it may have said before
            self.send(op, id=self._id, **fields)
        return self._id

    def targets(self, **fields: Any) -> list[Message]:
        """Return what may be picked now, best first.

        Nothing where the server has nothing fresh, or its answer was too long on the way.
        """
        answer = self.ask("get_targets", **fields)
        found: list[Message] = answer.get("targets", [])
        return [] if self.too_late(answer) else found

    def too_late(self, message: Message) -> bool:
        """Return whether a message, the last one, was so long on the way that it is not valid."""
        return bool(self.late_ms >= message.get("valid_ms", math.inf))

    def ack(self, target: str, result: str, **fields: Any) -> bool:
        """Tell what the robot does with a target; only True allows it to go on."""
        return bool(self.ask("ack", target=target, result=result, **fields)["op"] == "acked")

    def close(self) -> None:
        """Close the connection."""
        self._lines.close()
        self._socket.close()

    def __enter__(self) -> RobotClient:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self.close()
