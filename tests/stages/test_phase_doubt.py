"""Depth and colour that are not of the same scene."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from mushpipe import RgbdFrame
from mushpipe.sources.mcap import McapSource
from mushpipe.stages.cap_net import CapNet
from mushpipe.stages.phase_hough import PhaseHough
from tests.stages.frames import SIMULATED, first

NET = CapNet(radius_px=(8, None), min_score=0.05, beside_depth=0.8)


def told(*frames: RgbdFrame) -> None:
    stage = PhaseHough(radius_px=(8, None), use_learned=True)
    stage.open()
    for frame in frames:
        stage.process(frame, *NET.process(frame))


def test_of_what_belongs_together_nothing_is_said(caplog: pytest.LogCaptureFixture) -> None:
    for path in sorted(SIMULATED.glob("*.mcap")):
        told(next(iter(McapSource(path=path).frames())))
    assert caplog.messages == []


@pytest.mark.parametrize(("colour", "depth"), [("first-bed", "tilted"), ("moving", "brown")])
def test_depth_of_another_scene_is_told_of_once(
    colour: str, depth: str, caplog: pytest.LogCaptureFixture
) -> None:
    mixed = replace(first(colour), depth=first(depth).depth)
    told(*[mixed] * 40)
    assert len(caplog.messages) == 1
    assert "positions are not to be trusted" in caplog.messages[0]


def test_caps_that_only_depth_shows_are_told_of(caplog: pytest.LogCaptureFixture) -> None:
    """As where depth stands still and the bed was picked meanwhile."""
    told(replace(first("plane-51"), depth=first("first-bed").depth))
    assert "caps that depth shows cap-net sees nothing in colour" in caplog.messages[0]


def test_depth_in_which_no_caps_are_is_told_of(caplog: pytest.LogCaptureFixture) -> None:
    frame = first("first-bed")
    assert frame.depth is not None
    flat = np.full_like(frame.depth, 4000)
    told(replace(frame, depth=flat))
    told(replace(frame, depth_scale=8 * frame.depth_scale))
    assert len(caplog.messages) == 2
    assert all("depth does not show" in text for text in caplog.messages)
