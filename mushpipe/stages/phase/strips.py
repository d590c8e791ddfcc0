"""Edge points in strips of the image, so that those around an outline lie side by side in memory.

A ring around a centre crosses a few strips, and in each the points between two columns are one
range: SIMD looks at all of them in a fraction of the time that it takes to look up their pixels.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from mushpipe.core.arrays import Floats, Ints32, Singles
from mushpipe.core.jit import borrower, inlined, jit
from mushpipe.stages.phase.edges import Edges
from mushpipe.stages.phase.scratch import Scratch
from mushpipe.stages.phase.steps import rises

Single = np.float32
STRIP = 16  # px
AROUND = 32  # sectors of an outline in which it is looked for what hides it
# They are as wide as each other in |cos| + |sin| = 1, where a point's sector needs no arc tangent.
_SIDE = np.repeat([1, -1], AROUND // 2)
_ACROSS = _SIDE * np.tile(1 - np.arange(1, AROUND, 2) * 2 / AROUND, 2)
_ALONG = _SIDE * (1 - abs(_ACROSS))
COSINE, SINE = (np.array([_ACROSS, _ALONG]) / np.hypot(_ACROSS, _ALONG)).astype(np.float32)
TURNED = 0.7  # cosine between an edge's normal and the radius
ALIGNED = 0.8  # the same, for edges that support an outline
RAY = np.float32(0.75)  # px; so far beside a direction an edge may lie
A1, A3, A5 = np.float32(0.9998660), np.float32(-0.3302995), np.float32(0.1801410)
A7, A9 = np.float32(-0.0851330), np.float32(0.0208351)
QUARTER, FULL = np.float32(math.pi / 2), np.float32(2 * math.pi)


class Strips(NamedTuple):
    """Edge points by strip and column.

    Attributes:
        x: (M,) px, as all up to `weight` in `Edges`.
        y: (M,) px.
        nx: (M,)
        ny: (M,)
        weight: (M,)
        starts: Where each column of each strip begins.
        height: Of the image, px.
        width: Of the image, px.
    """

    x: Singles
    y: Singles
    nx: Singles
    ny: Singles
    weight: Singles
    starts: Ints32
    height: int
    width: int


@jit
def _sort(points: Singles, height: int, width: int) -> tuple[Singles, Ints32]:
    """Return points (C, M), x and y first, by strip and column, and where each column begins."""
    count = points.shape[1]
    starts = np.zeros((height // STRIP + 1) * width + 1, np.int32)
    cell, row = np.empty(count, np.int32), np.empty(count, np.int32)
    for k in range(count):
        u = min(max(int(points[0, k]), 0), width - 1)
        cell[k] = min(max(int(points[1, k]), 0), height - 1) // STRIP * width + u
        starts[cell[k] + 1] += 1
    for k in range(1, len(starts)):
        starts[k] += starts[k - 1]
    free, out = starts.copy(), np.empty_like(points)
    for k in range(count):
        row[k] = free[cell[k]]
        free[cell[k]] += 1
    for column in range(len(points)):
        for k in range(count):
            out[column, row[k]] = points[column, k]
    return out, starts


def in_strips(edges: Edges, height: int, width: int) -> Strips:
    """Return the edge points of an image of a size (px) in strips."""
    (x, y, nx, ny, weight), starts = _sort(np.stack(edges), height, width)
    return Strips(x, y, nx, ny, weight, starts, height, width)


@borrower
def _sector(dx: float, dy: float) -> int:
    """Return the sector of a direction."""
    across = dx / (abs(dx) + abs(dy))
    turn = 1 - across if dy >= 0 else 3 + across
    return int(turn * (AROUND / 4)) % AROUND


@borrower
def _uncovered(
    edges: Strips, height: Singles, step: float, shape: Floats, count: int, scratch: Scratch
) -> int:
    """Keep the rows of points in whose sector nothing stands higher; return their number."""
    rows, up, kept = scratch.rows, scratch.lanes[:, :AROUND], 0
    rises(height, shape, COSINE, SINE, up)
    highest = np.float32(0)
    for k in range(AROUND):
        highest = max(highest, up[0, k])
    if highest <= step:
        return count
    for k in range(count):
        row = rows[k]
        rows[kept] = row
        kept += up[0, _sector(edges.x[row] - shape[0], edges.y[row] - shape[1])] <= step
    return kept


@borrower
def _strips(edges: Strips, shape: Floats, outer: float) -> tuple[int, int]:
    """Return the strips, from and up to, that a circle around an outline's centre crosses.

    Points beyond the image are in the strips and columns at its border, and so is such a circle.
    """
    first = min(max(int(shape[1] - outer), 0), edges.height - 1)
    last = min(max(int(shape[1] + outer), 0), edges.height - 1)
    return first // STRIP, last // STRIP + 1


@borrower
def _span(edges: Strips, shape: Floats, outer: float, strip: int) -> tuple[int, int]:
    """Return the rows, from and up to, of the points of a strip that may lie in such a circle."""
    above = strip * STRIP - shape[1] if strip > 0 else 0.0
    below = shape[1] - (strip + 1) * STRIP if (strip + 1) * STRIP < edges.height else 0.0
    away = max(above, below, 0.0)
    half = math.sqrt(max(0.0, outer * outer - away * away))
    left = min(max(int(shape[0] - half), 0), edges.width - 1)
    right = min(max(int(shape[0] + half), 0), edges.width - 1)
    row = strip * edges.width
    return edges.starts[row + left], edges.starts[row + right + 1]


@borrower
def _single(shape: Floats) -> tuple[Single, Single, Single, Single, Single]:
    """Return an outline in single precision, in which SIMD does twice as much."""
    x, y, r = np.float32(shape[0]), np.float32(shape[1]), np.float32(shape[2])
    return x, y, r, np.float32(shape[3]), np.float32(shape[4])


@inlined
def _seen(
    edges: Strips,
    k: np.uint32,
    outline: tuple[Single, Single, Single, Single, Single],
    square: Single,
) -> tuple[Single, Single, Single, bool]:
    """Return a point's place from the centre, its distance from the outline, and if it faces it.

    `square` is that of the least cosine between its normal and the radius. Without branches.
    """
    x, y, r, p, q = outline
    one, two = np.float32(1), np.float32(2)
    dx, dy = edges.x[k] - x, edges.y[k] - y
    squared = dx * dx + dy * dy
    safe = max(squared, one)
    away = dx * edges.nx[k] + dy * edges.ny[k]
    e = abs(np.sqrt(safe) - r - (p * (dx * dx - dy * dy) + two * q * dx * dy) / safe)
    return dx, dy, e, (away < 0) & (away * away >= square * squared) & (squared >= one)


@borrower
def _around(edges: Strips, low: int, shape: Floats, reach: float, near: Ints32) -> None:
    """Write if the points from a row on lie within `reach` of an outline and face its centre."""
    outline, square, far = _single(shape), np.float32(TURNED**2), np.float32(reach)
    for i in range(len(near)):
        _, _, e, facing = _seen(edges, np.uint32(low + i), outline, square)
        near[i] = facing & (e <= far)


@borrower
def gather(
    edges: Strips, height: Singles, step: float, shape: Floats, reach: float, scratch: Scratch
) -> int:
    """Write which edge points around an outline face its centre to `scratch.rows`; return how many.

    None where it is higher outside by `step` (m), for there something nearer hides the outline.

    Args:
        edges: Edge points.
        height: (h, w) m at half resolution, -1 where unknown; empty without depth.
        step: m
        shape: (5,) the outline.
        reach: How far (px) from it points are looked for.
        scratch: For all edge points.
    """
    rows, count = scratch.rows, 0
    outer = shape[2] + abs(shape[3]) + abs(shape[4]) + reach
    first, last = _strips(edges, shape, outer)
    for strip in range(first, last):
        low, high = _span(edges, shape, outer, strip)
        near = scratch.near[: high - low]
        _around(edges, low, shape, reach, near)
        for i in range(high - low):
            rows[count] = low + i
            count += near[i]
    return _uncovered(edges, height, step, shape, count, scratch) if len(height) else count


@borrower
def _turn(dx: Single, dy: Single) -> Single:
    """Return the angle (0..2 pi) of a direction, to 1e-5.

    Abramowitz & Stegun (1964), 4.4.47; without branches, so that SIMD does it.
    """
    across, along = abs(dx), abs(dy)
    t = min(across, along) / max(across, along)
    u = t * t
    angle = A1 + u * (A3 + u * (A5 + u * (A7 + u * A9)))
    angle = QUARTER - t * angle if along > across else t * angle
    angle = QUARTER + QUARTER - angle if dx < 0 else angle
    return FULL - angle if dy < 0 else angle


@borrower
def _beside(
    edges: Strips, low: int, shape: Floats, near: float, n: int, at: Ints32, off: Ints32
) -> None:
    """Write at which of n directions the points from a row on support an outline, -1 for none.

    Args:
        edges: Edge points.
        low: The first row.
        shape: (5,)
        near: How far (px) from the outline a point may lie.
        n: Number of directions.
        at: (K,) receives the directions.
        off: (K,) receives the distances from the outline, in 1/1000 px.
    """
    outline, square, far = _single(shape), np.float32(ALIGNED**2), np.float32(near)
    gap = np.float32(2 * math.pi * shape[2] / n)
    per_turn, half, fine = np.float32(n / (2 * math.pi)), np.float32(0.5), np.float32(1000)
    for i in range(len(at)):
        dx, dy, e, facing = _seen(edges, np.uint32(low + i), outline, square)
        turn = _turn(dx, dy) * per_turn + half
        place = np.int32(turn)
        beside = abs(turn - np.float32(place) - half) * gap < RAY
        at[i] = place if facing & (e < far) & beside else -1
        off[i] = np.int32(e * fine)


@borrower
def outline_hits(
    edges: Strips, shape: Floats, near: float, n: int, hits: Ints32, scratch: Scratch
) -> tuple[int, float]:
    """Write per direction the row of the nearest edge point that supports the outline, else -1.

    Args:
        edges: Edge points.
        shape: (5,)
        near: How far (px) from the outline a point may lie.
        n: Number of directions.
        hits: (D,) receives the rows, and -2 beyond the last direction.
        scratch: For all edge points.

    Returns:
        The number of hits, and the root mean square of their distances (px).
    """
    best = scratch.off
    best[:n], hits[:n], hits[n:] = 2**30, -1, -2
    outer = shape[2] + abs(shape[3]) + abs(shape[4]) + near
    first, last = _strips(edges, shape, outer)
    for strip in range(first, last):
        low, high = _span(edges, shape, outer, strip)
        at, off = scratch.rows[: high - low], scratch.near[: high - low]
        _beside(edges, low, shape, near, n, at, off)
        for i in range(high - low):
            direction = at[i] % n
            if at[i] >= 0 and off[i] < best[direction]:
                best[direction], hits[direction] = off[i], low + i
    found, squares = 0, 0.0
    for direction in range(n):
        if hits[direction] >= 0:
            found += 1
            squares += (0.001 * best[direction]) ** 2
    return found, math.sqrt(squares / max(found, 1))
