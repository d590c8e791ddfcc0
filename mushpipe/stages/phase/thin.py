"""Thin edges: the maxima of the gradient along its direction."""

from __future__ import annotations

from typing import Any

import numpy as np

from mushpipe.core.arrays import Bytes, Ints32, Singles
from mushpipe.core.jit import borrower, inlined, jit


@borrower
def _ridge(
    above: Singles, here: Singles, below: Singles, gx: Singles, gy: Singles,
    region: Bytes, threshold: float, maybe: Bytes,
) -> None:  # fmt: skip
    """Write where in a row a maximum along the gradient may lie: not on slopes that go on.

    Args:
        above: (W,) magnitude of the gradient in the row above.
        here: (W,) in the row.
        below: (W,) in the row below.
        gx: (W,) gradient in the row.
        gy: (W,)
        region: (W,) where to look.
        threshold: Least magnitude.
        maybe: (W,) receives 0 or 1; the first and last pixel stay as they are.
    """
    least, half, slope_on = np.float32(threshold), np.float32(0.5), np.float32(1.1)
    for x in range(len(here) - 2):  # without branches, and with no index below 0, for SIMD
        m, u, v = here[x + 1], gx[x + 1], gy[x + 1]
        across, along = max(here[x], here[x + 2]), max(above[x + 1], below[x + 1])
        falling, rising = max(above[x], below[x + 2]), max(above[x + 2], below[x])
        slanted = falling if (u > 0) == (v > 0) else rising
        straight = across if abs(u) >= half * m else along
        beside = slanted if min(abs(u), abs(v)) >= half * m else straight
        on = beside <= slope_on * m
        maybe[x + 1] = on & (m > least) & (region[x + 1] != 0)


@inlined
def _bilinear(flat: Singles, first: Any, width: Any, fx: Any, fy: Any) -> Any:
    """Return the value at a fraction of the way from a pixel to the one right of and below it."""
    a, b = flat[np.uint32(first)], flat[np.uint32(first + np.int32(1))]
    c = flat[np.uint32(first + width)]
    d = flat[np.uint32(first + width + np.int32(1))]
    top, bottom = a + fx * (b - a), c + fx * (d - c)
    return top + fy * (bottom - top)


@borrower
def _across(
    size: Singles, y: int, columns: Ints32, gx: Singles, gy: Singles, count: int, found: Singles
) -> None:
    """Write unit normals and the magnitudes one pixel along them and back, of pixels of a row.

    Args:
        size: (H, W) magnitude of the gradient.
        y: The row, neither the first nor the last.
        columns: (W,) the pixels, of which the first `count` matter.
        gx: (W,) gradient in the row.
        gy: (W,)
        count: How many.
        found: (4, W) receives nx, ny, the magnitude ahead, and behind.
    """
    flat, width = size.reshape(-1), np.int32(size.shape[1])
    start, none, one = np.int32(y) * width, np.float32(0), np.float32(1)
    for k in range(count):  # without branches, for SIMD
        x = np.uint32(columns[k])
        here = start + np.int32(x)
        m = flat[np.uint32(here)]
        nx, ny = gx[x] / m, gy[x] / m
        first = here - np.int32(nx < none) - (width if ny < none else np.int32(0))
        fx, fy = nx + one if nx < none else nx, ny + one if ny < none else ny
        found[2, k] = _bilinear(flat, first, width, fx, fy)
        first = here - np.int32(nx > none) - (width if ny > none else np.int32(0))
        fx, fy = one - nx if nx > none else -nx, one - ny if ny > none else -ny
        found[3, k] = _bilinear(flat, first, width, fx, fy)
        found[0, k], found[1, k] = nx, ny


@jit
def thin(
    gx: Singles,
    gy: Singles,
    size: Singles,
    region: Bytes,
    threshold: float,
    points: Singles,
    index: Ints32,
) -> int:
    """Write the maxima of the gradient along its direction, within a region, into `points`.

    The offset along the normal is the vertex of the parabola through the magnitudes one pixel
    before, at, and behind the pixel. `index` receives the row at each pixel.

    Args:
        gx: (H, W) the gradient of an image.
        gy: (H, W)
        size: (H, W) its magnitude.
        region: (H, W) where to look.
        threshold: Least magnitude.
        points: (7, capacity) receives x, y, nx, ny, magnitude over threshold, and the pixel.
        index: (H, W)

    Returns:
        The number of points; looking ends where `points` is full.
    """
    height, width = size.shape
    count, maybe = 0, np.zeros(width, np.uint8)
    columns, found = np.empty(width, np.int32), np.empty((4, width), np.float32)
    for y in range(2, height - 2):
        _ridge(size[y - 1], size[y], size[y + 1], gx[y], gy[y], region[y], threshold, maybe)
        candidates = 0
        for x in range(2, width - 2):
            columns[candidates] = x
            candidates += maybe[x]
        _across(size, y, columns, gx[y], gy[y], candidates, found)
        for k in range(candidates):
            if count == points.shape[1]:
                return count
            x = columns[k]
            m, ahead, behind = size[y, x], found[2, k], found[3, k]
            nx, ny = found[0, k], found[1, k]
            bend = ahead - 2 * m + behind
            t = 0.5 * (behind - ahead) / bend if bend < -1e-6 else 0.0
            points[0, count], points[1, count] = x + t * nx, y + t * ny
            points[2, count], points[3, count] = nx, ny
            points[4, count], points[5, count], points[6, count] = m / threshold, x, y
            # What is no maximum is written over by the next; a branch would be guessed wrong.
            top = ahead <= m and behind < m
            index[y, x] = count if top else -1
            count += top
    return count
