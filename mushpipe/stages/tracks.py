"""Ids that stay with a mushroom from frame to frame, also under a camera that moves."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np

from mushpipe.core.arrays import Bools, Floats, Ints, Rows
from mushpipe.core.columns import Columns, column
from mushpipe.core.tables import Circles, Locations
from mushpipe.stages.pairs import assigned, distances

GATE = 0.5  # farthest that a mushroom may be from where it is expected, in radii
NEAR = 0.4  # gates, root mean square; of those that come there by chance it is 0.7
CHANCE = 0.01  # that so few as one, two or three come as near by chance
FEWEST = 3  # mushrooms that must agree on a shift
PAUSE_NS = 10**9  # between two pictures; where it is longer, anything may have been moved meanwhile


@dataclass(frozen=True, eq=False)
class Sightings(Columns):
    """Mushrooms and where they were seen.

    Attributes:
        id: (N,).
        seen_ns: (N,) when.
        center: (N, 2) px.
        radius: (N,) px.
        position: (N, 3) m, the surface point; NaN without depth.
        size: (N,) m, radius; NaN where unknown.
    """

    id: Ints = column(dtype=np.int64)
    seen_ns: Ints = column(dtype=np.int64)
    center: Floats = column(2)
    radius: Floats = column()
    position: Floats = column(3)
    size: Floats = column()


class Tracks:
    """Assigns mushrooms to those seen before: least total distance, each within half a radius.

    Distances are taken in 3D, and in the image where a position is unknown; of two as far away the
    one of about the same radius is nearer. When the camera moves all mushrooms shift alike; that
    shift is what most pairs of old and new agree on. Where few are found again, and those not where
    they were, all of them are new.
    """

    def __init__(self) -> None:
        self._next = 0
        self._last_ns = 0
        self._known = Sightings.unknown(0)

    def update(
        self,
        circles: Circles,
        locations: Locations,
        image: tuple[int, int],
        stamp_ns: int,
        memory_ns: int,
    ) -> Ints:
        """Return an id (N,) per mushroom; one unseen for longer than the memory is forgotten.

        Args:
            circles: Outlines, px.
            locations: The same mushrooms in 3D.
            image: Width and height, px.
            stamp_ns: When they were seen.
            memory_ns: How long a mushroom that is not seen is remembered; one of the picture before
                for `PAUSE_NS` at least.
        """
        self._forget(stamp_ns, memory_ns)
        new = Sightings(
            id=np.full(len(circles), -1),
            seen_ns=np.full(len(circles), stamp_ns),
            center=circles.center,
            radius=circles.radius,
            position=locations.position,
            size=locations.diameter / 2,
        )
        old, flat = _moved(self._known, new, image)
        deep = _deep(new, old)
        rows, columns = _assign(np.where(np.isfinite(deep), deep, flat), _resized(new, old))
        if 2 * _latest(old)[columns].sum() < len(new) and _by_chance(flat[rows, columns]):
            rows = columns = rows[:0]
        ids = new.id.copy()
        ids[rows] = old.id[columns]
        fresh = np.flatnonzero(ids < 0)
        ids[fresh] = self._next + np.arange(len(fresh))
        self._next += len(fresh)
        unseen = np.setdiff1d(np.arange(len(old)), columns)
        self._known = replace(new, id=ids).joined(old.take(unseen))
        return ids

    def _forget(self, stamp_ns: int, memory_ns: int) -> None:
        """Drop what was not seen for too long: what is found in its place may be another one."""
        # where stamps go back, nobody knows for how long it was not seen
        unseen_ns = np.abs(stamp_ns - self._known.seen_ns)
        latest = (self._known.seen_ns == self._last_ns) & (unseen_ns <= PAUSE_NS)
        self._known = self._known.take(np.flatnonzero(latest | (unseen_ns <= memory_ns)))
        self._last_ns = stamp_ns


def _latest(old: Sightings) -> Bools:
    """Return which (M,) were seen last: these come first, whatever was done to the clock."""
    return np.asarray(old.seen_ns == old.seen_ns[:1])


def _flat(new: Sightings, old: Sightings) -> Floats:
    """Return how far each new mushroom (N) is from each old one (M) in the image, in gates."""
    return distances(new.center, old.center) / _gates(new.radius, old.radius)


def _deep(new: Sightings, old: Sightings) -> Floats:
    """Return the same (N, M) in 3D, NaN where that is not known."""
    return distances(new.position, old.position) / _gates(new.size, old.size)


def _resized(new: Sightings, old: Sightings) -> Floats:
    """Return how much larger or smaller (N, M) each new one is in the image, in gates."""
    return np.abs(new.radius[:, None] - old.radius[None]) / _gates(new.radius, old.radius)


def _gates(new: Floats, old: Floats) -> Floats:
    return GATE * np.minimum(new[:, None], old[None])


def _assign(apart: Floats, resized: Floats) -> tuple[Rows, Rows]:
    """Return the rows and columns of the pairs: as many as there can be, as near as can be."""
    n, m = apart.shape
    cost = np.full((n, m + n), np.inf)
    near = apart <= 1
    cost[:, :m][near] = np.hypot(apart[near], resized[near])
    np.fill_diagonal(cost[:, m:], 1e6)  # to stay alone: more than any number of pairs
    columns = assigned(cost)
    rows = np.flatnonzero(columns < m)
    return rows, columns[rows]


def _by_chance(found: Floats) -> bool:
    """Return whether old mushrooms meet new ones only as any two beds would.

    Under a camera that turned, a tenth of a dense bed does, and up to a quarter; where those of
    many views are remembered, all do. The ids, and what robots said of them, would go to mushrooms
    that nobody meant. The few that an arm leaves in view are where they were.

    Args:
        found: (K,) how far those that were found again are from where they are expected, in gates.
    """
    if not (k := len(found)):
        return False
    # By chance a square is uniform in 0..1, and the sum of k below s with probability s^k / k!.
    few = (CHANCE * math.factorial(k)) ** (1 / k) if k <= 3 else np.inf
    return bool(np.sum(found**2) > min(few, k * NEAR**2))


def _moved(old: Sightings, new: Sightings, image: tuple[int, int]) -> tuple[Sightings, Floats]:
    """Return the old mushrooms where they are expected now, and how far that is from the new ones.

    They are expected where they were, unless they all shifted: unless most are not where they were,
    and a shift brings at least half of those still in view, and more than no shift does, onto new
    ones. In a row of caps that is one pitch, where one end is picked and the other comes to light.
    """
    flat = _flat(new, old)
    stayed = (flat < 0.999).any(axis=0).sum()  # at the very gate, rounding would decide
    fewer = min(len(new), len(old))
    if fewer < FEWEST or _at_rest(new, old):
        return old, flat
    shifted = replace(old, center=old.center + _common_shift(new, old))
    apart = _flat(new, shifted)
    near = apart <= 1
    # Of those seen before the last picture nobody knows whether they are still where they were.
    latest = _latest(old)[:, None]
    in_view = (latest & (shifted.center >= 0) & (shifted.center < image)).all(axis=1).sum()
    if near.any(axis=0).sum() < max(FEWEST, stayed + 1, 0.5 * in_view):
        return old, flat
    deep = (new.position[:, None] - old.position[None])[near]
    known = deep[np.isfinite(deep).all(axis=1)]
    # without a shift in 3D the assignment falls back to the image
    step = np.median(known, axis=0) if len(known) else np.full(3, np.nan)
    return replace(shifted, position=old.position + step), apart


def _at_rest(new: Sightings, old: Sightings) -> bool:
    """Return whether most old mushrooms moved so little that even the smallest stays in its gate.

    Large ones may all be in theirs after a step that takes the small ones out of it.
    """
    step = np.median(distances(new.center, old.center).min(axis=0))
    return bool(step < GATE / 2 * min(new.radius.min(), old.radius.min()))


def _common_shift(new: Sightings, old: Sightings) -> Floats:
    """Return the shift (2,) px that most pairs of old and new circles agree on, by voting."""
    steps = (new.center[:, None] - old.center[None]).reshape(-1, 2)
    cell = max(GATE / 2 * float(np.median(new.radius)), 2.0)  # px; finer, it would take minutes
    cells = np.rint(steps / cell).astype(int)
    cells -= cells.min(axis=0) - 1  # with a margin, because a peak may lie between cells
    shape = cells.max(axis=0) + 2
    votes = np.bincount(np.ravel_multi_index(tuple(cells.T), shape), minlength=shape.prod())
    around = votes.reshape(shape)
    for axis in (0, 1):
        around = around + np.roll(around, 1, axis) + np.roll(around, -1, axis)
    peak = np.unravel_index(around.argmax(), around.shape)
    return np.asarray(np.median(steps[(np.abs(cells - peak) <= 1).all(axis=1)], axis=0))
