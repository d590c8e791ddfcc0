"""All caps of a frame: sampling, fitting, and what follows from the fitted parameters."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mushpipe.core.jit import jit
from mushpipe.stages.cap_model import (
    HEIGHT,
    RADIUS,
    SIZE,
    UNKNOWNS,
    Floats,
    N,
    Vector,
    frozen,
    meet,
    slope,
)
from mushpipe.stages.cap_outline import sample_outline
from mushpipe.stages.cap_samples import (
    CELLS,
    COMPASS,
    DIRECTIONS,
    paint,
    ray_at,
    sample_depth,
    sample_edges,
)
from mushpipe.stages.cap_solve import ROUND, Noise, refine, start, uncertainty, workspace


@dataclass(frozen=True, eq=False)
class Fits:
    """Fitted caps in the optical frame; NaN where not valid.

    Attributes:
        valid: (N,) whether there is a fit.
        center: (N, 3) m, of the rim plane.
        axis: (N, 3) unit, out of the cap.
        radius: (N,) m, of the rim.
        height: (N,) m, of the dome.
        apex: (N, 3) m.
        surface: (N, 3) m, where the ray of the circle's centre meets the cap.
        covariance: (N, 8, 8) of centre, two turns of the axis, radius, height, bulge.
        sigma_tilt: (N,) rad.
        sigma_radius: (N,) m.
        sigma_surface: (N, 3) m.
        fitness: (N,) 0..1, mean robust weight of the points of the grid, 0 for a missing one.
        edges: (N,) number of trusted edge rays.
    """

    valid: NDArray[np.bool_]
    center: Floats
    axis: Floats
    radius: Floats
    height: Floats
    apex: Floats
    surface: Floats
    covariance: Floats
    sigma_tilt: Floats
    sigma_radius: Floats
    sigma_surface: Floats
    fitness: Floats
    edges: NDArray[np.int64]


@jit
def core_depth(depth: NDArray[Any], circle: Floats) -> float:
    """Return the median native depth near the centre of a circle (x, y, r), 0 without any."""
    values = np.empty(81)
    n = 0
    for i in range(-4, 5):
        for j in range(-4, 5):
            u = int(np.floor(circle[0] + 0.12 * i * circle[2] + 0.5))
            v = int(np.floor(circle[1] + 0.12 * j * circle[2] + 0.5))
            if 0 <= v < depth.shape[0] and 0 <= u < depth.shape[1] and depth[v, u] > 0:
                values[n] = depth[v, u]
                n += 1
    return float(np.median(values[:n])) if n else 0.0


@jit
def rank_by_depth(
    depth: NDArray[Any], circles: Floats, ranks: NDArray[np.int32]
) -> NDArray[np.int64]:
    """Return each circle's rank (N,), the nearest 0, and paint them over a `ranks` full of N."""
    far = np.empty(len(circles))
    for i in range(len(circles)):
        far[i] = core_depth(depth, circles[i])
        if far[i] <= 0.0:
            far[i] = 1e30  # hides nothing
    order = np.argsort(far)
    paint(ranks, circles, order)
    rank = np.empty(len(circles), np.int64)
    for k in range(len(circles)):
        rank[order[k]] = k
    return rank


