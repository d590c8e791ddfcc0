"""Ids that stay with a mushroom from frame to frame."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import linear_sum_assignment

from mushpipe import Circles


class Tracks:
    """Assigns circles to those seen before: least total distance, each within half a radius."""

    def __init__(self) -> None:
        self._next = 0
        self._id = np.zeros(0, np.int64)
        self._center = np.zeros((0, 2))
        self._radius = np.zeros(0)
        self._seen_ns = np.zeros(0, np.int64)

    def update(self, circles: Circles, stamp_ns: int, memory_ns: int) -> NDArray[np.int64]:
        """Return an id per circle; a track unseen for longer than the memory is forgotten."""
        ids = np.full(len(circles), -1, np.int64)
        rows, columns = self._match(circles)
        ids[rows] = self._id[columns]
        new = np.flatnonzero(ids < 0)
        ids[new] = np.arange(self._next, self._next + len(new))
        self._next += len(new)
        unseen = np.setdiff1d(np.arange(len(self._id)), columns)
        unseen = unseen[stamp_ns - self._seen_ns[unseen] <= memory_ns]
        self._id = np.concatenate([ids, self._id[unseen]])
        self._center = np.concatenate([circles.center, self._center[unseen]])
        self._radius = np.concatenate([circles.radius, self._radius[unseen]])
        now = np.full(len(ids), stamp_ns, np.int64)
        self._seen_ns = np.concatenate([now, self._seen_ns[unseen]])
        return ids

    def _match(self, circles: Circles) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
        step = np.linalg.norm(circles.center[:, None] - self._center[None], axis=2)
        gate = 0.5 * np.minimum(circles.radius[:, None], self._radius[None])
        # A pair outside its gate costs more than any number of pairs inside theirs.
        cost = np.where(step <= gate, step / np.maximum(gate, 1e-9), 1e6)
        rows, columns = linear_sum_assignment(cost)
        inside = cost[rows, columns] < 1e6
        return rows[inside], columns[inside]
