"""Paired differences: two alternatives judged on the same frames."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from mushpipe.evaluate import statistics
from mushpipe.evaluate.events import Events, Kind
from mushpipe.evaluate.matching import assign, circle_iou
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
        values.append(
            {
                name: statistics.evaluate(
                    METRICS[name].statistic, quantities[METRICS[name].quantity], drawn, events.unit
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
    """Number the mushrooms of a single frame as units, the same ones alike in both.

    A truth is the same one anyhow; false detections are where their circles overlap.
    """
    mine, theirs = (np.flatnonzero(e.kind == Kind.FALSE) for e in (base, other))
    iou = circle_iou(
        base.center[mine], base.radius[mine], other.center[theirs], other.radius[theirs]
    )
    rows, columns = assign(iou, 0.5)
    member = other.member.copy()
    member[theirs] = base.member.min(initial=0) - 1 - np.arange(len(theirs))
    member[theirs[columns]] = base.member[mine[rows]]
    members = np.unique(np.concatenate([base.member, member]))
    numbered = [
        replace(events, unit=np.searchsorted(members, of))
        for events, of in ((base, base.member), (other, member))
    ]
    return numbered[0], numbered[1], len(members)
