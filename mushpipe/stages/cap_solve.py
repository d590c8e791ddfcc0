"""Gauss-Newton over all caps of a frame: residuals, robust weights, priors, covariance."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from mushpipe.core.jit import jit
from mushpipe.stages.cap_linear import add, cholesky, scale, substitute, tukey
from mushpipe.stages.cap_model import (
    BULGE,
    E1,
    E2,
    HEIGHT,
    RADIUS,
    ROOM,
    UNKNOWNS,
    Floats,
    N,
    depth_rows,
    move,
    tangent_rows,
)
from mushpipe.stages.cap_samples import GRID

ROUND = 8  # rays around the detected circle
_TURN = np.arange(ROUND) * (2 * np.pi / ROUND)
WAVES: Floats = np.stack([np.ones(ROUND), np.cos(_TURN), np.sin(_TURN)]) / ROUND
# Noise is correlated between pixels; this share of the points counts.
EFFECTIVE = 0.35 * 169 / GRID**2
BULGE_LIMIT = 0.15  # beyond, the profile is no longer convex
DEPTH_CUTS = np.array([400.0, 81.0, 81.0, 16.0])
EDGE_CUTS = np.array([25.0, 25.0, 9.0, 9.0])


class Noise(NamedTuple):
    """Standard deviations of the model.

    Attributes:
        shape: m, how far a cap's surface departs from the model.
        outline: In rim radii, how far its outline does.
        circle_px: Of the detected circle's centre and radius, px.
        edge_px: Of a depth edge, px.
        color_px: Of the outline in colour, px.
        edge_weight: Share of the depth edge's rays that count as independent.
        color_weight: The same of the rays along the outline in colour.
        aspect: Middle aspect h/R of a cap.
        aspect_sigma: Its spread.
        bulge: Middle bulge of a cap's profile.
        bulge_sigma: Its spread.
    """

    shape: float
    outline: float
    circle_px: float
    edge_px: float
    color_px: float
    edge_weight: float
    color_weight: float
    aspect: float
    aspect_sigma: float
    bulge: float
    bulge_sigma: float


@jit
def add_depth(
    cap: Floats, points: Floats, noise: Any, focal: float, cut: float, work: Any
) -> float:
    """Add the points (5, M) of a cap; return the sum of their robust weights."""
    system, flat, rows, weights = work
    count = points.shape[1]
    depth_rows(cap, points, count, flat)
    total = 0.0
    for j in range(count):
        cosine, residual = rows[UNKNOWNS + 1, j], rows[UNKNOWNS, j]
        missed = 0.0 if cosine > 0.0 else 0.7 * points[3, j] / focal
        variance = noise.shape**2 + (points[4, j] * cosine) ** 2 + missed**2
        weight = tukey(residual * residual / variance, cut)
        total += weight
        weights[j] = EFFECTIVE * weight / variance
    scale(rows, weights, count)
    add(system, rows, count)
    return total


@jit
def add_edges(
    cap: Floats, edges: Floats, sigma: float, weight: float, cut: float, work: Any
) -> None:
    """Add the rays (3, M) along an edge, which touch the cap within sigma (m)."""
    system, flat, rows, weights = work
    count = edges.shape[1]
    tangent_rows(cap, edges, count, flat)
    variance = sigma * sigma
    for j in range(count):
        weights[j] = weight * tukey(rows[UNKNOWNS, j] ** 2 / variance, cut) / variance
    scale(rows, weights, count)
    add(system, rows, count)


@jit
def add_circle(cap: Floats, around: Floats, noise: Any, pixel: float, work: Any) -> None:
    """Add the detected circle's three numbers: mean, cosine and sine of its distance to the cap.

    The rays (3, ROUND) around the circle touch the cap on average; single ones need not, for the
    outline of a cap is no circle.
    """
    system, flat, rows, weights = work
    tangent_rows(cap, around, ROUND, flat)
    for i in range(UNKNOWNS + 1):
        for w in range(3):
            total = 0.0
            for j in range(ROUND):
                total += WAVES[w, j] * rows[i, j]
            rows[i, ROUND + w] = total
    for i in range(UNKNOWNS + 1):
        for w in range(3):
            rows[i, w] = rows[i, ROUND + w]
    variance = (noise.circle_px * pixel) ** 2 + (noise.outline * cap[RADIUS]) ** 2
    weights[0] = 1.0 / variance
    # the mean of cos^2 is a half: a shift by d shows as d/2 in the cosine
    weights[1] = weights[2] = 4.0 / variance
    scale(rows, weights, 3)
    add(system, rows, 3)


@jit
def tilt(cap: Floats, up: Floats) -> tuple[float, float]:
    """Return the turn along e1 and e2 (rad) that takes the upright to a cap's axis."""
    cosine = min(max(cap[N] * up[0] + cap[N + 1] * up[1] + cap[N + 2] * up[2], -1.0), 1.0)
    stretch = -np.arccos(cosine) / np.sqrt(max(1.0 - cosine * cosine, 1e-18))
    first = cap[E1] * up[0] + cap[E1 + 1] * up[1] + cap[E1 + 2] * up[2]
    second = cap[E2] * up[0] + cap[E2 + 1] * up[1] + cap[E2 + 2] * up[2]
    return stretch * first, stretch * second


