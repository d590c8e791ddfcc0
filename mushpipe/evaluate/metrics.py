"""The metrics: what is measured on each event, and which statistic of it has which name.

Errors are *detected minus true*. Angles are between axes as vectors, 0 to 180 degrees, so a
flipped axis shows as 180. `docs/evaluation.md` says it in full.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from mushpipe.core.arrays import Floats, Ints
from mushpipe.evaluate import statistics
from mushpipe.evaluate.events import Events, Kind
from mushpipe.evaluate.statistics import Statistic


def angle_deg(a: Floats, b: Floats) -> Floats:
    """Return the angles between unit vectors (N, 3), 0..180 degrees; exact near 0 and 180."""
    sine = np.linalg.norm(np.cross(a, b), axis=1)
    return np.asarray(np.degrees(np.arctan2(sine, (a * b).sum(axis=1))))


def quantities_of(events: Events) -> dict[str, Floats]:
    """Return what the metrics are statistics of, (N,) each; NaN where it does not apply."""
    found = events.kind == Kind.FOUND
    result = {
        "precision": np.where(events.kind == Kind.MISSED, np.nan, found),
        "recall": np.where(events.kind == Kind.FALSE, np.nan, found),
        "f": np.where(events.kind == Kind.FALSE, -1.0, found),
        "radius": events.radius - events.true_radius,
        "diameter": 1e3 * (events.diameter - events.true_diameter),
        **_vector("center", ("u", "v"), events.center - events.true_center),
        **_vector("surface", ("x", "y", "z"), 1e3 * (events.surface - events.true_surface)),
        **_vector("apex", ("x", "y", "z"), 1e3 * (events.position - events.true_apex)),
        **_angles(events),
        **_calibration(events),
    }
    for name in _COVERED:
        value = getattr(events, name)
        finite = np.isfinite(value) & ((value > 0) | (not name.startswith("sigma")))
        known = finite.all(axis=tuple(range(1, finite.ndim)))
        result[f"has_{name}"] = np.where(found, known, np.nan)
    return result


_COVERED = ("position", "diameter", "axis", "sigma_position", "sigma_diameter", "sigma_tilt")


def _vector(name: str, parts: tuple[str, ...], error: Floats) -> dict[str, Floats]:
    components = {f"{name}_{part}": error[:, i] for i, part in enumerate(parts)}
    return {name: np.linalg.norm(error, axis=1), **components}


def _angles(events: Events) -> dict[str, Floats]:
    """Axis error, that of the answer "upright" on the same mushrooms, and the error of the tilt."""
    error = angle_deg(events.axis, events.true_axis)
    true_tilt = angle_deg(events.up, events.true_axis)
    return {
        "axis": error,
        "upright": np.where(np.isfinite(error), true_tilt, np.nan),
        "tilt": angle_deg(events.up, events.axis) - true_tilt,
    }


def _calibration(events: Events) -> dict[str, Floats]:
    """Squared errors over squared stated sigmas; a sigma of 0 counts as not stated."""
    errors = stated_errors(events)
    return {
        "z2_position": _z2(errors["position"], events.sigma_position).mean(axis=1),
        "z2_diameter": _z2(errors["diameter"], events.sigma_diameter),
        "z2_tilt": _z2(errors["tilt"], events.sigma_tilt),
    }


def stated_errors(events: Events) -> dict[str, Floats]:
    """Return the errors for which sigmas are stated: (N, 3) m, (N,) m and (N,) rad."""
    meant = np.where(events.apex[:, None] == 1, events.true_apex, events.true_surface)
    return {
        "position": events.position - meant,
        "diameter": events.diameter - events.true_diameter,
        "tilt": np.radians(angle_deg(events.axis, events.true_axis)),
    }


def _z2(error: Floats, sigma: Floats) -> Floats:
    return np.asarray((error / np.where(sigma > 0, sigma, np.nan)) ** 2)


@dataclass(frozen=True)
class Metric:
    """A named figure: a statistic of a quantity, in a unit ("" where it has none)."""

    name: str
    quantity: str
    label: str
    statistic: Statistic
    unit: str


_STATISTICS: dict[str, Statistic] = {
    "mean": statistics.mean,
    "bias": statistics.mean,
    "std": statistics.std,
    "mae": statistics.mean_abs,
    "median": statistics.median_abs,
    "p95": statistics.p95_abs,
}
_DISTANCE = ("mean", "std", "median", "p95")
_SIGNED = ("bias", "std", "mae", "median", "p95")
_COMPONENT = ("bias", "std")
_ERRORS: dict[str, tuple[str, tuple[str, ...]]] = {
    "center": ("px", _DISTANCE),
    "center_u": ("px", _COMPONENT),
    "center_v": ("px", _COMPONENT),
    "radius": ("px", _SIGNED),
    "surface": ("mm", _DISTANCE),
    "surface_x": ("mm", _COMPONENT),
    "surface_y": ("mm", _COMPONENT),
    "surface_z": ("mm", _SIGNED),
    "apex": ("mm", _DISTANCE),
    "apex_x": ("mm", _COMPONENT),
    "apex_y": ("mm", _COMPONENT),
    "apex_z": ("mm", _SIGNED),
    "diameter": ("mm", _SIGNED),
    "axis": ("deg", _DISTANCE),
    "upright": ("deg", _DISTANCE),
    "tilt": ("deg", _COMPONENT),
}


def _all() -> Iterator[Metric]:
    yield Metric("precision", "precision", "", statistics.mean, "")
    yield Metric("recall", "recall", "", statistics.mean, "")
    yield Metric("f", "f", "", statistics.dice, "")
    for quantity, (unit, labels) in _ERRORS.items():
        for label in labels:
            yield Metric(f"{quantity}_{label}_{unit}", quantity, label, _STATISTICS[label], unit)
    for quantity in ("position", "diameter", "tilt"):
        name = f"calibration_{quantity}"
        yield Metric(name, f"z2_{quantity}", "calibration", statistics.mean, "")
    for quantity in _COVERED:
        name = f"coverage_{quantity}"
        yield Metric(name, f"has_{quantity}", "coverage", statistics.mean, "")


METRICS: dict[str, Metric] = {metric.name: metric for metric in _all()}


@dataclass(frozen=True)
class Value:
    """A metric's value with its 95 % interval, and on how many rows it stands; NaN = unknown."""

    value: float
    low: float
    high: float
    n: int


