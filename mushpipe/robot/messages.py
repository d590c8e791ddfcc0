"""What clients may say, checked, and how the server's words are put together."""

from __future__ import annotations

from collections.abc import Mapping
from functools import cache
from importlib import resources
from typing import Annotated, Any, Literal

import orjson
from pydantic import BaseModel, BeforeValidator, ConfigDict, Field, TypeAdapter, ValidationError

PROTOCOL = "mushpipe-robot"
VERSION = "1.0"
MAX_LINE = 65_536
NAME = r"^[A-Za-z0-9_.-]{0,64}$"
HEARTBEAT_S = 1.0
CLIENT_TIMEOUT_S = 10.0  # without a line
LONGEST_HOLD_MS = 3_600_000


def _whole(value: Any) -> Any:
    """Take 7.0 for 7, as JSON does; some controllers know only one kind of number."""
    return int(value) if isinstance(value, float) and value.is_integer() else value


Whole = Annotated[int, BeforeValidator(_whole)]
Id = Annotated[Whole, Field(ge=0, le=2**53 - 1)] | Annotated[str, Field(max_length=64)]
Outcome = Literal["accepted", "rejected", "done", "failed"]
State = Literal["running", "stalled", "no_camera"]
Code = Literal[
    "bad_json",
    "bad_request",
    "busy",
    "conflict",
    "hello_expected",
    "internal",
    "line_too_long",
    "replay_refused",
    "stale",
    "timeout",
    "too_many_clients",
    "unauthorised",
    "unknown_frame",
    "unknown_op",
    "unknown_target",
    "unsupported_version",
]


class Refusal(Exception):  # noqa: N818 - an answer to a client, not a fault of the program
    """Something the client asked for and does not get; ``fatal`` ends the connection."""

    def __init__(self, code: Code, text: str, fatal: bool = False, **extra: Any) -> None:
        super().__init__(text)
        self.code: Code = code
        self.fatal = fatal
        self.extra = extra


class _Message(BaseModel):
    # Unknown fields are ignored, so that newer clients can talk to older servers.
    model_config = ConfigDict(extra="ignore", frozen=True, strict=True)


class Hello(_Message):
    """The client's first line."""

    op: Literal["hello"]
    version: str = Field(pattern=r"^[0-9]{1,4}\.[0-9]{1,4}$")
    mode: Literal["request", "stream"]
    name: str = Field("", pattern=NAME)
    token: str = Field("", max_length=256)
    accept_replay: bool = False


class GetTargets(_Message):
    """Asks for the newest targets."""

    op: Literal["get_targets"]
    id: Id
    max: Whole = Field(1000, ge=1, le=1000)
    max_age_ms: Whole | None = Field(None, ge=1, le=600_000)
    frame: str | None = Field(None, max_length=64)


class Ack(_Message):
    """Tells what the robot does with a target."""

    op: Literal["ack"]
    id: Id
    target: str = Field(pattern=r"^m[0-9]{1,15}$")
    result: Outcome
    hold_ms: Whole = Field(0, ge=0, le=LONGEST_HOLD_MS)
    reason: str = Field("", max_length=200)


class Ping(_Message):
    """Asks for a pong."""

    op: Literal["ping"]
    id: Id


class Heartbeat(_Message):
    """Says that the client lives."""

    op: Literal["heartbeat"]


class Bye(_Message):
    """Announces that the client leaves."""

    op: Literal["bye"]


Inbound = Hello | GetTargets | Ack | Ping | Heartbeat | Bye
_ADAPTER: TypeAdapter[Inbound] = TypeAdapter(Annotated[Inbound, Field(discriminator="op")])
OPS = ("hello", "get_targets", "ack", "ping", "heartbeat", "bye")


def parse(line: bytes) -> Inbound:
    """Read a client's line.

    Raises:
        Refusal: `bad_json`, `unknown_op` or `bad_request`; it carries the line's id where it has
            a proper one.
    """
    try:
        body = orjson.loads(line)
    except ValueError as error:
        raise Refusal("bad_json", f"not a JSON object: {error}") from None
    if not isinstance(body, dict):
        raise Refusal("bad_json", "not a JSON object")
    known = _identity(body)
    if not isinstance(body.get("op"), str) or body["op"] not in OPS:
        raise Refusal("unknown_op", f"op must be one of {', '.join(OPS)}", **known)
    try:
        return _ADAPTER.validate_python(body)
    except ValidationError as error:
        first = error.errors(include_url=False)[0]
        place = ".".join(str(part) for part in first["loc"][1:])
        if first["loc"][1:2] == ("id",):  # of a union, whose parts are named as they are written
            text = "id: expected a whole number from 0 to 2^53 - 1 or at most 64 characters"
            raise Refusal("bad_request", text, **known) from None
        raise Refusal("bad_request", f"{place}: {first['msg']}", **known) from None


def _identity(body: Mapping[str, Any]) -> dict[str, Any]:
    value = _whole(body.get("id"))
    whole = isinstance(value, int) and not isinstance(value, bool) and 0 <= value < 2**53
    short = isinstance(value, str) and len(value) <= 64
    return {"id": value} if whole or short else {}


def dump(op: str, **content: Any) -> bytes:
    """Encode a line of the server; orjson cannot write NaN or infinity."""
    return orjson.dumps({"op": op, **content}) + b"\n"


def error_line(refusal: Refusal, **envelope: Any) -> bytes:
    """Encode a refusal."""
    content = {"id": None, "code": refusal.code, "message": str(refusal), "fatal": refusal.fatal}
    return dump("error", **{**content, **refusal.extra}, **envelope)


@cache
def schema(side: Literal["server", "client"]) -> dict[str, Any]:
    """Return the JSON Schema of every line that one side sends."""
    text = resources.files("mushpipe.robot").joinpath(f"schema/{side}.schema.json").read_bytes()
    document: dict[str, Any] = orjson.loads(text)
    return document
