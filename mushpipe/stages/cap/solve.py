"""Gauss-Newton for one cap: residuals, robust weights, priors, covariance."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from mushpipe.core.arrays import Floats, Singles
from mushpipe.core.jit import borrower, jit
from mushpipe.stages.cap.linear import cholesky, invert_factor, multiply, substitute, tukey
from mushpipe.stages.cap.model import (
    BULGE,
    E1,
    E2,
    HEIGHT,
    LANES,
    RADIUS,
    ROOM,
    UNKNOWNS,
    N,
    Single,
    Vector,
    fill_rows,
    move,
)

ROUND = 8  # rays around the detected circle, the first columns of a cap's rays
DIAGONAL = Single(np.sqrt(0.5))  # cosine and sine of the rays between the axes
BULGE_LIMIT = 0.15  # beyond, the profile is no longer convex
POINT_CUTS = np.array([400.0, 81.0, 81.0, 16.0])
TOUCH_CUTS = np.array([25.0, 25.0, 9.0, 9.0])
STEPS = len(POINT_CUTS)
# steps to the depth alone, with the outline in colour, and with what the scene says; in an array,
# for of literals in the code each pair would make numba compile another `refine`
STAGES = np.array([0, 2, 4, 5])


class Noise(NamedTuple):
    """Standard deviations of the model.

    Attributes:
        shape: In rim radii, how far a cap's surface departs from the model.
        outline: In rim radii, how far its outline does.
        circle_px: Of the detected circle's centre and radius, px.
        aspect_sigma: Spread of the aspect h/R of caps.
        bulge: Middle bulge of a cap's profile.
        bulge_sigma: Its spread.
        firm: How many independent rays the stated sigmas are worth, against a cap's residuals.
        usual: The squared residual of a usual cap, in those sigmas.
    """

    shape: float
    outline: float
    circle_px: float
    aspect_sigma: float
    bulge: float
    bulge_sigma: float
    firm: float
    usual: float


class Habit(NamedTuple):
    """How caps grow.

    Attributes:
        up: Unit vector.
        spread: Of tilts off it per direction, rad.
        aspect: Height of a usual dome, in rim radii.
    """

    up: Vector
    spread: float
    aspect: float


System = tuple[Floats, Floats]  # normal matrix (8, 8) and gradient (8,)
Work = tuple[System, Singles, Singles, Singles]  # from `workspace`


@borrower
def weigh(
    rows: Singles, rays: Singles, count: int, noise: Noise, pixel: float, radius: float, step: int,
    weights: Singles,
) -> tuple[float, float]:  # fmt: skip
    """Fill the weights (M,) of the rows of a cap's rays.

    Args:
        rows: (10 or more, M) from `fill_rows`.
        rays: (6, M): unit ray, range (m, 0 for a ray that touches), sigma (m), and the share that
            counts as independent.
        count: How many columns are rays.
        noise: `Noise`.
        pixel: Angle of a pixel, rad.
        radius: Of the cap, m.
        step: Number of the step; weights narrow from one to the next.
        weights: Out.

    Returns:
        Sum of the robust weights of the points, and how many times as large as stated the squared
        residuals are.
    """
    surface, outline = Single((noise.shape * radius) ** 2), Single((noise.outline * radius) ** 2)
    far_cut = Single(POINT_CUTS[min(step, STEPS - 1)])
    touch_cut = Single(TOUCH_CUTS[min(step, STEPS - 1)])
    none, missing = Single(0), Single(0.7 * pixel)
    total, misfit, shares = none, none, none
    for j in range(count):
        far, sigma, share = rays[3, j], rays[4, j], rays[5, j]
        cosine, residual = rows[UNKNOWNS + 1, j], rows[UNKNOWNS, j]
        touches = far == none
        missed = missing * far if cosine == none else none
        spread = sigma * cosine
        variance = (outline if touches else surface) + spread * spread + missed * missed
        per_variance = Single(1) / variance
        squared, cut = residual * residual * per_variance, touch_cut if touches else far_cut
        weight = tukey(squared, cut)
        total += none if touches else weight
        misfit += share * min(squared, cut)
        shares += share
        weights[j] = share * weight * per_variance
    if step >= STEPS - 1:
        factor = Single((noise.firm + shares) / (noise.firm + misfit / noise.usual))
        for j in range(count):
            weights[j] *= factor
    return float(total), misfit / max(float(shares), 1e-9)


@borrower
def weigh_circle(rows: Singles, variance: float, cut: float, weights: Singles) -> None:
    """Put the detected circle's three numbers in the place of its rays' rows, the first ROUND.

    Mean, cosine and sine of the rays' distance to the cap: they touch it on average; single ones
    need not, for the outline of a cap is no circle.
    """
    share = Single(1 / ROUND)
    for i in range(UNKNOWNS + 1):
        a, b, c, d = rows[i, 0], rows[i, 1], rows[i, 2], rows[i, 3]
        e, f, g, h = rows[i, 4], rows[i, 5], rows[i, 6], rows[i, 7]
        rows[i, 0] = share * (a + b + c + d + e + f + g + h)
        rows[i, 1] = share * (a - e + DIAGONAL * (b - d - f + h))
        rows[i, 2] = share * (c - g + DIAGONAL * (b + d - f - h))
    for w in range(3):
        # the mean of cos^2 is a half: a shift by d shows as d/2 in the cosine
        precision = (1.0 if w == 0 else 4.0) / variance
        weights[w] = precision * tukey(rows[UNKNOWNS, w] ** 2 * precision, cut)


@borrower
def tilt(cap: Floats, up: Vector) -> tuple[float, float]:
    """Return the turn along e1 and e2 (rad) that takes the upright to a cap's axis."""
    cosine = min(max(cap[N] * up[0] + cap[N + 1] * up[1] + cap[N + 2] * up[2], -1.0), 1.0)
    stretch = -np.arccos(cosine) / np.sqrt(max(1.0 - cosine * cosine, 1e-18))
    first = cap[E1] * up[0] + cap[E1 + 1] * up[1] + cap[E1 + 2] * up[2]
    second = cap[E2] * up[0] + cap[E2 + 1] * up[1] + cap[E2 + 2] * up[2]
    return stretch * first, stretch * second


