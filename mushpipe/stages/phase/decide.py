"""Accepting candidates one by one: each explains its edges away for those that come after it.

The candidate with the largest probability is accepted, and its edges are used up; of those that are
likely and hardly differ in it, those that a network agrees with come first where it leads, for
holes and errors of depth make rivals as probable that lie beside the cap; they may even make the
cap unlikely, of which image and network are sure. Its neighbours are then looked at again: another
circle on the same cap has lost its support, while one below it need no longer show the outline that
it hides. This is the non-maximum suppression of the detector.
"""

from __future__ import annotations

import math

import numpy as np

from mushpipe.core.arrays import Bools, Floats, Ints32, Singles
from mushpipe.core.jit import borrower, jit
from mushpipe.stages.discs import LIKELY, lens
from mushpipe.stages.phase.features import AT_LEARNED
from mushpipe.stages.phase.refit import COSINES, HIDDEN, NARROW, SINES, reach_of, tolerance
from mushpipe.stages.phase.scratch import Scratch, scratch_for
from mushpipe.stages.phase.strips import Strips, gather
from mushpipe.stages.phase.trust import FAINT, logit, mixed, trust_in
from mushpipe.stages.verifier_net import Models, probability

MARGIN = 1.0  # px; so far within an accepted circle an outline counts as hidden by it
HOPELESS = 2e-5  # probability from which on nothing that is accepted later can help
TAKEN = 2.5  # px; edges so near an accepted outline are its own
# Depth alone is against a candidate of so much probability with it, agreement with the network and
# probability without it.
DOUBTED, AGREED, SURE = 0.2, 0.8, 0.9
# Of two likely circles on one cap, the one with the larger logit(probability) + LEAD * agreement is
# mostly the better one. From 1.2 to 4 it is much the same.
LEAD = 2.4


@borrower
def overlap_features(shape: Floats, accepted: Floats, row: Floats) -> None:
    """Write overlap, spans and doubled into row[4], row[5], row[6]."""
    row[4] = row[5] = row[6] = 0
    own = math.pi * shape[2] ** 2
    for other in accepted:
        squared = (other[0] - shape[0]) ** 2 + (other[1] - shape[1]) ** 2
        if squared >= (other[2] + shape[2]) ** 2:
            continue
        d = math.sqrt(squared)
        shared, area = lens(d, shape[2], other[2]), math.pi * other[2] ** 2
        row[4] = max(row[4], shared / own)
        row[5] = max(row[5], shared / area)
        row[6] = max(row[6], shared / (own + area - shared))


@borrower
def covered(x: Singles, y: Singles, circles: Floats, margin: float, under: Ints32) -> None:
    """Write 1 for points (N,) that lie within one of the circles by more than a margin (px)."""
    for k in range(len(x)):
        under[k] = 0
    for i in range(len(circles)):
        u, v = np.float32(circles[i, 0]), np.float32(circles[i, 1])
        square = np.float32(max(0.0, circles[i, 2] - margin) ** 2)
        for k in range(len(x)):
            dx, dy = x[k] - u, y[k] - v
            under[k] |= dx * dx + dy * dy < square


@borrower
def outline_features(
    edges: Strips, shape: Floats, hits: Ints32, owner: Ints32, accepted: Floats, row: Floats,
    scratch: Scratch,
) -> None:  # fmt: skip
    """Write free, support, trust and hits into row[0..3].

    A direction is hidden where depth says so (`HIDDEN`), or where it lies within an accepted circle
    and has no edge of its own left.
    """
    n, inside, free, found, weight = 0, 0, 0, 0, 0.0
    while n < len(hits) and hits[n] != -2:
        n += 1
    x, y, under = scratch.lanes[0, :n], scratch.lanes[1, :n], scratch.under
    for k in range(n):
        x[k] = shape[0] + shape[2] * COSINES[n, k]
        y[k] = shape[1] + shape[2] * SINES[n, k]
    covered(x, y, accepted, MARGIN, under)
    right, bottom = edges.width - 1, edges.height - 1
    for k in range(n):
        if x[k] < 0 or y[k] < 0 or x[k] > right or y[k] > bottom:
            continue
        inside += 1
        if hits[k] == HIDDEN:
            continue
        if hits[k] >= 0 and owner[hits[k]] < 0:
            free += 1
            found += 1
            weight += edges.weight[hits[k]]
        elif under[k] == 0:
            free += 1
    row[0] = free / max(inside, 1)
    row[1] = found / max(free, 1)
    row[2] = weight / max(free, 1)
    row[3] = math.log(1 + found)


