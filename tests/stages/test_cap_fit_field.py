"""Caps fitted to a real bed: against silhouettes drawn by hand, and against itself, turned."""

from __future__ import annotations

import cv2
import numpy as np
import orjson
import pytest

from mushpipe import Circles, RgbdFrame
from mushpipe.stages.cap.batch import Fits
from mushpipe.stages.cap_fit import CapFit
from tests.stages.frames import field_data, recorded


@pytest.fixture(scope="module")
def bed() -> tuple[RgbdFrame, Circles, np.ndarray]:
    """The frame, circles of the caps that were drawn by hand, and their diameters, m."""
    frame = recorded("white-bed-0")[0]
    drawn = orjson.loads((field_data() / "white-bed-0.labels.json").read_bytes())["must_find"]
    center = np.array([[cap["cx"], cap["cy"]] for cap in drawn])
    radius = np.array([(cap["ellipse_px"][0] + cap["ellipse_px"][1]) / 4 for cap in drawn])
    diameter = np.array([cap["diam_silhouette"] for cap in drawn]) / 1000
    return frame, Circles(center, radius, np.ones(len(drawn))), diameter


def fitted(frame: RgbdFrame, circles: Circles) -> Fits:
    assert frame.camera is not None
    return CapFit().fit(frame.gray, frame.depth_m, frame.camera, circles)


def turned(frame: RgbdFrame, rotation: np.ndarray, middle: np.ndarray) -> RgbdFrame:
    """The cloud of a frame, turned about a point, as the same camera sees it."""
    camera, depth = frame.camera, frame.depth_m
    assert camera is not None
    v, u = np.nonzero(depth > 0)
    points = camera.deproject(np.stack([u, v], axis=-1).astype(float), depth[v, u].astype(float))
    points = (points - middle) @ rotation.T + middle
    order = np.argsort(-points[:, 2])  # the nearest is painted last
    seen, color = np.zeros(depth.shape, np.float32), np.zeros_like(frame.color)
    x, y = np.rint(camera.project(points[order])).astype(int).T
    for right, down in ((0, 0), (0, 1), (1, 0), (1, 1)):  # a point fills the gap to the next
        inside = (x + right >= 0) & (x + right < depth.shape[1])
        inside &= (y + down >= 0) & (y + down < depth.shape[0])
        place = y[inside] + down, x[inside] + right
        nearer = (seen[place] == 0) | (points[order, 2][inside] < seen[place])
        place = place[0][nearer], place[1][nearer]
        seen[place] = points[order, 2][inside][nearer]
        color[place] = frame.color[v[order], u[order]][inside][nearer]
    color = cv2.inpaint(color, (seen == 0).astype(np.uint8), 3, cv2.INPAINT_TELEA)
    return RgbdFrame(frame.header, color, seen, 1.0, camera)


def test_diameters_are_those_of_the_silhouettes(bed: tuple[RgbdFrame, Circles, np.ndarray]) -> None:
    frame, circles, diameter = bed
    fits = fitted(frame, circles)
    assert fits.valid.all()
    assert np.median(np.abs(2 * fits.radius / diameter - 1)) < 0.06


@pytest.mark.parametrize("way", [(18, 0, 0), (-18, 0, 0), (0, 18, 0), (0, -18, 0)])
def test_a_view_from_18_degrees_aside_finds_the_same_caps(
    bed: tuple[RgbdFrame, Circles, np.ndarray], way: tuple[int, int, int]
) -> None:
    frame, circles, _ = bed
    assert frame.camera is not None
    first = fitted(frame, circles)
    rotation = cv2.Rodrigues(np.radians(way))[0]
    middle = np.array([0, 0, np.nanmedian(frame.depth_m)])
    center = (first.center - middle) @ rotation.T + middle
    radius = first.radius * frame.camera.fx / center[:, 2]
    again = Circles(frame.camera.project(center), radius, np.ones(len(center)))
    second = fitted(turned(frame, rotation, middle), again)
    cosine = ((first.axis @ rotation.T) * second.axis).sum(axis=1)
    angle, sigma = np.arccos(np.clip(cosine, -1, 1)), np.hypot(first.sigma_tilt, second.sigma_tilt)
    assert np.degrees(np.median(angle)) < 5
    assert np.mean((angle / sigma) ** 2) < 1.4  # both views share the cloud's own errors
    assert np.median(np.abs(second.radius / first.radius - 1)) < 0.07
