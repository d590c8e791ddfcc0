"""What speaks for and against a candidate: named features, each with one definition.

Features of the image, then features that need depth. `free`, `support`, `trust`, `hits`, `overlap`,
`spans` and `doubled` depend on what has been accepted before and stand in `phase.decide`.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from mushpipe.core.arrays import Bytes, Floats, Ints32, Singles
from mushpipe.core.jit import borrower
from mushpipe.stages.linear import solve
from mushpipe.stages.phase.depth import Relief
from mushpipe.stages.phase.edges import Gradient
from mushpipe.stages.phase.refit import COSINES, HIDDEN, SINES
from mushpipe.stages.phase.scratch import DIRECTIONS
from mushpipe.stages.phase.steps import height_at, rises, step_up

# How bright a cap is against what is beside it is none of them: simulated beds are fuller than real
# ones, so a cap with dark soil all around it counted as less likely than one in a cluster.
IMAGE_FEATURES = {
    "free": "share of the outline, within the image, that nothing nearer hides",
    "support": "share of the free outline with an edge that no accepted circle has used",
    "trust": "mean weight of the edges of the free outline, 0 where there is none",
    "hits": "logarithm of 1 + the number of those edges",
    "overlap": "largest share of the disc that one accepted circle covers",
    "spans": "largest share of an accepted circle that the disc covers",
    "doubled": "largest IoU with an accepted circle",
    "residual": "root mean square distance of the edges from the outline, over the radius",
    "oval": "departure of the outline from a circle, over the radius",
    "cover": "share of the disc that the mask covers",
    "coherence": "sum of the inward part of the gradient over the disc, over the sum of its size",
    "texture": "mean gradient within 0.7 radii times the radius, over the mean brightness",
}
DEPTH_FEATURES = {
    "height": "height h of the middle over the bed, as h / (|h| + R)",
    "bend_small": "smaller principal curvature of the surface, times R; a sphere has 1, a stem 0",
    "bend_large": "larger principal curvature, times R",
    "roughness": "root mean square residual of a quadric fitted to the surface, over R",
    "drop": "share of the known outline outside which it is lower by a step",
    "rise": "share of the known outline outside which it is higher by a step",
    "gap": "share of the disc without depth",
}
LEARNED = "learned"  # what circles of another detector say; see `phase.learned`
NAMES = (*IMAGE_FEATURES, *DEPTH_FEATURES, LEARNED)
AT_LEARNED = NAMES.index(LEARNED)
FIRST_STATIC = NAMES.index("residual")
FIRST_DEPTH = len(IMAGE_FEATURES)
SAMPLES = 16  # directions in which the disc is sampled
LEAST_KNOWN = 0.35  # share of the disc with depth below which depth features are off
_TURNS = 2 * np.pi * (np.arange(SAMPLES) + 0.5) / SAMPLES
_COSINES, _SINES = np.cos(_TURNS), np.sin(_TURNS)
# The surface is sampled on a grid within 0.75 radii: rows 1, u, v, u^2, u v, v^2, in radii.
_U, _V = (axis.ravel() for axis in np.meshgrid(*2 * [np.linspace(-0.75, 0.75, 9)]))
_BASIS = np.column_stack([np.ones(81), _U, _V, _U * _U, _U * _V, _V * _V])
_BASIS = _BASIS[_U * _U + _V * _V <= 0.5625]
_BY_TERM = np.ascontiguousarray(_BASIS.T)
_PRODUCTS = np.array([_BY_TERM[p] * _BY_TERM[q] for p in range(6) for q in range(p, 6)])
_RINGS = np.array([0.15, 0.3, 0.45, 0.6, 0.75, 0.88, 0.97])


class Room(NamedTuple):
    """Room to work in, made once for all outlines.

    Attributes:
        heights: (P,) m, of the points of a surface.
        weights: (P,) of them.
        normal: (6, 6) normal matrix.
        right: (6,) its right side.
        lanes: (2, DIRECTIONS) of whatever has a number per direction.
    """

    heights: Floats
    weights: Floats
    normal: Floats
    right: Floats
    lanes: Singles


@borrower
def _pixel(x: float, y: float, width: int, height: int) -> tuple[int, int]:
    """Nearest pixel; x = -1 beyond the image."""
    u, v = math.floor(x + 0.5), math.floor(y + 0.5)
    if u < 0 or v < 0 or u >= width or v >= height:
        return -1, -1
    return u, v


@borrower
def disc_features(image: Singles, grad: Gradient, mask: Bytes, shape: Floats, row: Floats) -> None:
    """Write cover, coherence and texture of a disc, sampled on a polar grid, into row[0..2].

    Samples count by the area they stand for.
    """
    lines, width = image.shape
    area = set_area = inward = total = small = bright = small_area = 0.0
    for k in range(SAMPLES):
        c, s = _COSINES[k], _SINES[k]
        for t in _RINGS:
            u, v = _pixel(shape[0] + t * shape[2] * c, shape[1] + t * shape[2] * s, width, lines)
            if u < 0:
                continue
            area += t
            set_area += t * mask[v, u]
            inward -= t * (grad.x[v, u] * c + grad.y[v, u] * s)
            total += t * grad.size[v, u]
            if t < 0.7:
                small += t * grad.size[v, u]
                bright += t * image[v, u]
                small_area += t
    row[0] = set_area / max(area, 1e-9)
    row[1] = inward / max(total, 1e-9)
    row[2] = min(4.0, small * shape[2] / max(bright, 1e-9 + 4 * small_area))


@borrower
def _quadric(z: Floats, sigma: float, before: Floats, a: Floats, weight: Floats) -> float:
    """Fit z = b0 + b1 u + b2 v + b3 u^2 + b4 u v + b5 v^2 to heights z (P,) m, -1 for unknown.

    Args:
        z: (P,)
        sigma: m; points farther than 3 sigma from the previous solution are left out.
        before: (6,) the previous solution; the new one is written over it.
        a: (6, 6) scratch.
        weight: (P,) scratch.

    Returns:
        The root mean square residual (m) of the points; each clipped to 20 mm.
    """
    for k in range(len(z)):
        weight[k] = 1.0 if (z[k] != -1) & (_misfit(z[k], k, before) <= 3 * sigma) else 0.0
    row = 0
    for p in range(6):  # products of the basis that are ready leave sums that SIMD does
        total = 0.0
        for k in range(len(z)):
            total += weight[k] * z[k] * _BY_TERM[p, k]
        before[p] = total
        for q in range(p, 6):
            total = 0.0
            for k in range(len(z)):
                total += weight[k] * _PRODUCTS[row, k]
            a[p, q] = a[q, p] = total
            row += 1
        a[p, p] += 1e-4
    solve(a, before)
    squares, count = 0.0, 0.0
    for k in range(len(z)):
        known = 1.0 if z[k] != -1 else 0.0
        squares += known * min(_misfit(z[k], k, before), 0.02) ** 2
        count += known
    return math.sqrt(squares / max(count, 1.0))


@borrower
def _misfit(z: float, k: int, b: Floats) -> float:
    """Return how far (m) the height of the k-th point lies from a quadric."""
    plane = b[0] + b[1] * _BY_TERM[1, k] + b[2] * _BY_TERM[2, k]
    bend = b[3] * _BY_TERM[3, k] + b[4] * _BY_TERM[4, k] + b[5] * _BY_TERM[5, k]
    return float(abs(z - plane - bend))


@borrower
def surface_features(relief: Relief, shape: Floats, row: Floats, room: Room) -> float:
    """Write height, bend_small, bend_large, roughness and gap into row[0..3] and row[6].

    Args:
        relief: What stands on the bed.
        shape: x, y, r, p, q.
        row: Receives the features.
        room: To work in.

    Returns:
        The height of the middle, m; NaN where too little is known.
    """
    (z, weight, a, b, _), known = room, 0
    for k in range(len(z)):
        x, y = shape[0] + _BASIS[k, 1] * shape[2], shape[1] + _BASIS[k, 2] * shape[2]
        z[k] = height_at(relief.height, x, y)
        known += z[k] != -1
    row[6] = 1 - known / len(z)
    if row[6] > 1 - LEAST_KNOWN or known < 8:
        return math.nan
    b[:] = 0.0
    rms = _quadric(z, math.inf, b, a, weight)
    rms = _quadric(z, max(0.001, rms), b, a, weight)
    radius = shape[2] * relief.pixel
    mean, spread = -(b[3] + b[5]), math.sqrt((b[3] - b[5]) ** 2 + b[4] ** 2)
    row[0] = b[0] / (abs(b[0]) + radius)
    row[1] = min(3.0, max(-2.0, (mean - spread) / radius))
    row[2] = min(4.0, max(-2.0, (mean + spread) / radius))
    row[3] = min(1.0, rms / radius)
    return float(b[0])


@borrower
def edge_features(relief: Relief, shape: Floats, hits: Ints32, row: Floats, lanes: Singles) -> None:
    """Write drop and rise into row[4], row[5]; mark directions of `hits` with a rise as hidden."""
    step = step_up(shape[2] * relief.pixel)
    n, known, lower, higher = 0, 0, 0, 0
    while n < len(hits) and hits[n] != -2:
        n += 1
    ups = lanes[:, :n]
    rises(relief.height, shape, COSINES[n, :n], SINES[n, :n], ups)
    for k in range(n):
        up = ups[0, k]
        if up == 0:
            continue
        known += 1
        if up < -step:
            lower += 1
        elif up > step:
            higher += 1
            hits[k] = HIDDEN
    row[4] = lower / max(known, 1)
    row[5] = higher / max(known, 1)


@borrower
def _static(
    image: Singles, grad: Gradient, mask: Bytes, relief: Relief, shapes: Floats, hits: Ints32,
    residual: Singles, table: Floats, middle: Floats, room: Room,
) -> None:  # fmt: skip
    for k in range(len(shapes)):
        shape, row = shapes[k], table[k]
        row[FIRST_STATIC] = residual[k] / shape[2]
        row[FIRST_STATIC + 1] = math.hypot(shape[3], shape[4]) / shape[2]
        disc_features(image, grad, mask, shape, row[FIRST_STATIC + 2 :])
        middle[k] = math.nan
        if len(relief.height):
            middle[k] = surface_features(relief, shape, row[FIRST_DEPTH:], room)
            if middle[k] == middle[k]:
                edge_features(relief, shape, hits[k], row[FIRST_DEPTH:], room.lanes)


def static_features(
    image: Singles, grad: Gradient, mask: Bytes, relief: Relief, shapes: Floats, hits: Ints32,
    residual: Singles,
) -> tuple[Floats, Floats]:  # fmt: skip
    """Return all features that do not depend on other candidates, (N, F), and heights (N,) m.

    The others are 0. A height is NaN where depth is missing, and the features of depth then 0.

    Args:
        image: (H, W) gray levels.
        grad: Its gradient.
        mask: (H, W) 0 or 1.
        relief: What stands on the bed.
        shapes: (N, 5) outlines.
        hits: (N, D) rows of the edges that support them; hidden directions are marked in it.
        residual: (N,) px.
    """
    table, middle = np.zeros((len(shapes), len(NAMES))), np.full(len(shapes), np.nan)
    points, lanes = np.empty((2, len(_BASIS))), np.empty((2, DIRECTIONS), np.float32)
    room = Room(points[0], points[1], np.empty((6, 6)), np.empty(6), lanes)
    _static(image, grad, mask, relief, shapes, hits, residual, table, middle, room)
    return table, middle
