"""Who is working on which target: what acknowledgements remove and restore."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from math import inf
from typing import Literal

from mushpipe.robot.messages import Refusal

Outcome = Literal["accepted", "rejected", "done", "failed"]
# What is done and out of sight for so long does not come back; its entry may go.
FORGET_S = 600.0
MOST_ENTRIES = 4096


@dataclass
class _Entry:
    owner: str
    done: bool
    until: float
    seen: float

    def ends(self) -> float:
        return self.seen + FORGET_S if self.done else self.until


class Ledger:
    """Targets that are not offered, until when, and on whose word. Times are monotonic seconds.

    ``version`` changes whenever the set of hidden targets may have changed.
    """

    def __init__(self, claim_s: float = 60.0) -> None:
        self.version = 0
        self._claim_s = claim_s
        self._entries: dict[int, _Entry] = {}

    def settle(self, now: float) -> None:
        """Restore what was claimed or held for long enough."""
        over = [key for key, entry in self._entries.items() if now >= entry.ends()]
        for key in over:
            del self._entries[key]
        self.version += bool(over)

    def see(self, ids: Iterable[int], now: float) -> None:
        """Note which mushrooms are visible, targets or not."""
        for key in ids:
            if key in self._entries:
                self._entries[key].seen = now

    def hidden(self) -> frozenset[int]:
        """Return the ids that are not to be offered to anybody."""
        return frozenset(self._entries)

    def apply(
        self, owner: str, target: int, outcome: Outcome, hold_s: float, visible: bool, now: float
    ) -> Literal["removed", "restored"]:
        """Take a robot's word on a target; return what became of it.

        Raises:
            Refusal: `conflict` where another robot holds the target, `unknown_target` where it is
                neither visible nor held, `busy` where too many are held.
        """
        self.settle(now)
        entry = self._entries.get(target)
        if entry is None and not visible:
            raise Refusal("unknown_target", f"m{target} is neither visible nor accepted")
        if entry is not None and entry.owner != owner:
            raise Refusal("conflict", f"m{target} is held by another robot")
        if entry is not None and entry.done:
            return "removed"  # for good, whatever is said later
        self.version += 1
        if outcome in ("accepted", "done") or hold_s > 0:
            if entry is None and len(self._entries) >= MOST_ENTRIES:
                raise Refusal("busy", f"{MOST_ENTRIES} targets are held already")
            wait = {"accepted": self._claim_s, "done": inf}.get(outcome, hold_s)
            self._entries[target] = _Entry(owner, outcome == "done", now + wait, now)
            return "removed"
        self._entries.pop(target, None)
        return "restored"
