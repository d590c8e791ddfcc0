"""A picture of mushrooms is no mushroom: colour of a bed, depth of the plane it was printed on."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from mushpipe import RgbdFrame
from mushpipe.stages.cap_fit import CapFit
from mushpipe.stages.cap_net import CapNet
from mushpipe.stages.phase_hough import PhaseHough
from tests.stages.frames import first


def printed(frame: RgbdFrame, slope: float) -> RgbdFrame:
    """Return the frame as a poster in 0.5 m, farther by `slope` (m) at the right border."""
    assert frame.depth is not None
    height, width = frame.depth.shape
    noise = np.random.default_rng(0).normal(0, 0.0008, (height, width))
    depth = (0.5 + slope * np.linspace(-0.5, 0.5, width) + noise) / frame.depth_scale
    return replace(frame, depth=depth.astype(frame.depth.dtype))


def caps(frame: RgbdFrame) -> int:
    """Return how many caps the stages of graphs/pick.yaml find."""
    net, detect = (
        CapNet(radius_px=(8, None), min_score=0.05, beside_depth=0.8),
        PhaseHough(radius_px=(8, None), min_score=0.1, use_learned=True),
    )
    mask, learned = net.process(frame)
    circles = detect.process(frame, mask, learned)
    return len(CapFit(min_score=0.5).process(frame, circles, learned)[2])


@pytest.mark.parametrize("name", ["first-bed", "dense", "brown", "lab"])
def test_of_a_poster_below_the_camera_nothing_is_a_cap(name: str) -> None:
    frame = first(name)
    assert caps(frame) > 10
    assert caps(printed(frame, 0.0)) == 0


@pytest.mark.parametrize("name", ["first-bed", "dense", "brown"])
def test_of_a_slanting_poster_hardly_anything_is_a_cap(name: str) -> None:
    frame = first(name)
    assert caps(printed(frame, 0.25)) <= 0.06 * caps(frame)
