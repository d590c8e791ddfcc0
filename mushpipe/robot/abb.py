"""Short ASCII lines for controllers that cannot parse JSON: one line in, one line out.

Millimetres, degrees nowhere, quaternions w x y z, every line below 80 characters, because that is
the longest string of RAPID. Nothing is sent unasked, so that a receive is always one answer.
"""

from __future__ import annotations

import hmac
import re
from typing import get_args

from mushpipe.robot.hub import Ending, Hub, Result, ceil_ms
from mushpipe.robot.messages import LONGEST_HOLD_MS, NAME, Outcome, Refusal
from mushpipe.robot.session import Outgoing
from mushpipe.robot.targets import Target

LONGEST = 79
_OUTCOMES: dict[str, Outcome] = {outcome.upper(): outcome for outcome in get_args(Outcome)}


def target_line(target: Target, age_ms: int) -> str | None:
    """Return ``T,id,x,y,z,q1,q2,q3,q4,diameter,flags,age``; None where it would be too long."""
    x, y, z, qx, qy, qz, qw, diameter = target.row
    place = ",".join(f"{1000 * value:.1f}" for value in (x, y, z))
    turn = ",".join(f"{value:.4f}" for value in (qw, qx, qy, qz))
    line = f"T,{target.id},{place},{turn},{1000 * diameter:.1f},{target.flags},{age_ms}"
    return line if len(line) <= LONGEST else None


class AbbSession:
    """The line protocol of docs/robot.md."""

    terminators = b"\r\n"

    def __init__(self, hub: Hub, number: int) -> None:
        self.ready = False
        self.closing = False
        self._hub = hub
        self._owner = f"#{number}"

    def handle(self, line: bytes, now: float) -> Outgoing | None:
        """Answer a line of the client."""
        expires = None
        try:
            words = line.decode("ascii").strip().split(",")
            if not self.ready:
                answer = self._hello(words)
            elif words[0] == "NEXT":
                answer, expires = self._next(words, now)
            else:
                answer = self._other(words, now)
        except Refusal as refusal:
            return self.refuse(refusal, now)
        except ValueError:
            return self.refuse(Refusal("bad_request", "not understood", not self.ready), now)
        return Outgoing(answer.encode("ascii") + b"\n", expires)

    def _hello(self, words: list[str]) -> str:
        settings = self._hub.settings
        if words[0] != "HELLO" or len(words) < 2:
            raise Refusal("hello_expected", "HELLO,1 comes first", fatal=True)
        if words[1] != "1":
            raise Refusal("unsupported_version", "this server speaks 1", fatal=True)
        said = dict(word.partition("=")[::2] for word in words[2:])
        token = said.get("TOKEN", "")
        if settings.token and not hmac.compare_digest(token, settings.token):
            raise Refusal("unauthorised", "the token is missing or wrong", fatal=True)
        if settings.replay and "REPLAY" not in said:
            raise Refusal("replay_refused", "this is a recording", fatal=True)
        if not re.fullmatch(NAME, said.get("NAME", "")):
            raise Refusal("bad_request", "a name is of letters, digits, _ . -", fatal=True)
        self.ready = True
        if said.get("NAME"):
            self._owner = said["NAME"]
            self._hub.name(self._owner, self)
        return f"HELLO,1,{self._source()},{self._hub.session[:8]}"

    def _source(self) -> str:
        return "REPLAY" if self._hub.settings.replay else "LIVE"

    def _next(self, words: list[str], now: float) -> tuple[str, float]:
        """Answer with the best target that has a line."""
        most = self._hub.settings.max_age_s
        limit = min(most, _positive(words[1]) / 1000) if len(words) > 1 else most
        result = self._hub.fresh(now, limit)
        age = ceil_ms(max(0.0, now - result.taken))
        return self._best(result, age) or f"NONE,{age}", result.taken + limit

    def _best(self, result: Result, age_ms: int) -> str | None:
        lines = (target_line(target, age_ms) for target in self._hub.offered(result))
        return next((line for line in lines if line is not None), None)

    def _other(self, words: list[str], now: float) -> str:
        if words[0] == "ACK" and len(words) in (3, 4) and words[2] in _OUTCOMES:
            target, hold_ms = _positive(words[1]), _positive(words[3]) if len(words) > 3 else 0
            if hold_ms > LONGEST_HOLD_MS:
                raise Refusal("bad_request", f"a target is held for {LONGEST_HOLD_MS} ms at most")
            outcome = _OUTCOMES[words[2]]
            effect = self._hub.acknowledge(self._owner, target, outcome, hold_ms / 1e3, now)
            return f"A,{target},{effect.upper()}"
        if words == ["STATE"]:
            seq = self._hub.newest.seq if self._hub.newest else 0
            return f"S,{self._hub.state(now).upper()},{seq},{self._source()}"
        if words == ["PING"]:
            return "PONG"
        if words == ["BYE"]:
            self.closing = True
            return "BYE"
        raise Refusal("unknown_op", "not understood")

    def due(self, now: float) -> Outgoing | None:
        """Return None: every line is an answer."""
        del now
        return None

    def refuse(self, refusal: Refusal, now: float) -> Outgoing:
        """Return ``E,CODE`` or ``E,STALE,STATE``; a fatal refusal ends the connection.

        Nobody asked when time is up: a line would be taken for the answer to the next one.
        """
        del now
        self.closing = self.closing or refusal.fatal
        if refusal.code == "timeout":
            return Outgoing(b"")
        words = ["E", refusal.code.upper(), str(refusal.extra.get("state", "")).upper()]
        return Outgoing(",".join(word for word in words if word).encode("ascii") + b"\n")

    def leave(self, reason: Ending) -> None:
        """End the connection; there is no last word, because nobody asked."""
        del reason
        self.closing = True


def _positive(word: str) -> int:
    if not (word.isdecimal() and len(word) <= 15):
        raise Refusal("bad_request", "a number was expected")
    return int(word)
