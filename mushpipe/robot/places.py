"""Where targets stood that a robot is on its way to, should they come back under another id.

Ids end where the camera pauses or its clock is set. What a robot has accepted stands there still,
and as a target that nobody has accepted it would be offered to another robot. What was only put
off may be offered once more: a camera on the arm sees other mushrooms there before long.
"""

from __future__ import annotations

from collections.abc import Sequence, Set

import numpy as np

from mushpipe.core.arrays import Bools
from mushpipe.robot.targets import Choice, Target

USUAL_M = 0.04  # diameter of a target of which none is known


class Places:
    """The places at which targets that are claimed were last seen."""

    def __init__(self) -> None:
        self._largest = -1  # id of those seen so far: ids rise, and never come twice
        self._claimed: dict[int, tuple[Target, str, int]] = {}

    def look(self, choice: Choice, claimed: Set[int]) -> None:
        """Note where claimed targets are; those that are claimed no more are forgotten."""
        self._claimed = {key: at for key, at in self._claimed.items() if key in claimed}
        self._largest = max((self._largest, *(target.id for target in choice.targets)))
        for target in choice.targets:
            if target.id in claimed:
                self._claimed[target.id] = target, choice.frame, self._largest

    def taken(self, targets: Sequence[Target], frame: str) -> Bools:
        """Return which targets came up within half a diameter of where a claimed one was last seen.

        All at once: a robot that accepts whatever it sees claims thousands, and the others are
        served meanwhile.
        """
        claimed = [
            (*known.row[:3], known.row[7], largest)
            for known, known_frame, largest in self._claimed.values()
            if known_frame == frame and largest < self._largest  # else nothing came up since
        ]
        if not claimed or not targets:
            return np.zeros(len(targets), bool)
        old = np.array(claimed)
        new = np.array([(*target.row[:3], target.row[7], target.id) for target in targets])
        apart = sum((new[:, i, None] - old[:, i]) ** 2 for i in range(3))
        size = np.maximum(new[:, 3, None], old[:, 3])
        near = apart < (np.where(size > 0, size, USUAL_M) / 2) ** 2
        return np.asarray((near & (new[:, 4, None] > old[:, 4])).any(axis=1))
