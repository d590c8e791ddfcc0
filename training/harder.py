"""Simulated frames made harder to see: caps and beds with blotches, and worse depth.

Simulated skin is smooth, so edges within a cap tell strongly against it there; real caps have
scales, stains and bruises.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from mushpipe.core.truth import INSTANCES_TOPIC
from training.net.augment import blotched
from training.net.scenes import cap_mask
from training.scenes import Case
from training.sensors import worse


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
    """Return a case that is `stained`, in worse depth."""
    case = stained(case, rng)
    return replace(case, frame=worse(case.frame, rng))
