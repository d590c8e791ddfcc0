"""How high a cap stands over the ground around it."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from mushpipe import Camera
from mushpipe.stages.cap.blocks import Image
from mushpipe.stages.cap.order import by_depth
from mushpipe.stages.cap.stand import stands
from mushpipe.stages.cap_fit import CapFit
from mushpipe.stages.upright import pixel_rays
from tests.stages.caps import CAMERA, cap, circles_of, draw, frame_from

DOWN = np.array([0.0, 0, 1])


def ground(normal: np.ndarray, away: float) -> np.ndarray:
    """Depth (H, W) m of the plane of the points p with p n = -away."""
    rays = pixel_rays(CAMERA).astype(np.float64)
    return -away / (rays @ normal[:2] + normal[2])


def image_of(depth: np.ndarray, circles: np.ndarray) -> Image:
    single = depth.astype(np.float32)
    return Image(single, pixel_rays(CAMERA), by_depth(single, circles)[1], CAMERA.focal)


@settings(max_examples=40, deadline=None)
@given(
    lean=st.tuples(st.floats(-0.4, 0.4), st.floats(-0.4, 0.4)),
    u=st.floats(20, 300),
    v=st.floats(20, 220),
    radius=st.floats(4, 40),
    high=st.floats(0, 0.1),
)
def test_it_is_the_distance_of_the_apex_from_the_plane_of_the_ground(
    lean: tuple[float, float], u: float, v: float, radius: float, high: float
) -> None:
    up = np.array([*lean, -1.0]) / np.linalg.norm([*lean, -1.0])
    depth = ground(up, 0.4)
    foot = CAMERA.deproject(np.array([u, v]), np.array(depth[round(v), round(u)]))
    apex = foot + up * (high - 0.4 - foot @ up)
    circle = np.array([[u, v, radius]])
    assert stands(image_of(depth, circle), circle, apex[None], up, 0.0) == pytest.approx(
        high, abs=1e-5
    )


def test_neighbours_and_missing_depth_are_no_ground() -> None:
    circles = np.array([[160.0, 120, 20], [190, 120, 15], [160, 160, 18]])
    depth = ground(-DOWN, 0.4)
    v, u = np.mgrid[: CAMERA.height, : CAMERA.width]
    for x, y, radius in circles:
        depth[np.hypot(u - x, v - y) <= radius] = 0.36
    depth[:, 130:140] = 0
    apexes = np.tile([0.0, 0, 0.36], (3, 1))
    found = stands(image_of(depth, circles), circles, apexes, -DOWN, 0.0)
    assert found == pytest.approx(np.full(3, 0.04), abs=1e-6)


def test_where_no_ground_is_seen_it_is_not_known() -> None:
    circles = np.array([[160.0, 120, 20], [160, 120, 60], [-30, 120, 10]])
    apexes = np.tile([0.0, 0, 0.36], (3, 1))
    found = stands(image_of(ground(-DOWN, 0.4), circles), circles, apexes, -DOWN, 0.0)
    assert np.isnan(found).tolist() == [True, False, True]
    nothing = image_of(np.zeros((CAMERA.height, CAMERA.width)), circles)
    assert np.isnan(stands(nothing, circles, apexes, -DOWN, 0.0)).all()


def test_a_third_of_the_ground_that_is_no_ground_moves_nothing() -> None:
    """A hand or a tray's rim beside the cap, or a hole."""
    circle, apex = np.array([[160.0, 120, 20]]), np.array([[0.0, 0, 0.36]])
    v, u = np.mgrid[: CAMERA.height, : CAMERA.width]
    third = np.abs(np.arctan2(v - 120, u - 160)) < np.radians(58)
    for other in (0.25, 0.9):
        image = image_of(np.where(third, other, ground(-DOWN, 0.4)), circle)
        assert stands(image, circle, apex, -DOWN, 0.0) == pytest.approx([0.04], abs=1e-6)


@pytest.mark.parametrize(("degrees", "known"), [(20, False), (30, False), (100, True)])
def test_a_glimpse_of_the_ground_tells_nothing(degrees: float, known: bool) -> None:
    """Of 72 places all around 12 must be seen: of every direction three."""
    circle, apex = np.array([[160.0, 120, 20]]), np.array([[0.0, 0, 0.36]])
    v, u = np.mgrid[: CAMERA.height, : CAMERA.width]
    seen = np.abs(np.degrees(np.arctan2(v - 120, u - 160))) < degrees / 2
    image = image_of(np.where(seen, ground(-DOWN, 0.4), 0), circle)
    found = stands(image, circle, apex, -DOWN, 0.0)
    assert found == pytest.approx([0.04 if known else np.nan], abs=1e-6, nan_ok=True)


def test_a_fit_tells_how_high_its_cap_stands() -> None:
    caps = [cap(10, 0, (-0.06, 0, 0.4), 0.02, 0.5), cap(0, 0, (0.06, 0, 0.43), 0.02, 0.6)]
    depth, gray = draw(caps, 0.44)
    frame, circles = frame_from(depth, gray), circles_of(caps)
    fits = CapFit(up="camera").fit(frame.gray, frame.depth_m, CAMERA, circles)
    assert fits.stand == pytest.approx([0.44 - c.apex[2] for c in caps], abs=1e-3)


def test_the_bias_of_the_depth_lifts_no_cap_off_its_ground() -> None:
    caps = [cap(10, 0, (-0.06, 0, 0.4), 0.02, 0.5), cap(0, 0, (0.06, 0, 0.43), 0.02, 0.6)]
    depth, gray = draw(caps, 0.44)
    frame, circles = frame_from(depth + 0.01, gray), circles_of(caps)
    stage = CapFit(up="camera", depth_bias_mm=10)
    fits = stage.fit(frame.gray, frame.depth_m, CAMERA, circles)
    assert fits.stand == pytest.approx([0.44 - c.apex[2] for c in caps], abs=1e-3)


def test_what_the_lens_shows_nothing_of_is_no_ground() -> None:
    lens = (-0.28, 0.07, 0.0002, 0, -0.01)
    camera = Camera(320, 240, 165, 165, 159.5, 119.5, "brown_conrady", lens)
    rays, up = pixel_rays(camera), np.array([0.05, 0, -1]) / np.hypot(0.05, 1)
    lost = rays[..., 0] > 1e3
    depth = np.where(lost, 0.4, -0.4 / (rays @ up[:2] + up[2])).astype(np.float32)
    # at the end of what the lens shows, with neighbours all along the other side
    circles = np.array([[8.0, 116, 20], [53, 117, 28], [37, 153, 24], [39, 81, 24]])
    image = Image(depth, rays, by_depth(depth, circles)[1], camera.focal)
    foot = depth[116, 8] * np.array([*rays[116, 8], 1])
    found = stands(image, circles, np.tile(foot + 0.05 * up, (4, 1)), up, 0.0)[0]
    assert np.isnan(found) or found == pytest.approx(0.05, abs=1e-3)
