"""Accepted outlines, refitted to the edges that are theirs alone."""

from __future__ import annotations

import math

import numpy as np

from mushpipe.core.arrays import Floats, Ints32, Singles
from mushpipe.core.jit import borrower, jit
from mushpipe.stages.discs import Radii, within
from mushpipe.stages.phase.decide import covered
from mushpipe.stages.phase.depth import Relief
from mushpipe.stages.phase.refit import NARROW, around, fit_outline
from mushpipe.stages.phase.scratch import Scratch, scratch_for
from mushpipe.stages.phase.strips import Strips

SHADE = 3.0  # px; so far around an accepted circle, a lower one is shaded
OWN = 24  # edge points with which an outline is fitted to what is its own


@borrower
def _met(shape: Floats, accepted: Floats, found: Floats) -> int:
    """Write the accepted outlines whose circle meets the circle of a shape; return how many."""
    count = 0
    for k in range(len(accepted)):
        across, down = accepted[k, 0] - shape[0], accepted[k, 1] - shape[1]
        reach = accepted[k, 2] + shape[2]
        if across**2 + down**2 < reach * reach:
            for i in range(accepted.shape[1]):
                found[count, i] = accepted[k, i]
            count += 1
    return count


@borrower
def _keep_own(
    edges: Strips, k: int, count: int, near: Floats, owner: Ints32, x: Singles, y: Singles,
    scratch: Scratch,
) -> int:  # fmt: skip
    """Keep of the first `scratch.rows` those that are an outline's own; return how many.

    Args:
        edges: Edge points.
        k: Number of the outline.
        count: How many rows.
        near: (N, 5) accepted outlines that meet it.
        owner: Of every edge point.
        x: Room for as many.
        y: Likewise.
        scratch: In and out.
    """
    own, shaded, kept = scratch.rows, scratch.near, 0
    for m in range(count):
        x[m], y[m] = edges.x[own[m]], edges.y[own[m]]
    covered(x[:count], y[:count], near, -SHADE, shaded)
    for m in range(count):
        row = own[m]
        if (owner[row] < 0 or owner[row] == k) and shaded[m] == 0:
            own[kept] = row
            kept += 1
    return kept


@jit
def polish(edges: Strips, relief: Relief, outlines: Floats, owner: Ints32, radii: Radii) -> None:
    """Refit accepted outlines (K, 5), in their order and in place, to what is theirs alone.

    Edges of others do not count, nor those within or just outside a circle that was accepted
    before: where a cap dips under another one, its steepest shading is not its outline. What leaves
    the range of radii stays as it was.
    """
    scratch, places = scratch_for(len(edges.x)), np.empty((2, len(edges.x)), np.float32)
    shape, near = np.empty(5), np.empty_like(outlines)
    for k in range(len(outlines)):
        shape[:] = outlines[k]
        met = _met(shape, outlines[:k], near)
        count = around(edges, relief, shape, NARROW, scratch)
        kept = _keep_own(edges, k, count, near[:met], owner, places[0], places[1], scratch)
        moved = fit_outline(edges, kept, shape, NARROW, scratch) if kept >= OWN else False
        limit = max(1.5, 0.15 * outlines[k, 2])
        away = math.hypot(shape[0] - outlines[k, 0], shape[1] - outlines[k, 1])
        away = max(away, abs(shape[2] - outlines[k, 2]))
        if moved and away < limit and within(shape[2], radii):
            outlines[k] = shape
