"""What a depth image says about each cap: points on a grid inside its circle, and its depth edge.

Kernels work on the sensor's native depth, 0 = missing, and on the rays of all pixels; they assume
finite numbers.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from mushpipe.core.jit import jit

Floats = NDArray[np.float64]
GRID = 11
DIRECTIONS = 32
RADII = 26
INNER, OUTER = 0.55, 1.45  # where an edge is looked for, in radii of the circle
CORE = 0.35  # squared share of the radius inside which the middle depth is taken

_CENTERS = (np.arange(GRID) + 0.5) / GRID * 2 - 1
_X, _Y = (axis.ravel() for axis in np.meshgrid(_CENTERS, _CENTERS))
_INSIDE = _X**2 + _Y**2 <= 1
CELLS: Floats = np.stack([_X[_INSIDE], _Y[_INSIDE]], axis=-1)
_TURN = np.arange(DIRECTIONS) * (2 * np.pi / DIRECTIONS)
COMPASS: Floats = np.stack([np.cos(_TURN), np.sin(_TURN)], axis=-1)
SCAN: Floats = np.linspace(INNER, OUTER, RADII)


@jit
def paint(labels: NDArray[np.int32], circles: Floats, order: NDArray[np.int64]) -> None:
    """Write 1 + row of the circle (x, y, r) into the pixels it covers, in the given order."""
    height, width = labels.shape
    for i in order:
        x, y, r = circles[i, 0], circles[i, 1], circles[i, 2]
        for v in range(max(0, int(np.ceil(y - r))), min(height, int(np.floor(y + r)) + 1)):
            half = np.sqrt(max(r * r - (v - y) ** 2, 0.0))
            left = max(0, int(np.ceil(x - half)))
            right = min(width, int(np.floor(x + half)) + 1)
            for u in range(left, right):
                labels[v, u] = i + 1


@jit
def block(
    depth: NDArray[Any],
    scale: float,
    rays: NDArray[np.float32],
    labels: NDArray[np.int32],
    hides: NDArray[np.bool_],
    place: tuple[int, int, int],
    out: Floats,
) -> int:
    """Average the valid pixels of a square block.

    Args:
        depth: (H, W) native.
        scale: Metres per unit.
        rays: (H, W, 2) x and y of each pixel's ray at z = 1; beyond 1e3 where it has none.
        labels: (H, W) 1 + row of the nearest circle that covers the pixel.
        hides: (N + 1,) whether the mushroom of that label stands before this one.
        place: u, v, half width of the block, px.
        out: (4,) out: mean x and y of the rays, mean depth (m), variance of the depth (m^2).

    Returns:
        How many pixels were valid.
    """
    height, width = depth.shape
    u0, v0, half = place
    count, sx, sy, sz, szz = 0, 0.0, 0.0, 0.0, 0.0
    first = 0.0
    for v in range(max(0, v0 - half), min(height, v0 + half + 1)):
        for u in range(max(0, u0 - half), min(width, u0 + half + 1)):
            if depth[v, u] <= 0 or hides[labels[v, u]] or rays[v, u, 0] > 1e3:
                continue
            z = depth[v, u] * scale
            if count == 0:
                first = z
            count += 1
            sx += rays[v, u, 0]
            sy += rays[v, u, 1]
            sz += z - first
            szz += (z - first) * (z - first)
    if count:
        out[0], out[1], out[2] = sx / count, sy / count, first + sz / count
        out[3] = max(szz / count - (sz / count) ** 2, 0.0)
    return count


@jit
def middle_depth(points: Floats, count: NDArray[np.int64], half: int) -> float:
    """Return the median depth of the blocks near the centre, 0 without any."""
    values = np.empty(len(points))
    n = 0
    for j in range(len(points)):
        near = CELLS[j, 0] ** 2 + CELLS[j, 1] ** 2 < CORE
        if near and count[j] > 0.4 * (2 * half + 1) ** 2:
            values[n] = points[j, 2]
            n += 1
    return float(np.median(values[:n])) if n else 0.0


@jit
def trusted_edge(kinds: NDArray[np.int8]) -> int:
    """Return the last step of the cap on a ray outwards, -1 where its edge is not to be trusted.

    Args:
        kinds: (RADII,) of each step: 1 cap, -1 deeper, 2 nearer or another's, 0 missing.

    The edge is the maximum of a running sum that rewards cap and punishes the rest; it counts
    only where something deeper follows at once, for there the cap ends and is not merely hidden.
    """
    best, edge, total = 0.0, -1, 0.0
    for k in range(len(kinds)):
        kind = kinds[k]
        total += 1.0 if kind == 1 else (-1.0 if kind == -1 else (-0.5 if kind == 2 else -0.15))
        if kind == 1 and total > best:
            best, edge = total, k
    for k in range(edge + 1, min(edge + 5, len(kinds))):
        if kinds[k] == 2:
            return -1
        if kinds[k] == -1:
            return edge if edge >= 0 else -1
    return -1


@jit
def step_kind(
    depth: NDArray[Any],
    scale: float,
    labels: NDArray[np.int32],
    hides: NDArray[np.bool_],
    place: tuple[int, int],
    gate: tuple[float, float],
) -> int:
    """Return what a pixel (u, v) is to a cap whose depth lies within the gate (m)."""
    u, v = place
    if not (0 <= v < depth.shape[0] and 0 <= u < depth.shape[1]):
        return 0
    if hides[labels[v, u]]:
        return 2
    z = depth[v, u] * scale
    if z <= 0:
        return 0
    if z < gate[0]:
        return 2
    return 1 if z < gate[1] else -1


@jit
def sample_depth(
    depth: NDArray[Any],
    scale: float,
    rays: NDArray[np.float32],
    labels: NDArray[np.int32],
    hides: NDArray[np.bool_],
    circle: Floats,
    focal: float,
    noise: tuple[float, float],
    out: Floats,
) -> tuple[int, float]:
    """Take the points of a cap: block means on a grid inside its circle, gated around its depth.

    Args:
        depth: (H, W) native, 0 = missing.
        scale: Metres per unit.
        rays: (H, W, 2) rays at z = 1.
        labels: (H, W) 1 + row of the nearest circle that covers the pixel.
        hides: (N + 1,) whether the mushroom of that label stands before this one.
        circle: (3,) x, y, radius, px.
        focal: Focal length, px.
        noise: Sigma of depth is noise[0] + noise[1] z, m.
        out: (M, 5) out: unit ray, range (m), sigma of the range (m).

    Returns:
        Number of points, and the cap's middle depth (m), 0 where there is none.
    """
    radius = circle[2]
    half = max(0, int(np.floor(radius / GRID)))
    full = (2 * half + 1) ** 2
    points = np.empty((len(CELLS), 4))
    count = np.empty(len(CELLS), np.int64)
    for j in range(len(CELLS)):
        u = int(np.round(circle[0] + radius * CELLS[j, 0]))
        v = int(np.round(circle[1] + radius * CELLS[j, 1]))
        count[j] = block(depth, scale, rays, labels, hides, (u, v, half), points[j])
    middle = middle_depth(points, count, half)
    if middle <= 0.0:
        return 0, 0.0
    size = radius * middle / focal
    n = 0
    for j in range(len(CELLS)):
        z, sigma = points[j, 2], noise[0] + noise[1] * points[j, 2]
        even = (2.5 * sigma) ** 2 + (0.6 * size * (2 * half + 1) / radius) ** 2
        if count[j] <= 0.4 * full or points[j, 3] > even:
            continue
        if not middle - 0.8 * size < z < middle + size:
            continue
        length = np.sqrt(1.0 + points[j, 0] ** 2 + points[j, 1] ** 2)
        out[n, 0], out[n, 1], out[n, 2] = points[j, 0] / length, points[j, 1] / length, 1 / length
        out[n, 3] = z * length
        out[n, 4] = sigma * (0.3 + 0.7 / np.sqrt(count[j])) * length
        n += 1
    return n, middle


@jit
def sample_edges(
    depth: NDArray[Any],
    scale: float,
    rays: NDArray[np.float32],
    labels: NDArray[np.int32],
    hides: NDArray[np.bool_],
    circle: Floats,
    focal: float,
    middle: float,
    offset: float,
    out: Floats,
) -> int:
    """Find the depth edge of a cap in 32 directions.

    Args:
        depth: (H, W) native, and so on as in `sample_depth`.
        scale: Metres per unit.
        rays: (H, W, 2) rays at z = 1.
        labels: (H, W) labels.
        hides: (N + 1,) labels that stand before this cap.
        circle: (3,) x, y, radius, px.
        focal: Focal length, px.
        middle: Middle depth of the cap, m.
        offset: How much of its edge the sensor loses, px.
        out: (DIRECTIONS, 3) out: unit rays along the edge.

    Returns:
        Number of trusted edge rays.
    """
    size = circle[2] * middle / focal
    gate = (middle - 0.8 * size, middle + 0.95 * size)
    kinds = np.empty(RADII, np.int8)
    n = 0
    for j in range(DIRECTIONS):
        dx, dy = COMPASS[j, 0], COMPASS[j, 1]
        for k in range(RADII):
            u = int(np.round(circle[0] + circle[2] * SCAN[k] * dx))
            v = int(np.round(circle[1] + circle[2] * SCAN[k] * dy))
            kinds[k] = step_kind(depth, scale, labels, hides, (u, v), gate)
        edge = trusted_edge(kinds)
        if edge < 0:
            continue
        reach = circle[2] * (SCAN[edge] + 0.5 * (SCAN[1] - SCAN[0])) + offset
        ray_at(rays, focal, circle[0] + reach * dx, circle[1] + reach * dy, out[n])
        n += 1
    return n


@jit
def ray_at(rays: NDArray[np.float32], focal: float, x: float, y: float, out: Floats) -> None:
    """Fill the unit ray (3,) of a place in the image (px); outside of it, as without distortion."""
    v = min(max(int(np.round(y)), 0), rays.shape[0] - 1)
    u = min(max(int(np.round(x)), 0), rays.shape[1] - 1)
    rx, ry = rays[v, u, 0] + (x - u) / focal, rays[v, u, 1] + (y - v) / focal
    length = np.sqrt(1.0 + rx * rx + ry * ry)
    out[0], out[1], out[2] = rx / length, ry / length, 1.0 / length
