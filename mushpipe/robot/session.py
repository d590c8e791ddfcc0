"""One JSON client, as a state machine: lines in, lines out, no socket and no clock of its own."""

from __future__ import annotations

import hmac
from typing import Protocol

from mushpipe.robot.hub import Ending, Hub, Leaving, Result
from mushpipe.robot.messages import (
    HEARTBEAT_S,
    VERSION,
    Ack,
    Bye,
    GetTargets,
    Hello,
    Inbound,
    Ping,
    Refusal,
    State,
    dump,
    error_line,
    parse,
)


class Outgoing:
    """A line to send, and the monotonic time after which it must not leave any more."""

    def __init__(self, data: bytes, expires: float | None = None) -> None:
        self.data = data
        self.expires = expires


class Session(Leaving, Protocol):
    """What a connection needs of either protocol. Times are monotonic seconds."""

    ready: bool
    terminators: bytes

    def handle(self, line: bytes, now: float) -> Outgoing | None:
        """Answer a line of the client."""

    def due(self, now: float) -> Outgoing | None:
        """Return the next line that the client did not ask for."""

    def refuse(self, refusal: Refusal, now: float) -> Outgoing:
        """Say why the connection ends, and end it."""


class JsonSession:
    """The protocol of docs/robot.md."""

    terminators = b"\n"

    def __init__(self, hub: Hub, number: int) -> None:
        self.ready = False
        self.closing = False
        self._hub = hub
        self._owner = f"#{number}"
        self._streams = False
        self._greeted = False
        self._sent = 0
        self._heartbeat: float = 0.0
        self._told: State | None = None
        self._last_word: Ending | None = None

    def handle(self, line: bytes, now: float) -> Outgoing | None:
        """Answer a line of the client, unless another has its name and only its bye waits."""
        if self._last_word == "replaced":
            return None
        try:
            return self._answer(parse(line), now)
        except Refusal as refusal:
            if not self.ready and not refusal.fatal:
                text = f"before hello: {refusal}"
                refusal = Refusal("hello_expected", text, fatal=True, **refusal.extra)
            return self.refuse(refusal, now)

    def due(self, now: float) -> Outgoing | None:
        """Return the next of: hello, bye, heartbeat, and in a stream the newest targets."""
        hub = self._hub
        if not self._greeted:
            self._greeted = True
            return Outgoing(dump("hello", **hub.greeting(now)))
        if self._last_word is not None:
            self.closing = True
            return Outgoing(dump("bye", reason=self._last_word, **hub.envelope(now)))
        if not self.ready:
            return None
        state = hub.state(now)
        if now >= self._heartbeat or state != self._told:
            self._heartbeat, self._told = now + HEARTBEAT_S, state
            seq = hub.newest.seq if hub.newest else 0
            age = {"seq": seq, "age_ms": hub.age_ms(now), "client": self._owner}
            return Outgoing(dump("heartbeat", state=state, **age, **hub.envelope(now)))
        return self._stream(now) if self._streams else None

    def _stream(self, now: float) -> Outgoing | None:
        if self._hub.newest is None or self._hub.newest.seq == self._sent:
            return None
        limit_s = self._hub.settings.max_age_s
        try:
            result = self._hub.fresh(now, limit_s)  # which may be newer already
        except Refusal:
            return None  # the heartbeat tells of a stall; nothing old is sent
        self._sent = result.seq
        return self._targets(result, now, limit_s, 1000, None)

    def _targets(
        self, result: Result, now: float, limit_s: float, most: int, identity: int | str | None
    ) -> Outgoing:
        line = self._hub.targets_line(result, now, most, limit_s, identity)
        return Outgoing(line, result.taken + min(limit_s, self._hub.settings.max_age_s))

    def _answer(self, message: Inbound, now: float) -> Outgoing | None:
        if isinstance(message, Hello):
            self._welcome(message)
        elif not self.ready:
            asked = {"id": message.id} if isinstance(message, GetTargets | Ack | Ping) else {}
            raise Refusal("hello_expected", "the first line must be a hello", fatal=True, **asked)
        elif isinstance(message, GetTargets):
            return self._get(message, now)
        elif isinstance(message, Ack):
            return self._ack(message, now)
        elif isinstance(message, Ping):
            return Outgoing(dump("pong", id=message.id, **self._hub.envelope(now)))
        elif isinstance(message, Bye):
            self.leave("client")
        return None

    def _welcome(self, hello: Hello) -> None:
        if self.ready:
            raise Refusal("bad_request", "hello was said already")
        settings = self._hub.settings
        if hello.version.partition(".")[0] != VERSION.partition(".")[0]:
            text = f"this server speaks {VERSION}, the client {hello.version}"
            raise Refusal("unsupported_version", text, fatal=True)
        if settings.token and not hmac.compare_digest(
            hello.token.encode(), settings.token.encode()
        ):
            raise Refusal("unauthorised", "the token is missing or wrong", fatal=True)
        if settings.replay and not hello.accept_replay:
            text = "this is a recording, not a camera; a client that wants it says accept_replay"
            raise Refusal("replay_refused", text, fatal=True)
        self.ready = True
        self._streams = hello.mode == "stream"
        if hello.name:
            self._owner = hello.name
            self._hub.name(hello.name, self)

    def _get(self, message: GetTargets, now: float) -> Outgoing:
        hub = self._hub
        limit_s = hub.settings.max_age_s if message.max_age_ms is None else message.max_age_ms / 1e3
        try:
            result = hub.fresh(now, limit_s)
            if message.frame not in (None, result.choice.frame):
                raise Refusal("unknown_frame", f"targets are in '{result.choice.frame}'")
        except Refusal as refusal:
            refusal.extra["id"] = message.id
            raise
        return self._targets(result, now, limit_s, message.max, message.id)

    def _ack(self, message: Ack, now: float) -> Outgoing:
        number = int(message.target[1:])
        try:
            effect = self._hub.acknowledge(
                self._owner, number, message.result, message.hold_ms / 1e3, now
            )
        except Refusal as refusal:
            refusal.extra.update(id=message.id, target=message.target)
            raise
        content = {"id": message.id, "target": message.target, "result": message.result}
        return Outgoing(dump("acked", **content, effect=effect, **self._hub.envelope(now)))

    def refuse(self, refusal: Refusal, now: float) -> Outgoing:
        """Say why something is not done; a fatal refusal ends the connection."""
        self.closing = self.closing or refusal.fatal
        return Outgoing(error_line(refusal, **self._hub.envelope(now)))

    def leave(self, reason: Ending) -> None:
        """End the connection after a `bye`."""
        self._last_word = self._last_word or reason
