"""Circles of another detector, beside which `phase-hough` looks for its own."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from mushpipe import Circles
from mushpipe.core.jit import borrower, jit
from mushpipe.stages.discs import LEAST_OF_RANGE, MOST_OF_RANGE, iou
from mushpipe.stages.phase_edges import Plane
from mushpipe.stages.phase_refit import Table

_AROUND = 4.0  # px; a circle of a network is not more exact than that


def candidates_of(learned: Circles, smallest: float, largest: float) -> Plane:
    """Return circles as candidates (N, 4) for a refit: those of a radius (px) within the range."""
    rows = np.column_stack([learned.center, learned.radius, learned.score]).astype(np.float32)
    enough = learned.radius >= LEAST_OF_RANGE * smallest
    return np.asarray(rows[enough & (learned.radius <= MOST_OF_RANGE * largest)])


def add_discs(learned: Circles, foreground: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """Return a foreground (H, W) with 1 in the circles and a little around them as well."""
    added = foreground.copy()
    _fill(added, learned.center, learned.radius)
    return added


def agreement(shapes: Table, radius: Table, learned: Circles) -> Table:
    """Return how far each outline (N, 5) of a radius (N,) is one of the circles: 0..1.

    The largest score of a circle, times its IoU with the outline's circle.
    """
    return _agreement(shapes, radius, learned.center, learned.radius, learned.score)


@borrower
def _fill(foreground: NDArray[np.uint8], center: Table, radius: Table) -> None:
    height, width = foreground.shape
    for k in range(len(center)):
        x, y, reach = center[k, 0], center[k, 1], radius[k] + _AROUND
        for v in range(max(0, math.ceil(y - reach)), min(height, math.floor(y + reach) + 1)):
            half = math.sqrt(reach * reach - (v - y) ** 2)
            for u in range(max(0, math.ceil(x - half)), min(width, math.floor(x + half) + 1)):
                foreground[v, u] = 1


@jit
def _agreement(shapes: Table, radius: Table, center: Table, of: Table, score: Table) -> Table:
    best = np.zeros(len(shapes))
    for k in range(len(shapes)):
        for m in range(len(center)):
            dx, dy = shapes[k, 0] - center[m, 0], shapes[k, 1] - center[m, 1]
            squared = dx * dx + dy * dy
            if squared < (radius[k] + of[m]) ** 2:
                best[k] = max(best[k], score[m] * iou(math.sqrt(squared), radius[k], of[m]))
    return best