@jit
def gather(
    image: Any,
    circle: Floats,
    rank: int,
    focal: float,
    sensor: tuple[float, float, float, float],
    data: Any,
) -> tuple[int, int, float]:
    """Take the data of a cap; return numbers of points and edge rays, and its middle depth (m)."""
    points, edges, around = data
    n, middle = sample_depth(image, rank, circle, focal, (sensor[0], sensor[1]), points)
    if n == 0:
        return 0, 0, 0.0
    m = sample_edges(image, rank, circle, focal, middle, sensor[3], edges)
    for j in range(n):
        points[3, j] -= sensor[2] / points[2, j]
    for j in range(ROUND):
        turn = COMPASS[j * (DIRECTIONS // ROUND)]
        x, y = circle[0] + circle[2] * turn[0], circle[1] + circle[2] * turn[1]
        around[0, j], around[1, j], around[2, j] = ray_at(image[2], focal, x, y)
    return n, m, middle - sensor[2]


@jit
def fit_all(
    color: NDArray[np.uint8],
    image: Any,
    circles: Floats,
    focal: float,
    up: Floats,
    noise: Any,
    sensor: tuple[float, float, float, float],
    least: int,
    out: Any,
) -> None:
    """Fit every cap; see `fit_caps`. A cap without a fit keeps the count 0."""
    caps, covariances, surfaces, counts = out
    rank = rank_by_depth(image[0], circles, image[3])
    points, edges = np.empty((5, len(CELLS))), np.empty((3, DIRECTIONS))
    around, work = np.empty((3, ROUND)), workspace()
    outline = np.empty((3, DIRECTIONS))
    for i in range(len(circles)):
        data = (points, edges, around)
        n, m, middle = gather(image, circles[i], rank[i], focal, sensor, data)
        if n < least or middle <= 0.0:
            continue
        data = (points[:, :n], edges[:, :m], around, outline[:, :0])
        size = circles[i, 2] * middle / focal
        ray = ray_at(image[2], focal, circles[i, 0], circles[i, 1])
        start(caps[i], up, ray, middle, size)
        if not refine(caps[i], data, up, noise, focal, size, (0, 2), work):
            continue
        lines = sample_outline(color, image, rank[i], caps[i], circles[i], focal, outline)
        data = (points[:, :n], edges[:, :m], around, outline[:, :lines])
        if not refine(caps[i], data, up, noise, focal, size, (2, 5), work):
            continue
        weight = uncertainty(caps[i], data, up, noise, focal, covariances[i], work)
        if weight < 0.0:
            continue
        locate(caps[i], ray, covariances[i], noise.circle_px / focal, surfaces[i])
        counts[i, 0], counts[i, 1], counts[i, 2] = n, m, weight


@jit
def locate(cap: Floats, ray: Vector, covariance: Floats, sigma: float, out: Floats) -> None:
    """Fill the point (3,) where a ray meets a cap, and its sigmas (3,), m.

    Args:
        cap: (15,) the cap.
        ray: Unit vector.
        covariance: (8, 8) of the cap.
        sigma: Of the ray's direction, rad.
        out: (6,) out.
    """
    c = frozen(cap)
    t, k, _ = meet(c, ray, False)
    row = np.array(slope(c, ray, t, k))
    variance = 0.0
    for i in range(UNKNOWNS):
        for j in range(UNKNOWNS):
            variance += row[3 + i] * covariance[i, j] * row[3 + j]
    square = max(row[2], 0.1) ** 2  # of the cosine of incidence
    far = t + row[0] / (row[1] * max(row[2], 0.3))  # a step to the surface with its bulge
    across = (sigma * t) ** 2
    # an error across the ray moves the point up or down the slope
    along = (variance + across * (1.0 - square)) / square
    for i in range(3):
        share = ray[i] * ray[i]
        out[i] = far * ray[i]
        out[3 + i] = np.sqrt(along * share + across * (1.0 - share))


def fit_caps(
    color: NDArray[np.uint8],
    depth: NDArray[Any],
    scale: float,
    bias: float,
    rays: NDArray[np.float32],
    circles: Floats,
    focal: float,
    up: Floats,
    noise: Noise,
    sensor: tuple[float, float],
    edge_offset: float,
    least: int,
) -> Fits:
    """Fit a cap to the depth in each circle.

    Args:
        color: (H, W, 3) RGB.
        depth: (H, W) native, 0 = missing, finite.
        scale: Metres per unit.
        bias: Taken off the depth, m.
        rays: (H, W, 2) float32 rays at z = 1.
        circles: (N, 3) x, y, radius, px.
        focal: Focal length, px.
        up: (3,) unit, the upright.
        noise: Standard deviations of the model.
        sensor: Sigma of depth is sensor[0] + sensor[1] z, m.
        edge_offset: How much of an edge the sensor loses, px.
        least: Fewest points that make a fit.
    """
    n = len(circles)
    caps, covariances = np.full((n, SIZE), np.nan), np.full((n, UNKNOWNS, UNKNOWNS), np.nan)
    surfaces, counts = np.full((n, 6), np.nan), np.zeros((n, 3))
    ranks = np.full(depth.shape, n, np.int32)
    fit_all(
        color,
        (depth, scale, rays, ranks),
        circles,
        focal,
        up,
        noise,
        (*sensor, bias, edge_offset),
        least,
        (caps, covariances, surfaces, counts),
    )
    return _fits(caps, covariances, surfaces, counts)


def _fits(caps: Floats, covariances: Floats, surfaces: Floats, counts: Floats) -> Fits:
    finite = np.isfinite(caps).all(axis=1) & np.isfinite(covariances).all(axis=(1, 2))
    valid = (counts[:, 0] > 0) & finite & np.isfinite(surfaces).all(axis=1)
    for array in (caps, covariances, surfaces):
        array[~valid] = np.nan
    diagonal = np.diagonal(covariances, axis1=1, axis2=2)
    center, axis = caps[:, :3], caps[:, N : N + 3]
    return Fits(
        valid,
        center,
        axis,
        caps[:, RADIUS],
        caps[:, HEIGHT],
        center + caps[:, HEIGHT, None] * axis,
        surfaces[:, :3],
        covariances,
        np.sqrt(diagonal[:, 3] + diagonal[:, 4]),
        np.sqrt(diagonal[:, 5]),
        surfaces[:, 3:],
        np.where(valid, np.minimum(counts[:, 2] / len(CELLS), 1.0), np.nan),
        counts[:, 1].astype(np.int64),
    )
