"""Where targets stood that a robot is on its way to, should they come back under another id.

Ids end where the camera pauses or its clock is set. What a robot has accepted stands there still,
and as a target that nobody has accepted it would be offered to another robot. What was only put
off may be offered once more: a camera on the arm sees other mushrooms there before long.
"""

from __future__ import annotations

import math
from collections.abc import Set

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

    def taken(self, target: Target, frame: str) -> bool:
        """Whether a target came up within half a diameter of where a claimed one was last seen."""
        return any(
            target.id > largest
            and frame == known_frame
            and math.dist(target.row[:3], known.row[:3])
            < (max(target.row[7], known.row[7]) or USUAL_M) / 2
            for known, known_frame, largest in self._claimed.values()
        )
