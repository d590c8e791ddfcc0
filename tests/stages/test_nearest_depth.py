from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from mushpipe import Circles, DepthSource, InputError, Locations
from mushpipe.stages.nearest_depth import NearestDepth
from tests.stages.scenes import CAMERA, frame_of, pixel_grid, sphere_depth


def circle(x: float, y: float, r: float) -> Circles:
    return Circles([[x, y]], [r], [1.0])


def locate(depth: np.ndarray | None, circles: Circles) -> Locations:
    return NearestDepth().process(frame_of(np.zeros((120, 160)), depth), circles)


def test_the_centre_of_a_sphere_is_its_front_point() -> None:
    depth = sphere_depth((0.0, 0.0, 0.5), 0.03, 0.53)
    found = locate(depth, circle(79.5, 59.5, 12.0))
    # Pixel centres lie half a pixel beside the axis: 0.6 mm at 0.47 m.
    assert found.position[0] == pytest.approx([0, 0, 0.47], abs=1.3e-3)
    assert found.distance[0] == pytest.approx(np.linalg.norm(found.position[0]))
    assert found.source[0] == DepthSource.MEASURED


@given(z=st.floats(0.2, 1.5), x=st.integers(30, 130), y=st.integers(30, 90), r=st.floats(6.0, 20.0))
def test_on_a_facing_plane_the_diameter_is_exact(z: float, x: int, y: int, r: float) -> None:
    found = locate(np.full((120, 160), z), circle(x, y, r))
    expected = [(x - 79.5) * z / 200, (y - 59.5) * z / 200, z]
    assert found.position[0] == pytest.approx(expected, rel=1e-6)
    assert found.diameter[0] == pytest.approx(2 * r * z / 200, rel=1e-6)


def test_a_hole_at_the_centre_is_filled_from_its_nearest_neighbours() -> None:
    depth = np.full((120, 160), 0.4)
    u, v = pixel_grid()
    depth[(u - 80) ** 2 + (v - 60) ** 2 <= 16] = np.nan
    found = locate(depth, circle(80, 60, 15))
    assert found.source[0] == DepthSource.NEIGHBOURS
    assert found.position[0, 2] == pytest.approx(0.4)
    # The neighbours surround the hole, so their mean is near the centre.
    assert found.position[0, :2] == pytest.approx([0.001, 0.001], abs=0.006)


def test_neighbours_outside_the_circle_are_never_taken() -> None:
    depth = np.full((120, 160), 0.6)
    u, v = pixel_grid()
    depth[(u - 80) ** 2 + (v - 60) ** 2 <= 15**2] = np.nan
    found = locate(depth, circle(80, 60, 15))
    assert found.source[0] == DepthSource.MISSING
    assert np.isnan(found.position).all()
    assert np.isnan(found.distance[0])
    assert np.isnan(found.diameter[0])


def test_half_a_cap_without_depth_has_no_invented_diameter() -> None:
    depth = np.full((120, 160), 0.4)
    depth[:, :84] = np.nan
    found = locate(depth, circle(80, 60, 10))
    # The row has one end only; the column still has both.
    assert found.source[0] == DepthSource.NEIGHBOURS
    assert found.diameter[0] == pytest.approx(2 * 10 * 0.4 / 200, rel=1e-6)


@pytest.mark.parametrize("camera", [None, CAMERA])
def test_without_depth_everything_is_missing(camera: object) -> None:
    frame = frame_of(np.zeros((120, 160)), None, camera)  # type: ignore[arg-type]
    found = NearestDepth().process(frame, circle(80, 60, 10))
    assert found.source.tolist() == [DepthSource.MISSING]


def test_depth_without_calibration_is_an_input_error() -> None:
    frame = frame_of(np.zeros((120, 160)), np.full((120, 160), 0.4), None)
    with pytest.raises(InputError, match="without the camera's calibration: record camera_info"):
        NearestDepth().process(frame, circle(80, 60, 10))


def test_no_circles_give_no_locations() -> None:
    none = Circles(np.zeros((0, 2)), np.zeros(0), np.zeros(0))
    assert len(locate(np.full((120, 160), 0.4), none)) == 0


def test_a_circle_at_the_border_uses_what_is_inside() -> None:
    found = locate(np.full((120, 160), 0.4), circle(0, 0, 10))
    assert found.position[0] == pytest.approx([-79.5 * 0.002, -59.5 * 0.002, 0.4])
    assert found.diameter.shape == (1,)


def test_a_circle_beyond_the_image_is_missing() -> None:
    found = locate(np.full((120, 160), 0.4), circle(400, 300, 10))
    assert found.source[0] == DepthSource.MISSING


@pytest.mark.parametrize("neighbours", [1, 4, 30])
@pytest.mark.parametrize("seed", range(4))
def test_any_depth_is_located_as_by_looking_at_all_pixels(seed: int, neighbours: int) -> None:
    """Slanted and full of holes, with circles that reach beyond the image."""
    rng = np.random.default_rng(seed)
    u, v = pixel_grid()
    depth = 0.4 + 0.0007 * u - 0.0004 * v + rng.normal(0, 0.01, u.shape)
    depth[rng.random(u.shape) < (0.3, 0.6, 0.9, 0.99)[seed]] = np.nan
    n = 20
    circles = Circles(rng.uniform(0, [159, 119], (n, 2)), rng.uniform(2, 20, n), np.ones(n))
    found = NearestDepth(neighbours=neighbours).process(
        frame_of(np.zeros((120, 160)), depth), circles
    )
    depth = depth.astype(np.float32).astype(float)
    points = CAMERA.deproject(np.stack([u, v], axis=-1), np.nan_to_num(depth))
    for row, ((x, y), r) in enumerate(zip(circles.center, circles.radius, strict=True)):
        inside = np.isfinite(depth) & (np.hypot(u - x, v - y) <= r)
        order = np.argsort(np.hypot(u - x, v - y)[inside])
        at_centre = depth[round(y), round(x)]
        if np.isfinite(at_centre):
            source, position = DepthSource.MEASURED, points[round(y), round(x)]
        elif inside.any():
            source = DepthSource.NEIGHBOURS
            position = points[inside][order[:neighbours]].mean(axis=0)
        else:
            source, position = DepthSource.MISSING, np.full(3, np.nan)
        assert found.source[row] == source
        assert found.position[row] == pytest.approx(position, abs=1e-9, nan_ok=True)
        ends = []
        for dx, dy in ((-1, 0), (1, 0), (0, -1), (0, 1)):
            side = inside & ((u - x) * dx + (v - y) * dy > 0)
            end = np.array([x + r * dx, y + r * dy])
            away = np.where(side, np.hypot(u - end[0], v - end[1]), np.inf)
            z = depth.ravel()[away.argmin()] if side.any() else np.nan
            ends.append(CAMERA.deproject(end, np.array(z)))
        spans = np.linalg.norm([ends[0] - ends[1], ends[2] - ends[3]], axis=1)
        known = spans[np.isfinite(spans)]
        expected = known.mean() if len(known) else np.nan
        assert found.diameter[row] == pytest.approx(expected, abs=1e-9, nan_ok=True)
