"""All caps of a frame: sampling, fitting, and what follows from the fitted parameters."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from mushpipe.core.arrays import Bools, Floats, Ints
from mushpipe.core.jit import borrower, jit
from mushpipe.stages.cap.attempt import (
    COUNTS,
    DOME,
    EDGES,
    EXTENT,
    LINES,
    MISFIT,
    OTHERS,
    POINTS,
    POOR,
    TILT,
    WEIGHT,
    Fit,
    Frame,
    Room,
    Settings,
    fit_cap,
    scratch,
)
from mushpipe.stages.cap.blocks import CELLS
from mushpipe.stages.cap.circle import improve
from mushpipe.stages.cap.habit import spread_of, usual_aspect
from mushpipe.stages.cap.linear import invert
from mushpipe.stages.cap.model import (
    HEIGHT,
    RADIUS,
    ROOM,
    SIZE,
    UNKNOWNS,
    N,
    Single,
    Vector,
    beside,
    frozen,
    meet,
    slope,
)
from mushpipe.stages.cap.regrow import beyond, slack
from mushpipe.stages.cap.samples import ASTRAY, DIRECTIONS, ray_at
from mushpipe.stages.cap.solve import ROUND, STAGES, Habit, refine, tilt
from mushpipe.stages.cap.stand import stands
from mushpipe.stages.cap.top import rise

ROUNDNESS = 0.01  # in rim radii: how far the rim of a cap is from the circle of its area
GUESSED = 0.1  # in rim radii: how far off an outline is that no depth edge confirms,
SEEN = 5  # and with what power of the share that is not confirmed that grows;
CUT = 0.4  # and the border of the image cuts off, by the square of its share
TOLD = 11  # numbers that follow from a fit: surface point, m, and
# where these begin: its sigmas, m; sigma of the tilt, rad, and of the radius, m; the apex, m
SIGMAS, SIGMA_TILT, SIGMA_RADIUS, APEX = 3, 6, 7, 8
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
        lean: (N,) rad, of the axis off the upright.
        stand: (N,) m, how far the apex lies above the ground around; NaN where none is seen.
    """

    valid: Bools
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
    edges: Ints
    lines: Ints
    misfit: Floats
    lean: Floats
    stand: Floats


@borrower
def second_fit(
    frame: Frame, circle: Floats, habit: Habit, settings: Settings, fit: Fit,
    covariance: Floats, told: Floats, room: Room,
) -> None:  # fmt: skip
    """Refine a fit with what the scene says of its cap's tilt, and then its circle, in place.

    Arguments as `fit_cap`, and out: covariance (8, 8), and what follows from the fit, (TOLD,), as
    `locate` and `describe` fill it. If any of it is not finite, the count of points becomes 0.
    """
    image, (rays, cap, counts), noise = frame.image, fit, settings.noise
    count = ROUND + int(counts[POINTS] + counts[EDGES] + counts[LINES])
    setting = (noise, 1.0 / image.focal, counts[EXTENT], slack(image, circle))
    counts[WEIGHT], counts[MISFIT] = refine(
        cap, rays, count, habit, setting, STAGES[2], STAGES[3], room.work
    )
    invert(room.work[0][0], covariance)
    held, doubt = (counts[EDGES], counts[LINES]), max(1.0, counts[MISFIT] / POOR)
    improve(circle, cap, held, doubt, image, room.lanes)
    ray = ray_at(image, circle[0], circle[1])
    locate(cap, ray, covariance, noise.circle_px / image.focal, told)
    describe(fit, covariance, beyond(image, circle), told)
    total = counts[WEIGHT] + counts[MISFIT]
    for value in cap:
        total += value
    for value in told:
        total += value
    if not (np.isfinite(total) and counts[WEIGHT] >= 0.0):
        counts[POINTS] = 0.0


@jit
def fit_all(
    frame: Frame, circles: Floats, rank: Ints, habit: Habit,
    settings: Settings, out: tuple[Floats, ...],
) -> None:  # fmt: skip
    """Fit every cap, first with the same prior for all, then with what they say of the scene.

    Args:
        frame: What they are fitted to.
        circles: (N, 3) x, y, radius, px.
        rank: (N,) of them, as `ranks` from `by_depth`.
        habit: How caps grow.
        settings: How.
        out: Per cap its circle, improved; parameters, covariance, what follows, and counts, as by
            `second_fit`. A cap without a fit keeps its circle and has a count of 0, the rest NaN.
    """
    improved, caps, covariances, told, counts = out
    room, n = scratch(*frame.image.depth.shape), len(circles)
    rays = np.empty((n, 6, ROOM), np.float32)
    squares, variances, spreads = np.full(n, -1.0), np.ones(n), np.empty(n)
    aspects, domes = np.full(n, -1.0), np.ones(n)
    for i in range(n):
        fit = Fit(rays[i], caps[i], counts[i])
        fit_cap(frame, circles[i], (rank[i], n), habit, settings, fit, room)
        if counts[i, POINTS] > 0:
            first, second = tilt(caps[i], habit.up)
            squares[i] = first * first + second * second
            variances[i] = counts[i, TILT]
            aspects[i] = caps[i, HEIGHT] / caps[i, RADIUS]
            domes[i] = counts[i, DOME] / caps[i, RADIUS] ** 2
    spread_of(squares, variances, habit.spread, spreads)
    aspect = usual_aspect(aspects, domes, habit.aspect, settings.noise.aspect_sigma)
    for i in range(n):
        if counts[i, POINTS] > 0:
            improved[i] = circles[i]
            fit, own = Fit(rays[i], caps[i], counts[i]), Habit(habit.up, spreads[i], aspect)
            second_fit(frame, improved[i], own, settings, fit, covariances[i], told[i], room)
        if not counts[i, POINTS] > 0:
            improved[i] = circles[i]
            caps[i], covariances[i], told[i], counts[i, WEIGHT] = np.nan, np.nan, np.nan, np.nan


