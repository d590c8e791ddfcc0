"""Simulated frames made harder to see: caps and beds with blotches, and worse depth.

Simulated skin is smooth, so edges within a cap tell strongly against it there; real caps have
scales, stains and bruises.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from mushpipe.core.truth import INSTANCES_TOPIC, Ignore
from training.net.augment import blotched
from training.net.scenes import cap_mask
from training.scenes import Case
from training.sensors import worse

SUNK = 0.008  # m; so much too far away a pixel does not show its cap
LOST = 0.3  # share of such pixels from which on a cap is not to be told by its depth


def stained(case: Case, rng: np.random.Generator) -> Case:
    """Return a case with blotched caps, in half of the frames on a blotched bed."""
    frame = case.frame
    cap = cap_mask(case.truth, frame.attached[INSTANCES_TOPIC]).astype(np.float32)
    image = blotched(np.asarray(frame.color, np.float32) / np.float32(255), cap, rng)
    if rng.random() < 0.5:
        image = blotched(image, 1 - cap, rng)
    color = np.clip(np.rint(image * 255), 0, 255).astype(np.uint8)
    return replace(case, frame=replace(frame, color=color))


def harder(case: Case, rng: np.random.Generator) -> Case:
    """Return a case that is `stained`, in worse depth.

    A cap that depth puts on the bed by more than `LOST` no longer counts: that flat things are caps
    is not to be learned.
    """
    case = stained(case, rng)
    frame = worse(case.frame, rng)
    labels = frame.attached[INSTANCES_TOPIC].labels
    rows = len(case.truth) + 1
    sunk = np.bincount(labels[frame.depth_m > case.frame.depth_m + SUNK], minlength=rows)
    share = sunk[1:] / np.maximum(np.bincount(labels.ravel(), minlength=rows)[1:], 1)
    lost = (share > LOST) & (case.truth.ignore == Ignore.COUNTS)
    ignore = np.where(lost, Ignore.AMBIGUOUS, case.truth.ignore).astype(np.uint8)
    return replace(case, frame=frame, truth=replace(case.truth, ignore=ignore))
