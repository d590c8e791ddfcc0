"""What a depth image says about each cap: points on a grid inside its circle, and its depth edge.

Kernels work on depth in metres, 0 = missing, and on the rays of all pixels; they assume finite
numbers.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from mushpipe.core.jit import jit

Floats = NDArray[np.float64]
Singles = NDArray[np.float32]
Vector = tuple[float, float, float]
GRID = 11
DIRECTIONS = 32
RADII = 26
INNER, OUTER = 0.55, 1.45  # where an edge is looked for, in radii of the circle
EDGE_PX = 2.0  # sigma of a depth edge
# Noise and errors of shape are correlated; so much of a point, or of a ray along an edge, counts.
POINT_SHARE, EDGE_SHARE = 0.35 * 169 / GRID**2, 0.6
ASTRAY = 1 / 3  # share of other depth in a circle: is what its centre shows the cap at all?
CORE = 0.35  # squared share of the radius inside which the middle depth is taken

_CENTERS = (np.arange(GRID) + 0.5) / GRID * 2 - 1
_X, _Y = (axis.ravel() for axis in np.meshgrid(_CENTERS, _CENTERS))
_INSIDE = _X**2 + _Y**2 <= 1
CELLS: Floats = np.stack([_X[_INSIDE], _Y[_INSIDE]], axis=-1)
_TURN = np.arange(DIRECTIONS) * (2 * np.pi / DIRECTIONS)
COMPASS: Floats = np.stack([np.cos(_TURN), np.sin(_TURN)], axis=-1)


@jit
def block(
    depth: Singles,
    ranks: NDArray[np.int16],
    rank: int,
    place: tuple[int, int, int],
    out: Floats,
) -> int:
    """Average the valid pixels of a square block.

    Args:
        depth: (H, W) m, 0 = missing.
        ranks: (H, W) rank of the nearest circle that covers the pixel.
        rank: This circle's; pixels of a lower one are hidden.
        place: u, v, half width of the block, px.
        out: (4,) out: mean u and v (px), mean depth (m) and its variance.

    Returns:
        How many pixels were valid.
    """
    height, width = depth.shape
    u0, v0, half = place
    count, su, sv, sz, szz = 0, 0, 0, 0.0, 0.0
    for v in range(max(0, v0 - half), min(height, v0 + half + 1)):
        row = 0
        for u in range(max(0, u0 - half), min(width, u0 + half + 1)):
            z = float(depth[v, u])
            valid = (z > 0.0) & (ranks[v, u] >= rank)  # a factor is faster than a branch
            row += valid
            su += u * valid
            sz += z * valid
            szz += z * z * valid
        count += row
        sv += v * row
    if count:
        mean = sz / count
        out[0], out[1], out[2] = su / count, sv / count, mean
        out[3] = max(szz / count - mean * mean, 0.0)
    return count


@jit
def middle_depth(points: Floats, count: NDArray[np.int64], half: int) -> float:
    """Return the median depth (m) of the blocks near the centre, 0 without any."""
    values = np.empty(len(points))
    n = 0
    for j in range(len(points)):
        near = CELLS[j, 0] ** 2 + CELLS[j, 1] ** 2 < CORE
        if near and count[j] > 0.4 * (2 * half + 1) ** 2:
            values[n] = points[j, 2]
            n += 1
    return float(np.median(values[:n])) if n else 0.0


@jit
def sample_depth(
    image: Any,
    rank: int,
    circle: Floats,
    focal: float,
    noise: tuple[float, float],
    out: Singles,
) -> tuple[int, int, float]:
    """Take the points of a cap: block means on a grid inside its circle, gated around its depth.

    Args:
        image: Depth (H, W), rays (H, W, 2) at z = 1, beyond 1e3 where a pixel has none, and ranks
            (H, W) as in `block`.
        rank: This circle's.
        circle: (3,) x, y, radius, px.
        focal: Focal length, px.
        noise: Sigma of depth is noise[0] + noise[1] z, m.
        out: (6, M) out: unit ray, range and its sigma (m), share that counts as independent.

    Returns:
        Number of points, number of those outside of the gate, and the cap's middle depth (m), 0
        where there is none.
    """
    depth, rays, ranks = image
    radius = circle[2]
    half = max(0, int(np.floor(radius / GRID)))
    full = (2 * half + 1) ** 2
    points = np.empty((len(CELLS), 4))
    count = np.empty(len(CELLS), np.int64)
    for j in range(len(CELLS)):
        u = int(np.floor(circle[0] + radius * CELLS[j, 0] + 0.5))
        v = int(np.floor(circle[1] + radius * CELLS[j, 1] + 0.5))
        count[j] = block(depth, ranks, rank, (u, v, half), points[j])
    middle = middle_depth(points, count, half)
    if middle <= 0.0:
        return 0, 0, 0.0
    size = radius * middle / focal
    n, other = 0, 0
    for j in range(len(CELLS)):
        z = points[j, 2]
        sigma = noise[0] + noise[1] * z
        even = (2.5 * sigma) ** 2 + (0.6 * size * (2 * half + 1) / radius) ** 2
        if count[j] <= 0.4 * full or points[j, 3] > even:
            continue
        if not middle - 0.8 * size < z < middle + size:
            other += 1
            continue
        ray = ray_at(rays, focal, points[j, 0], points[j, 1])
        if ray[2] < 1e-3:
            continue  # where the lens has none
        out[0, n], out[1, n], out[2, n], out[3, n] = ray[0], ray[1], ray[2], z / ray[2]
        out[4, n] = sigma * (0.3 + 0.7 / np.sqrt(count[j])) / ray[2]
        out[5, n] = POINT_SHARE
        n += 1
    return n, other, middle


@jit
def edge_along(
    depth: NDArray[np.float32],
    ranks: NDArray[np.int16],
    rank: int,
    line: tuple[float, float, float, float],
    gate: tuple[float, float],
) -> int:
    """Return the last step of a cap on a line outwards, -1 where its edge is not to be trusted.

    The edge is the maximum of a running sum that rewards what lies within the cap's depth and
    punishes the rest: deeper by 1, nearer or another's by 1/2, missing by 0.15. It counts only
    where something deeper follows within 4 steps, for there the cap ends and is not merely hidden.

    Args:
        depth: (H, W) m, 0 = missing.
        ranks: (H, W) as in `block`.
        rank: This circle's.
        line: x, y of the first step and of a step, px.
        gate: Depths of the cap, m.
    """
    height, width = depth.shape
    best, edge, total, follows = 0.0, -1, 0.0, 0
    for k in range(RADII):
        u = int(np.floor(line[0] + k * line[2] + 0.5))
        v = int(np.floor(line[1] + k * line[3] + 0.5))
        z, hidden = 0.0, False
        if 0 <= v < height and 0 <= u < width:
            z, hidden = float(depth[v, u]), ranks[v, u] < rank
        if hidden or 0.0 < z < gate[0]:
            total -= 0.5
            if follows == 0:
                follows = -1
        elif z <= 0.0:
            total -= 0.15
        elif z > gate[1]:
            total -= 1.0
            if follows == 0 and k <= edge + 4:
                follows = 1
        else:
            total += 1.0
            if total > best:
                best, edge, follows = total, k, 0
        if edge >= 0 and total < best - 4.0:
            break
    return edge if follows > 0 else -1


@jit
def sample_edges(
    image: Any,
    rank: int,
    circle: Floats,
    focal: float,
    middle: float,
    offset: float,
    out: Singles,
) -> int:
    """Find the depth edge of a cap in 32 directions.

    Args:
        image: As in `sample_depth`.
        rank: This circle's.
        circle: (3,) x, y, radius, px.
        focal: Focal length, px.
        middle: Middle depth of the cap, m.
        offset: How much of its edge the sensor loses, px.
        out: (6, DIRECTIONS) out: rays that touch the cap, as in `touch`.

    Returns:
        Number of trusted edge rays.
    """
    depth, rays, ranks = image
    x, y, radius = circle[0], circle[1], circle[2]
    size = radius * middle / focal
    gate = (middle - 0.8 * size, middle + 0.95 * size)
    step = radius * (OUTER - INNER) / (RADII - 1)
    n = 0
    for j in range(DIRECTIONS):
        dx, dy = COMPASS[j, 0], COMPASS[j, 1]
        line = (x + INNER * radius * dx, y + INNER * radius * dy, step * dx, step * dy)
        edge = edge_along(depth, ranks, rank, line, gate)
        if edge < 0:
            continue
        reach = INNER * radius + (edge + 0.5) * step + offset
        ray = ray_at(rays, focal, x + reach * dx, y + reach * dy)
        touch(out, n, ray, EDGE_PX * middle / focal, EDGE_SHARE)
        n += 1
    return n


@jit
def touch(out: Singles, n: int, ray: Vector, sigma: float, share: float) -> None:
    """Fill column n of rays (6, M) with one that touches the cap, within sigma (m)."""
    out[0, n], out[1, n], out[2, n] = ray
    out[3, n], out[4, n], out[5, n] = 0.0, sigma, share


@jit
def ray_at(rays: NDArray[np.float32], focal: float, x: float, y: float) -> Vector:
    """Return the unit ray of a place in the image (px); outside of it, as without distortion."""
    v = min(max(int(np.floor(y + 0.5)), 0), rays.shape[0] - 1)
    u = min(max(int(np.floor(x + 0.5)), 0), rays.shape[1] - 1)
    rx, ry = rays[v, u, 0] + (x - u) / focal, rays[v, u, 1] + (y - v) / focal
    length = np.sqrt(1.0 + rx * rx + ry * ry)
    return rx / length, ry / length, 1.0 / length