def measure(events: Events, frames: int, resamples: int = 1000, seed: int = 0) -> dict[str, Value]:
    """Return every metric with its bootstrap interval.

    Frames are resampled, since the mushrooms of one frame share light, distance and sensor
    noise; of a single frame its mushrooms are.

    Args:
        events: What happened, `Events.unit` in 0..frames-1.
        frames: How many frames were judged, those without any event included.
        resamples: Number of bootstrap samples; 0 gives no intervals.
        seed: Seed of the bootstrap.
    """
    rows, units = units_of(events, frames)
    drawn = statistics.draw(units, resamples, seed)
    quantities = quantities_of(events)
    return {
        metric.name: _value(metric, quantities[metric.quantity], drawn, rows)
        for metric in METRICS.values()
    }


def _value(metric: Metric, x: Floats, drawn: Floats, rows: Ints) -> Value:
    n = int(np.isfinite(x).sum())
    value = statistics.evaluate(metric.statistic, x, np.ones((1, len(x))))[0]
    if not len(drawn):
        return Value(float(value), np.nan, np.nan, n)
    samples = statistics.evaluate(metric.statistic, x, drawn, rows)
    return Value(float(value), *statistics.interval(samples), n)


def units_of(events: Events, frames: int) -> tuple[Ints, int]:
    """Return the (N,) unit that each event is resampled with, and how many units there are."""
    if frames != 1:
        return events.unit, frames
    members, rows = np.unique(events.member, return_inverse=True)
    return rows, len(members)
