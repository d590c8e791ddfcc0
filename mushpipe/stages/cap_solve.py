"""Gauss-Newton over all caps of a frame: residuals, robust weights, priors, covariance."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from mushpipe.core.jit import jit
from mushpipe.stages.cap_model import (
    HEIGHT,
    N,
    RADIUS,
    UNKNOWNS,
    Floats,
    depth_residual,
    move,
    span,
    tangent_residual,
)
from mushpipe.stages.cap_samples import GRID

ROUND = 16  # rays around the detected circle
_TURN = np.arange(ROUND) * (2 * np.pi / ROUND)
WAVES: Floats = np.stack([np.full(ROUND, 1.0), np.cos(_TURN), np.sin(_TURN)], axis=-1) / ROUND
# Noise is correlated between pixels; this share of the points counts.
EFFECTIVE = 0.35 * 169 / GRID**2
EDGE_WEIGHT = 0.6
DEPTH_CUTS = np.array([400.0, 81.0, 81.0, 16.0])
EDGE_CUTS = np.array([25.0, 25.0, 9.0, 9.0])


class Noise(NamedTuple):
    """Standard deviations of the model.

    Attributes:
        shape: m, how far a cap's surface departs from the model.
        outline: In rim radii, how far its outline does.
        circle_px: Of the detected circle's centre and radius, px.
        edge_px: Of a depth edge, px.
        aspect: Middle aspect h/R of a cap.
        aspect_sigma: Its spread.
        tilt: rad, spread of the tilt off the upright, per direction.
    """

    shape: float
    outline: float
    circle_px: float
    edge_px: float
    aspect: float
    aspect_sigma: float
    tilt: float


@jit
def add(normal: Floats, gradient: Floats, row: Floats, residual: float, weight: float) -> None:
    """Add one residual to the lower triangle of the normal matrix and to the gradient."""
    for i in range(UNKNOWNS):
        scaled = weight * row[i]
        gradient[i] += scaled * residual
        for j in range(i + 1):
            normal[i, j] += scaled * row[j]


@jit
def cholesky(matrix: Floats) -> bool:
    """Factor the lower triangle in place; False where it is not positive definite."""
    for j in range(UNKNOWNS):
        pivot = matrix[j, j]
        for k in range(j):
            pivot -= matrix[j, k] * matrix[j, k]
        if not 1e-12 < pivot < 1e30:
            return False
        matrix[j, j] = np.sqrt(pivot)
        for i in range(j + 1, UNKNOWNS):
            value = matrix[i, j]
            for k in range(j):
                value -= matrix[i, k] * matrix[j, k]
            matrix[i, j] = value / matrix[j, j]
    return True


@jit
def substitute(factor: Floats, vector: Floats) -> None:
    """Solve factor factor^T x = vector in place."""
    for i in range(UNKNOWNS):
        for k in range(i):
            vector[i] -= factor[i, k] * vector[k]
        vector[i] /= factor[i, i]
    for i in range(UNKNOWNS - 1, -1, -1):
        for k in range(i + 1, UNKNOWNS):
            vector[i] -= factor[k, i] * vector[k]
        vector[i] /= factor[i, i]


@jit
def tukey(squared: float, cut: float) -> float:
    """Return Tukey's weight of a squared, normalised residual."""
    return (1.0 - squared / cut) ** 2 if squared < cut else 0.0


@jit
def add_depth(
    cap: Floats, points: Floats, noise: Any, focal: float, cut: float, system: Any
) -> float:
    """Add the points (M, 5) of a cap; return the sum of their robust weights."""
    normal, gradient, row = system
    total = 0.0
    for j in range(len(points)):
        ray, far, sigma = points[j, :3], points[j, 3], points[j, 4]
        residual, cosine = depth_residual(cap, ray, far, row)
        variance = noise.shape**2 + (sigma * cosine) ** 2
        if cosine == 0.0:
            variance += (0.7 * far / focal) ** 2
        weight = tukey(residual * residual / variance, cut)
        total += weight
        if weight > 0.0:
            add(normal, gradient, row, residual, EFFECTIVE * weight / variance)
    return total


@jit
def add_edges(
    cap: Floats, edges: Floats, noise: Any, pixel: float, cut: float, system: Any
) -> None:
    """Add the rays (M, 3) along the depth edge: each touches the cap."""
    normal, gradient, row = system
    variance = (noise.edge_px * pixel) ** 2 + (noise.outline * cap[RADIUS]) ** 2
    for j in range(len(edges)):
        residual = tangent_residual(cap, edges[j], row)
        weight = EDGE_WEIGHT * tukey(residual * residual / variance, cut)
        if weight > 0.0:
            add(normal, gradient, row, residual, weight / variance)