@jit
def add_priors(cap: Floats, upright: tuple[Floats, float], noise: Any, work: Any) -> None:
    """Add what is known of any cap: its aspect, and that it grows upwards, more or less."""
    system, _, rows, weights = work
    rows[: UNKNOWNS + 1, :4] = 0.0
    rows[5, 0], rows[6, 0] = -noise.aspect, 1.0
    rows[UNKNOWNS, 0] = cap[HEIGHT] - noise.aspect * cap[RADIUS]
    weights[0] = 1.0 / (noise.aspect_sigma * cap[RADIUS]) ** 2
    lean = tilt(cap, upright[0])
    for w in range(2):
        rows[3 + w, 1 + w] = 1.0
        rows[UNKNOWNS, 1 + w] = lean[w]
        weights[1 + w] = 1.0 / upright[1] ** 2
    rows[7, 3], rows[UNKNOWNS, 3] = 1.0, cap[BULGE] - noise.bulge
    weights[3] = 1.0 / noise.bulge_sigma**2
    scale(rows, weights, 4)
    add(system, rows, 4)


@jit
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
    low, high = 0.2 * radius, 1.3 * radius
    step[6] = min(max(cap[HEIGHT] + step[6], low), high) - cap[HEIGHT]
    step[7] = min(max(cap[BULGE] + step[7], -BULGE_LIMIT), BULGE_LIMIT) - cap[BULGE]


@jit
def workspace() -> Any:
    """Return normal matrix (8, 8) and gradient (8,), rows flat and not, and weights (ROOM,)."""
    system = (np.empty((UNKNOWNS, UNKNOWNS)), np.empty(UNKNOWNS))
    flat = np.zeros(14 * ROOM)
    return system, flat, flat.reshape(14, ROOM), np.empty(ROOM)


@jit
def build(
    cap: Floats,
    data: tuple[Floats, Floats, Floats, Floats],
    upright: tuple[Floats, float],
    noise: Any,
    focal: float,
    cuts: tuple[float, float],
    work: Any,
) -> float:
    """Fill the normal equations of a cap; return the sum of the weights of its points.

    Args:
        cap: (15,) the estimate.
        data: Points (5, M), rays along the depth edge (3, E), around the circle (3, ROUND) and
            along the outline in colour (3, L).
        upright: Unit vector (3,) and the spread of tilts off it, rad.
        noise: `Noise`.
        focal: Focal length, px.
        cuts: Squared residuals, of points and edges, beyond which one has no weight.
        work: From `workspace`.
    """
    points, edges, around, outline = data
    work[0][0][:] = 0.0
    work[0][1][:] = 0.0
    pixel = cap[2] / focal
    total = add_depth(cap, points, noise, focal, cuts[0], work)
    mismatch = (noise.outline * cap[RADIUS]) ** 2
    sigma = np.sqrt((noise.edge_px * pixel) ** 2 + mismatch)
    add_edges(cap, edges, sigma, noise.edge_weight, cuts[1], work)
    sigma = np.sqrt((noise.color_px * pixel) ** 2 + mismatch)
    add_edges(cap, outline, sigma, noise.color_weight, cuts[1], work)
    add_circle(cap, around, noise, pixel, work)
    add_priors(cap, upright, noise, work)
    return total


@jit
def refine(
    cap: Floats,
    data: tuple[Floats, Floats, Floats, Floats],
    upright: tuple[Floats, float],
    noise: Any,
    focal: float,
    size: float,
    first: int,
    last: int,
    work: Any,
) -> bool:
    """Take Gauss-Newton steps number first to last - 1; False where one has no solution."""
    normal, gradient = work[0]
    for k in range(first, last):
        m = min(k, len(DEPTH_CUTS) - 1)
        build(cap, data, upright, noise, focal, (DEPTH_CUTS[m], EDGE_CUTS[m]), work)
        if not cholesky(normal):
            return False
        substitute(normal, gradient)
        for i in range(UNKNOWNS):
            gradient[i] = -gradient[i]
        limit(cap, gradient, size)
        move(cap, gradient)
    return True


@jit
def uncertainty(
    cap: Floats,
    data: tuple[Floats, Floats, Floats, Floats],
    upright: tuple[Floats, float],
    noise: Any,
    focal: float,
    covariance: Floats,
    work: Any,
) -> float:
    """Fill the covariance (8, 8) at the solution; return the weight of the points, -1 if none."""
    total = build(cap, data, upright, noise, focal, (DEPTH_CUTS[-1], EDGE_CUTS[-1]), work)
    if not cholesky(work[0][0]):
        return -1.0
    for i in range(UNKNOWNS):
        covariance[i, :] = 0.0
        covariance[i, i] = 1.0
        substitute(work[0][0], covariance[i])
    return total
