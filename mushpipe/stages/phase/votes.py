"""The phase-coded accumulator and its peaks (Atherton & Kerbyson 1999).

T. J. Atherton and D. J. Kerbyson, "Size invariant circle detection", Image and Vision Computing 17
(1999) 795-803. Every edge point votes along its gradient for the centres of all radii r of the
range at once, with the complex weight

    exp(i phi(r)) / (2 pi r),    phi(r) = (1 - gap) (2 pi ln(r / Rmin) / ln(Rmax / Rmin) - pi),

their log-coded phase, here with a gap between the phases of Rmax and Rmin so that both cannot be
taken for each other. The phases of a circle's votes agree at its centre: the magnitude there is the
share of the outline that voted, whatever its size, and the phase is the radius.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from mushpipe.core.arrays import Floats, Singles
from mushpipe.core.jit import borrower, jit
from mushpipe.stages.discs import Radii
from mushpipe.stages.phase.strips import Strips

CELL = 2  # px; the accumulator has half the resolution of the image
GAP = 0.15
STEP = 2.0  # px between the radii of an edge point's votes
WIDE = 20.0  # px; the votes that meet in 3 x 3 cells cancel where the phase turns in fewer
REACH = 2  # cells around a peak within which it must be the highest


class Rings(NamedTuple):
    """The radii that are voted for, with their weights.

    Attributes:
        radius: (K,) px.
        real: (K,) real part of the weight.
        imaginary: (K,)
    """

    radius: Singles
    real: Singles
    imaginary: Singles


def centres(
    edges: Strips, radii: Radii, shape: tuple[int, int], least: float, every: int = 1
) -> Singles:
    """Return likely circles (N, 4): x, y, radius in px, and the share of the outline that voted.

    Args:
        edges: What votes.
        radii: Of the circles.
        shape: Height and width of the image, px.
        least: Smallest share.
        every: Of so many edge points one votes.
    """
    coded = coded_range(radii)
    cells = vote(edges, rings_between(coded), (-(-shape[0] // CELL), -(-shape[1] // CELL)), every)
    found = peaks(*summed(cells), least, coded)
    near = (found[:, 2] > radii.smallest - 2 * STEP) & (found[:, 2] < radii.largest + 2 * STEP)
    return found if coded == radii else found[near]


def coded_range(radii: Radii) -> Radii:
    """Return the radii between which the phase turns once: `WIDE` apart at least."""
    smallest, largest = radii
    low = max(smallest - max(0.0, WIDE - (largest - smallest)) / 2, smallest / 2)
    return Radii(low, max(largest, low + WIDE))


def rings_between(radii: Radii) -> Rings:
    """Return radii about `STEP` apart; a full circle's votes then add up to about 1."""
    smallest, largest = radii
    count = max(3, math.ceil((largest - smallest) / STEP) + 1)
    radius = np.linspace(smallest, largest, count)
    phase = phase_of(radius, radii)
    # Of an outline of 2 pi r edge points, each votes once near the centre for its own radius and,
    # being spread over the 3 x 3 cells that are summed, for the neighbouring radii too.
    spacing = (largest - smallest) / (count - 1)
    weight = spacing / (3 * CELL) / (2 * np.pi * radius)
    parts = radius, weight * np.cos(phase), weight * np.sin(phase)
    return Rings(*(part.astype(np.float32) for part in parts))


def phase_of(radius: Floats, radii: Radii) -> Floats:
    """Return the phase of each radius."""
    span = math.log(max(radii.largest / radii.smallest, 1.001))
    share = np.log(radius / radii.smallest) / span
    return np.asarray((1 - GAP) * (2 * np.pi * share - np.pi))


