"""Refit of a candidate to the edge points of its outline, to a fraction of a pixel.

The outline is r(t) = r + p cos 2t + q sin 2t around the centre: a circle, and to first order the
ellipse of a tilted cap. Its five parameters minimise the distances of the edge points along the
radius by Gauss-Newton with the weights of Geman & McClure (1987), on fewer and fewer far points.
The circle of the same area has the radius sqrt(r^2 + (p^2 + q^2) / 2).
"""

from __future__ import annotations

import math

import numpy as np

from mushpipe.core.arrays import Floats, Ints32, Singles
from mushpipe.core.jit import borrower, jit
from mushpipe.stages.discs import Radii, within
from mushpipe.stages.linear import solve
from mushpipe.stages.phase.depth import Relief
from mushpipe.stages.phase.scratch import DIRECTIONS, Scratch, scratch_for
from mushpipe.stages.phase.steps import step_up
from mushpipe.stages.phase.strips import TURNED, Strips, gather, outline_hits

# Cosine and sine of each direction, by how many directions there are.
_TURNS = 2 * np.pi * np.arange(DIRECTIONS) / np.maximum(np.arange(DIRECTIONS + 1), 1)[:, None]
COSINES, SINES = np.cos(_TURNS).astype(np.float32), np.sin(_TURNS).astype(np.float32)
# A wide fit, then a narrow one to the edge points around what it found; both of the radius.
REACH = (0.3, 0.2)  # how far from the outline edge points are looked for
SCALES = ((0.18, 0.1), (0.08, 0.05))  # the residual at which a weight has fallen to a quarter
WIDE, NARROW = 0, 1
LEAST = 8  # edge points, by their weight, that hold an outline in place
OVAL = 0.12  # of the radius: expected size of p and q
# Shading inside an outline draws the phase to smaller radii; a second start finds the outer ring.
STARTS = (1.0, 1.3)
SAME = 0.04  # of the radius
BUCKET = 8  # px; cells in which outlines are looked up
FAINT = 0.15  # share of the outline with edges below which a candidate is given up
FIRM = 0.9  # share of the outline with edges, from which on no second start is made
HIDDEN = -3  # in a table of hits: something nearer hides the outline there


@borrower
def directions_of(radius: float) -> int:
    """Return how many directions an outline is looked at in: one every 2 px."""
    return min(DIRECTIONS, max(24, int(math.pi * radius)))


@borrower
def tolerance(radius: float) -> float:
    """Return how far (px) from the outline an edge point still supports it."""
    return max(1.5, 0.07 * radius)


@borrower
def _accumulate(
    edges: Strips, rows: Ints32, count: int, shape: Floats, scale: float, a: Floats, b: Floats
) -> float:
    """Write the normal equations of the edge points to a (5, 5), b (5,); return the weights' sum.

    `shape` is x, y, r, p, q; `scale` the residual (px) at which a weight has fallen to a quarter.
    The Jacobian of a point is c, s, 1, cos 2t, sin 2t. Sums in variables of their own stay in
    registers: a third of the time of sums in an array.
    """
    zero, one, two, least = np.float32(0), np.float32(1), np.float32(2), np.float32(TURNED)
    total = a00 = a01 = a02 = a03 = a04 = a11 = a12 = a13 = a14 = zero
    a23 = a24 = a33 = a34 = a44 = b0 = b1 = b2 = b3 = b4 = zero
    x, y, r = np.float32(shape[0]), np.float32(shape[1]), np.float32(shape[2])
    p, q, per_scale = np.float32(shape[3]), np.float32(shape[4]), np.float32(1 / scale)
    for k in range(count):  # without branches, so that SIMD does it
        row = np.uint32(rows[k])
        dx, dy = edges.x[row] - x, edges.y[row] - y
        d = np.sqrt(dx * dx + dy * dy)
        per_d = one / max(d, one)
        c, s = dx * per_d, dy * per_d
        facing = -(c * edges.nx[row] + s * edges.ny[row])
        c2, s2 = c * c - s * s, two * s * c
        e = d - (r + p * c2 + q * s2)
        off = e * per_scale
        far = one + off * off
        w = edges.weight[row] * facing / (far * far)
        w = w if (facing >= least) & (d >= one) else zero
        wc, ws, w3, w4 = w * c, w * s, w * c2, w * s2
        total += w
        a00, a01, a02, a03, a04 = a00 + wc * c, a01 + wc * s, a02 + wc, a03 + wc * c2, a04 + wc * s2
        a11, a12, a13, a14 = a11 + ws * s, a12 + ws, a13 + ws * c2, a14 + ws * s2
        a23, a24, a33, a34, a44 = a23 + w3, a24 + w4, a33 + w3 * c2, a34 + w3 * s2, a44 + w4 * s2
        b0, b1, b2, b3, b4 = b0 + wc * e, b1 + ws * e, b2 + w * e, b3 + w3 * e, b4 + w4 * e
    a[0, 0], a[0, 1], a[0, 2], a[0, 3], a[0, 4] = a00, a01, a02, a03, a04
    a[1, 1], a[1, 2], a[1, 3], a[1, 4] = a11, a12, a13, a14
    a[2, 2], a[2, 3], a[2, 4], a[3, 3], a[3, 4], a[4, 4] = total, a23, a24, a33, a34, a44
    b[0], b[1], b[2], b[3], b[4] = b0, b1, b2, b3, b4
    return float(total)


