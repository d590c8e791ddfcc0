"""Depth accuracy on a plane at a known distance: Table I of Baisa & Al-Diri 2022."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from mushpipe.core.arrays import Floats, Singles
from mushpipe.core.errors import EXIT_DIFFERS, EXIT_OK, InputError, UsageError
from mushpipe.evaluate import statistics
from mushpipe.evaluate.metrics import Value
from mushpipe.evaluate.thresholds import Outcome, check, parse_threshold, require_known

WINDOW = 31  # px
FARTHEST_OFF = 0.2  # share of the distance; the SR300 is off by 1 %
PLANE_METRICS = ("mean_mm", "std_mm", "range_mm", "offset_mm", "flat_std_mm", "valid")


@dataclass(frozen=True)
class PlaneRow:
    """The accuracy of a recording: means over its frames, with bootstrap intervals over them."""

    name: str
    distance_m: float
    frames: int
    values: dict[str, Value]


def window_of(depth_m: Singles) -> Floats:
    """Return the central (WINDOW, WINDOW) window of a depth image, in mm; NaN = missing."""
    top, left = ((length - WINDOW) // 2 for length in depth_m.shape)
    if min(top, left) < 0:
        raise InputError(f"the depth image is smaller than the window of {WINDOW}x{WINDOW} px")
    return 1e3 * depth_m[top : top + WINDOW, left : left + WINDOW].astype(float)


def plane_values(window: Floats, distance_m: float) -> dict[str, float]:
    """Measure one window of depths.

    Args:
        window: (S, S) mm, NaN = missing.
        distance_m: True distance of the plane along the optical axis.

    Returns:
        ``mean_mm``, ``std_mm`` about it, ``range_mm`` (largest minus smallest), ``offset_mm``
        (mean minus truth), ``flat_std_mm`` about the best plane, which a slant of the target
        does not widen, and ``valid``, the share of pixels with depth. All but the last are NaN
        without depth.
    """
    depths = window[np.isfinite(window)]
    result = dict.fromkeys(PLANE_METRICS, np.nan)
    result["valid"] = len(depths) / window.size
    if len(depths):
        mean = float(depths.mean())
        result |= {
            "mean_mm": mean,
            "std_mm": float(depths.std()),
            "range_mm": float(np.ptp(depths)),
        }
        result |= {"offset_mm": mean - 1e3 * distance_m, "flat_std_mm": _flat_std(window)}
    return result


def _flat_std(window: Floats) -> float:
    v, u = np.nonzero(np.isfinite(window))
    design = np.stack([u, v, np.ones(len(u))], axis=1)
    depths = window[v, u]
    solution, *_ = np.linalg.lstsq(design, depths, rcond=None)
    return float((depths - design @ solution).std())


def _windows(recording: Path) -> Iterator[Floats]:
    """Yield the central window of each depth image of a recording.

    Raises:
        InputError: It cannot be played, or its images are too small.
    """
    from mushpipe.sources.mcap import McapSource

    try:
        for frame in McapSource(path=recording).frames():
            if frame.depth is not None:
                yield window_of(frame.depth_m)
    except InputError as error:
        told = str(error) if str(recording) in str(error) else f"{recording}: {error}"
        if "_topic=" in told:  # a setting of runs, which nothing here takes
            told += f" of 'mushpipe record --source {recording} -o NEW.mcap', and measure that one"
        raise InputError(told) from error


def measure_plane(
    recording: Path, distance_m: float, resamples: int = 1000, seed: int = 0
) -> PlaneRow:
    """Measure the depth of a recording against a plane at a known distance.

    Raises:
        InputError: The recording cannot be played, or holds no depth.
        UsageError: The plane is not at that distance.
    """
    frames = [plane_values(window, distance_m) for window in _windows(recording)]
    if not frames:
        raise InputError(f"{recording}: it holds no depth")
    weights = statistics.draw(len(frames), resamples, seed)
    values = {}
    for name in PLANE_METRICS:
        x = np.array([frame[name] for frame in frames])
        value = statistics.evaluate(statistics.mean, x, np.ones((1, len(x))))[0]
        ends = (np.nan, np.nan)
        if len(frames) > 1 and resamples:
            ends = statistics.interval(statistics.evaluate(statistics.mean, x, weights))
        values[name] = Value(float(value), *ends, len(x))
    mean = values["mean_mm"].value / 1e3
    if abs(mean - distance_m) > FARTHEST_OFF * distance_m:
        raise UsageError(
            f"{recording.stem}: its depth says {mean:.3f} m, --plane {distance_m:g} m: no camera "
            "is so far off; state the distance along the optical axis, in metres"
        )
    return PlaneRow(recording.stem, distance_m, len(frames), values)


def judge_planes(
    recordings: list[Path], distances: str, thresholds: list[str], resamples: int, seed: int
) -> tuple[list[PlaneRow], list[tuple[str, Outcome]], int]:
    """Measure recordings of planes.

    Args:
        recordings: One per distance.
        distances: True distances in metres, separated by commas; a single one serves all.
        thresholds: On `PLANE_METRICS`; every recording must keep them.
        resamples: Number of bootstrap samples.
        seed: Seed of the bootstrap.

    Returns:
        A row per recording, the thresholds' outcomes with the recording's name, and the exit code.

    Raises:
        UsageError: The distances or thresholds are wrong.
        InputError: A recording cannot be played, or holds no depth.
    """
    bounds = [parse_threshold(text) for text in thresholds]
    require_known(bounds, PLANE_METRICS)
    truths = _distances(distances, len(recordings))
    rows = [
        measure_plane(path, truth, resamples, seed)
        for path, truth in zip(recordings, truths, strict=True)
    ]
    outcomes = [
        (row.name, outcome)
        for row in rows
        for outcome in check(bounds, {name: value.value for name, value in row.values.items()})
    ]
    return rows, outcomes, EXIT_OK if all(o.kept for _, o in outcomes) else EXIT_DIFFERS


def _distances(text: str, recordings: int) -> list[float]:
    try:
        values = [float(part) for part in text.split(",")]
    except ValueError:
        raise UsageError(f"--plane {text}: expected metres, separated by commas") from None
    if not all(0 < value < 100 for value in values):
        raise UsageError(f"--plane {text}: expected distances in metres, above 0 and below 100")
    if len(values) not in (1, recordings):
        each = "" if recordings == 1 else f", or {recordings}"
        raise UsageError(f"--plane {text}: expected one distance{each}, there are {len(values)}")
    return values * recordings if len(values) == 1 else values
