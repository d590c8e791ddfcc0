"""What a depth image says about each cap: points on a grid inside its circle; rays that touch it.

Kernels work on depth in metres, 0 = missing, and on the rays of all pixels; they assume finite
numbers.
"""

from __future__ import annotations

import numpy as np

from mushpipe.core.arrays import Floats, Ints32, Singles
from mushpipe.core.jit import borrower
from mushpipe.stages.cap.blocks import (
    CELLS,
    COUNT,
    DEPTH,
    GRID,
    SPREAD,
    Cut,
    Image,
    K,
    Sensor,
    U,
    V,
    Window,
    average,
    enough,
    half_width,
    middle_depth,
)
from mushpipe.stages.cap.model import Single, Vector

DIRECTIONS = 32
RADII = 26
INNER, OUTER = 0.55, 1.45  # where an edge is looked for, in radii of the circle,
STEP = (OUTER - INNER) / (RADII - 1)  # in so many steps
# Noise and errors of shape are correlated; so much of a point, or of a ray along an edge, counts.
POINT_SHARE, EDGE_SHARE = 0.35 * 169 / GRID**2, 0.6
ASTRAY = 1 / 3  # share of other depth in a circle: is what its centre shows the cap at all?
CROWDED = 6.0  # px; in a smaller circle cells of the grid share pixels, each of which counts once
CORE = 0.35  # squared share of the radius inside which the middle depth is taken

_TURN = np.arange(DIRECTIONS) * (2 * np.pi / DIRECTIONS)
COMPASS: Floats = np.stack([np.cos(_TURN), np.sin(_TURN)], axis=-1)
EAST, SOUTH = np.cos(_TURN).astype(np.float32), np.sin(_TURN).astype(np.float32)


@borrower
def sample_depth(
    window: Window, cut: Cut, image: Image, circle: Floats, sensor: Sensor, out: Singles
) -> tuple[int, int, float]:
    """Take the points of a cap: block means on a grid inside its circle, gated around its depth.

    Args:
        window: From `own_depth`, whose depth is in `cut`.
        cut: Room.
        image: What the window was cut out of.
        circle: (3,) x, y, radius, px.
        sensor: What took the depth.
        out: (6, M) out: x and y of the ray at z = 1, 1; z and its sigma (m), share that counts as
            independent.

    Returns:
        Number of points, number of those outside of the gate, and the cap's middle depth (m), 0
        where there is none.
    """
    radius, blocks = circle[2], cut.blocks
    half = half_width(radius)
    average(window, circle, half, cut)
    middle = middle_depth(cut, half, CORE)
    if middle <= 0.0:
        return 0, 0, 0.0
    size = radius * middle / image.focal
    low, high, least = middle - 0.8 * size, middle + size, enough(half)
    step = (0.6 * size * (2 * half + 1) / radius) ** 2
    n, other = 0, 0
    for j in range(len(CELLS)):
        if radius < CROWDED and _taken(cut.pixels, j):
            continue
        z = blocks[j + DEPTH * K]
        sigma = sensor.noise + sensor.growth * z
        even = (2.5 * sigma) ** 2 + step
        if blocks[j + COUNT * K] <= least or blocks[j + SPREAD * K] > even:
            continue
        if not low < z < high:
            other += 1
            continue
        x, y = place(image, blocks[j + U * K], blocks[j + V * K])
        if abs(x) > 1e3:
            continue  # where the lens has none
        out[0, n], out[1, n], out[2, n], out[3, n] = x, y, 1.0, z - sensor.bias
        out[4, n] = sigma * (0.3 + 0.7 / np.sqrt(blocks[j + COUNT * K]))
        out[5, n] = POINT_SHARE
        n += 1
    return n, other, middle


@borrower
def _taken(pixels: Ints32, cell: int) -> bool:
    """Return whether the pixel of a cell is that of a cell before it."""
    taken = False
    for k in range(cell):
        taken |= pixels[k] == pixels[cell] and pixels[k + K] == pixels[cell + K]
    return taken


@borrower
def touch(out: Singles, n: int, at: tuple[float, float], sigma: float, share: float) -> None:
    """Fill column n of rays (6, M) with one that touches the cap, within sigma (m).

    Args:
        out: Rays.
        n: Number of the column.
        at: x and y of the ray at z = 1; `normalise` makes it a unit ray.
        sigma: m.
        share: That counts as independent.
    """
    out[0, n], out[1, n], out[2, n] = at[0], at[1], 1.0
    out[3, n], out[4, n], out[5, n] = 0.0, sigma, share


@borrower
def normalise(rays: Singles, count: int) -> None:
    """Make unit rays of the first columns (6, M) that hold rays at z = 1, depths and their sigmas.

    Ranges and their sigmas take the place of depths; rays that touch keep what they have.
    """
    one, none = Single(1), Single(0)
    for j in range(count):
        length = np.sqrt(one + rays[0, j] * rays[0, j] + rays[1, j] * rays[1, j])
        short = one / length
        rays[4, j] *= length if rays[3, j] > none else one
        rays[0, j] *= short
        rays[1, j] *= short
        rays[2, j] = short
        rays[3, j] *= length


@borrower
def place(image: Image, x: float, y: float) -> tuple[float, float]:
    """Return the ray at z = 1 of a place in an image (px); outside of it, as without distortion."""
    rays, focal = image.rays, image.focal
    v = min(max(int(np.floor(y + 0.5)), 0), rays.shape[0] - 1)
    u = min(max(int(np.floor(x + 0.5)), 0), rays.shape[1] - 1)
    return rays[v, u, 0] + (x - u) / focal, rays[v, u, 1] + (y - v) / focal


@borrower
def ray_at(image: Image, x: float, y: float) -> Vector:
    """Return the unit ray of a place in an image; arguments as `place`."""
    rx, ry = place(image, x, y)
    length = np.sqrt(1.0 + rx * rx + ry * ry)
    return rx / length, ry / length, 1.0 / length
