"""Who is working on which target: what acknowledgements remove and restore."""

from __future__ import annotations

from collections.abc import Iterable, Set
from dataclasses import dataclass
from typing import Literal

from mushpipe.robot.messages import Outcome, Refusal

MOST_ENTRIES = 4096
LINGER_S = 10.0
"""A picked mushroom is gone from sight before that."""


@dataclass(frozen=True)
class _Entry:
    owner: str
    until: float
    accepted: bool  # else it was only put off


@dataclass(frozen=True)
class _Done:
    owner: str
    since: float


class Ledger:
    """Targets that are not offered, until when, and on whose word. Times are monotonic seconds.

    ``version`` changes whenever the set of hidden targets may have changed.
    """

    def __init__(self, claim_s: float = 60.0) -> None:
        self.version = 0
        self._claim_s = claim_s
        self._entries: dict[int, _Entry] = {}
        self._done: dict[int, _Done] = {}  # for good: ids never come twice
        self._told: set[int] = set()

    def settle(self, now: float) -> None:
        """Restore what was claimed or held for long enough."""
        over = [key for key, entry in self._entries.items() if now >= entry.until]
        for key in over:
            del self._entries[key]
        self.version += bool(over)

    def claimed(self) -> Set[int]:
        """Return the targets that a robot is on its way to."""
        return {key for key, entry in self._entries.items() if entry.accepted}

    def hides(self, target: int) -> bool:
        """Return whether a target is not to be offered to anybody."""
        return target in self._entries or target in self._done

    def put_off(self, target: int) -> bool:
        """Return whether a target is hidden though no robot is on its way to it."""
        return target in self._entries and not self._entries[target].accepted

    def lingering(self, visible: Iterable[int], seen: float) -> list[tuple[int, str]]:
        """Return targets that are seen long after they were done, and whose word that was.

        Each of them once.
        """
        done = [key for key in visible if key in self._done and key not in self._told]
        late = [key for key in done if seen - self._done[key].since >= LINGER_S]
        self._told.update(late)
        return [(key, self._done[key].owner) for key in late]

    def apply(
        self, owner: str, target: int, outcome: Outcome, hold_s: float, visible: bool, now: float
    ) -> Literal["removed", "restored"]:
        """Take a robot's word on a target; return what became of it.

        Raises:
            Refusal: `conflict` where another robot holds the target, `unknown_target` where it is
                neither visible nor held, accepted unseen after it was put off, or accepted though
                it is done, `busy` where too many are held.
        """
        self.settle(now)
        entry = self._entries.get(target)
        word = self._done.get(target, entry)
        holder = word.owner if word else None
        new = holder is None or (outcome == "accepted" and holder == owner and self.put_off(target))
        if new and not visible:
            raise Refusal("unknown_target", f"m{target} is neither visible nor accepted")
        if holder not in (None, owner):
            raise Refusal("conflict", f"m{target} is held, or done, by another robot")
        if target in self._done:
            if outcome == "accepted":
                raise Refusal("unknown_target", f"m{target} is done")
            return "removed"  # for good, whatever is said later
        held = outcome == "accepted" or (outcome != "done" and hold_s > 0)
        if held and entry is None and len(self._entries) >= MOST_ENTRIES:
            raise Refusal("busy", f"{MOST_ENTRIES} targets are held already")
        self.version += 1
        self._entries.pop(target, None)
        if outcome == "done":
            self._done[target] = _Done(owner, now)
            return "removed"
        if held:
            wait = self._claim_s if outcome == "accepted" else hold_s
            self._entries[target] = _Entry(owner, now + wait, outcome == "accepted")
            return "removed"
        return "restored"
