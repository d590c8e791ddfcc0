"""Depth and colour that are not of the same scene."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from mushpipe import RgbdFrame
from mushpipe.sources.mcap import McapSource
from mushpipe.stages.cap_net import CapNet
from mushpipe.stages.phase_hough import PhaseHough
from tests.stages.frames import SIMULATED, simulated

NET = CapNet(radius_px=(8, None), min_score=0.05, beside_depth=0.8)


def told(*frames: RgbdFrame) -> None:
    stage = PhaseHough(radius_px=(8, None), use_learned=True)
    stage.open()
    for frame in frames:
        stage.process(frame, *NET.process(frame))


def bed(seed: int) -> RgbdFrame:
    return simulated(seed, width=640, height=480, count=60)


def test_of_what_belongs_together_nothing_is_said(caplog: pytest.LogCaptureFixture) -> None:
    for path in sorted(SIMULATED.glob("*.mcap")):
        told(next(iter(McapSource(path=path).frames())))
    assert caplog.messages == []


@pytest.mark.parametrize("seed", [9100, 9101])
def test_depth_of_another_scene_is_told_of_once(
    seed: int, caplog: pytest.LogCaptureFixture
) -> None:
    mixed = replace(bed(seed), depth=bed(seed + 50).depth)
    told(*[mixed] * 40)
    assert len(caplog.messages) == 1
    assert "positions are not to be trusted" in caplog.messages[0]


def test_caps_that_only_depth_shows_are_told_of(caplog: pytest.LogCaptureFixture) -> None:
    """As where depth stands still and the bed was picked meanwhile."""
    empty = simulated(9102, width=640, height=480, count=0)
    told(replace(empty, depth=bed(9102).depth))
    assert "caps that depth shows cap-net sees nothing in colour" in caplog.messages[0]


def test_depth_in_which_no_caps_are_is_told_of(caplog: pytest.LogCaptureFixture) -> None:
    frame = bed(9103)
    assert frame.depth is not None
    flat = np.full_like(frame.depth, 4000)
    told(replace(frame, depth=flat))
    told(replace(frame, depth_scale=8 * frame.depth_scale))
    assert len(caplog.messages) == 2
    assert all("depth does not show" in text for text in caplog.messages)
