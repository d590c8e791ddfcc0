"""`cap-net` and `phase-hough` together: fewer false circles than the net alone, finer ones."""

from __future__ import annotations

import numpy as np

from mushpipe.core.truth import TRUTH_TOPIC
from mushpipe.stages.cap_net import CapNet
from mushpipe.stages.phase_hough import PhaseHough
from tests.stages.frames import simulated
from training.matching import Score, counted

RADII = (8.0, 45.0)


def test_brown_caps_among_rubble_are_found_and_refitted() -> None:
    settings = {"cap_color": "brown", "soil": 3.0, "rubble": 50, "relief_mm": 3.0, "count": 40}
    alone, both = Score(), Score()
    for seed in (77, 78, 79):
        frame = simulated(seed, width=640, height=480, shape_family="b", **settings)
        truth = frame.attached[TRUTH_TOPIC]
        mask, coarse = CapNet(radius_px=RADII).process(frame)
        _, learned = CapNet(radius_px=RADII, min_score=0.05).process(frame)
        circles = PhaseHough(radius_px=RADII, use_learned=True).process(frame, mask, learned)
        alone.add(coarse, truth, counted(truth, *RADII))
        both.add(circles, truth, counted(truth, *RADII))
    assert both.f > 0.9
    assert both.precision >= alone.precision
    away, before = (np.median([e[0] for e in score.errors]) for score in (both, alone))
    assert away < 0.7 * before
