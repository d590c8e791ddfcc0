"""What stands around a mushroom: what hides it, and how much room there is."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from mushpipe.core.arrays import Floats, Ints
from mushpipe.core.jit import jit
from mushpipe.core.tables import Circles, Locations
from mushpipe.stages.cap.order import paint
from mushpipe.stages.discs import discs_of
from mushpipe.stages.pairs import distances


def hidden_share(circles: Circles, distance: Floats, image: tuple[int, int]) -> Floats:
    """Return which share (N,) of each circle lies behind circles of nearer mushrooms.

    Args:
        circles: Outlines, px.
        distance: (N,) m; a mushroom without hides nothing and is hidden by all that it overlaps.
        image: Width and height, px; what lies outside does not count.
    """
    n = len(circles)
    order = np.argsort(distance, kind="stable")[: np.isfinite(distance).sum()]  # NaN comes last
    rank = np.full(n, n)
    rank[order] = np.arange(len(order))
    discs = discs_of(circles)
    ranks = np.full(image[::-1], n, np.int16)
    paint(ranks, discs, order)
    return covered(ranks, discs, rank)


@jit
def covered(ranks: NDArray[np.int16], discs: Floats, rank: Ints) -> Floats:
    """Return the share (N,) of each disc's pixels that bear a lower rank than its own.

    Args:
        ranks: (H, W) rank of the nearest disc on each pixel.
        discs: (N, 3) x, y, radius, px.
        rank: (N,) of the discs.
    """
    height, width = ranks.shape
    shares = np.zeros(len(discs))
    for i in range(len(discs)):
        x, y, r = discs[i]
        total, lower = 0, 0
        for v in range(max(0, int(np.ceil(y - r))), min(height, int(np.floor(y + r)) + 1)):
            for u in range(max(0, int(np.ceil(x - r))), min(width, int(np.floor(x + r)) + 1)):
                if (u - x) ** 2 + (v - y) ** 2 <= r * r:
                    total += 1
                    lower += ranks[v, u] < rank[i]
        shares[i] = lower / max(total, 1)
    return shares


def clearance(circles: Circles, locations: Locations, above: Floats) -> Floats:
    """Return the gap (N,) m between each cap's outline and the nearest other one, from above.

    Args:
        circles: Outlines, px.
        locations: Diameters, and which positions are known.
        above: (N, 2) m, the positions as they lie seen from above.

    Caps overlap where it is negative. A neighbour whose place or size in metres is unknown is taken
    to be as far away as the cap itself, for room that nobody measured is not free. Infinite for a
    mushroom alone; NaN where its own position or diameter is unknown.
    """
    radius = locations.diameter / 2
    pixel = radius / circles.radius  # m
    gaps = _gaps(above, radius)
    seen = pixel[:, None] * _gaps(circles.center, circles.radius)
    gap = np.where(np.isnan(gaps), seen, gaps).min(axis=1, initial=np.inf)
    return np.where(np.isfinite(radius + above[:, 0]), gap, np.nan)


def _gaps(place: Floats, radius: Floats) -> Floats:
    """Return the gaps (N, N) between circles; there is none to itself."""
    gaps = distances(place, place) - radius[:, None] - radius[None]
    np.fill_diagonal(gaps, np.inf)
    return gaps
