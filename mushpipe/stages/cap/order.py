"""Which circle hides which: the nearer one, by the depth in its middle."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from mushpipe.core.arrays import Floats, Ints, Singles
from mushpipe.core.jit import borrower, jit
from mushpipe.stages.cap.blocks import median
from mushpipe.stages.cap.model import LANES

WIDE = 32767.0  # columns, more than any image has
Order = tuple[Ints, NDArray[np.int16]]


@borrower
def paint(ranks: NDArray[np.int16], circles: Floats, order: Ints) -> None:
    """Write into each pixel the rank of the nearest circle that covers it.

    Args:
        ranks: (H, W) out; the nearest circle has rank 0, where there is none it stays as it is.
        circles: (N, 3) x, y, radius, px.
        order: (N,) rows of the circles, the nearest first.
    """
    height, width = ranks.shape
    for rank in range(len(order) - 1, -1, -1):
        x, y, r = circles[order[rank]]
        first = min(max(0, int(np.ceil(x - r))), width)
        beyond = max(first, min(width, int(np.floor(x + r)) + 1))
        beyond = min(width, first + (beyond - first + LANES - 1) // LANES * LANES)
        value = np.int16(rank)
        for v in range(max(0, int(np.ceil(y - r))), min(height, int(np.floor(y + r)) + 1)):
            half = np.sqrt(max(r * r - (v - y) ** 2, 0.0))
            # of every row the same columns: loops of one length are foreseen by the processor
            row = ranks[v, first:beyond]
            left = np.int16(min(max(np.ceil(x - half) - first, 0.0), WIDE))
            right = np.int16(max(min(np.floor(x + half) - first, WIDE), -1.0))
            for j in range(beyond - first):
                column = np.int16(j)
                row[j] = value if (left <= column) & (column <= right) else row[j]


@borrower
def core_depth(depth: Singles, circle: Floats, values: Singles) -> float:
    """Return the median depth (m) near the centre of a circle (x, y, r), 0 without any.

    Args:
        depth: (H, W) m, missing where not above 0.
        circle: (3,) x, y, radius, px.
        values: (25,) room.
    """
    n = 0
    for i in range(-2, 3):
        for j in range(-2, 3):
            u = int(np.floor(circle[0] + 0.24 * i * circle[2] + 0.5))
            v = int(np.floor(circle[1] + 0.24 * j * circle[2] + 0.5))
            if 0 <= v < depth.shape[0] and 0 <= u < depth.shape[1] and depth[v, u] > 0:
                values[n] = depth[v, u]
                n += 1
    return median(values, n)


def by_depth(depth: Singles, circles: Floats) -> Order:
    """Return each circle's rank (N,), the nearest 0, and the lowest on each pixel (H, W), else N.

    Args:
        depth: (H, W) m, missing where not above 0.
        circles: (N, 3) x, y, radius, px.
    """
    ranks = np.full(depth.shape, len(circles), np.int16)
    return _rank(depth, circles, ranks), ranks


@jit
def _rank(depth: Singles, circles: Floats, ranks: NDArray[np.int16]) -> Ints:
    far, values = np.empty(len(circles)), np.empty(25, np.float32)
    for i in range(len(circles)):
        far[i] = core_depth(depth, circles[i], values)
        if far[i] <= 0.0:
            far[i] = 1e30  # hides nothing
    order = np.argsort(far)
    paint(ranks, circles, order)
    rank = np.empty(len(circles), np.int64)
    for k in range(len(circles)):
        rank[order[k]] = k
    return rank