@borrower
def chance_beside(
    edges: Strips, shape: Floats, hits: Ints32, owner: Ints32, accepted: Floats, row: Floats,
    models: Models, which: int, trust: float, scratch: Scratch,
) -> float:  # fmt: skip
    """Return the probability of a candidate beside the accepted; writes what depends on them."""
    outline_features(edges, shape, hits, owner, accepted, row, scratch)
    overlap_features(shape, accepted, row)
    chance = float(probability(row, models, which, scratch.first, scratch.second))
    return _trusting(row, chance, models, which, trust, scratch)


@borrower
def _trusting(
    row: Floats, chance: float, models: Models, which: int, trust: float, scratch: Scratch
) -> float:
    """Return a probability beside a network that is believed so far where it sees little."""
    if which != 3 or trust >= 1 or row[AT_LEARNED] >= FAINT:
        return chance
    alone = float(probability(row, models, 1, scratch.first, scratch.second))
    return mixed(chance, alone, trust)


@borrower
def _alone(
    table: Floats, chance: Floats, models: Models, which: Ints32, scratch: Scratch, alone: Floats
) -> None:
    """Write the probabilities (N,) without a network, 0 of what has no depth."""
    for k in range(len(alone)):
        alone[k] = chance[k] if which[k] == 1 else 0.0
        if which[k] == 3:
            alone[k] = probability(table[k], models, 1, scratch.first, scratch.second)


@borrower
def _sight(row: Floats, chance: float, models: Models, which: int, scratch: Scratch) -> float:
    """Return the probability without depth of what only depth is against, 0 of anything else."""
    if which != 3 or not DOUBTED <= chance < LIKELY or row[AT_LEARNED] < AGREED:
        return 0.0
    sight = float(probability(row, models, 2, scratch.first, scratch.second))
    return sight if sight >= SURE else 0.0


@borrower
def _use_up(edges: Strips, shape: Floats, number: int, owner: Ints32, scratch: Scratch) -> None:
    rows, nothing = scratch.rows, scratch.lanes[:0]
    count = gather(edges, nothing, 0.0, shape, reach_of(shape[2], NARROW), scratch)
    near = max(TAKEN, 1.3 * tolerance(shape[2]))
    for k in range(count):
        dx, dy = edges.x[rows[k]] - shape[0], edges.y[rows[k]] - shape[1]
        d = max(1e-6, math.sqrt(dx * dx + dy * dy))
        c, s = dx / d, dy / d
        e = d - (shape[2] + shape[3] * (c * c - s * s) + shape[4] * 2 * s * c)
        if abs(e) < near and owner[rows[k]] < 0:
            owner[rows[k]] = number


@borrower
def _first_of(
    waiting: Bools, chance: Floats, sight: Floats, table: Floats, least: float, led: bool
) -> int:
    """Return the row of the candidate that is accepted next, -1 where there is none."""
    best, top = -1, -1.0
    for k in range(len(chance)):
        if waiting[k] and chance[k] >= least:
            rank = chance[k] - 1  # below that of all in which agreement counts
            if led and (chance[k] >= LIKELY or sight[k] > 0):
                rank = logit(max(chance[k], sight[k])) + LEAD * table[k, AT_LEARNED]
            if rank >= top:
                best, top = k, rank
    return best


