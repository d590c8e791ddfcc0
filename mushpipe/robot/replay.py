"""Playing a recorded transcript again: as the client it was, or as the server it was."""

from __future__ import annotations

import re
import socket
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path
from typing import Any

import orjson

from mushpipe.core.errors import InputError
from mushpipe.robot.transcript import Line, read_transcript

Show = Callable[[str, bytes], None]
"""Is told of every line: ``>`` what we send, ``<`` what we get."""
SILENCE_S = 15.0


def lines_of(path: Path, client: int | None = None) -> tuple[list[Line], list[str]]:
    """Return one client's lines, by default those of the first client that said anything.

    And, in words, what of the file is damaged.

    Raises:
        InputError: There is no such client.
    """
    everything, damage = read_transcript(path)
    said = [line for line in everything if line.kind != "event"]
    if client is None:
        client = next((line.client for line in said if line.kind == "rx"), None)
    found = [line for line in said if line.client == client]
    if not found:
        raise InputError(f"{path}: there is no such client in this transcript")
    return found, damage


def as_client(lines: Iterable[Line], host: str, port: int, show: Show) -> int:
    """Send what the client sent, at once, and show the answers; return how many came."""
    with socket.create_connection((host, port), SILENCE_S) as sock:
        for line in lines:
            if line.kind == "rx":
                show(">", line.text)
                sock.sendall(line.text + b"\n")
        # The server answers what it has got, then closes in its turn.
        sock.shutdown(socket.SHUT_WR)
        count = 0
        with sock.makefile("rb") as answers:
            for answer in answers:
                show("<", answer.rstrip(b"\n"))
                count += 1
    return count


def as_server(
    lines: Iterable[Line], port: int, show: Show, listening: Callable[[int], None]
) -> int:
    """Send to one client, on loopback, what the server sent; return how many lines that were.

    Every message says ``replay``, and an answer waits for a request of the client, whose id it
    takes. Lines for ABB go only to a client that said ``REPLAY``. ``listening`` is told the port.
    """
    with socket.create_server(("127.0.0.1", port)) as server:
        server.settimeout(SILENCE_S)
        listening(server.getsockname()[1])
        connection, _ = server.accept()
    connection.settimeout(SILENCE_S)
    with connection, connection.makefile("rb") as heard:
        count = 0
        for text in _answers(lines, _Asked(heard, show)):
            show(">", text)
            connection.sendall(text + b"\n")
            count += 1
    return count


class _Asked:
    """The requests of the client that is connected now, in the order they came."""

    def __init__(self, heard: Iterable[bytes], show: Show) -> None:
        self._heard = iter(heard)
        self._show = show

    def next_line(self) -> bytes | None:
        """Wait for a line; None where the client leaves."""
        line = next(self._heard, None)
        if line is None:
            return None
        self._show("<", line.rstrip(b"\r\n"))
        return line

    def next_id(self) -> Any:
        """Wait for a request and return its id; None where the client leaves."""
        while (line := self.next_line()) is not None:
            identity = _identity(line)
            if identity is not None:
                return identity
        return None


def _identity(line: bytes) -> Any:
    try:
        body = orjson.loads(line)
    except ValueError:
        return None
    return body.get("id") if isinstance(body, dict) else None


def _answers(lines: Iterable[Line], asked: _Asked) -> Iterator[bytes]:
    greeted = False
    for line in lines:
        if line.kind != "tx":
            continue
        try:
            body = orjson.loads(line.text)
        except ValueError:  # for ABB, where every line answers one
            request = asked.next_line()
            if request is None:
                return
            greeted = greeted or b"REPLAY" in request.strip().split(b",")
            if not greeted:
                yield b"E,REPLAY_REFUSED"
                return
            yield re.sub(rb",LIVE$", b",REPLAY", line.text)
            continue
        if body.get("id") is not None:
            body["id"] = asked.next_id()
            if body["id"] is None:
                return
        yield orjson.dumps({**body, "replay": True})