@borrower
def fit_outline(edges: Strips, count: int, shape: Floats, stage: int, scratch: Scratch) -> bool:
    """Improve x, y, r, p, q (5,) in place by the first points of `scratch.rows`.

    False where they do not hold it in place.
    """
    start_x, start_y, start_r = shape[0], shape[1], shape[2]
    rows, a, b = scratch.rows, scratch.a, scratch.b
    for scale_of_radius in SCALES[stage]:
        scale = max(1.0, scale_of_radius * shape[2])
        if _accumulate(edges, rows, count, shape, scale, a, b) < LEAST:
            return False
        prior = 8 / max(1.0, (OVAL * shape[2]) ** 2)
        for m in range(5):
            for n in range(m):
                a[m, n] = a[n, m]
            a[m, m] += 0.6
        for m in (3, 4):
            a[m, m] += prior
            b[m] -= prior * shape[m]
        solve(a, b)
        for m in range(5):
            shape[m] += b[m]
        moved = math.hypot(shape[0] - start_x, shape[1] - start_y)
        if moved > max(3.0, 0.4 * start_r) or not 0.6 * start_r < shape[2] < 1.6 * start_r:
            return False
    return True


@borrower
def reach_of(radius: float, stage: int) -> float:
    """Return how far (px) from an outline edge points are looked for."""
    return max(3.0, REACH[stage] * radius)


@borrower
def around(edges: Strips, relief: Relief, shape: Floats, stage: int, scratch: Scratch) -> int:
    """Write the rows of edge points around an outline into `scratch.rows`; return how many."""
    height = relief.height if stage == NARROW else relief.height[:0]
    step, reach = step_up(shape[2] * relief.pixel), reach_of(shape[2], stage)
    return gather(edges, height, step, shape, reach, scratch)


@borrower
def fit_around(edges: Strips, relief: Relief, shape: Floats, stage: int, scratch: Scratch) -> bool:
    """Fit an outline (5,) to the edge points around it, in place; False if they do not hold it."""
    count = around(edges, relief, shape, stage, scratch)
    return count >= 2 * LEAST and fit_outline(edges, count, shape, stage, scratch)


@jit
def refit(
    edges: Strips, relief: Relief, candidates: Singles, radii: Radii
) -> tuple[Floats, Ints32, Singles]:
    """Refit candidates (N, 4) to the edges; those that nothing holds in place are dropped.

    Args:
        edges: Edge points.
        relief: What stands on the bed.
        candidates: x, y, radius (px) and magnitude.
        radii: Of their circles.

    Returns:
        Outlines (M, 5), the hits of their directions (M, `DIRECTIONS`), -2 beyond the last
        direction, and the distances of the hits (M,), px.
    """
    n = len(candidates) * len(STARTS)
    shapes, residual = np.empty((n, 5)), np.empty(n, np.float32)
    hits = np.full((n, DIRECTIONS), -2, np.int32)
    scratch = scratch_for(len(edges.x))
    kept = tried = 0
    firm = np.zeros(len(candidates), np.bool_)
    wide, following = np.empty((n, 5)), np.empty((2, n), np.int32)
    cells = np.full((2, edges.height // BUCKET + 3, edges.width // BUCKET + 3), -1, np.int32)
    for start in STARTS:
        for k in range(len(candidates)):
            if firm[k] or (start > 1 and candidates[k, 2] > 0.95 * radii.largest):
                continue
            shape = shapes[kept]
            shape[0], shape[1] = candidates[k, 0], candidates[k, 1]
            shape[2] = min(radii.largest, start * candidates[k, 2])
            shape[3] = shape[4] = 0
            if not fit_around(edges, relief, shape, WIDE, scratch):
                continue
            if _known(shape, wide, cells[WIDE], following[WIDE]):
                continue  # from there the narrow fit comes to what it came to before
            wide[tried] = shape
            _enter(shape, tried, cells[WIDE], following[WIDE])
            tried += 1
            if not fit_around(edges, relief, shape, NARROW, scratch):
                continue
            if not within(shape[2], radii):
                continue
            if _known(shape, shapes, cells[NARROW], following[NARROW]):
                continue
            n, near = directions_of(shape[2]), tolerance(shape[2])
            found, residual[kept] = outline_hits(edges, shape, near, n, hits[kept], scratch)
            firm[k] = found > FIRM * n
            if found >= FAINT * n:
                _enter(shape, kept, cells[NARROW], following[NARROW])
                kept += 1
    return shapes[:kept], hits[:kept], residual[:kept]


@borrower
def _cell(shape: Floats, cells: Ints32) -> tuple[int, int]:
    """Return row and column of an outline's centre in a grid; places beyond it count as its rim."""
    row = min(max(int(shape[1] / BUCKET), 1), cells.shape[0] - 2)
    return row, min(max(int(shape[0] / BUCKET), 1), cells.shape[1] - 2)


@borrower
def _enter(shape: Floats, number: int, cells: Ints32, following: Ints32) -> None:
    """Enter an outline in the grid; arguments as `_known`."""
    row, column = _cell(shape, cells)
    following[number], cells[row, column] = cells[row, column], number


@borrower
def _known(shape: Floats, others: Floats, cells: Ints32, following: Ints32) -> bool:
    """Whether another outline is the same but for a few per cent.

    `cells` holds the last outline entered in each cell of a grid, `following` the one before it.
    """
    near = max(0.7, SAME * shape[2])
    row, column = _cell(shape, cells)
    for v in range(row - 1, row + 2):
        for u in range(column - 1, column + 2):
            k = cells[v, u]
            while k >= 0:
                away = max(abs(others[k, 0] - shape[0]), abs(others[k, 1] - shape[1]))
                if max(away, abs(others[k, 2] - shape[2])) < near:
                    return True
                k = following[k]
    return False
