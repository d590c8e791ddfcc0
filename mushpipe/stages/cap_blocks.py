"""The depth that is a circle's own: cut out of the image, and averaged over blocks of a grid."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from mushpipe.core.jit import inlined, jit
from mushpipe.stages.cap_model import Floats, Single, Singles

GRID = 11
HIDDEN = Single(-1)
ENOUGH = 0.4  # share of a block's pixels that must have depth

_CENTERS: Floats = (np.arange(GRID) + 0.5) / GRID * 2 - 1
_X, _Y = np.meshgrid(_CENTERS, _CENTERS)
_INSIDE = _X**2 + _Y**2 <= 1
CELLS: Floats = np.stack([_X[_INSIDE], _Y[_INSIDE]], axis=-1)
_SKIPPED = np.argmax(_INSIDE, axis=1)  # cells of a row outside of the circle, on either side


@jit
def own_depth(
    depth: Singles, ranks: NDArray[np.int16], rank: int, circle: Floats, reach: float
) -> tuple[Singles, int, int]:
    """Cut the depth around a circle out of an image.

    Args:
        depth: (H, W) m, missing where not above 0.
        ranks: (H, W) rank of the nearest circle that covers the pixel.
        rank: This circle's; pixels of a lower one are hidden.
        circle: (3,) x, y, radius, px.
        reach: How far around the centre, in radii.

    Returns:
        A copy of the depth, as far as the image goes, 0 where it is missing, HIDDEN where a nearer
        circle hides it; and u and v of its first pixel.
    """
    far = reach * circle[2] + 2.0
    left = min(max(int(circle[0] - far), 0), depth.shape[1])
    right = min(max(int(circle[0] + far) + 2, left), depth.shape[1])
    top = min(max(int(circle[1] - far), 0), depth.shape[0])
    bottom = min(max(int(circle[1] + far) + 2, top), depth.shape[0])
    own = np.empty((bottom - top, right - left), np.float32)
    for i in range(bottom - top):
        row, seen, nearest = own[i], depth[top + i, left:right], ranks[top + i, left:right]
        for j in range(len(row)):
            z = seen[j] if seen[j] > Single(0) else Single(0)  # false for NaN
            row[j] = z if nearest[j] >= rank else HIDDEN
    return own, left, top


@jit
def average(
    cut: tuple[Singles, int, int], circle: Floats, half: int, means: Floats, counts: Floats
) -> None:
    """Average the valid pixels of square blocks, of the width 2 half + 1, around CELLS.

    Args:
        cut: From `own_depth`.
        circle: (3,) x, y, radius, px.
        half: Half width of a block, px.
        means: (97, 4) out: mean u and v (px), mean depth (m) and its variance; 0 if none is valid.
        counts: (97,) out: how many pixels are.
    """
    own, left, top = cut
    first = max(int(circle[0] - circle[2]) - half - left, 0)
    last = min(first + int(2 * circle[2]) + 2 * half + 3, own.shape[1])
    left, width, height = left + first, max(last - first, 0), len(own)
    columns, cell = np.empty((4, width), np.float32), 0
    middles = np.floor(circle[0] + circle[2] * _CENTERS + (0.5 - left)).astype(np.int64)
    number, deep, square, low = columns[0], columns[1], columns[2], columns[3]
    for a in range(GRID):
        columns[:] = 0.0
        v0 = int(np.floor(circle[1] + circle[2] * _CENTERS[a] + 0.5)) - top
        for v in range(max(0, v0 - half), min(height, v0 + half + 1)):
            row, below = own[v, first:last], Single(v - v0)
            for u in range(len(row)):
                z = max(row[u], Single(0))
                valid = Single(1) if z > Single(0) else Single(0)
                number[u] += valid
                deep[u] += z
                square[u] += z * z
                low[u] += below * valid
        for b in range(_SKIPPED[a], GRID - _SKIPPED[a]):
            u0 = middles[b]
            count, su, sv, sz, szz = Single(0), Single(0), Single(0), Single(0), Single(0)
            for u in range(max(0, u0 - half), min(width, u0 + half + 1)):
                count += number[u]
                su += Single(u - u0) * number[u]
                sv += low[u]
                sz += deep[u]
                szz += square[u]
            counts[cell] = count
            share = Single(1) / max(count, Single(1))
            mean = sz * share
            means[cell, 0], means[cell, 1] = left + u0 + su * share, top + v0 + sv * share
            means[cell, 2], means[cell, 3] = mean, max(szz * share - mean * mean, Single(0))
            cell += 1


@inlined
def enough(half: int) -> float:
    """Return of how many valid pixels a block of a half width (px) must have more."""
    return ENOUGH * (2 * half + 1) ** 2


@jit
def middle_depth(means: Floats, counts: Floats, half: int, core: float) -> float:
    """Return the median depth (m) of the blocks near the centre, 0 without any.

    Args:
        means: From `average`.
        counts: From `average`.
        half: Half width of a block, px.
        core: Squared share of the radius that is near.
    """
    values, n = np.empty(len(means)), 0
    for j in range(len(means)):
        near = CELLS[j, 0] ** 2 + CELLS[j, 1] ** 2 < core
        if near and counts[j] > enough(half):
            values[n] = means[j, 2]
            n += 1
    return float(np.median(values[:n])) if n else 0.0
