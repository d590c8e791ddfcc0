"""Where edges of caps lie in depth, beside those in colour."""

from __future__ import annotations

import re
from dataclasses import replace

import cv2
import numpy as np
import pytest

from mushpipe import Camera, Circles, Header, Mask, RgbdFrame
from mushpipe.evaluate.truth import read_truth
from mushpipe.sources.mcap import McapSource
from mushpipe.stages.cap_fit import CapFit
from mushpipe.stages.cap_gap import edge_gaps
from mushpipe.stages.phase_hough import PhaseHough
from tests.stages.frames import SIMULATED


def disc(x: float, y: float, radius: float) -> np.ndarray:
    """Return how much of each pixel (240, 320) lies within a circle, 0..1."""
    v, u = np.mgrid[:240, :320]
    return np.clip(radius + 0.5 - np.hypot(u - x, v - y), 0, 1)


@pytest.mark.parametrize("wider", [-2.0, 0.0, 1.0, 3.0])
def test_the_gap_is_what_depth_is_wider_by(wider: float) -> None:
    place = (161.3, 118.6)
    luma = 40 + 170 * disc(*place, 40)
    depth = np.where(disc(*place, 40 + wider) > 0.5, 0.47, 0.5).astype(np.float32)
    color = np.repeat(luma[..., None], 3, axis=2).astype(np.uint8)
    frame = RgbdFrame(
        Header(0, 0, "camera"), color, depth, 1.0, Camera(320, 240, 617, 617, 160, 120)
    )
    gaps = edge_gaps(frame, Circles(np.array([place]), np.array([40.4]), np.ones(1)))
    assert len(gaps) == 32
    assert np.mean(gaps) == pytest.approx(wider, abs=0.3)  # pixels of depth are in or out


def widened(frame: RgbdFrame, by: int) -> RgbdFrame:
    """Return the frame as a stereo camera sees it: what is nearer reaches so many px further."""
    if not by:
        return frame
    assert frame.depth is not None
    depth = np.where(frame.depth > 0, frame.depth, 65535)
    around = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * by + 1, 2 * by + 1))
    near = cv2.erode(depth.astype(np.float32), around)
    return replace(frame, depth=np.where(near < 65535, near, 0).astype(np.uint16))


def told(stage: CapFit, by: int, caplog: pytest.LogCaptureFixture) -> tuple[list[str], float]:
    """Return what `cap-fit` warns of on a recording so widened, and the diameters' bias, mm."""
    caplog.clear()
    detect, bias = PhaseHough(radius_px=(8, 80), min_score=0.5), []
    stage.open()
    path = SIMULATED / "first-bed.mcap"
    known = read_truth(path)
    for frame in McapSource(path=path).frames():
        seen, truth = widened(frame, by), known.frames[known.place(frame.header)].caps
        circles = detect.process(seen, Mask(np.ones(seen.color.shape[:2], np.bool_)))
        sure = circles.take(circles.radius > 15)
        found, _, circles = stage.process(seen, sure)
        away = np.linalg.norm(truth.center[:, None] - circles.center, axis=2)
        near = (away.min(axis=1) < 3) & (truth.visible > 0.8)
        bias.extend((found.diameter[away.argmin(axis=1)] - truth.diameter)[near])
    said = [record.getMessage() for record in caplog.records]
    return [text for text in said if "edge_offset_px" in text], 1e3 * float(np.nanmedian(bias))


def test_a_camera_that_shows_caps_wider_is_told_of_with_what_puts_it_right(
    caplog: pytest.LogCaptureFixture,
) -> None:
    said, right = told(CapFit(), 0, caplog)
    assert said == []
    (message,), wide = told(CapFit(), 3, caplog)
    assert "px outside of those in colour" in message
    assert "diameters are too large" in message
    found = re.search(r"set edge_offset_px: (-?[\d.]+)", message)
    assert found is not None
    said, mended = told(CapFit(edge_offset_px=float(found[1])), 3, caplog)
    assert said == []
    assert wide - right > 2
    assert abs(mended) < 0.6


def test_a_setting_for_another_camera_is_told_of(caplog: pytest.LogCaptureFixture) -> None:
    (message,), bias = told(CapFit(edge_offset_px=-2.5), 1, caplog)
    assert "edge_offset_px: -2.5 takes them for 2.5 px outside" in message
    assert "diameters are too small" in message
    assert bias < -0.5
