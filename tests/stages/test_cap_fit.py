from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.ndimage import distance_transform_edt
from scipy.spatial.transform import Rotation

from mushpipe import Camera, Circles, DepthSource, Locations, Poses
from mushpipe.stages.cap.model import ROOM, SIZE, fill_rows, move, span
from mushpipe.stages.cap_fit import CapFit, _beside_edges
from mushpipe.stages.upright import pixel_rays, upright
from tests.stages.caps import (
    CAMERA,
    Cap,
    angle,
    cap,
    circle_around,
    circles_of,
    draw,
    draw_pointed,
    frame_from,
    frame_of,
)

EXACT = {"depth_noise_mm": 0.02, "depth_noise_per_m": 0.0, "edge_offset_px": 0.0, "tilt_deg": 60}


def fit(caps: list[Cap], **more: object) -> tuple[Locations, Poses]:
    depth, gray = draw(caps, 0.44)
    stage = CapFit.model_validate({**EXACT, "up": "camera", **more})
    return stage.process(frame_from(depth, gray), circles_of(caps))[:2]


@settings(max_examples=25, deadline=None)
@given(
    tilt=st.floats(0, 35),
    turn=st.floats(0, 360),
    x=st.floats(-0.08, 0.08),
    y=st.floats(-0.05, 0.05),
    radius=st.floats(0.015, 0.03),
    aspect=st.floats(0.42, 0.7),
)
def test_an_exact_cap_is_recovered_wherever_it_is_and_however_it_leans(
    tilt: float, turn: float, x: float, y: float, radius: float, aspect: float
) -> None:
    true = cap(tilt, turn, (x, y, 0.4), radius, aspect)
    locations, poses = fit([true])
    assert poses.valid[0]
    assert angle(poses.axis[0], true.axis) < 1.5
    # half a pixel: the depth that is drawn ends at whole ones, all around a centred cap alike
    assert locations.diameter[0] == pytest.approx(2 * radius, abs=5e-4)
    assert np.linalg.norm(poses.apex[0] - true.apex) < 8e-4
    depth, _ = draw([true], 0.44)
    u, v = np.rint(circles_of([true]).center[0]).astype(int)
    assert locations.position[0, 2] == pytest.approx(depth[v, u], abs=3e-4)
    assert locations.source[0] == DepthSource.MEASURED


@pytest.mark.parametrize("wider", [2, 3])
def test_edge_offset_puts_caps_right_that_a_stereo_camera_shows_larger(wider: int) -> None:
    bed, caps = (
        0.44,
        [cap(8, turn, (x, 0.0, 0.4), 0.02, 0.6) for turn, x in ((20, -0.06), (90, 0.05))],
    )
    depth, gray = draw(caps, bed)
    away, nearest = distance_transform_edt(depth == bed, return_indices=True)
    depth = np.where(away <= wider, depth[tuple(nearest)], depth)
    worst = {}
    for offset in (0.7, -float(wider)):
        stage = CapFit(up="camera", edge_offset_px=offset)
        locations = stage.process(frame_from(depth, gray), circles_of(caps))[0]
        worst[offset] = 1e3 * np.abs(locations.diameter - 0.04).max()
    assert worst[-float(wider)] < 0.6 < worst[0.7]  # mm


def test_sigmas_and_fitness_are_positive_and_the_quaternion_turns_z_onto_the_axis() -> None:
    locations, poses = fit([cap(20, 40, (0, 0, 0.4), 0.02, 0.6)])
    turned = Rotation.from_quat(poses.quaternion[0]).apply([0, 0, 1])
    assert turned == pytest.approx(poses.axis[0])
    assert 0 < poses.sigma_rad[0] < 0.2
    assert 0.8 < poses.fitness[0] <= 1
    assert (locations.sigma_position > 0).all()
    assert 0 < locations.sigma_diameter[0] < 0.002
    assert locations.distance[0] == pytest.approx(np.linalg.norm(locations.position[0]))


def test_a_diameter_is_twice_a_radius_and_so_is_its_sigma() -> None:
    caps = [cap(20, 40, (-0.05, 0, 0.4), 0.02, 0.6), cap(5, 90, (0.05, 0, 0.41), 0.025, 0.5)]
    depth, gray = draw(caps, 0.44)
    frame, circles, stage = frame_from(depth, gray), circles_of(caps), CapFit(up="camera")
    fits = stage.fit(frame.gray, frame.depth_m, CAMERA, circles)
    found, poses, _ = stage.process(frame, circles)
    assert found.diameter == pytest.approx(2 * fits.radius)
    assert found.sigma_diameter == pytest.approx(2 * fits.sigma_radius)
    assert (fits.sigma_radius > np.sqrt(fits.covariance[:, 5, 5])).all()
    np.testing.assert_array_equal(poses.apex, fits.apex)
    np.testing.assert_array_equal(found.position, fits.surface)
    np.testing.assert_array_equal(found.sigma_position, fits.sigma_surface)


