"""The safety filter: which picks become targets, and the form in which they leave.

A pick is withheld, and counted under one reason, unless everything a robot needs is known and
finite. What is unknown and not needed (orientation, diameter, sigmas) leaves as null.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Literal, get_args

import numpy as np
import orjson
from pydantic import Field, field_validator, model_validator

from mushpipe.core.arrays import Bools, Floats, Rows
from mushpipe.core.geometry import axis_from_quaternion
from mushpipe.core.group import Group
from mushpipe.core.tables import AXIS_TOLERANCE, LARGEST_M, DepthSource, PickFlag, Picks
from mushpipe.core.transform import REACH, UNIT_TOLERANCE

Reason = Literal["no_depth", "estimated", "invalid", "workspace", "claimed", "limit"]
Vector = tuple[float, float, float]

_FLAGS = tuple((int(flag), flag.name.lower()) for flag in PickFlag if flag.name)
_SOURCES = {int(source): source.name.lower() for source in DepthSource}
# Beyond these a number is not a measurement.
FARTHEST_M, SMALLEST_M = 100.0, 0.0001
ID_LIMIT = 10**15  # an acknowledgement has no place for more digits


class Workspace(Group):
    """A box, in the frame the targets are sent in; nothing outside of it is ever sent."""

    low: Vector = Field(description="corner with the smallest x, y, z, m")
    high: Vector = Field(description="corner with the largest x, y, z, m")

    @field_validator("low", "high")
    @classmethod
    def _metres(cls, value: Vector) -> Vector:
        if max(map(abs, value)) > REACH:
            raise ValueError(f"it is in m, and more than {REACH:g} m away: was it given in mm?")
        return value

    @model_validator(mode="after")
    def _not_empty(self) -> Workspace:
        if not all(a < b for a, b in zip(self.low, self.high, strict=True)):
            raise ValueError("each coordinate of low must be less than that of high")
        return self

    def contains(self, position: Floats) -> Bools:
        """Return for (N, 3) positions, m, whether they lie inside."""
        inside = (position >= self.low) & (position <= self.high)
        return np.asarray(inside.all(axis=1))


@dataclass(frozen=True)
class Target:
    """One target, ready to leave.

    Attributes:
        id: The pick's id.
        json: The target as a JSON object.
        row: Position m (3), quaternion xyzw (4, zeros where unknown), diameter m (0 where unknown).
        flags: `PickFlag` bits.
    """

    id: int
    json: bytes
    row: tuple[float, ...]
    flags: int


@dataclass(frozen=True)
class Choice:
    """The targets of one frame.

    Attributes:
        frame: What they are expressed in.
        targets: In the picks' order.
        withheld: How many picks are none, by reason.
    """

    frame: str
    targets: tuple[Target, ...]
    withheld: Mapping[Reason, int]


class Filter:
    """Turns picks into targets."""

    def __init__(self, allow_estimated: bool = False, workspace: Workspace | None = None) -> None:
        self._allow_estimated = allow_estimated
        self._workspace = workspace
        self._picks = 0
        self._withheld: Counter[Reason] = Counter()

    def __call__(self, picks: Picks) -> Choice:
        """Return what may be sent of one frame's picks."""
        oriented = _oriented(picks)
        with np.errstate(all="ignore"):
            left, withheld = self._sieve(picks, oriented)
            self._picks += len(picks)
            self._withheld.update(withheld)
            return Choice(picks.frame_id, _targets(picks, oriented, left), withheld)

    def summary(self) -> str:
        """Return how many of all picks so far were withheld, and why; empty if none was."""
        reasons = ", ".join(f"{n} '{reason}'" for reason, n in self._withheld.items() if n)
        if not reasons:
            return ""
        text = f"{self._withheld.total()} of {self._picks} mushrooms in all frames were withheld"
        hint = " ('allow_estimated: true' sends those)" if self._withheld["estimated"] else ""
        return f"{text} from robots: {reasons}{hint}"

    def _sieve(self, picks: Picks, oriented: Bools) -> tuple[Rows, dict[Reason, int]]:
        bad: dict[Reason, Bools] = {
            "no_depth": _no_depth(picks),
            "estimated": _estimated(picks) & (not self._allow_estimated),
            "invalid": ~_valid(picks, oriented),
        }
        if self._workspace is not None:
            bad["workspace"] = ~self._workspace.contains(picks.position)
        left = np.ones(len(picks), bool)
        withheld: dict[Reason, int] = dict.fromkeys(get_args(Reason), 0)
        for reason, rows in bad.items():
            withheld[reason] = int((left & rows).sum())
            left &= ~rows
        return np.flatnonzero(left), withheld


