"""What a depth image says about each cap: points on a grid inside its circle, and its depth edge.

Kernels work on depth in metres, 0 = missing, and on the rays of all pixels; they assume finite
numbers.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from mushpipe.core.jit import jit
from mushpipe.stages.cap_blocks import CELLS, GRID, average, enough, middle_depth
from mushpipe.stages.cap_model import Floats, Single, Singles, Vector

DIRECTIONS = 32
RADII = 26
INNER, OUTER = 0.55, 1.45  # where an edge is looked for, in radii of the circle,
STEP = (OUTER - INNER) / (RADII - 1)  # in so many steps
EDGE_PX = 2.0  # sigma of a depth edge
# Noise and errors of shape are correlated; so much of a point, or of a ray along an edge, counts.
POINT_SHARE, EDGE_SHARE = 0.35 * 169 / GRID**2, 0.6
ASTRAY = 1 / 3  # share of other depth in a circle: is what its centre shows the cap at all?
CORE = 0.35  # squared share of the radius inside which the middle depth is taken

_TURN = np.arange(DIRECTIONS) * (2 * np.pi / DIRECTIONS)
COMPASS: Floats = np.stack([np.cos(_TURN), np.sin(_TURN)], axis=-1)
EAST, SOUTH = np.cos(_TURN).astype(np.float32), np.sin(_TURN).astype(np.float32)


@jit
def sample_depth(
    cut: Any,
    rays: Singles,
    circle: Floats,
    focal: float,
    noise: tuple[float, float],
    out: Singles,
) -> tuple[int, int, float]:
    """Take the points of a cap: block means on a grid inside its circle, gated around its depth.

    Args:
        cut: From `own_depth`.
        rays: (H, W, 2) rays at z = 1, beyond 1e3 where a pixel has none.
        circle: (3,) x, y, radius, px.
        focal: Focal length, px.
        noise: Sigma of depth is noise[0] + noise[1] z, m.
        out: (6, M) out: unit ray, range and its sigma (m), share that counts as independent.

    Returns:
        Number of points, number of those outside of the gate, and the cap's middle depth (m), 0
        where there is none.
    """
    radius = circle[2]
    half = max(0, int(np.floor(radius / GRID)))
    points, count = np.empty((len(CELLS), 4)), np.empty(len(CELLS))
    average(cut, circle, half, points, count)
    middle = middle_depth(points, count, half, CORE)
    if middle <= 0.0:
        return 0, 0, 0.0
    size = radius * middle / focal
    n, other = 0, 0
    for j in range(len(CELLS)):
        z = points[j, 2]
        sigma = noise[0] + noise[1] * z
        even = (2.5 * sigma) ** 2 + (0.6 * size * (2 * half + 1) / radius) ** 2
        if count[j] <= enough(half) or points[j, 3] > even:
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
def follow(cut: Any, circle: Floats, gate: tuple[float, float], state: Singles) -> None:
    """Find the last step of a cap in each direction, where its edge is to be trusted.

    The edge is the maximum of a running sum that rewards what lies within the cap's depth and
    punishes the rest: deeper by 1, nearer or another's by 1/2, missing by 0.15. It counts only
    where something deeper follows within 4 steps, for there the cap ends and is not merely hidden.

    Args:
        cut: From `own_depth`.
        circle: (3,) x, y, radius, px.
        gate: Depths of the cap, m.
        state: (6 DIRECTIONS,) out, rows of DIRECTIONS: whether it goes on, the sum, its maximum,
            the step of that (-1 without), and what follows it: 1 something deeper, -1 something
            nearer, 0 neither yet; then the depth at the last step. In one array at fixed distances
            the compiler sees that nothing overlaps, and works on several directions at once.
    """
    own, (height, width) = cut[0].reshape(-1), cut[0].shape
    none, one, low, high = Single(0), Single(1), Single(gate[0]), Single(gate[1])
    half, little, four = Single(0.5), Single(0.15), Single(4)
    x, y = Single(circle[0] - cut[1] + 0.5), Single(circle[1] - cut[2] + 0.5)
    pixels = np.empty(DIRECTIONS, np.int32)
    for j in range(DIRECTIONS):
        state[j], state[j + DIRECTIONS], state[j + 2 * DIRECTIONS] = one, none, none
        state[j + 3 * DIRECTIONS], state[j + 4 * DIRECTIONS] = -one, none
    for k in range(RADII):
        far, step = Single(circle[2] * (INNER + k * STEP)), Single(k)
        for j in range(DIRECTIONS):
            u, v = np.int32(np.floor(x + far * EAST[j])), np.int32(np.floor(y + far * SOUTH[j]))
            inside = (u >= 0) & (v >= 0) & (u < width) & (v < height)
            pixels[j] = v * width + u if inside else -1
        for j in range(DIRECTIONS):
            state[j + 5 * DIRECTIONS] = own[pixels[j]] if pixels[j] >= 0 else none
        for j in range(DIRECTIONS):
            on, total = state[j] > none, state[j + DIRECTIONS]
            best, edge = state[j + 2 * DIRECTIONS], state[j + 3 * DIRECTIONS]
            follows, z = state[j + 4 * DIRECTIONS], state[j + 5 * DIRECTIONS]
            missing, deeper = z == none, z > high
            nearer = (z < low) & (z != none)  # or another's
            change = -half if nearer else (-little if missing else (-one if deeper else one))
            total += change if on else none
            top = on & (change == one) & (total > best)
            ends = one if deeper & (step <= edge + four) else none
            ends = -one if nearer else ends
            follows = ends if on & (follows == none) else follows
            best, edge = total if top else best, step if top else edge
            on = on & ((edge < none) | (total >= best - four))
            state[j], state[j + DIRECTIONS] = one if on else none, total
            state[j + 2 * DIRECTIONS], state[j + 3 * DIRECTIONS] = best, edge
            state[j + 4 * DIRECTIONS] = none if top else follows
        going = none
        for j in range(DIRECTIONS):
            going += state[j]
        if going == none:
            break


@jit
def sample_edges(
    cut: Any,
    rays: Singles,
    circle: Floats,
    focal: float,
    middle: float,
    offset: float,
    out: Singles,
) -> int:
    """Find the depth edge of a cap in 32 directions.

    Args:
        cut: From `own_depth`, not empty.
        rays: (H, W, 2) rays at z = 1.
        circle: (3,) x, y, radius, px.
        focal: Focal length, px.
        middle: Middle depth of the cap, m.
        offset: How much of its edge the sensor loses, px.
        out: (6, DIRECTIONS) out: rays that touch the cap, as in `touch`.

    Returns:
        Number of trusted edge rays.
    """
    size, state = circle[2] * middle / focal, np.empty(6 * DIRECTIONS, np.float32)
    follow(cut, circle, (middle - 0.8 * size, middle + 0.95 * size), state)
    n = 0
    for j in range(DIRECTIONS):
        edge = state[j + 3 * DIRECTIONS]
        if edge < 0.0 or state[j + 4 * DIRECTIONS] <= 0.0:
            continue
        reach = circle[2] * (INNER + (edge + 0.5) * STEP) + offset
        x, y = circle[0] + reach * COMPASS[j, 0], circle[1] + reach * COMPASS[j, 1]
        touch(out, n, ray_at(rays, focal, x, y), EDGE_PX * middle / focal, EDGE_SHARE)
        n += 1
    return n


@jit
def touch(out: Singles, n: int, ray: Vector, sigma: float, share: float) -> None:
    """Fill column n of rays (6, M) with one that touches the cap, within sigma (m)."""
    out[0, n], out[1, n], out[2, n] = ray
    out[3, n], out[4, n], out[5, n] = 0.0, sigma, share


@jit
def ray_at(rays: Singles, focal: float, x: float, y: float) -> Vector:
    """Return the unit ray of a place in the image (px); outside of it, as without distortion."""
    v = min(max(int(np.floor(y + 0.5)), 0), rays.shape[0] - 1)
    u = min(max(int(np.floor(x + 0.5)), 0), rays.shape[1] - 1)
    rx, ry = rays[v, u, 0] + (x - u) / focal, rays[v, u, 1] + (y - v) / focal
    length = np.sqrt(1.0 + rx * rx + ry * ry)
    return rx / length, ry / length, 1.0 / length
