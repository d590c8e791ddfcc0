"""What all clients share: the newest result, the pipeline's state, and who works on what."""

from __future__ import annotations

import logging
import math
import uuid
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Literal, Protocol
from weakref import WeakValueDictionary

import orjson

from mushpipe.robot.clock import Clock
from mushpipe.robot.ledger import LINGER_S, Ledger
from mushpipe.robot.messages import (
    CLIENT_TIMEOUT_S,
    HEARTBEAT_S,
    PROTOCOL,
    VERSION,
    Outcome,
    Refusal,
    State,
)
from mushpipe.robot.places import Places
from mushpipe.robot.targets import Choice, Reason, Target

logger = logging.getLogger("mushpipe")
Ending = Literal["end", "failed", "no_camera", "client", "replaced"]


class Leaving(Protocol):
    """A session that can be ended."""

    closing: bool

    def leave(self, reason: Ending) -> None:
        """End the connection after a last word."""


@dataclass(frozen=True)
class Settings:
    """What every session is held to; times in seconds."""

    max_age_s: float = 0.5
    stall_s: float = 1.0
    claim_s: float = 60.0
    max_targets: int = 200
    replay: bool = False
    token: str = ""
    software: str = "mushpipe"


@dataclass(frozen=True)
class Result:
    """The targets of one frame.

    Attributes:
        seq: Number of the result in this session, from 1.
        frame_number: The frame's sequence number at its source.
        stamp_ns: Sensor time, ns since the epoch.
        taken: Monotonic time from which its age counts, s; minus infinity where nobody knows.
        published: Monotonic time at which the pipeline handed it over, s.
        choice: The targets.
    """

    seq: int
    frame_number: int
    stamp_ns: int
    taken: float
    published: float
    choice: Choice


