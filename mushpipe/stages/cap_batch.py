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
    ROOM,
    SIZE,
    UNKNOWNS,
    Floats,
    N,
    Singles,
    Vector,
    frozen,
    meet,
    slope,
)
from mushpipe.stages.cap_order import rank_by_depth
from mushpipe.stages.cap_outline import sample_outline
from mushpipe.stages.cap_samples import (
    ASTRAY,
    CELLS,
    COMPASS,
    DIRECTIONS,
    ray_at,
    sample_depth,
    sample_edges,
    touch,
)
from mushpipe.stages.cap_solve import ROUND, Noise, invert, refine, tilt, workspace
from mushpipe.stages.cap_start import CONICAL, USUAL, axis_of, spread_of, start

POOR = 0.9  # misfit (a usual cap has 0.25) at which a fit starts again; it widens the sigmas, too
BETTER = 0.8  # how much smaller the misfit of another start must be
ROUNDNESS = 0.01  # in rim radii: how far the rim of a cap is from the circle of its area
GUESSED = 0.1  # in rim radii: how far off an outline is that no depth edge confirms
LEVER = 1.5  # rad of tilt per outline error in rim radii


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
        edges: (N,) number of rays along the depth edge.
        lines: (N,) number of rays along the outline in colour.
        misfit: (N,) mean squared residual, in sigmas.
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
    lines: NDArray[np.int64]
    misfit: Floats


