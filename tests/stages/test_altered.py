"""Altered frames for judging: labels stay on the caps that they are of."""

from __future__ import annotations

import numpy as np
import pytest

from mushpipe.core.truth import TRUTH_TOPIC
from tests.stages.frames import simulated
from training.altered import Labelled, flipped, scaled


def pixel(case: Labelled, row: int) -> tuple[np.ndarray, float, np.ndarray]:
    """Return colour and depth (m) at a circle's centre, and the ray of that pixel."""
    frame = case.frame
    x, y = np.rint(case.must[row, :2]).astype(int)
    assert frame.camera is not None
    ray = frame.camera.deproject(np.array([[x, y]], float), np.ones(1))[0]
    return frame.color[y, x], float(frame.depth_m[y, x]), ray


@pytest.mark.parametrize("axes", [(0,), (1,), (0, 1)])
def test_circles_and_camera_follow_a_flipped_frame(axes: tuple[int, ...]) -> None:
    frame = simulated(31, width=320, height=240, count=8)
    truth = frame.attached[TRUTH_TOPIC]
    circles = np.column_stack([np.rint(truth.center), truth.radius])
    case = Labelled(frame, circles, circles[:0])
    other = flipped(case, axes)
    signs = np.array([-1 if 1 in axes else 1, -1 if 0 in axes else 1, 1])
    for row in np.flatnonzero((circles[:, :2] > 0).all(axis=1) & (circles[:, 0] < 320)):
        if circles[row, 1] < 240:
            (color, depth, ray), (same, z, mirrored) = pixel(case, row), pixel(other, row)
            np.testing.assert_array_equal(same, color)
            np.testing.assert_equal(z, depth)
            np.testing.assert_allclose(mirrored, signs * ray, atol=1e-6)


@pytest.mark.parametrize("scale", [0.5, 2.0])
def test_circles_and_camera_follow_a_scaled_frame(scale: float) -> None:
    frame = simulated(31, width=320, height=240, count=8)
    case = Labelled(frame, np.array([[99.5, 59.5, 20.0]]), np.zeros((0, 3)))
    other = scaled(case, scale)
    assert other.frame.color.shape == (240 * scale, 320 * scale, 3)
    x, y, radius = other.must[0]
    assert (x, y, radius) == (100 * scale - 0.5, 60 * scale - 0.5, 20 * scale)
    assert frame.camera is not None
    assert other.frame.camera is not None
    rays = [
        case.frame.camera.deproject(case.must[:, :2], np.ones(1)),
        other.frame.camera.deproject(other.must[:, :2], np.ones(1)),
    ]
    np.testing.assert_allclose(rays[1], rays[0], atol=1e-9)