@pytest.mark.parametrize("circle_px", [0.5, 2.0])
def test_where_the_ray_is_the_axis_a_point_is_as_sure_across_as_its_circle(
    circle_px: float,
) -> None:
    true = cap(0, 0, (0, 0, 0.4), 0.02, 0.6)
    locations, _ = fit([true], circle_sigma_px=circle_px)
    across = circle_px / CAMERA.fx * true.apex[2]
    assert locations.sigma_position[0, :2] == pytest.approx(across, rel=0.01)
    assert 1e-5 < locations.sigma_position[0, 2] < 1e-3


def test_edges_that_are_off_widen_the_sigmas_by_their_share_of_the_radius() -> None:
    """2 px of 40 are 0.05: of a cap 40 mm wide half of 2 mm, and of a tilt 1.5 times as much."""
    locations = Locations.unknown(2, diameter=[0.04, np.nan], sigma_diameter=[0.0005, np.nan])
    poses = replace(Poses.unknown(2), sigma_rad=np.array([0.1, np.nan]))
    radius = np.array([40.0, 40.0])
    found, leaning = _beside_edges(locations, poses, 2.0, radius)
    assert found.sigma_diameter[0] == pytest.approx(np.hypot(0.0005, 0.001))
    assert leaning.sigma_rad[0] == pytest.approx(np.hypot(0.1, 0.075))
    assert np.isnan([found.sigma_diameter[1], leaning.sigma_rad[1]]).all()
    assert _beside_edges(locations, poses, 0.0, radius) == (locations, poses)


def test_the_whole_scene_turned_in_the_image_turns_the_answer() -> None:
    caps = [cap(25, 10, (0.02, 0.01, 0.4), 0.02, 0.55)]
    square = Camera(241, 241, 400, 400, 120, 120)
    depth, gray = draw(caps, 0.44, square)
    stage = CapFit.model_validate({**EXACT, "up": "camera"})
    circles = circles_of(caps, square)
    _, straight, _ = stage.process(frame_from(depth, gray, square), circles)
    # a quarter turn maps (x, y) to (-y, x); the centre of the image stays
    turned = Circles(
        np.stack([240 - circles.center[:, 1], circles.center[:, 0]], axis=1),
        circles.radius,
        circles.score,
    )
    _, side, _ = stage.process(
        frame_from(np.rot90(depth, -1).copy(), np.rot90(gray, -1).copy(), square), turned
    )
    x, y, z = straight.axis[0]
    assert angle(side.axis[0], np.array([-y, x, z])) < 0.3


def test_a_nearer_cap_hides_its_part_of_the_one_below() -> None:
    low = cap(15, 200, (0, 0, 0.4), 0.022, 0.55)
    high = cap(0, 0, (0.03, 0, 0.375), 0.016, 0.6)
    locations, poses = fit([low, high])
    assert angle(poses.axis[0], low.axis) < 3
    assert locations.diameter[0] == pytest.approx(0.044, abs=1.5e-3)
    assert angle(poses.axis[1], high.axis) < 2


@pytest.mark.parametrize("power", [1.2, 1.35])
def test_a_high_pointed_cap_that_leans_is_not_taken_for_a_small_upright_one(power: float) -> None:
    true = cap(45, 60, (0, 0, 0.4), 0.022, 0.95)
    depth, gray = draw_pointed(true, power, 0.45)
    x, y, radius = circle_around(depth < 0.45)
    stage = CapFit(up="camera", edge_offset_px=0)
    locations, poses, _ = stage.process(frame_from(depth, gray), Circles([[x, y]], [radius], [1.0]))
    assert angle(poses.axis[0], true.axis) < 3
    assert locations.diameter[0] == pytest.approx(0.044, abs=2e-3)