@jit
def decide(
    edges: Strips, shapes: Floats, hits: Ints32, table: Floats, which: Ints32, models: Models,
    least: float, led: bool,
) -> tuple[Ints32, Floats, Ints32, Floats]:  # fmt: skip
    """Accept candidates in the order of their probability.

    Args:
        edges: Edge points.
        shapes: (N, 5) outlines.
        hits: (N, D) rows of the edges that support them.
        table: (N, F) features; those that depend on others are written, as they stood when the
            candidate was accepted, or at the end.
        which: (N,) the model that decides on a candidate.
        models: The models.
        least: Smallest probability that is accepted.
        led: Whether agreement with the network counts in the order of those that are likely, and
            the network is believed as far as it sees caps here (`phase.trust`).

    Returns:
        Rows of the accepted in their order, the probability of every candidate, of every edge point
        the number of the accepted circle that it belongs to, -1 for none, and the probability
        without depth of the candidates that depth alone is against, 0 of the others.
    """
    n = len(shapes)
    owner = np.full(len(edges.x), -1, np.int32)
    chance, waiting = np.empty(n), np.ones(n, np.bool_)
    order, scratch = np.empty(n, np.int32), scratch_for(len(edges.x))
    first, beside = neighbours(shapes)
    near = np.empty((n, 5))
    for k in range(n):
        chance[k] = chance_beside(
            edges, shapes[k], hits[k], owner, near[:0], table[k], models, which[k], 1.0, scratch
        )
    sight, trust = np.zeros(n), 1.0
    if led:
        _alone(table, chance, models, which, scratch, sight)
        trust = trust_in(shapes, sight, table[:, AT_LEARNED], first, beside)
        for k in range(n):
            chance[k] = _trusting(table[k], chance[k], models, which[k], trust, scratch)
            sight[k] = _sight(table[k], chance[k], models, which[k], scratch)
    for count in range(n):
        best = _first_of(waiting, chance, sight, table, least, led)
        if best < 0:
            return order[:count], chance, owner, sight
        waiting[best], order[count] = False, best
        _use_up(edges, shapes[best], count, owner, scratch)
        # Not only what it used up: what it hides, too, changes the odds of its neighbours.
        for k in beside[first[best] : first[best + 1]]:
            if waiting[k] and chance[k] > HOPELESS:
                met = _accepted(shapes, waiting, beside[first[k] : first[k + 1]], near)
                chance[k] = chance_beside(
                    edges, shapes[k], hits[k], owner, near[:met], table[k], models, which[k],
                    trust, scratch,
                )  # fmt: skip
    return order, chance, owner, sight


@jit
def neighbours(shapes: Floats) -> tuple[Ints32, Ints32]:
    """Return the outlines so near each outline (N, 5) that accepting one may change the other.

    Returns:
        (N + 1,) and (M,): those of outline k are `beside[first[k] : first[k + 1]]`.
    """
    n = len(shapes)
    first, beside = np.zeros(n + 1, np.int32), np.empty(0, np.int32)
    by_x = np.argsort(shapes[:, 0])
    largest = shapes[:, 2].max() if n else 0.0
    for turn in range(2):  # count, then fill
        if turn == 1:
            first[1:] = np.cumsum(first[1:])
            beside = np.empty(first[n], np.int32)
            at = first.copy()
        for i in range(n):
            one = by_x[i]
            for j in range(i + 1, n):
                other = by_x[j]
                across = shapes[other, 0] - shapes[one, 0]
                if across > shapes[one, 2] + largest + 4:
                    break
                reach = shapes[one, 2] + shapes[other, 2] + 4
                if across**2 + (shapes[other, 1] - shapes[one, 1]) ** 2 >= reach * reach:
                    continue
                if turn == 0:
                    first[one + 1] += 1
                    first[other + 1] += 1
                else:
                    beside[at[one]], beside[at[other]] = other, one
                    at[one] += 1
                    at[other] += 1
    return first, beside


@borrower
def _accepted(shapes: Floats, waiting: Bools, beside: Ints32, near: Floats) -> int:
    """Write the accepted of some outlines to the first rows of `near`; return how many."""
    count = 0
    for k in beside:
        if not waiting[k]:
            for i in range(shapes.shape[1]):
                near[count, i] = shapes[k, i]
            count += 1
    return count
