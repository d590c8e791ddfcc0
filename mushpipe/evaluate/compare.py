"""Paired differences: two alternatives judged on the same frames."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from mushpipe.evaluate import statistics
from mushpipe.evaluate.events import Events
from mushpipe.evaluate.metrics import METRICS, Value, quantities_of

COMPARED = (
    "f",
    "precision",
    "recall",
    "center_median_px",
    "radius_bias_px",
    "radius_std_px",
    "surface_mean_mm",
    "surface_z_std_mm",
    "apex_mean_mm",
    "diameter_bias_mm",
    "diameter_std_mm",
    "axis_mean_deg",
)


def differences(
    base: Events, other: Events, frames: int, resamples: int = 1000, seed: int = 0
) -> dict[str, Value]:
    """Return other minus base for the compared metrics, each with its bootstrap interval.

    Both are resampled alike, frame by frame (of a single frame, mushroom by mushroom), so what
    makes a frame hard for both does not widen the interval.

    Args:
        base: Events of the first alternative.
        other: Events of the second, on the same frames in the same order.
        frames: How many frames were judged.
        resamples: Number of bootstrap samples; 0 gives no intervals.
        seed: Seed of the bootstrap.
    """
    if frames == 1:
        base, other, frames = _by_member(base, other)
    drawn = statistics.draw(frames, resamples, seed)
    drawn = np.concatenate([np.ones((1, frames)), drawn])
    values = []
    for events in (base, other):
        quantities = quantities_of(events)
        weights = drawn[:, events.unit]
        values.append(
            {
                name: statistics.evaluate(
                    METRICS[name].statistic, quantities[METRICS[name].quantity], weights
                )
                for name in COMPARED
            }
        )
    result = {}
    for name in COMPARED:
        difference = values[1][name] - values[0][name]
        low, high = statistics.interval(difference[1:])
        result[name] = Value(float(difference[0]), low, high, frames)
    return result


def _by_member(base: Events, other: Events) -> tuple[Events, Events, int]:
    """Number the mushrooms of a single frame as units: a truth is the same one in both."""
    shift = 1 + int(-base.member.min(initial=0))
    # The false detections of the other alternative are mushrooms of nobody else's.
    other = replace(other, member=np.where(other.member < 0, other.member - shift, other.member))
    members = np.unique(np.concatenate([base.member, other.member]))
    numbered = [replace(e, unit=np.searchsorted(members, e.member)) for e in (base, other)]
    return numbered[0], numbered[1], len(members)
