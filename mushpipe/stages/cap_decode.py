"""From the maps of `cap-net` to circles: peaks of the heat, then one circle per cap.

After CenterNet (Zhou, Wang & Kraehenbuehl 2019, arXiv 1904.07850, section 4.1): a cell is a peak
where it is the largest of its 3x3 neighbourhood.
"""

from __future__ import annotations

import math

import cv2
import numpy as np

from mushpipe.core.arrays import Bools, Floats, Rows, Singles
from mushpipe.core.jit import borrower
from mushpipe.stages.discs import iou

STRIDE = 4
HEAT, MASK, RADIUS, OFFSET = 0, 1, 2, slice(3, 5)
CHANNELS = 5
_MOST = 600  # peaks; more caps than that do not fit into an image


def circles_of(maps: Singles, least: float) -> tuple[Floats, Floats]:
    """Return circles (N, 3) px and scores (N,), the most certain first.

    Args:
        maps: (5, h, w): logits of heat and mask, log(radius / STRIDE), and the way from a cell to
            the centre in x and y, in cells.
        least: Smallest score.
    """
    heat = maps[HEAT]
    limit = np.log(least / (1 - least)) if 0 < least < 1 else (-np.inf if least <= 0 else np.inf)
    highest = np.asarray(cv2.dilate(heat, np.ones((3, 3), np.uint8)))
    row, column = np.nonzero((heat >= highest) & (heat > limit))
    order = np.argsort(-heat[row, column], kind="stable")[:_MOST]
    row, column = row[order], column[order]
    at = maps[:, row, column].astype(np.float64)
    # the middle of cell k is pixel STRIDE (k + 1/2) - 1/2
    cells = np.stack([column, row]) + np.clip(at[OFFSET], -2, 2) + 0.5
    radius = STRIDE * np.exp(np.clip(at[RADIUS], -3, 6))
    circles = np.column_stack([*(STRIDE * cells - 0.5), radius])
    return circles, 1 / (1 + np.exp(-at[HEAT]))


def first_of_each(circles: Floats, overlap: float) -> Rows:
    """Return the rows of circles (N, 3) that overlap no kept row before by more than an IoU."""
    free = np.ones(len(circles), bool)
    _suppress(circles, overlap, free)
    return np.flatnonzero(free)


@borrower
def _suppress(circles: Floats, overlap: float, free: Bools) -> None:
    for row in range(len(circles)):
        x, y, radius = circles[row]
        for before in range(row):
            u, v, other = circles[before]
            squared = (x - u) ** 2 + (y - v) ** 2
            meets = free[before] and squared < (radius + other) ** 2
            if meets and iou(math.sqrt(squared), radius, other) > overlap:
                free[row] = False
                break
