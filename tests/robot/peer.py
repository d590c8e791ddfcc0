"""A client written from docs/robot.md alone; it knows nothing of mushpipe's code.

Every line in either direction is checked against the schemas the document names.
"""

from __future__ import annotations

import json
import socket
from importlib import resources
from typing import Any

from jsonschema import Draft202012Validator


def _schema(side: str) -> Draft202012Validator:
    text = resources.files("mushpipe").joinpath(f"robot/schema/{side}.schema.json").read_text()
    document = json.loads(text)
    Draft202012Validator.check_schema(document)
    return Draft202012Validator(document)


SERVER, CLIENT = _schema("server"), _schema("client")


def _no_constants(name: str) -> float:
    raise AssertionError(f"{name} left the server")


def read_line(line: bytes) -> dict[str, Any]:
    """Decode and validate a line of the server."""
    assert line.endswith(b"\n")
    assert len(line) <= 1 << 20
    message: dict[str, Any] = json.loads(line.decode("utf-8"), parse_constant=_no_constants)
    SERVER.validate(message)
    return message


class Peer:
    """A robot."""

    def __init__(self, port: int, timeout: float = 20.0, receive_buffer: int = 0) -> None:
        self.sock = socket.socket()
        if receive_buffer:
            self.sock.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, receive_buffer)
        self.sock.settimeout(timeout)
        self.sock.connect(("127.0.0.1", port))
        self.reader = self.sock.makefile("rb")

    def __enter__(self) -> Peer:
        return self

    def __exit__(self, *_: object) -> None:
        self.reader.close()
        self.sock.close()

    def read(self) -> dict[str, Any]:
        line = self.reader.readline()
        if not line:
            raise EOFError
        return read_line(line)

    def say(self, op: str, **fields: Any) -> None:
        message = {"op": op, **fields}
        CLIENT.validate(message)
        self.raw(json.dumps(message).encode() + b"\n")

    def raw(self, data: bytes) -> None:
        self.sock.sendall(data)

    def greet(self, mode: str = "request", **fields: Any) -> dict[str, Any]:
        """Exchange hellos; return the server's."""
        hello = self.read()
        assert hello["op"] == "hello"
        self.say("hello", version="1.0", mode=mode, **fields)
        assert self.read()["op"] == "heartbeat"
        return hello

    def wait(self, op: str) -> dict[str, Any]:
        """Return the next message of a kind."""
        while True:
            message = self.read()
            if message["op"] == op:
                return message

    def ask(self, op: str, **fields: Any) -> dict[str, Any]:
        """Return the answer to a request."""
        self.say(op, **fields)
        while True:
            message = self.read()
            if message.get("id") == fields["id"]:
                return message

    def targets(self, **fields: Any) -> list[str]:
        """Return the ids that are offered."""
        answer = self.ask("get_targets", id="ids", **fields)
        assert answer["op"] == "targets", answer
        assert answer["count"] == len(answer["targets"])
        return [target["id"] for target in answer["targets"]]

    def skim(self) -> int:
        """Return the number of the next targets, without validating them: they are long."""
        while b'"op":"targets"' not in (line := self.reader.readline()):
            assert line
        return int(json.loads(line)["seq"])

    def rest(self) -> list[dict[str, Any]]:
        """Return all lines up to the end of the connection."""
        found = []
        while True:
            try:
                found.append(self.read())
            except (EOFError, ConnectionResetError):
                return found