@jit
def gather(
    image: Any,
    circle: Floats,
    rank: int,
    focal: float,
    sensor: tuple[float, float, float, float],
    rays: Singles,
) -> tuple[int, int, int, float]:
    """Take the rays of a cap; return what there is of it.

    Returns:
        Numbers of its points, of points of other depth and of edge rays; its middle depth, m.
    """
    n, other, middle = sample_depth(
        image, rank, circle, focal, (sensor[0], sensor[1]), rays[:, ROUND:]
    )
    if n == 0:
        return 0, other, 0, 0.0
    for j in range(ROUND, ROUND + n):
        rays[3, j] -= sensor[2] / rays[2, j]
    m = sample_edges(image, rank, circle, focal, middle, sensor[3], rays[:, ROUND + n :])
    for j in range(ROUND):
        turn = COMPASS[j * (DIRECTIONS // ROUND)]
        x, y = circle[0] + circle[2] * turn[0], circle[1] + circle[2] * turn[1]
        touch(rays, j, ray_at(image[1], focal, x, y), 0.0, 0.0)
    return n, other, m, middle - sensor[2]


@jit
def attempt(
    frame: Any, circle: Floats, rank: int, size: float, seen: tuple[Singles, int],
    upright: tuple[Floats, float], settings: Any, fit: tuple[Floats, Floats], work: Any,
) -> tuple[int, float]:  # fmt: skip
    """Fit a cap from where it starts: to its depth, then to its outline in colour as well.

    Args:
        frame: As in `first_fits`.
        circle: (3,) x, y, radius, px.
        rank: Of the circle.
        size: Its radius at the cap, m.
        seen: The cap's rays (6, ROOM), with room for those of the outline, and how many there are.
        upright: Unit vector (3,) and spread of tilts, rad.
        settings: As in `first_fits`.
        fit: Parameters (15,), in and out, and covariance (8, 8), out.
        work: From `workspace`.

    Returns:
        Number of rays along the outline in colour, and the misfit, infinite without a solution.
    """
    gray, image, focal = frame
    (rays, count), (cap, covariance), setting = seen, fit, (settings[0], 1.0 / focal, size)
    if refine(cap, rays, count, upright, setting, (0, 2), work)[0] < 0.0:
        return 0, np.inf
    lines = sample_outline(
        gray, image[1], image[2], rank, cap, circle, focal, settings[2], work[1], rays[:, count:]
    )
    total, misfit = refine(cap, rays, count + lines, upright, setting, (2, 4), work)
    if total < 0.0:
        return 0, np.inf
    invert(work[0][0], covariance)
    return lines, misfit


@jit
def first_fits(
    frame: Any, circles: Floats, upright: tuple[Floats, float], settings: Any, rays: Singles,
    out: Any,
) -> None:  # fmt: skip
    """Gather the rays of every cap, and fit it with the same prior for all.

    Args:
        frame: Luma (H, W), image (see `sample_depth`) and focal length, px.
        circles: (N, 3) x, y, radius, px.
        upright: Unit vector (3,) and spread of tilts, rad.
        settings: `Noise`; sigma of depth (2), bias (m) and edge offset (px); sigma of the outline
            in colour, px; fewest points.
        rays: (N, 6, ROOM) room for those of each cap.
        out: Per cap parameters, covariance, surface point with sigmas, and counts of points, edge
            rays, outline rays, weight; size, m; misfit; points of other depth. A cap without a fit
            keeps a count of 0.
    """
    _, image, focal = frame
    caps, covariances, _, counts = out
    rank, work = rank_by_depth(image[0], circles, image[2]), workspace()
    rival = (np.empty(SIZE), np.empty((UNKNOWNS, UNKNOWNS)))
    spare = np.empty((6, ROOM), np.float32)
    for i in range(len(circles)):
        circle, fit = circles[i], (caps[i], covariances[i])
        n, other, m, middle = gather(image, circle, rank[i], focal, settings[1], rays[i])
        if n < settings[3] or middle <= 0.0:
            continue
        size, count = circle[2] * middle / focal, ROUND + n + m
        ray = ray_at(image[1], focal, circle[0], circle[1])
        points = rays[i][:, ROUND:]
        axis = axis_of(points, n, upright[0], ray, USUAL[0])
        start(caps[i], axis, USUAL, ray, middle, size)
        lines, misfit = attempt(
            frame, circle, rank[i], size, (rays[i], count), upright, settings, fit, work
        )
        if misfit > POOR:
            spare[:, :count] = rays[i][:, :count]
            leaning = axis_of(points, n, upright[0], ray, CONICAL[0])
            for axis in (upright[0], -np.array(ray), leaning):
                start(rival[0], axis, CONICAL, ray, middle, size)
                found, rest = attempt(
                    frame, circle, rank[i], size, (spare, count), upright, settings, rival, work
                )
                if rest < BETTER * misfit:
                    lines, misfit, rays[i][:, count:] = found, rest, spare[:, count:]
                    caps[i], covariances[i] = rival
        if np.isfinite(misfit):
            counts[i, 0], counts[i, 1], counts[i, 2], counts[i, 4] = n, m, lines, size
            counts[i, 6] = other


@jit
def second_fits(
    frame: Any, circles: Floats, upright: tuple[Floats, float], settings: Any, rays: Singles,
    out: Any,
) -> None:  # fmt: skip
    """Refine every fit with what the scene says of its caps' tilt; arguments as `first_fits`."""
    _, image, focal = frame
    noise = settings[0]
    caps, covariances, surfaces, counts = out
    squares, variances = np.full(len(caps), -1.0), np.ones(len(caps))
    for i in range(len(caps)):
        if counts[i, 0] > 0:
            first, second = tilt(caps[i], upright[0])
            squares[i] = first * first + second * second
            variances[i] = 0.5 * (covariances[i, 3, 3] + covariances[i, 4, 4])
    spreads, work = np.empty(len(caps)), workspace()
    spread_of(squares, variances, upright[1], spreads)
    for i in range(len(caps)):
        if counts[i, 0] == 0:
            continue
        count = ROUND + int(counts[i, 0] + counts[i, 1] + counts[i, 2])
        setting = (noise, 1.0 / focal, counts[i, 4])
        own = (upright[0], spreads[i])
        counts[i, 3], counts[i, 5] = refine(caps[i], rays[i], count, own, setting, (4, 5), work)
        invert(work[0][0], covariances[i])
        ray = ray_at(image[1], focal, circles[i, 0], circles[i, 1])
        locate(caps[i], ray, covariances[i], noise.circle_px / focal, surfaces[i])


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
    frame: tuple[NDArray[np.float32], tuple[NDArray[np.float32], NDArray[np.float32]], float],
    circles: Floats,
    upright: tuple[Floats, float],
    settings: tuple[Noise, tuple[float, float, float, float], float, int],
) -> Fits:
    """Fit a cap to the depth in each circle.

    Args:
        frame: Luma (H, W) 0..1; depth (H, W) m, 0 = missing, finite, and the rays (H, W, 2) of the
            pixels at z = 1; focal length, px.
        circles: (N, 3) x, y, radius, px.
        upright: Unit vector (3,) and the spread of tilts off it per direction, rad.
        settings: Standard deviations of the model; of the sensor: sigma of depth at the camera (m)
            and its growth (m per m), bias (m), and how much of an edge it loses (px); sigma of the
            outline in colour, px; the fewest points that make a fit.
    """
    n = len(circles)
    gray, image, focal = frame
    out = (
        np.full((n, SIZE), np.nan),
        np.full((n, UNKNOWNS, UNKNOWNS), np.nan),
        np.full((n, 6), np.nan),
        np.zeros((n, 7)),
    )
    rays = np.empty((n, 6, ROOM), np.float32)
    ranked = (gray, (*image, np.full(image[0].shape, n, np.int16)), focal)
    first_fits(ranked, circles, upright, settings, rays, out)
    second_fits(ranked, circles, upright, settings, rays, out)
    return _fits(*out)


def _fits(caps: Floats, covariances: Floats, surfaces: Floats, counts: Floats) -> Fits:
    finite = np.isfinite(caps).all(axis=1) & np.isfinite(covariances).all(axis=(1, 2))
    valid = (counts[:, 0] > 0) & (counts[:, 3] >= 0) & finite & np.isfinite(surfaces).all(axis=1)
    for array in (caps, covariances, surfaces):
        array[~valid] = np.nan
    diagonal = np.diagonal(covariances, axis1=1, axis2=2)
    guessed = GUESSED * (1 - counts[:, 1] / DIRECTIONS) ** 5
    astray = counts[:, 6] > ASTRAY * (counts[:, 0] + counts[:, 6])
    doubt = np.maximum(counts[:, 5] / POOR, 1)
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
        doubt * np.sqrt(diagonal[:, 3] + diagonal[:, 4] + (LEVER * guessed) ** 2),
        doubt * np.sqrt(diagonal[:, 5] + (ROUNDNESS**2 + guessed**2) * caps[:, RADIUS] ** 2),
        np.hypot(surfaces[:, 3:], np.where(astray, caps[:, RADIUS], 0)[:, None]),
        np.where(valid, np.minimum(counts[:, 3] / len(CELLS), 1.0), np.nan),
        counts[:, 1].astype(np.int64),
        counts[:, 2].astype(np.int64),
        counts[:, 5],
    )