@jit
def add_circle(cap: Floats, outline: Floats, noise: Any, pixel: float, system: Any) -> None:
    """Add the detected circle's three numbers: mean, cosine and sine of its distance to the cap.

    The rays (ROUND, 3) around the circle touch the cap on average; single ones need not, for the
    outline of a cap is no circle.
    """
    normal, gradient, row = system
    value = np.zeros(3)
    rows = np.zeros((3, UNKNOWNS))
    for j in range(ROUND):
        residual = tangent_residual(cap, outline[j], row)
        for w in range(3):
            value[w] += WAVES[j, w] * residual
            for i in range(UNKNOWNS):
                rows[w, i] += WAVES[j, w] * row[i]
    size = (noise.circle_px * pixel) ** 2 + (noise.outline * cap[RADIUS]) ** 2
    for w in range(3):
        # the mean of cos^2 is a half: a shift by d shows as d/2 in the cosine
        add(normal, gradient, rows[w], value[w], (1.0 if w == 0 else 4.0) / size)


@jit
def add_priors(cap: Floats, up: Floats, noise: Any, system: Any) -> None:
    """Add what is known of any cap: its aspect, and that it grows upwards, more or less."""
    normal, gradient, row = system
    row[:] = 0.0
    row[5], row[6] = -noise.aspect, 1.0
    spread = (noise.aspect_sigma * cap[RADIUS]) ** 2
    add(normal, gradient, row, cap[HEIGHT] - noise.aspect * cap[RADIUS], 1.0 / spread)
    # off = up - n (n.up): sine of the tilt, towards the upright; its length becomes the angle
    cosine = min(max(cap[N] * up[0] + cap[N + 1] * up[1] + cap[N + 2] * up[2], -1.0), 1.0)
    sine = np.sqrt(max(1.0 - cosine * cosine, 1e-18))
    stretch = np.arccos(cosine) / sine
    for direction in range(2):
        row[:] = 0.0
        row[3 + direction] = 1.0
        off = 0.0
        for i in range(3):
            off -= up[i] * cap[8 + 3 * direction + i]
        add(normal, gradient, row, off * stretch, 1.0 / noise.tilt**2)


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


@jit
def start(cap: Floats, up: Floats, ray: Floats, middle: float, size: float) -> None:
    """Fill a cap that stands upright where its circle and its middle depth say."""
    for i in range(3):
        cap[i] = ray[i] / ray[2] * (middle + 0.45 * size)
        cap[N + i] = up[i]
    cap[RADIUS] = 1.03 * size
    cap[HEIGHT] = 0.6 * cap[RADIUS]
    span(cap)


@jit
def build(
    cap: Floats,
    data: tuple[Floats, Floats, Floats],
    up: Floats,
    noise: Any,
    focal: float,
    cuts: tuple[float, float],
    system: Any,
) -> float:
    """Fill the normal equations of a cap; return the sum of the weights of its points.

    Args:
        cap: (14,) the estimate.
        data: Points (M, 5), edge rays (E, 3) and rays around the circle (ROUND, 3).
        up: (3,) unit, the upright.
        noise: `Noise`.
        focal: Focal length, px.
        cuts: Squared residuals, of points and edges, beyond which one has no weight.
        system: Normal matrix (7, 7), gradient (7,) and a row (7,) to work with.
    """
    points, edges, outline = data
    system[0][:] = 0.0
    system[1][:] = 0.0
    pixel = cap[2] / focal
    total = add_depth(cap, points, noise, focal, cuts[0], system)
    add_edges(cap, edges, noise, pixel, cuts[1], system)
    add_circle(cap, outline, noise, pixel, system)
    add_priors(cap, up, noise, system)
    return total


@jit
def refine(
    cap: Floats,
    data: tuple[Floats, Floats, Floats],
    up: Floats,
    noise: Any,
    focal: float,
    size: float,
    first: int,
    last: int,
) -> bool:
    """Take Gauss-Newton steps number first to last - 1; False where one has no solution."""
    system = (np.empty((UNKNOWNS, UNKNOWNS)), np.empty(UNKNOWNS), np.empty(UNKNOWNS))
    for k in range(first, last):
        m = min(k, len(DEPTH_CUTS) - 1)
        build(cap, data, up, noise, focal, (DEPTH_CUTS[m], EDGE_CUTS[m]), system)
        if not cholesky(system[0]):
            return False
        step = -system[1]
        substitute(system[0], step)
        limit(cap, step, size)
        move(cap, step)
    return True


@jit
def uncertainty(
    cap: Floats,
    data: tuple[Floats, Floats, Floats],
    up: Floats,
    noise: Any,
    focal: float,
    covariance: Floats,
) -> float:
    """Fill the covariance (7, 7) at the solution; return the weight of the points, -1 if none."""
    system = (covariance, np.empty(UNKNOWNS), np.empty(UNKNOWNS))
    total = build(cap, data, up, noise, focal, (DEPTH_CUTS[-1], EDGE_CUTS[-1]), system)
    factor = covariance.copy()
    if not cholesky(factor):
        return -1.0
    for i in range(UNKNOWNS):
        covariance[i, :] = 0.0
        covariance[i, i] = 1.0
        substitute(factor, covariance[i])
    return total
