"""Playing a recorded transcript again: as the client it was, or as the server it was."""

from __future__ import annotations

import re
import socket
from collections.abc import Callable, Iterable, Iterator, Mapping
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from pathlib import Path
from typing import Any

import orjson

from mushpipe.core.errors import InputError, UsageError
from mushpipe.robot.transcript import Line, read_transcript

Show = Callable[[str, bytes], None]
"""Is told of every line: ``>`` what we send, ``<`` what we get."""
SILENCE_S = 15.0
_REFUSAL = {
    "op": "error", "id": None, "code": "replay_refused", "fatal": True, "replay": True,
    "message": "this is a recording; a client that wants it says accept_replay",
}  # fmt: skip


def lines_of(path: Path, client: int | None = None) -> tuple[list[Line], list[str]]:
    """Return one client's lines, by default those of the first client that said anything.

    And, in words, what of the file is damaged.

    Raises:
        InputError: No client said anything.
        UsageError: There is no such client.
    """
    everything, damage = read_transcript(path)
    said = [line for line in everything if line.kind != "event"]
    if client is None:
        client = next((line.client for line in said if line.kind == "rx"), None)
    found = [line for line in said if line.client == client]
    if not found and client is None:
        raise InputError(f"{path}: no client said anything; choose one with --client")
    if not found:
        known = ", ".join(map(str, sorted({line.client for line in said}))) or "none"
        raise UsageError(
            f"{path}: there is no client {client} in this transcript; it has these: {known}"
        )
    return found, damage


def as_client(
    lines: Iterable[Line], host: str, port: int, show: Show, hello: Mapping[str, Any] | None = None
) -> None:
    """Send what the client sent, at once, and show the answers.

    Args:
        lines: The transcript.
        host: Of the server.
        port: Of the server.
        show: Is told of every line.
        hello: Fields that the client's hello has instead of its own, such as a token.

    Raises:
        OSError: The server cannot be reached, or ends the conversation with an error.
    """
    said = [line.text for line in lines if line.kind == "rx"]
    with (
        ThreadPoolExecutor(1) as sender,
        socket.create_connection((host, port), SILENCE_S) as sock,
    ):
        saying = sender.submit(_say, sock, said, hello or {}, show)
        last = b""
        with sock.makefile("rb") as answers:
            for answer in answers:
                last = answer.rstrip(b"\n")
                show("<", last)
        saying.result()
    if b'"fatal":true' in last:
        raise ConnectionError("the server ended the conversation: see its last line")


def _say(sock: socket.socket, said: list[bytes], hello: Mapping[str, Any], show: Show) -> None:
    """Say everything; answers are read meanwhile, for a server does not wait with them."""
    with suppress(OSError):  # it has hung up; its last line says why
        try:
            for text in said:
                body = _object(text) or {}
                line = orjson.dumps({**body, **hello}) if body.get("op") == "hello" else text
                show(">", text)
                sock.sendall(line + b"\n")
        finally:
            # The server answers what it has got, then closes in its turn.
            sock.shutdown(socket.SHUT_WR)


def as_server(
    lines: Iterable[Line], port: int, show: Show, listening: Callable[[int], None]
) -> None:
    """Send to one client, on loopback, what the server sent.

    Every message says ``replay``, and an answer waits for a request of the client, whose id it
    takes. Targets go only to a client that accepts a recording: by ``accept_replay`` in its hello,
    or in lines for ABB by ``REPLAY``. ``listening`` is told the port.
    """
    with socket.create_server(("127.0.0.1", port)) as server:
        server.settimeout(SILENCE_S)
        listening(server.getsockname()[1])
        connection, _ = server.accept()
    connection.settimeout(SILENCE_S)
    with connection, connection.makefile("rb") as heard:
        for text in _answers(lines, _Asked(heard, show)):
            show(">", text)
            connection.sendall(text + b"\n")


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
            identity = (_object(line) or {}).get("id")
            if identity is not None:
                return identity
        return None


def _object(line: bytes) -> dict[str, Any] | None:
    try:
        body = orjson.loads(line)
    except ValueError:
        return None
    return body if isinstance(body, dict) else None


def _answers(lines: Iterable[Line], asked: _Asked) -> Iterator[bytes]:
    greeted = False
    for line in lines:
        if line.kind != "tx":
            continue
        body = _object(line.text)
        if body is None:  # for ABB, where every line answers one
            request = asked.next_line()
            if request is None:
                return
            greeted = greeted or b"REPLAY" in request.strip().split(b",")
            if not greeted:
                yield b"E,REPLAY_REFUSED"
                return
            yield re.sub(rb",LIVE(?=,|$)", b",REPLAY", line.text)
            continue
        if not greeted and body.get("op") != "hello":
            request = asked.next_line()
            if request is None:
                return
            greeted = (_object(request) or {}).get("accept_replay") is True
            if not greeted:
                yield orjson.dumps({**_REFUSAL, "t_ms": body.get("t_ms", 0)})
                return
        if body.get("id") is not None:
            body["id"] = asked.next_id()
            if body["id"] is None:
                return
        yield orjson.dumps({**body, "replay": True})
