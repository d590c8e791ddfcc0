"""Which circle is which cap: exact circle IoU of at least 0.5, ignored ones neutral."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from mushpipe import Circles
from mushpipe.core.arrays import Bools, Floats, Rows
from mushpipe.core.truth import Truth
from mushpipe.evaluate.matching import assign, circle_iou

IOU = 0.5


def counted(truth: Truth, smallest: float, largest: float) -> Bools:
    """Return which caps must be found, for a detector of a range of radii (px)."""
    sized = (truth.radius >= smallest) & (truth.radius <= largest)
    return np.asarray((truth.ignore == 0) & sized)


def matched(iou: Floats, counts: Bools) -> tuple[Rows, Rows]:
    """Return the circles and the caps that go together, of a table of IoU (circles, caps).

    Args:
        iou: (N, M).
        counts: (M,) which caps must be found.
    """
    rows, columns = assign(iou[:, counts], IOU)
    return rows, np.flatnonzero(counts)[columns]


@dataclass
class Score:
    """Counts over frames, and the errors of what was matched.

    `errors` holds centre error, radius error and share visible of each match; `reliability` score
    and 1 or 0 of each circle that is right or wrong.
    """

    right: int = 0
    missed: int = 0
    false: int = 0
    errors: list[tuple[float, float, float]] = field(default_factory=list)
    reliability: list[tuple[float, float]] = field(default_factory=list)

    def add(self, circles: Circles, truth: Truth, counts: Bools) -> None:
        """Match the circles of a frame with its truth."""
        iou = circle_iou(circles.center, circles.radius, truth.center, truth.radius)
        rows, columns = matched(iou, counts)
        neutral = (iou[:, ~counts] >= IOU).any(axis=1)
        wrong = np.setdiff1d(np.flatnonzero(~neutral), rows)
        self.right += len(rows)
        self.missed += int(counts.sum()) - len(rows)
        self.false += len(wrong)
        away = np.linalg.norm(circles.center[rows] - truth.center[columns], axis=1)
        larger = circles.radius[rows] - truth.radius[columns]
        self.errors += zip(away, larger, truth.visible[columns], strict=True)
        self.reliability += [(s, 1.0) for s in circles.score[rows]]
        self.reliability += [(s, 0.0) for s in circles.score[wrong]]

    def merge(self, other: Score) -> None:
        """Add the counts of another score."""
        self.right += other.right
        self.missed += other.missed
        self.false += other.false
        self.errors += other.errors
        self.reliability += other.reliability

    @property
    def recall(self) -> float:
        """Share of the caps that were found."""
        return self.right / max(1, self.right + self.missed)

    @property
    def precision(self) -> float:
        """Share of the circles that are right."""
        return self.right / max(1, self.right + self.false)

    @property
    def f(self) -> float:
        """Harmonic mean of recall and precision; 1 where there is nothing and nothing was found."""
        wrong = self.missed + self.false
        return 2 * self.right / (2 * self.right + wrong) if self.right + wrong else 1.0