@borrower
def locate(cap: Floats, ray: Vector, covariance: Floats, sigma: float, out: Floats) -> None:
    """Fill the point (3,) where a ray meets a cap, and its sigmas (3,), m.

    Args:
        cap: (15,) the cap.
        ray: Unit vector.
        covariance: (8, 8) of the cap.
        sigma: Of the ray's direction, rad.
        out: (6 or more,) out.
    """
    c, away = frozen(cap), np.sqrt(cap[0] ** 2 + cap[1] ** 2 + cap[2] ** 2)
    r = (Single(ray[0]), Single(ray[1]), Single(ray[2]))
    x, y, z = Single(cap[0]), Single(cap[1]), Single(cap[2])
    q = beside((x, y, z), Single(away), Single(1) / c[11], r)
    t, per_k, _ = meet(c, q, r, False)
    row = slope(c, (q[0] + t * r[0], q[1] + t * r[1], q[2] + t * r[2]), r, per_k)
    t = away + t * cap[RADIUS]
    variance = 0.0
    for i in range(UNKNOWNS):
        for j in range(UNKNOWNS):
            variance += row[3 + i] * covariance[i, j] * row[3 + j]
    square = max(row[2], 0.1) ** 2  # of the cosine of incidence
    far = t + row[0] / max(row[2], 0.3)  # a step to the surface with its bulge
    across = (sigma * t) ** 2
    # An error across the ray moves the point up or down the slope. That both come together would
    # take a part of Z's variance off the optical axis, but the fit knows too little of its errors:
    # z2 of Z is 1.0 as it is, and 1.4 without that part (benchmarks/localization.py).
    along = (variance + across * (1.0 - square)) / square
    for i in range(3):
        share = ray[i] * ray[i]
        out[i] = far * ray[i]
        out[3 + i] = np.sqrt(along * share + across * (1.0 - share))


@borrower
def describe(fit: Fit, covariance: Floats, cut: float, told: Floats) -> None:
    """Widen the sigmas by what a fit cannot know of itself, and fill the rest that follows from it.

    Args:
        fit: Of the cap.
        covariance: (8, 8) of it.
        cut: Share of its circle that lies beyond the image.
        told: (TOLD,) surface point and its sigmas, in and out; the rest, out.
    """
    rays, cap, counts = fit
    doubt = max(1.0, counts[MISFIT] / POOR)
    guessed = GUESSED * (1.0 - counts[EDGES] / DIRECTIONS) ** SEEN + CUT * cut**2
    if counts[OTHERS] > ASTRAY * (counts[POINTS] + counts[OTHERS]):
        for i in range(SIGMAS, SIGMAS + 3):
            told[i] = np.hypot(told[i], cap[RADIUS])
    tilts = covariance[3, 3] + covariance[4, 4] + (LEVER * guessed) ** 2
    told[SIGMA_TILT] = doubt * np.sqrt(tilts)
    outline = (ROUNDNESS**2 + guessed**2) * cap[RADIUS] ** 2
    told[SIGMA_RADIUS] = doubt * np.sqrt(covariance[5, 5] + outline)
    height = cap[HEIGHT] + rise(cap, rays, int(counts[POINTS]))
    for i in range(3):
        told[APEX + i] = cap[i] + height * cap[N + i]


def fit_caps(frame: Frame, circles: Floats, rank: Ints, habit: Habit, settings: Settings) -> Fits:
    """Fit a cap to the depth in each circle.

    Args:
        frame: What they are fitted to.
        circles: (N, 3) x, y, radius, px.
        rank: (N,) of them, as `ranks` from `by_depth`.
        habit: How caps grow.
        settings: How.
    """
    n = len(circles)
    out = (
        np.empty((n, 3)),
        np.empty((n, SIZE)),
        np.empty((n, UNKNOWNS, UNKNOWNS)),
        np.empty((n, TOLD)),
        np.zeros((n, COUNTS)),
    )
    fit_all(frame, circles, rank, habit, settings, out)
    up, apexes = np.array(habit.up), np.ascontiguousarray(out[3][:, APEX:])  # as the kernel wants
    stand = stands(frame.image, circles, apexes, up, settings.sensor.bias)
    return _fits(*out, up, stand)


def _fits(
    circles: Floats, caps: Floats, covariances: Floats, told: Floats, counts: Floats,
    up: Floats, stand: Floats,
) -> Fits:  # fmt: skip
    return Fits(
        valid=counts[:, POINTS] > 0,
        circle=circles,
        center=caps[:, :3],
        axis=caps[:, N : N + 3],
        radius=caps[:, RADIUS],
        height=caps[:, HEIGHT],
        apex=told[:, APEX:],
        surface=told[:, :SIGMAS],
        covariance=covariances,
        sigma_tilt=told[:, SIGMA_TILT],
        sigma_radius=told[:, SIGMA_RADIUS],
        sigma_surface=told[:, SIGMAS:SIGMA_TILT],
        fitness=np.minimum(counts[:, WEIGHT] / len(CELLS), 1.0),
        edges=counts[:, EDGES].astype(np.int64),
        lines=counts[:, LINES].astype(np.int64),
        misfit=counts[:, MISFIT],
        lean=np.arccos(np.clip(caps[:, N : N + 3] @ up, -1, 1)),
        stand=stand,
    )
