"""All caps of a frame: sampling, fitting, and what follows from the fitted parameters."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mushpipe.core.jit import jit
from mushpipe.stages.cap_attempt import COUNTS, ODD, POOR, fit_circle, mend, scratch
from mushpipe.stages.cap_blocks import CELLS
from mushpipe.stages.cap_circle import improve
from mushpipe.stages.cap_model import (
    HEIGHT,
    RADIUS,
    ROOM,
    SIZE,
    UNKNOWNS,
    Floats,
    N,
    Single,
    Singles,
    Vector,
    frozen,
    meet,
    slope,
)
from mushpipe.stages.cap_order import Order
from mushpipe.stages.cap_samples import ASTRAY, DIRECTIONS, ray_at
from mushpipe.stages.cap_solve import ROUND, Noise, invert, refine, tilt, workspace
from mushpipe.stages.cap_start import spread_of

ROUNDNESS = 0.01  # in rim radii: how far the rim of a cap is from the circle of its area
GUESSED = 0.1  # in rim radii: how far off an outline is that no depth edge confirms,
SEEN = 5  # and with what power of the share that is not confirmed that grows
LEVER = 1.5  # rad of tilt per outline error in rim radii


@dataclass(frozen=True, eq=False)
class Fits:
    """Fitted caps in the optical frame; NaN where not valid.

    Attributes:
        valid: (N,) whether there is a fit.
        circle: (N, 3) x, y, radius, px, improved by the fit.
        center: (N, 3) m, of the rim plane.
        axis: (N, 3) unit, out of the cap.
        radius: (N,) m, of the rim.
        height: (N,) m, of the dome.
        apex: (N, 3) m.
        surface: (N, 3) m, where the ray of that circle's centre meets the cap.
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
    circle: Floats
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
def first_fits(
    frame: Any, circles: Floats, rank: NDArray[np.int64], upright: tuple[Floats, float],
    settings: Any, rays: Singles, out: Any,
) -> None:  # fmt: skip
    """Gather the rays of every cap, and fit it with the same prior for all.

    Args:
        frame: Luma (H, W); depth (H, W) m, missing where not above 0, with rays (H, W, 2) and
            ranks (H, W); focal length, px.
        circles: (N, 3) x, y, radius, px.
        rank: (N,) of them, as `ranks` from `by_depth`.
        upright: Unit vector (3,) and spread of tilts, rad.
        settings: `Noise`; sigma of depth (2), bias (m) and edge offset (px); sigma of the outline
            in colour, px; fewest points.
        rays: (N, 6, ROOM) room for those of each cap.
        out: Per cap parameters, covariance, surface point with sigmas, and counts; parameters and
            counts are filled as by `fit_circle`. A cap without a fit keeps a count of 0.
    """
    caps, _, _, counts = out
    room = scratch()
    for i in range(len(circles)):
        fit, ranks = (rays[i], caps[i], counts[i]), (rank[i], len(circles))
        misfit = fit_circle(frame, circles[i], rank[i], upright, settings, fit, room)
        if ODD < misfit < np.inf:
            mend(frame, circles[i], ranks, misfit, upright, settings, fit, room)


@jit
def second_fits(
    frame: Any, circles: Floats, upright: tuple[Floats, float], settings: Any, rays: Singles,
    out: Any,
) -> None:  # fmt: skip
    """Refine every fit with what the scene says of its caps' tilt, and then its circle, in place.

    Arguments as `first_fits`.
    """
    _, image, focal = frame
    noise = settings[0]
    caps, covariances, surfaces, counts = out
    squares, variances = np.full(len(caps), -1.0), np.ones(len(caps))
    for i in range(len(caps)):
        if counts[i, 0] > 0:
            first, second = tilt(caps[i], upright[0])
            squares[i] = first * first + second * second
            variances[i] = counts[i, 7]
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
        held, doubt = (counts[i, 1], counts[i, 2]), max(1.0, counts[i, 5] / POOR)
        improve(circles[i], caps[i], held, doubt, image[1], focal)
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
    c, away = frozen(cap), np.sqrt(cap[0] ** 2 + cap[1] ** 2 + cap[2] ** 2)
    r = (Single(ray[0]), Single(ray[1]), Single(ray[2]))
    q = [Single((away * ray[i] - cap[i]) / cap[RADIUS]) for i in range(3)]
    t, k, _ = meet(c, (q[0], q[1], q[2]), r, False)
    q = [q[i] + t * r[i] for i in range(3)]
    row = np.array(slope(c, (q[0], q[1], q[2]), r, k))
    t = away + t * cap[RADIUS]
    variance = 0.0
    for i in range(UNKNOWNS):
        for j in range(UNKNOWNS):
            variance += row[3 + i] * covariance[i, j] * row[3 + j]
    square = max(row[2], 0.1) ** 2  # of the cosine of incidence
    far = t + row[0] / max(row[2], 0.3)  # a step to the surface with its bulge
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
    order: Order,
    upright: tuple[Floats, float],
    settings: tuple[Noise, tuple[float, float, float, float], float, int],
) -> Fits:
    """Fit a cap to the depth in each circle.

    Args:
        frame: Luma (H, W) 0..1; depth (H, W) m, missing where not above 0, and the rays (H, W, 2)
            of the pixels at z = 1; focal length, px.
        circles: (N, 3) x, y, radius, px.
        order: From `by_depth`.
        upright: Unit vector (3,) and the spread of tilts off it per direction, rad.
        settings: Standard deviations of the model; of the sensor: sigma of depth at the camera (m)
            and its growth (m per m), bias (m), and how much of an edge it loses (px); sigma of the
            outline in colour, px; the fewest points that make a fit.
    """
    n, improved = len(circles), circles.copy()
    gray, image, focal = frame
    out = (
        np.full((n, SIZE), np.nan),
        np.full((n, UNKNOWNS, UNKNOWNS), np.nan),
        np.full((n, 6), np.nan),
        np.zeros((n, COUNTS)),
    )
    rays = np.empty((n, 6, ROOM), np.float32)
    rank, ranks = order
    ranked = (gray, (*image, ranks), focal)
    first_fits(ranked, circles, rank, upright, settings, rays, out)
    second_fits(ranked, improved, upright, settings, rays, out)
    return _fits(circles, improved, *out)


def _fits(
    circles: Floats,
    improved: Floats,
    caps: Floats,
    covariances: Floats,
    surfaces: Floats,
    counts: Floats,
) -> Fits:
    finite = np.isfinite(caps).all(axis=1) & np.isfinite(covariances).all(axis=(1, 2))
    valid = (counts[:, 0] > 0) & (counts[:, 3] >= 0) & finite & np.isfinite(surfaces).all(axis=1)
    for array in (caps, covariances, surfaces):
        array[~valid] = np.nan
    diagonal = np.diagonal(covariances, axis1=1, axis2=2)
    guessed = GUESSED * (1 - counts[:, 1] / DIRECTIONS) ** SEEN
    astray = counts[:, 6] > ASTRAY * (counts[:, 0] + counts[:, 6])
    doubt = np.maximum(counts[:, 5] / POOR, 1)
    center, axis = caps[:, :3], caps[:, N : N + 3]
    return Fits(
        valid,
        np.where(valid[:, None], improved, circles),
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