@borrower
def add_priors(cap: Floats, habit: Habit, noise: Noise, system: System) -> None:
    """Add what is known of any cap: aspect, bulge, and that it grows upwards, more or less."""
    normal, gradient = system
    weight = 1.0 / (noise.aspect_sigma * cap[RADIUS]) ** 2
    off = weight * (cap[HEIGHT] - habit.aspect * cap[RADIUS])
    normal[5, 5] += habit.aspect**2 * weight
    normal[6, 5] -= habit.aspect * weight
    normal[6, 6] += weight
    gradient[5] -= habit.aspect * off
    gradient[6] += off
    lean = tilt(cap, habit.up)
    for w in range(2):
        normal[3 + w, 3 + w] += 1.0 / habit.spread**2
        gradient[3 + w] += lean[w] / habit.spread**2
    normal[7, 7] += 1.0 / noise.bulge_sigma**2
    gradient[7] += (cap[BULGE] - noise.bulge) / noise.bulge_sigma**2


@borrower
def limit(cap: Floats, step: Floats, size: float) -> None:
    """Shorten a step that leaves the range in which the model is meant."""
    length = np.sqrt(step[0] ** 2 + step[1] ** 2 + step[2] ** 2)
    if length > 0.35 * size:
        for i in range(3):
            step[i] *= 0.35 * size / length
    turn = np.sqrt(step[3] ** 2 + step[4] ** 2)
    if turn > 0.35:
        step[3] *= 0.35 / turn
        step[4] *= 0.35 / turn
    radius = min(max(cap[RADIUS] + step[5], 0.6 * size, 0.8 * cap[RADIUS]), 1.6 * size)
    step[5] = min(radius, 1.2 * cap[RADIUS]) - cap[RADIUS]
    low, high = 0.08 * radius, 1.3 * radius
    step[6] = min(max(cap[HEIGHT] + step[6], low), high) - cap[HEIGHT]
    step[7] = min(max(cap[BULGE] + step[7], -BULGE_LIMIT), BULGE_LIMIT) - cap[BULGE]