class Hub:
    """The server's memory; it holds one result, never more.

    `publish` may be called by another thread; everything else belongs to the server's.
    """

    def __init__(
        self, settings: Settings, clock: Clock, frames_read: Callable[[], int] = lambda: 0
    ) -> None:
        self.settings = settings
        self.clock = clock
        self.session = str(uuid.uuid4())
        self.ledger = Ledger(settings.claim_s)
        self._places = Places()
        self.newest: Result | None = None
        self.ending: Ending | None = None
        self._frames_read = frames_read
        self._named: WeakValueDictionary[str, Leaving] = WeakValueDictionary()
        self._begin = clock.monotonic()
        # A source that has delivered nothing yet has not been seen to work.
        self._read = (0, self._begin - settings.stall_s)
        self._cache: tuple[tuple[int, int, int], bytes, dict[Reason, int], bool] | None = None

    def name(self, name: str, session: Leaving) -> None:
        """Give a session a name; another one that has it ends: what is accepted goes by names."""
        before = self._named.get(name)
        if before is not None and not before.closing:
            logger.warning(
                "a robot calls itself '%s' as another connection does: that one is ended", name
            )
            before.leave("replaced")
        self._named[name] = session

    def publish(self, choice: Choice, frame_number: int, stamp_ns: int, taken: float) -> Result:
        """Put a new result in the place of the last one."""
        seq = self.newest.seq + 1 if self.newest else 1
        now = self.clock.monotonic()
        self.newest = Result(seq, frame_number, stamp_ns, min(taken, now), now, choice)
        return self.newest

    def tick(self, now: float) -> None:
        """Notice what time and the pipeline have done."""
        count = self._frames_read()
        if count != self._read[0]:
            self._read = (count, now)
        self.ledger.settle(now)
        self._look()
        self._doubt()

    def _doubt(self) -> None:
        """Say it where a target stands on after a robot said that it was done.

        In a recording all of them do.
        """
        result = self.newest
        if result is None or self.settings.replay:
            return
        visible = (target.id for target in result.choice.targets)
        for target, owner in self.ledger.lingering(visible, result.published):
            logger.warning(
                "m%d still stands where it was, though robot '%s' said 'done' %g s ago or more: it "
                "is offered to nobody until it gets a new id",
                *(target, owner, LINGER_S),
            )

    def _look(self) -> None:
        if self.newest is not None:
            self._places.look(self.newest.choice, self.ledger.claimed())

    def state(self, now: float) -> State:
        """Say how the pipeline is."""
        if self.ending is not None:
            return "no_camera" if self.ending == "no_camera" else "stalled"
        if self.newest is not None and now - self.newest.published <= self.settings.stall_s:
            return "running"
        delivering = now - self._read[1] < self.settings.stall_s
        return "stalled" if delivering or self.settings.replay else "no_camera"

    def fresh(self, now: float, max_age_s: float) -> Result:
        """Return the newest result.

        Raises:
            Refusal: `stale`: there is none, or it is older than allowed.
        """
        result = self.newest
        limit = min(max_age_s, self.settings.max_age_s)
        if result is None or not now - result.taken <= limit or self.ending:
            text = "there is no result yet" if result is None else "the newest result is too old"
            raise Refusal("stale", text, state=self.state(now), age_ms=self.age_ms(now))
        return result

    def age_ms(self, now: float) -> int | None:
        """Return the age of the newest result, rounded up; None where nobody knows it."""
        age = max(0.0, now - self.newest.taken) if self.newest else math.inf
        return None if age == math.inf else ceil_ms(age)

    def envelope(self, now: float) -> dict[str, Any]:
        """Return what stands in every message."""
        return {"t_ms": int((now - self._begin) * 1000), "replay": self.settings.replay}

    def greeting(self, now: float) -> dict[str, Any]:
        """Return the content of the server's hello."""
        settings = self.settings
        return {
            "protocol": PROTOCOL,
            "version": VERSION,
            "software": settings.software,
            "session": self.session,
            "units": {"length": "m", "angle": "rad"},
            "quaternion": "xyzw",
            "frame": self.newest.choice.frame if self.newest else None,
            "max_age_ms": round(settings.max_age_s * 1000),
            "heartbeat_ms": round(HEARTBEAT_S * 1000),
            "client_timeout_ms": round(CLIENT_TIMEOUT_S * 1000),
            "auth": "token" if settings.token else "none",
            **self.envelope(now),
        }

    def targets_line(
        self, result: Result, now: float, most: int, limit_s: float, identity: Any
    ) -> bytes:
        """Encode a `targets` message with the age it has now."""
        body, withheld, more = self._body(result, most)
        age = max(0.0, now - result.taken)  # it may have come since the server looked at the clock
        limit = min(limit_s, self.settings.max_age_s)
        head = {
            "op": "targets",
            "id": identity,
            "seq": result.seq,
            "status": "ok",
            "frame_number": result.frame_number,
            "stamp": {"sec": result.stamp_ns // 10**9, "nsec": result.stamp_ns % 10**9},
            "age_ms": ceil_ms(age),
            "valid_ms": max(0, math.floor(round((limit - age) * 1000, 3))),
            "frame": result.choice.frame,
            **self.envelope(now),
            "withheld": withheld,
            "more": more,
        }
        return orjson.dumps(head)[:-1] + body

    def free(self, result: Result) -> list[Target]:
        """Return the targets nobody has claimed, best first."""
        choice = result.choice
        self._places.look(choice, self.ledger.claimed())
        shown = [t for t in choice.targets if not self.ledger.hides(t.id)]
        taken = self._places.taken(shown, choice.frame).tolist()
        return [t for t, gone in zip(shown, taken, strict=True) if not gone]

    def offered(self, result: Result) -> list[Target]:
        """Return the first targets nobody has claimed, as many as may be sent."""
        return self.free(result)[: self.settings.max_targets]

    def _body(self, result: Result, most: int) -> tuple[bytes, dict[Reason, int], bool]:
        """Encode what is the same for every client, once."""
        key = (result.seq, self.ledger.version, most)
        if self._cache is None or self._cache[0] != key:
            free = self.free(result)
            offered = free[: self.settings.max_targets]
            sent = offered[:most]
            withheld: dict[Reason, int] = {
                **result.choice.withheld,
                "claimed": len(result.choice.targets) - len(free),
                "limit": len(free) - len(offered),
            }
            listed = b",".join(target.json for target in sent)
            body = b',"count":%d,"targets":[%s]}\n' % (len(sent), listed)
            self._cache = (key, body, withheld, len(sent) < len(offered))
        return self._cache[1:]

    def acknowledge(
        self, owner: str, target: int, outcome: Outcome, hold_s: float, now: float
    ) -> Literal["removed", "restored"]:
        """Take a robot's word on a target.

        Raises:
            Refusal: See `Ledger.apply`; `stale` where a robot accepts a target, not one that it
                holds already, and nobody knows any more whether it is there.
        """
        self.ledger.settle(now)  # a claim that has just ended is none
        held = self.ledger.hides(target) and not self.ledger.put_off(target)
        if outcome == "accepted" and not held:
            self.fresh(now, self.settings.max_age_s)
        self._look()
        choice = self.newest.choice if self.newest else Choice("", (), {})
        known = [t for t in choice.targets if t.id == target]
        visible = not self._places.taken(known, choice.frame).all()
        effect = self.ledger.apply(owner, target, outcome, hold_s, visible, now)
        self._look()
        return effect


def ceil_ms(seconds: float) -> int:
    """Return whole milliseconds, rounded up."""
    # What a float adds to a whole number of milliseconds is not worth another one.
    return math.ceil(round(seconds * 1000, 3))
