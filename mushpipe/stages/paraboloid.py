"""Paraboloids fitted to the depth of all caps of a frame."""

from __future__ import annotations

import numpy as np

from mushpipe.core.arrays import Floats, Ints, Rows
from mushpipe.core.jit import borrower, jit
from mushpipe.stages.cap.blocks import (
    CELLS,
    DEPTH,
    SPREAD,
    Cut,
    Image,
    K,
    U,
    V,
    average,
    enough,
    half_width,
    middle_depth,
    own_depth,
    room_to_cut,
)
from mushpipe.stages.cap.model import ASPECT
from mushpipe.stages.cap.samples import ray_at

COEFFICIENTS = 7
TIP = 6  # the coefficient that says how pointed a cap is
ROUNDS = 3
DISC = 0.7  # points within so many radii; farther out a cap falls off faster than a paraboloid
EFFECTIVE = 0.5  # as in cap-fit: so much of a point's information is its own
SHAPE_M = 0.00025  # sigma of a cap about such a surface
BEND = 0.3  # sigma of the quadratic coefficients about those of a cap, in radii
POINTED = 0.2  # sigma of the slope of a pointed top, less in its innermost BLUNT radii
BLUNT = 0.15
FARTHEST = 2.0  # radii from the middle depth to a top; a hole's rim may suggest more
INNER = np.flatnonzero((CELLS**2).sum(axis=1) < DISC**2)


@jit
def fit_surfaces(
    image: Image,
    discs: Floats,
    rank: Ints,
    rows: Rows,
    noise: tuple[float, float],
    least: int,
    out: tuple[Floats, Floats],
) -> Ints:
    """Fit z = b0 + b1 x + b2 y + b3 x^2 + b4 x y + b5 y^2 + b6 q to caps, x and y in their radii.

    q = sqrt(x^2 + y^2 + BLUNT^2) - BLUNT is the tip of a pointed cap: a cone with a blunt end.

    Args:
        image: What they are fitted to.
        discs: (N, 3) x, y, radius, px.
        rank: (N,) of them, as `ranks` from `by_depth`.
        rows: (M,) which of them are fitted.
        noise: Sigma of depth is noise[0] + noise[1] z, m.
        least: Fewest points.
        out: Coefficients (M, 7) m and covariances (M, 7, 7); those without a fit stay as they are.

    Returns:
        (M, 2) how many points of the whole grid have depth of the cap, and how many other depth.
    """
    near = np.empty((COEFFICIENTS + 2, len(INNER)))
    weighted = np.empty((COEFFICIENTS + 1, len(INNER)))
    cut = room_to_cut(*image.depth.shape)
    seen = np.zeros((len(rows), 2), np.int64)
    for k in range(len(rows)):
        i = rows[k]
        n, middle = sample_inner(image, rank[i], discs[i], noise, cut, near)
        size = discs[i, 2] * middle / image.focal
        if n >= least and paraboloid(near, n, size, weighted, out[0][k], out[1][k]):
            if not abs(out[0][k, 0]) < min(FARTHEST * size, middle):
                out[0][k], out[1][k] = np.nan, np.nan
                continue
            out[0][k, 0] += middle
            gate = (middle - 0.8 * size, middle + size)
            seen[k, 0], seen[k, 1] = count_seen(image, rank[i], discs[i], gate)
    return seen


@borrower
def sample_inner(
    image: Image, rank: int, disc: Floats, noise: tuple[float, float], cut: Cut,
    out: Floats,
) -> tuple[int, float]:  # fmt: skip
    """Take block means on a grid in the inner part of a circle; arguments as `fit_surfaces`.

    Args:
        image: Where they are taken.
        rank: This circle's.
        disc: (3,) x, y, radius, px.
        noise: Sigma of depth.
        cut: From `room_to_cut`.
        out: (9, M) out: the seven terms of the surface, depth about the middle (m), variance.

    Returns:
        Number of points, and the middle depth (m), 0 without any.
    """
    half, blocks = half_width(disc[2]), cut.blocks
    average(own_depth(image, rank, disc, 1.0, cut.own), disc, half, cut)
    middle = middle_depth(cut, half, DISC * DISC)
    if middle <= 0.0:
        return 0, 0.0
    center = ray_at(image, disc[0], disc[1])
    size = disc[2] * middle / image.focal
    sigma = noise[0] + noise[1] * middle
    even = (2.5 * sigma) ** 2 + (0.6 * size * (2 * half + 1) / disc[2]) ** 2
    m = 0
    for j in INNER:
        z, count = blocks[j + DEPTH * K], blocks[j]
        if count <= enough(half):
            continue
        if blocks[j + SPREAD * K] > even or not middle - 0.8 * size < z < middle + size:
            continue
        ray = ray_at(image, blocks[j + U * K], blocks[j + V * K])
        if ray[2] < 1e-3:
            continue  # where the lens has none
        x = (ray[0] / ray[2] - center[0] / center[2]) * image.focal / disc[2]
        y = (ray[1] / ray[2] - center[1] / center[2]) * image.focal / disc[2]
        out[0, m], out[1, m], out[2, m] = 1.0, x, y
        out[3, m], out[4, m], out[5, m] = x * x, x * y, y * y
        out[TIP, m] = np.sqrt(x * x + y * y + BLUNT * BLUNT) - BLUNT
        out[COEFFICIENTS, m] = z - middle
        # part of the noise is shared by neighbouring pixels
        out[COEFFICIENTS + 1, m] = (sigma * (0.3 + 0.7 / np.sqrt(count))) ** 2 + SHAPE_M * SHAPE_M
        m += 1
    return m, middle