@jit
def workspace() -> Work:
    """Return normal matrix (8, 8) and gradient (8,), rows flat and not, and weights (ROOM,)."""
    system = (np.empty((UNKNOWNS, UNKNOWNS)), np.empty(UNKNOWNS))
    flat = np.zeros(14 * ROOM, np.float32)
    return system, flat, flat.reshape(14, ROOM), np.empty(ROOM, np.float32)


@borrower
def fill_up(rays: Singles, count: int) -> int:
    """Fill rays (6, M) that count nothing up to the next multiple of LANES; return that."""
    padded = (count + LANES - 1) // LANES * LANES
    for j in range(count, padded):
        rays[:, j] = 0.0
        rays[2, j], rays[4, j] = 1.0, 1.0
    return padded


@borrower
def refine(
    cap: Floats,
    rays: Singles,
    count: int,
    habit: Habit,
    settings: tuple[Noise, float, float, float],
    first: int,
    last: int,
    work: Work,
) -> tuple[float, float]:
    """Take Gauss-Newton steps, and leave the last one's normal matrix, factored, in `work`.

    Args:
        cap: (15,) the estimate, in and out.
        rays: (6, M) as in `weigh`; the first ROUND lie around the detected circle.
        count: How many columns are rays.
        habit: How caps grow.
        settings: `Noise`, the angle of a pixel (rad), the size of the circle at the cap (m), and
            how far off the circle may be (rim radii).
        first: Number of the first step.
        last: Past the last.
        work: From `workspace`.

    Returns:
        Sum of the weights of the points, -1 where a step has no solution; and the misfit.
    """
    system, flat, rows, weights = work
    normal, gradient = system
    noise, pixel, size, slack = settings
    astray = noise.outline**2 + slack**2  # variance, in rim radii
    total, misfit = 0.0, 0.0
    padded = fill_up(rays, count)
    for step in range(first, last):
        fill_rows(cap, rays, padded, flat)
        total, misfit = weigh(rows, rays, padded, noise, pixel, cap[RADIUS], step, weights)
        variance = (noise.circle_px * pixel * cap[2]) ** 2 + astray * cap[RADIUS] ** 2
        weigh_circle(rows, variance, TOUCH_CUTS[min(step, STEPS - 1)], weights)
        multiply(flat, weights, padded, system)
        add_priors(cap, habit, noise, system)
        if not cholesky(normal):
            return -1.0, misfit
        substitute(normal, gradient)
        for i in range(UNKNOWNS):
            gradient[i] = -gradient[i]
        limit(cap, gradient, size)
        move(cap, gradient)
    return total, misfit


@borrower
def variance_of_tilt(factor: Floats) -> float:
    """Return the variance of the tilt, rad^2, per direction, from a matrix `cholesky` factored.

    Two columns of the matrix give way to those of its inverse.
    """
    invert_factor(factor, 3, 4)
    total = 0.0
    for turn in (3, 4):
        # the diagonal of the inverse: the squared columns of that of the factor
        for i in range(turn, UNKNOWNS):
            total += factor[i, turn] * factor[i, turn]
    return 0.5 * total


@borrower
def variance_of_aspect(factor: Floats, aspect: float) -> float:
    """Return the variance of h - aspect R, m^2, from a matrix `cholesky` factored.

    The diagonal of the factor holds reciprocals.
    """
    fifth = -aspect * factor[5, 5]
    sixth = (1.0 - factor[6, 5] * fifth) * factor[6, 6]
    seventh = (factor[7, 5] * fifth + factor[7, 6] * sixth) * factor[7, 7]
    return float(fifth * fifth + sixth * sixth + seventh * seventh)
