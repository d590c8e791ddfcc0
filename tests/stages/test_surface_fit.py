"""Against spheroids drawn by a ray caster of their own, and closed forms."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from mushpipe import Camera, Circles, DepthSource, InputError, Locations, RgbdFrame
from mushpipe.sim.shapes import CapShape, Warp, dome
from mushpipe.stages.cap_fit import CapFit
from mushpipe.stages.paraboloid import invert
from mushpipe.stages.surface_fit import SurfaceFit
from mushpipe.stages.warm_up import example_frame
from tests.stages.caps import CAMERA, Cap, cap, circles_of, draw, frame_from

BED = 0.5
GRAY = np.zeros((CAMERA.height, CAMERA.width))
TILTS = (0, 10, 20, 30)
CAPS = [
    cap(tilt, 50.0 * i, (-0.11 + 0.073 * i, 0.0, 0.48), 0.022, 0.6) for i, tilt in enumerate(TILTS)
]


def locate(depth: np.ndarray, circles: Circles, camera: Camera | None = CAMERA) -> Locations:
    return SurfaceFit().process(frame_from(depth, GRAY, camera), circles)


def surface_z(caps: list[Cap], circles: Circles) -> np.ndarray:
    """Depth of a cap at the pixel next to each centre, from a picture without noise."""
    depth, _ = draw(caps, BED)
    u, v = np.rint(circles.center).astype(int).T
    return depth[v, u]


def test_position_and_diameter_of_tilted_spheroids() -> None:
    circles = circles_of(CAPS)
    found = locate(draw(CAPS, BED)[0], circles)
    assert found.position[:, 2] == pytest.approx(surface_z(CAPS, circles), abs=4e-4)
    assert found.diameter == pytest.approx(2 * 0.022, abs=0.0015)
    assert found.source.tolist() == [DepthSource.MEASURED] * 4
    projected = CAMERA.project(found.position)
    np.testing.assert_allclose(projected, circles.center, atol=1e-6)
    assert found.distance == pytest.approx(np.linalg.norm(found.position, axis=1))


def test_a_hole_at_the_centre_moves_nothing_and_is_said() -> None:
    circles, depth = circles_of(CAPS), draw(CAPS, BED)[0]
    whole = locate(depth, circles)
    v, u = np.mgrid[: CAMERA.height, : CAMERA.width]
    for (x, y), r in zip(circles.center, circles.radius, strict=True):
        depth[(u - x) ** 2 + (v - y) ** 2 < (0.25 * r) ** 2] = np.nan
    found = locate(depth, circles)
    assert found.source.tolist() == [DepthSource.NEIGHBOURS] * 4
    assert found.position[:, 2] == pytest.approx(whole.position[:, 2], abs=2e-4)
    assert (found.sigma_position[:, 2] > whole.sigma_position[:, 2]).all()


@pytest.mark.parametrize("stage", [SurfaceFit(), CapFit(up="camera")])
@pytest.mark.parametrize(
    ("form", "high"), [((0.2, 0.3), 0.9), ((0.32, 0.42), 0.6), ((0.9, 0.9), 0.6)]
)
def test_a_tip_lost_in_a_hole(
    stage: SurfaceFit | CapFit, form: tuple[float, float], high: float
) -> None:
    """Conical and flat caps of the simulator, 40 mm, upright in the middle of the image."""
    top, rim = 0.46, 0.02
    rho, z = dome(CapShape("b", high, form, 0.2, 0.2, True, Warp()), 200)
    across, along = rim * rho, top + rim * (high - z)
    v, u = np.mgrid[: CAMERA.height, : CAMERA.width]
    off = np.hypot((u - CAMERA.cx) / CAMERA.fx, (v - CAMERA.cy) / CAMERA.fy)
    edge = rim / along[-1]
    depth = np.where(off < edge, np.interp(off, across / along, along), BED)
    depth[off < 0.2 * edge] = np.nan
    middle = np.array([[CAMERA.cx, CAMERA.cy]])
    circle = Circles(middle, np.array([CAMERA.fx * edge]), np.ones(1))
    found = stage.process(frame_from(depth, GRAY), circle)
    place = found if isinstance(found, Locations) else found[0]
    assert place.source.tolist() == [DepthSource.NEIGHBOURS]
    assert abs(place.position[0, 2] - top) < min(0.0012, 2 * place.sigma_position[0, 2])


def test_depth_on_the_soil_alone_is_missing_never_a_number() -> None:
    circles, depth = circles_of(CAPS), draw(CAPS, BED)[0]
    for gone in (depth < BED, np.ones_like(depth, bool)):
        found = locate(np.where(gone, np.nan, depth), circles)
        assert found.source.tolist() == [DepthSource.MISSING] * 4
        for values in (found.position, found.distance, found.diameter):
            assert np.isnan(values).all()


def test_no_depth_no_circles_no_calibration() -> None:
    circles = circles_of(CAPS[:1])
    color = np.zeros((CAMERA.height, CAMERA.width, 3), np.uint8)
    frame = RgbdFrame(frame_from(GRAY + 1, GRAY).header, color, None, 1.0, CAMERA)
    assert SurfaceFit().process(frame, circles).source.tolist() == [DepthSource.MISSING]
    assert len(locate(GRAY + 0.5, circles.take(np.array([], int)))) == 0
    with pytest.raises(InputError, match="without the camera's calibration"):
        locate(GRAY + 0.5, circles, None)


def test_a_nearer_cap_is_not_taken_for_the_one_it_hides() -> None:
    below = cap(0, 0, (0.0, 0.0, 0.48), 0.025, 0.6)
    above = cap(0, 0, (0.024, 0.0, 0.45), 0.02, 0.6)
    circles = circles_of([below, above])
    found = locate(draw([below, above], BED)[0], circles)
    alone = locate(draw([below], BED)[0], circles.take(np.array([0])))
    assert found.position[0, 2] == pytest.approx(alone.position[0, 2], abs=5e-4)
    assert found.sigma_diameter[0] > 1.2 * alone.sigma_diameter[0]


@pytest.mark.parametrize("stage", [SurfaceFit(), CapFit(up="camera")])
def test_a_centre_that_shows_an_undetected_cap_is_in_doubt(stage: SurfaceFit | CapFit) -> None:
    low = cap(0, 0, (0, 0, 0.48), 0.022, 0.6)
    high = cap(0, 0, (0.009, 0, 0.45), 0.016, 0.6)
    circles = circles_of([low])
    found = stage.process(frame_from(draw([low, high], BED)[0], GRAY), circles)
    located = found if isinstance(found, Locations) else found[0]
    error = located.position[0, 2] - surface_z([low], circles)[0]
    assert abs(error) < 2 * located.sigma_position[0, 2]
    assert abs(error) > 0.01


@pytest.mark.parametrize("stage", [SurfaceFit(), CapFit(up="camera")])
@pytest.mark.parametrize("x", [-0.16, 0.16])
def test_that_doubt_lies_along_the_ray(stage: SurfaceFit | CapFit, x: float) -> None:
    low = cap(0, 0, (x, 0, 0.48), 0.022, 0.6)
    high = cap(0, 0, (x * 0.45 / 0.48 - np.copysign(0.009, x), 0, 0.45), 0.016, 0.6)
    circles = circles_of([low])
    found = stage.process(frame_from(draw([low, high], BED)[0], GRAY), circles)
    located = found if isinstance(found, Locations) else found[0]
    v, u = np.rint(circles.center[0][::-1]).astype(int)
    own = CAMERA.deproject(circles.center, draw([low], BED)[0][[v], [u]])
    error, sigma = located.position[0] - own[0], located.sigma_position[0]
    assert abs(error[0]) > 0.005
    assert (abs(error) < 3 * sigma).all()


def test_noise_stays_below_the_stated_sigma_and_moves_nothing() -> None:
    circles, depth = circles_of(CAPS), draw(CAPS, BED)[0]
    clean, rng = locate(depth, circles), np.random.default_rng(0)
    sigma = 0.0003 + 0.0012 * depth
    noisy = [locate(depth + rng.normal(0, sigma), circles) for _ in range(30)]
    spread = np.std([found.position[:, 2] for found in noisy], axis=0)
    bias = np.mean([found.position[:, 2] for found in noisy], axis=0) - clean.position[:, 2]
    # the stated one also holds the shape, and noise that neighbours share
    assert (spread < noisy[0].sigma_position[:, 2]).all()
    assert np.abs(bias).max() < 1e-4


def test_a_circle_that_is_off_moves_what_the_sigmas_say() -> None:
    """By a pixel, and by how much the answer moves with it."""
    circles, depth = circles_of(CAPS[:1]), draw(CAPS, BED)[0]
    frame = frame_from(depth, GRAY)
    wider, narrower = (
        SurfaceFit().process(frame, replace(circles, radius=circles.radius + by)) for by in (1, -1)
    )
    right, left = (
        SurfaceFit().process(frame, replace(circles, center=circles.center + np.array([by, 0])))
        for by in (1, -1)
    )
    sure, unsure = (
        SurfaceFit(circle_sigma_px=sigma).process(frame, circles) for sigma in (0.001, 1.0)
    )
    size = np.sqrt(unsure.sigma_diameter**2 - sure.sigma_diameter**2)
    assert size == pytest.approx((wider.diameter - narrower.diameter) / 2, rel=0.15)
    place = np.sqrt(unsure.sigma_position**2 - sure.sigma_position**2)
    assert place[0, 0] == pytest.approx((right.position - left.position)[0, 0] / 2, rel=0.1)


def test_a_distorted_camera_changes_nothing() -> None:
    lens = (0.1, -0.2, 0.002, -0.001, 0.05)
    bent = Camera(320, 240, 400.0, 400.0, 159.5, 119.5, "brown_conrady", lens)
    circles = circles_of(CAPS, bent)
    found = locate(draw(CAPS, BED, bent)[0], circles, bent)
    straight = locate(draw(CAPS, BED)[0], circles_of(CAPS))
    np.testing.assert_allclose(found.position, straight.position, atol=5e-4)
    np.testing.assert_allclose(found.diameter, straight.diameter, rtol=0.04)


@settings(max_examples=30, deadline=None)
@given(st.integers(0, 10**6), st.integers(1, 6))
def test_the_inverse_is_numpys(seed: int, n: int) -> None:
    rows = np.random.default_rng(seed).normal(size=(n + 3, n))
    matrix = rows.T @ rows + 0.1 * np.eye(n)
    own = matrix.copy()
    assert invert(own)
    np.testing.assert_allclose(own, np.linalg.inv(matrix), rtol=1e-7, atol=1e-9)
    assert not invert(np.zeros((n, n)))


@pytest.mark.parametrize("seed", [428, 514, 515])
def test_a_surface_whose_middle_is_far_from_all_its_points_is_none(seed: int) -> None:
    """Waves, steps and holes; what is fitted to the rim of one may lie behind the camera."""
    rng = np.random.default_rng(seed)
    frame = example_frame()
    height, width = frame.gray.shape
    v, u = np.mgrid[:height, :width]
    slopes, waves = rng.uniform(-8, 8, 2), rng.uniform(1, 9)
    z = 400 + slopes[0] * u + slopes[1] * v + 40 * np.sin(u / waves) * rng.uniform(0, 3)
    hole = rng.random(z.shape) < rng.uniform(0, 0.7)
    depth = np.where(hole, 0, np.clip(z, 80, 4000)).astype(np.uint16)
    circles = Circles(rng.uniform(0, [width, height], (30, 2)), rng.uniform(2, 80, 30), np.ones(30))
    found = SurfaceFit().process(replace(frame, depth=depth), circles)
    known = np.isfinite(found.position[:, 2])
    assert (found.position[known, 2] > 0).all()
    assert (found.source[~known] == DepthSource.MISSING).all()