@pytest.mark.parametrize("ground", [0.55, 0.6, 0.65, 0.7])
@pytest.mark.parametrize("ambient", [0.3, 0.45])
def test_a_darker_rim_on_ground_as_bright_as_the_cap_makes_it_no_smaller(
    ground: float, ambient: float
) -> None:
    """Lambert's law under a lamp aside: the steepest fall is inside, the outline is where it ends.

    The rim where the fall was taken for the outline made diameters 1.5 to 2.1 mm too small.
    """
    lamp = np.array([0.6, 0.3, 1.0]) / np.sqrt(1.45)
    errors = []
    for tilt, turn in [(0, 0), (10, 40), (20, 200), (25, 300)]:
        c = cap(tilt, turn, (0.0, 0.0, 0.3), 0.022, 0.6)
        depth, cover = draw([c], 0.34)
        share = (cover - 0.2) / 0.6  # of caps; the bed has the rest
        v, u = np.mgrid[: CAMERA.height, : CAMERA.width].astype(float)
        points = CAMERA.deproject(np.stack([u, v], axis=-1), depth)
        axes = np.array([c.radius, c.radius, c.height])
        normal = ((points - c.center) @ frame_of(c.axis) / axes**2) @ frame_of(c.axis).T
        normal /= np.linalg.norm(normal, axis=2, keepdims=True)
        lit = 0.85 * (ambient + (1 - ambient) * np.clip(-(normal @ lamp), 0, 1))
        flat = ground * (ambient + (1 - ambient) * lamp[2])
        luma = np.clip(share * lit + (1 - share) * flat, 0, 1)
        found, _, _ = CapFit(edge_offset_px=0).process(frame_from(depth, luma), circles_of([c]))
        errors.append(1e3 * (found.diameter[0] - 2 * c.radius))
    assert abs(np.mean(errors)) < 0.7


@pytest.mark.parametrize("below", [0.35, 0.4, 0.45, 0.5])
def test_ground_close_below_the_rim_makes_a_low_cap_no_larger(below: float) -> None:
    """In colour nothing shows; of the ground, so many radii below the rim, the noise is usual."""
    errors, z = [], []
    for turn in range(0, 360, 60):
        c, rng = cap(8, turn, (0, 0, 0.31), 0.0145, 0.6), np.random.default_rng(turn)
        depth, gray = draw([c], 0.31 + below * c.radius)
        depth += 0.0007 * rng.standard_normal(depth.shape)
        frame = frame_from(depth, np.full_like(gray, 0.5))
        found, _, _ = CapFit(edge_offset_px=0).process(frame, circles_of([c]))
        errors.append(1e3 * (found.diameter[0] - 2 * c.radius))
        z.append(1e-3 * errors[-1] / found.sigma_diameter[0])
    assert np.abs(errors).max() < 0.5
    assert np.abs(z).max() < 2


def test_an_outline_that_no_depth_edge_confirms_widens_the_sigmas() -> None:
    true = cap(15, 60, (0, 0, 0.4), 0.022, 0.55)
    depth, gray = draw([true], 0.44)
    stage, circles = CapFit(up="camera"), circles_of([true])
    with_edges, seen, _ = stage.process(frame_from(depth, gray), circles)
    alone = np.where(depth < 0.44, depth, np.nan)
    without, guessed, _ = stage.process(frame_from(alone, gray), circles)
    assert without.sigma_diameter[0] > 2 * with_edges.sigma_diameter[0]
    assert guessed.sigma_rad[0] > 1.5 * seen.sigma_rad[0]


def test_the_bed_says_what_is_up() -> None:
    v, u = np.mgrid[:240, :320]
    rays = CAMERA.deproject(np.stack([u, v], axis=-1).astype(float), np.ones(u.shape))
    normal = np.array([0.1, -0.25, -1.0]) / np.linalg.norm([0.1, -0.25, -1.0])
    depth = -0.4 / (rays @ normal)
    up = upright("bed", depth.astype(np.float32), pixel_rays(CAMERA))
    assert angle(up, normal) < 0.3
    up = upright((0, -1, -1), depth.astype(np.float32), pixel_rays(CAMERA))
    assert up == pytest.approx(np.array([0, -1, -1]) / np.sqrt(2))


def test_a_constant_error_of_depth_is_taken_off() -> None:
    true = cap(20, 40, (0, 0, 0.4), 0.02, 0.6)
    depth, gray = draw([true], 0.44)
    stage = CapFit.model_validate({**EXACT, "up": "camera", "depth_bias_mm": 2.85})
    _, poses, _ = stage.process(frame_from(depth + 0.00285, gray), circles_of([true]))
    assert np.linalg.norm(poses.apex[0] - true.apex) < 8e-4


def test_that_error_is_taken_off_over_a_hole_as_well() -> None:
    true = cap(10, 30, (0.01, -0.01, 0.4), 0.022, 0.55)
    depth, gray = draw([true], 0.44)
    circles = circles_of([true])
    v, u = np.mgrid[: CAMERA.height, : CAMERA.width]
    hole = np.hypot(u - circles.center[0, 0], v - circles.center[0, 1]) < 5
    top = depth[tuple(np.rint(circles.center[0, ::-1]).astype(int))]
    depth = np.where(hole, np.nan, depth + 0.008)
    stage = CapFit(up="camera", depth_bias_mm=8)
    found = stage.process(frame_from(depth, gray), circles)[0]
    assert found.source[0] == DepthSource.NEIGHBOURS
    assert found.position[0, 2] == pytest.approx(top, abs=5e-4)


