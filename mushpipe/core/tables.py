"""The per-mushroom types: parallel arrays in which row ``i`` is the same mushroom everywhere.

SI units, quaternions x y z w. NaN means *unknown*, and a check in each type keeps a number from
standing where the value is declared missing.
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import IntEnum, IntFlag
from functools import reduce

import numpy as np
from numpy.typing import NDArray

from mushpipe.core.arrays import Bools, Bytes, Floats, Ints
from mushpipe.core.columns import Columns, column
from mushpipe.core.geometry import axis_from_quaternion

AXIS_TOLERANCE = 1e-3
LARGEST_M = 1.0  # no mushroom is larger
_EXACTLY = "must be finite exactly where its source is not MISSING"


class DepthSource(IntEnum):
    """Where a depth value comes from."""

    MISSING = 0
    MEASURED = 1
    NEIGHBOURS = 2


class PickFlag(IntFlag):
    """What a robot must know about a pick before it acts on it."""

    DEPTH_MISSING = 1  # there is no position
    DEPTH_ESTIMATED = 2  # the centre has no depth; that of its surroundings stands in
    POSE_UNKNOWN = 4
    AT_BORDER = 8  # the image cuts the cap
    OCCLUDED = 16  # nearer mushrooms hide part of it
    TILT_UNOBSERVABLE = 32  # there is a pose, but its tilt is little better than a guess
    TOO_CLOSE_TO_NEIGHBOUR = 64  # less room around it than the gripper needs


def _known(values: Floats) -> Bools:
    """Return which rows (N, k) are finite; `all` along an axis so short takes twice as long."""
    return reduce(np.logical_and, np.isfinite(values).T)


def first_of(ids: Ints) -> Bools:
    """Return which rows (N,) have an id that no row before them has."""
    first = np.zeros(len(ids), np.bool_)
    first[np.unique(ids, return_index=True)[1]] = True
    return first


@dataclass(frozen=True, eq=False)
class Circles(Columns):
    """Mushroom outlines in the image.

    Attributes:
        center: (N, 2) px, x then y; the centre of the first pixel is (0, 0).
        radius: (N,) px.
        score: (N,) 0..1, larger is more certain.
    """

    center: Floats = column(2)
    radius: Floats = column()
    score: Floats = column()

    def check(self) -> None:
        """Centres are finite, radii positive, scores within 0..1."""
        self._require(_known(self.center), "the centre must be finite")
        self._require((self.radius > 0) & np.isfinite(self.radius), "the radius must be positive")
        self._require((self.score >= 0) & (self.score <= 1), "the score must be within 0..1")


@dataclass(frozen=True, eq=False)
class Locations(Columns):
    """Where the mushrooms are, in the camera's optical frame.

    Attributes:
        position: (N, 3) m, the visible surface point at the circle's centre.
        distance: (N,) m from the camera to that point.
        diameter: (N,) m of the cap's outline.
        source: (N,) `DepthSource` of the position.
        sigma_position: (N, 3) m one sigma, NaN = not estimated.
        sigma_diameter: (N,) m one sigma, NaN = not estimated.
    """

    position: Floats = column(3)
    distance: Floats = column()
    diameter: Floats = column()
    source: Bytes = column(dtype=np.uint8)
    sigma_position: Floats = column(3)
    sigma_diameter: Floats = column()

    @property
    def missing(self) -> Bools:
        """Whether there is no position, (N,)."""
        return np.asarray(self.source == DepthSource.MISSING)

    def check(self) -> None:
        """A position is finite exactly where its source is not missing; sizes are positive."""
        self._require(self.source <= max(DepthSource), "the source must be a DepthSource")
        present = ~self.missing
        self._require(_known(self.position) == present, f"position {_EXACTLY}")
        self._require(np.isfinite(self.distance) == present, f"distance {_EXACTLY}")
        self._require(~(self.diameter <= 0), "the diameter must be positive or NaN")
        self._require(~(self.distance < 0), "the distance must not be negative")
        for sigma in (self.sigma_position, self.sigma_diameter):
            self._require(~(sigma < 0), "a sigma must not be negative")


@dataclass(frozen=True, eq=False)
class Poses(Columns):
    """Orientation of the caps; a cap's own frame has +z along the cap normal, free about z.

    Attributes:
        quaternion: (N, 4) x y z w, rotation of the cap's frame in the camera frame.
        axis: (N, 3) unit cap normal pointing out of the cap.
        apex: (N, 3) m, top of the cap on that axis.
        sigma_rad: (N,) one-sigma uncertainty of the tilt.
        fitness: (N,) 0..1, the method's own measure of fit.
        valid: (N,) bool, False where the pose is unknown and its fields are NaN.
    """

    quaternion: Floats = column(4)
    axis: Floats = column(3)
    apex: Floats = column(3)
    sigma_rad: Floats = column()
    fitness: Floats = column()
    valid: Bools = column(dtype=np.bool_)

    def check(self) -> None:
        """Quaternion, axis and apex are known exactly where valid; both former have length 1.

        And the quaternion turns +z to the axis: a robot may go by either.
        """
        for name in ("quaternion", "axis", "apex"):
            known = _known(getattr(self, name))
            self._require(known == self.valid, f"{name} must be finite exactly where valid")
        for name in ("quaternion", "axis"):
            square = np.einsum("ij,ij->i", getattr(self, name), getattr(self, name))
            self._require(~(np.abs(square - 1) > 2e-6), f"{name} must have length 1")
        away = np.abs(axis_from_quaternion(self.quaternion) - self.axis)
        text = "the quaternion, x y z w, must turn +z to the axis, out of the cap"
        self._require(~(away > AXIS_TOLERANCE), text)
        self._require(~(self.sigma_rad < 0), "a sigma must not be negative")


@dataclass(frozen=True, eq=False)
class Picks(Columns):
    """What the robot gets, in the order in which to pick.

    Attributes:
        id: (N,) stable while the mushroom is visible.
        center: (N, 2) px, the circle the pick came from.
        radius: (N,) px.
        position: (N, 3) m, the apex where the pose is valid, else the surface point.
        surface: (N, 3) m, the visible surface point at the circle's centre.
        distance: (N,) m from the camera to the surface point.
        diameter: (N,) m.
        quaternion: (N, 4) x y z w.
        axis: (N, 3) unit cap normal.
        score: (N,) 0..1.
        sigma_position: (N, 3) m one sigma, of `position`.
        sigma_diameter: (N,) m one sigma.
        sigma_tilt: (N,) rad one sigma.
        source: (N,) `DepthSource` of the position.
        flags: (N,) `PickFlag` bits.
        frame_id: The frame that positions, quaternions and axes are expressed in.
    """

    id: Ints = column(dtype=np.int64)
    center: Floats = column(2)
    radius: Floats = column()
    position: Floats = column(3)
    surface: Floats = column(3)
    distance: Floats = column()
    diameter: Floats = column()
    quaternion: Floats = column(4)
    axis: Floats = column(3)
    score: Floats = column()
    sigma_position: Floats = column(3)
    sigma_diameter: Floats = column()
    sigma_tilt: Floats = column()
    source: Bytes = column(dtype=np.uint8)
    flags: NDArray[np.uint32] = column(dtype=np.uint32)
    frame_id: str = ""

    @property
    def missing(self) -> Bools:
        """Whether there is no position, (N,)."""
        return np.asarray(self.source == DepthSource.MISSING)

    def check(self) -> None:
        """A pick without depth carries no position, and says so."""
        self._require(self.source <= max(DepthSource), "the source must be a DepthSource")
        present = ~self.missing
        for name in ("position", "surface"):
            known = _known(getattr(self, name))
            self._require(known == present, f"{name} {_EXACTLY}")
        flagged = (self.flags & PickFlag.DEPTH_MISSING) != 0
        self._require(flagged != present, "DEPTH_MISSING must be set exactly where missing")

    def check_rows(self) -> None:
        """Ids are unique."""
        self._require(first_of(self.id), "ids must be unique")