@borrower
def count_seen(image: Image, rank: int, disc: Floats, gate: tuple[float, float]) -> tuple[int, int]:
    """Return on how many points of the grid depth lies within a cap's gate (m), and outside."""
    depth, ranks = image.depth, image.ranks
    own, other = 0, 0
    for j in range(len(CELLS)):
        u = int(np.floor(disc[0] + disc[2] * CELLS[j, 0] + 0.5))
        v = int(np.floor(disc[1] + disc[2] * CELLS[j, 1] + 0.5))
        if 0 <= v < depth.shape[0] and 0 <= u < depth.shape[1] and ranks[v, u] >= rank:
            inside = gate[0] < depth[v, u] < gate[1]
            own += inside
            other += depth[v, u] > 0 and not inside
    return own, other


@borrower
def paraboloid(
    points: Floats, count: int, size: float, weighted: Floats, surface: Floats, covariance: Floats
) -> bool:
    """Fit one paraboloid by least squares with Tukey's weights; False where it is not determined.

    Args:
        points: (9, M) the seven terms, depth about a middle one (m) and its variance.
        count: How many columns are points.
        size: Radius of the cap, m: the scale of what bends are expected.
        weighted: (8, M) room.
        surface: (7,) out.
        covariance: (7, 7) out.
    """
    right = weighted[COEFFICIENTS]
    for k in range(ROUNDS):
        limit = (100.0, 25.0, 16.0)[k]
        for j in range(count):
            error = 0.0  # all count alike at first
            if k > 0:
                error = points[COEFFICIENTS, j]
                for i in range(COEFFICIENTS):
                    error -= surface[i] * points[i, j]
            rest = max(1.0 - error * error / (limit * points[COEFFICIENTS + 1, j]), 0.0)
            weight = EFFECTIVE * rest * rest / points[COEFFICIENTS + 1, j]
            for i in range(COEFFICIENTS):
                weighted[i, j] = weight * points[i, j]
        for i in range(COEFFICIENTS):
            right[i] = dot(weighted[i], points[COEFFICIENTS], count)
            for m in range(i + 1):
                covariance[i, m] = covariance[m, i] = dot(weighted[i], points[m], count)
        for i in range(3, COEFFICIENTS):
            known = 1.0 / ((BEND if i < TIP else POINTED) * size) ** 2
            covariance[i, i] += known
            right[i] += known * (0.5 * ASPECT * size if i == 3 or i == 5 else 0.0)
        if not invert(covariance):
            surface[:], covariance[:] = np.nan, np.nan
            return False
        for i in range(COEFFICIENTS):
            surface[i] = dot(covariance[i], right, COEFFICIENTS)
    return True


@borrower
def dot(a: Floats, b: Floats, count: int) -> float:
    """Return the sum of products of the first `count` numbers."""
    total = 0.0
    for k in range(count):
        total += a[k] * b[k]
    return total


@borrower
def invert(matrix: Floats) -> bool:
    """Invert a positive definite matrix in place (Gauss-Jordan); False where it is none."""
    n = len(matrix)
    for k in range(n):
        pivot = matrix[k, k]
        if not 1e-9 < pivot < 1e30:
            return False
        matrix[k, k] = 1.0
        for j in range(n):
            matrix[k, j] /= pivot
        for i in range(n):
            if i == k:
                continue
            factor = matrix[i, k]
            matrix[i, k] = 0.0
            for j in range(n):
                matrix[i, j] -= factor * matrix[k, j]
    return True