@jit
def vote(edges: Strips, rings: Rings, shape: tuple[int, int], every: int = 1) -> Singles:
    """Return the accumulator (h, w, 2), real and imaginary part per cell.

    Only each `every`-th edge point votes, with the weight of so many.
    """
    height, width = np.int32(shape[0]), np.int32(shape[1])
    cells, at = np.zeros(2 * height * width, np.float32), np.empty(len(rings.radius), np.int32)
    half = np.float32(1 / CELL)
    for k in range(0, len(edges.x), every):
        x, y = (edges.x[k] + np.float32(0.5)) * half, (edges.y[k] + np.float32(0.5)) * half
        dx, dy, weight = edges.nx[k] * half, edges.ny[k] * half, np.float32(every) * edges.weight[k]
        for j in range(len(at)):  # all cells of a ray first, which SIMD does
            u, v = x + rings.radius[j] * dx, y + rings.radius[j] * dy
            inside = (u >= 0) & (v >= 0) & (u < width) & (v < height)
            at[j] = 2 * (np.int32(v) * width + np.int32(u)) if inside else -1
        for j in range(len(at)):
            if at[j] >= 0:
                cell = np.uint32(at[j])
                cells[cell] += weight * rings.real[j]
                cells[cell + np.uint32(1)] += weight * rings.imaginary[j]
    return cells.reshape((shape[0], shape[1], 2))


@jit
def summed(cells: Singles) -> tuple[Singles, Singles]:
    """Return the sums over 3 x 3 cells (h, w, 2) and their magnitude (h, w); 0 at the border."""
    height, width, _ = cells.shape
    total = np.zeros_like(cells)
    size = np.zeros((height, width), np.float32)
    columns = np.empty((width, 2), np.float32)
    for y in range(1, height - 1):
        for x in range(width):
            for c in range(2):
                columns[x, c] = cells[y - 1, x, c] + cells[y, x, c] + cells[y + 1, x, c]
        for x in range(1, width - 1):
            a = columns[x - 1, 0] + columns[x, 0] + columns[x + 1, 0]
            b = columns[x - 1, 1] + columns[x, 1] + columns[x + 1, 1]
            total[y, x, 0], total[y, x, 1] = a, b
            size[y, x] = np.sqrt(a * a + b * b)
    return total, size


@borrower
def highest_around(size: Singles, x: int, y: int) -> bool:
    """Whether no value within `REACH` is higher; of equal ones the first row, then column, is."""
    value = size[y, x]
    for v in range(max(y - REACH, 0), min(y + REACH + 1, size.shape[0])):
        for u in range(max(x - REACH, 0), min(x + REACH + 1, size.shape[1])):
            other = size[v, u]
            if other > value or (other == value and (v < y or (v == y and u < x))):
                return False
    return True


@borrower
def _vertex(before: float, at: float, behind: float) -> float:
    bend = before - 2 * at + behind
    if bend > -1e-9:
        return 0.0
    return min(0.5, max(-0.5, 0.5 * (before - behind) / bend))


@jit
def peaks(total: Singles, size: Singles, least: float, radii: Radii) -> Singles:
    """Return (N, 4): x, y, radius in px and magnitude of the local maxima of at least `least`.

    A maximum is the highest of the (2 REACH + 1)^2 cells around it; its place is the vertex of
    parabolas. The radius inverts the phase.
    """
    height, width = size.shape
    found = np.empty((height * width // 4 + 1, 4), np.float32)
    count = 0
    smallest, largest = radii
    log_range = math.log(max(largest / smallest, 1.001))
    for y in range(1, height - 1):
        for x in range(1, width - 1):
            if size[y, x] < least or not highest_around(size, x, y):
                continue
            u = x + _vertex(size[y, x - 1], size[y, x], size[y, x + 1])
            v = y + _vertex(size[y - 1, x], size[y, x], size[y + 1, x])
            phase = math.atan2(total[y, x, 1], total[y, x, 0]) / (1 - GAP)
            share = min(1.0, max(0.0, (phase + math.pi) / (2 * math.pi)))
            found[count, 0] = CELL * (u + 0.5) - 0.5
            found[count, 1] = CELL * (v + 0.5) - 0.5
            found[count, 2] = smallest * math.exp(share * log_range)
            found[count, 3] = size[y, x]
            count += 1
    return found[:count]
