"""Circles of another detector, beside which `phase-hough` looks for its own."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from mushpipe import Circles
from mushpipe.evaluate.matching import circle_iou
from mushpipe.stages.phase_edges import Plane
from mushpipe.stages.phase_refit import Table

_AROUND = 4.0  # px; a circle of a network is not more exact than that


def candidates_of(learned: Circles, smallest: float, largest: float) -> Plane:
    """Return the circles of a radius (px) within the range as candidates (N, 4) for a refit."""
    rows = np.column_stack([learned.center, learned.radius, learned.score]).astype(np.float32)
    within: NDArray[np.bool_] = (learned.radius >= smallest) & (learned.radius <= largest)
    return rows[within]


def discs_of(learned: Circles, shape: tuple[int, ...]) -> NDArray[np.uint8]:
    """Return (H, W) 1 in the circles and a little around them: there edges are looked for."""
    discs = np.zeros(shape, np.uint8)
    for (x, y), radius in zip(learned.center, learned.radius, strict=True):
        cv2.circle(discs, (round(x), round(y)), round(radius + _AROUND), 1, -1)
    return discs


def agreement(shapes: Table, radius: Table, learned: Circles) -> Table:
    """Return how far each outline (N, 5) of a radius (N,) is one of the circles: 0..1.

    The largest score of a circle, times its IoU with the outline's circle.
    """
    iou = circle_iou(shapes[:, :2], radius, learned.center, learned.radius)
    return np.asarray((iou * learned.score).max(axis=1, initial=0.0))
