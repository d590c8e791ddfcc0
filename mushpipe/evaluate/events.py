"""Judged frames as one flat table: a row per mushroom found, mushroom missed, false detection."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, fields
from enum import IntEnum
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mushpipe.core.arrays import Bytes, Floats, Ints, Rows
from mushpipe.core.columns import Columns, column
from mushpipe.core.types import Header
from mushpipe.evaluate.matching import Matching, match
from mushpipe.evaluate.results import Detections
from mushpipe.evaluate.truth import FrameTruth, Place

UP = (0.0, 0.0, -1.0)


class Kind(IntEnum):
    """What a row is."""

    FOUND = 0
    MISSED = 1
    FALSE = 2


@dataclass(frozen=True, eq=False)
class Verdict:
    """A judged frame: what is there, what was found, and which is which.

    ``header`` is None where the results hold no answer for the frame.
    """

    recording: str
    place: Place
    header: Header | None
    truth: FrameTruth
    detections: Detections
    matching: Matching

    @property
    def f(self) -> float:
        """F of this frame; NaN where there is nothing to find."""
        found, missed = len(self.matching.truth), len(self.matching.missed)
        rows = 2 * found + missed + len(self.matching.false)
        return 2 * found / rows if found + missed else math.nan


def judge(
    recording: str,
    place: Place,
    truth: FrameTruth,
    header: Header | None,
    detections: Detections,
    threshold: float = 0.5,
) -> Verdict:
    """Judge a frame; see `matching` for the rules."""
    matching = match(truth, detections.center, detections.radius, threshold)
    return Verdict(recording, place, header, truth, detections, matching)


@dataclass(frozen=True, eq=False)
class Events(Columns):
    """What happened to each mushroom and each detection that counts.

    The truth's side (``true_...``) is NaN on false detections, the detection's side on missed
    mushrooms. 3D values are in metres in the camera's optical frame.

    Attributes:
        unit: (N,) number of the judged frame.
        member: (N,) row in the frame's truth, or -1 - row in its detections where false.
        kind: (N,) `Kind`.
        true_center: (N, 2) px.
        true_radius: (N,) px.
        true_surface: (N, 3).
        true_apex: (N, 3).
        true_axis: (N, 3).
        true_diameter: (N,).
        center: (N, 2) px.
        radius: (N,) px.
        surface: (N, 3).
        position: (N, 3), meant to be the apex where `apex`, else the surface point.
        apex: (N,) 1 or 0.
        axis: (N, 3).
        diameter: (N,).
        sigma_position: (N, 3).
        sigma_diameter: (N,).
        sigma_tilt: (N,) rad.
        score: (N,) 0..1, how likely it was said to be right.
        up: (N, 3) unit vector against gravity.
    """

    unit: Ints = column(dtype=np.int64)
    member: Ints = column(dtype=np.int64)
    kind: Bytes = column(dtype=np.uint8)
    true_center: Floats = column(2)
    true_radius: Floats = column()
    true_surface: Floats = column(3)
    true_apex: Floats = column(3)
    true_axis: Floats = column(3)
    true_diameter: Floats = column()
    center: Floats = column(2)
    radius: Floats = column()
    surface: Floats = column(3)
    position: Floats = column(3)
    apex: Floats = column()
    axis: Floats = column(3)
    diameter: Floats = column()
    sigma_position: Floats = column(3)
    sigma_diameter: Floats = column()
    sigma_tilt: Floats = column()
    score: Floats = column()
    up: Floats = column(3)


_TRUTH_SIDE = ("center", "radius", "surface", "apex", "axis", "diameter")
_FOUND_SIDE = ("center", "radius", "surface", "position", "apex", "axis", "diameter")
_SIGMAS = ("sigma_position", "sigma_diameter", "sigma_tilt")
_TRUE_3D = ("true_surface", "true_apex", "true_axis")


def events_of(verdicts: Sequence[Verdict], up: Sequence[float] = UP) -> Events:
    """Return the events of judged frames; unit ``i`` is ``verdicts[i]``.

    Args:
        verdicts: Judged frames.
        up: Direction against gravity in the camera's frame, of any length.
    """
    direction = np.asarray(up, float) / np.linalg.norm(up)
    parts = [_frame(unit, verdict, direction) for unit, verdict in enumerate(verdicts)]
    if not parts:
        return Events.unknown(0)
    names = [item.name for item in fields(Events)]
    return Events(**{name: np.concatenate([part[name] for part in parts]) for name in names})


def comparable(verdict: Verdict) -> bool:
    """Return whether truth and detections give their 3D values in the same frame."""
    frames = {verdict.truth.frame_id, verdict.detections.frame_id} - {None, ""}
    return len(frames) < 2


def _frame(unit: int, verdict: Verdict, up: Floats) -> dict[str, NDArray[Any]]:
    m = verdict.matching
    found, missed, false = len(m.truth), len(m.missed), len(m.false)
    nowhere = -np.ones(1, np.intp)
    truth_rows = np.concatenate([m.truth, m.missed, nowhere.repeat(false)])
    rows = np.concatenate([m.found, nowhere.repeat(missed), m.false])
    n = found + missed + false
    part: dict[str, NDArray[Any]] = {
        "unit": np.full(n, unit),
        "member": np.where(truth_rows >= 0, truth_rows, -1 - rows),
        "kind": np.repeat([Kind.FOUND, Kind.MISSED, Kind.FALSE], [found, missed, false]),
        "up": np.tile(up, (n, 1)),
    }
    for name in _TRUTH_SIDE:
        part[f"true_{name}"] = _pick(getattr(verdict.truth.caps, name), truth_rows)
    for name in (*_FOUND_SIDE, *_SIGMAS, "score"):
        part[name] = _pick(getattr(verdict.detections, name), rows)
    if not comparable(verdict):
        part |= {name: np.full((n, 3), np.nan) for name in _TRUE_3D}
    return part


def _pick(values: NDArray[Any], rows: Rows) -> Floats:
    """Return the rows of (N, ...) values; NaN for row -1."""
    padded = np.concatenate([values.astype(float), np.full((1, *values.shape[1:]), np.nan)])
    return np.asarray(padded[rows])