def _oriented(picks: Picks) -> Bools:
    """Return which picks (N,) have an orientation."""
    finite = np.isfinite(picks.quaternion).all(axis=1) & np.isfinite(picks.axis).all(axis=1)
    return np.asarray(finite & ((picks.flags & PickFlag.POSE_UNKNOWN) == 0))


def _no_depth(picks: Picks) -> Bools:
    flagged = (picks.flags & PickFlag.DEPTH_MISSING) != 0
    return np.asarray(flagged | picks.missing)


def _estimated(picks: Picks) -> Bools:
    # Anything but a measurement is a guess, whether or not its producer set the flag.
    flagged = (picks.flags & PickFlag.DEPTH_ESTIMATED) != 0
    return np.asarray(flagged | (picks.source != DepthSource.MEASURED))


def _valid(picks: Picks, oriented: Bools) -> Bools:
    # A sigma that is infinite says the measurement failed; NaN only that nobody estimated it.
    sigmas = np.column_stack([picks.sigma_position, picks.sigma_diameter, picks.sigma_tilt])
    good = ~(np.isinf(sigmas) | (sigmas < 0)).any(axis=1)
    good &= (np.abs(picks.position) <= FARTHEST_M).all(axis=1)
    good &= (picks.score >= 0) & (picks.score <= 1)
    good &= (picks.id >= 0) & (picks.id < ID_LIMIT)
    sized = (picks.diameter >= SMALLEST_M) & (picks.diameter <= LARGEST_M)
    good &= sized | np.isnan(picks.diameter)
    for direction in (picks.quaternion, picks.axis):
        unit = np.abs(np.linalg.norm(direction, axis=1) - 1) <= UNIT_TOLERANCE
        good &= unit | ~oriented
    # A robot may go by either.
    away = np.abs(axis_from_quaternion(picks.quaternion) - picks.axis).max(axis=1)
    good &= (away <= AXIS_TOLERANCE) | ~oriented
    return np.asarray(good)


def _unit(rows: Floats) -> list[list[float]]:
    """Return rows of length 1 to six decimals, also where they were so only nearly."""
    units: list[list[float]] = np.round(
        rows / np.linalg.norm(rows, axis=1, keepdims=True), 6
    ).tolist()
    return units


def _targets(picks: Picks, oriented: Bools, rows: Rows) -> tuple[Target, ...]:
    """Encode rows; a micrometre and a millionth are finer than any camera."""
    position = np.round(picks.position, 6).tolist()
    quaternion, approach = _unit(picks.quaternion), _unit(-picks.axis)
    diameter = np.round(picks.diameter, 6).tolist()
    score = np.round(picks.score, 4).tolist()
    spread = np.round(picks.sigma_position, 6).tolist()
    unsure = np.asarray(np.isnan(picks.sigma_position).any(axis=1))
    size_spread = np.round(picks.sigma_diameter, 6).tolist()
    tilt = np.round(picks.sigma_tilt, 6).tolist()
    found = []
    for i in rows.tolist():
        flags = int(picks.flags[i]) | (0 if oriented[i] else int(PickFlag.POSE_UNKNOWN))
        # orjson writes NaN as null, which is what these fields mean by it.
        content: dict[str, Any] = {
            "id": f"m{picks.id[i]}",
            "position": position[i],
            "orientation": quaternion[i] if oriented[i] else None,
            "approach": approach[i] if oriented[i] else None,
            "diameter": diameter[i],
            "score": score[i],
            "sigma": {
                "position": None if unsure[i] else spread[i],
                "diameter": size_spread[i],
                "tilt": tilt[i],
            },
            "depth": _SOURCES[int(picks.source[i])],
            "flags": [name for bit, name in _FLAGS if bit & flags],
        }
        pose = quaternion[i] if oriented[i] else (0.0,) * 4
        size = diameter[i] if diameter[i] == diameter[i] else 0.0
        found.append(
            Target(int(picks.id[i]), orjson.dumps(content), (*position[i], *pose, size), flags)
        )
    return tuple(found)