def test_a_lens_with_distortion_is_followed() -> None:
    bent = Camera(320, 240, 400, 400, 159.5, 119.5, "brown_conrady", (0.15, -0.2, 0.002, 0.001, 0))
    true = cap(20, 130, (-0.09, 0.06, 0.4), 0.022, 0.6)
    depth, gray = draw([true], 0.44, bent)
    stage = CapFit.model_validate({**EXACT, "up": "camera"})
    locations, poses, _ = stage.process(frame_from(depth, gray, bent), circles_of([true], bent))
    assert angle(poses.axis[0], true.axis) < 2
    assert np.linalg.norm(poses.apex[0] - true.apex) < 8e-4
    assert locations.diameter[0] == pytest.approx(0.044, abs=4e-4)


def some_cap(bulge: float) -> np.ndarray:
    values = np.zeros(SIZE)
    values[:3] = [0.01, -0.02, 0.41]
    values[3:6] = np.array([0.3, 0.2, -0.93]) / np.linalg.norm([0.3, 0.2, -0.93])
    values[6:9] = [0.021, 0.013, bulge]
    span(values)
    return values


@pytest.mark.parametrize(("kind", "bulge"), [("depth", 0.0), ("depth", 0.06), ("tangent", 0.0)])
def test_derivatives_agree_with_finite_differences(kind: str, bulge: float) -> None:
    state, rng = some_cap(bulge), np.random.default_rng(3)
    count = 60
    turn = rng.uniform(0, 2 * np.pi, count)
    far = rng.uniform(0, 0.75, count) if kind == "depth" else rng.uniform(0.97, 1.03, count)
    offset = state[6] * far[:, None] * np.stack([np.cos(turn), np.sin(turn)], axis=1)
    target = state[:3] + np.column_stack([offset, np.zeros(count)])
    points = np.zeros((4, count), np.float32)
    points[3] = np.linalg.norm(target, axis=1)
    points[:3] = (target / points[3][:, None]).T
    if kind == "tangent":
        points[3] = 0  # a ray that touches

    def rows(at: np.ndarray) -> np.ndarray:
        flat = np.zeros(14 * ROOM, np.float32)
        fill_rows(at, points, count, flat)
        return flat.reshape(14, ROOM)[:, :count]

    base = rows(state)
    hit = base[9] > 0.3 if kind == "depth" else np.ones(count, bool)
    for k in range(8):
        # in single precision a length of 0.4 m is known to 3e-8 m
        step, eps = np.zeros(8), 1e-3 if k in (3, 4, 7) else 5e-5  # angles and bulge, or m
        step[k] = eps
        ends = []
        for sign in (1, -1):
            moved = state.copy()
            move(moved, sign * step)
            ends.append(rows(moved))
        if kind == "depth":
            # the cosine is held fixed: compare the range along the ray
            change = (ends[0][8] / ends[0][9] - ends[1][8] / ends[1][9]) / (2 * eps) * base[9]
        else:
            change = (ends[0][8] - ends[1][8]) / (2 * eps)
        # off the surface, and with a bulge, the residual is a distance to first order only
        near = hit & ((np.abs(base[8]) < 0.05 * state[6]) | (kind == "depth"))
        assert near.sum() > 15
        exact = kind == "depth" and bulge == 0
        lengths = slice(0, 3) if k < 3 else slice(k, k + 1)
        scale = np.abs(base[lengths, :][:, near]).max(axis=0).mean() + 1e-9
        assert np.abs(base[k] - change)[near].mean() < (5e-4 if exact else 0.3) * scale, k


def test_the_covariance_matches_repeated_fits() -> None:
    """Noise as the model takes it: white depth noise, and circles that are off."""
    true = cap(15, 60, (0.01, 0.01, 0.4), 0.02, 0.55)
    depth, gray = draw([true], 0.44)
    clean = circles_of([true])
    rng = np.random.default_rng(0)
    stage = CapFit(up="camera", edge_offset_px=0)
    axes, radii, sigma_tilt, sigma_size = [], [], [], []
    for _ in range(60):
        noisy = depth + rng.normal(0, 0.0008, depth.shape)
        circles = Circles(
            clean.center + rng.normal(0, 1.5, (1, 2)), clean.radius + rng.normal(0, 1.0, 1), [1.0]
        )
        locations, poses, _ = stage.process(frame_from(noisy, gray), circles)
        axes.append(poses.axis[0])
        radii.append(locations.diameter[0])
        sigma_tilt.append(poses.sigma_rad[0])
        sigma_size.append(locations.sigma_diameter[0])
    mean = np.mean(axes, axis=0)
    spread = np.sqrt(np.mean(np.sum((np.array(axes) - mean) ** 2, axis=1)))
    # the sigmas also hold shape and edge errors, absent here: never below the scatter
    assert spread < np.mean(sigma_tilt) < 12 * spread
    assert np.std(radii) < np.mean(sigma_size) < 12 * np.std(radii)
