"""Tops of caps that are no spheroid's."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from mushpipe.stages.cap.model import BULGE, HEIGHT, RADIUS, ROOM, SIZE, N
from mushpipe.stages.cap.solve import ROUND
from mushpipe.stages.cap.top import BENT, SUNK, rise
from mushpipe.stages.cap_fit import CapFit
from tests.stages.caps import CAMERA, cap, circles_of, draw, frame_from, frame_of

R, H = 0.02, 0.4


def parameters(axis: np.ndarray, bulge: float = 0.0) -> np.ndarray:
    values = np.zeros(SIZE)
    values[:3], values[N : N + 3] = (0.01, -0.02, 0.4), axis
    values[RADIUS], values[HEIGHT], values[BULGE] = R, H * R, bulge
    return values


def points(axis: np.ndarray, off: np.ndarray, above: np.ndarray, sigma: float) -> np.ndarray:
    """Rays (6, ROOM) to points at radii (N,) off the axis and heights (N,) over the rim plane."""
    turn = np.arange(len(off)) * 2.4
    local = np.column_stack([off * np.cos(turn), off * np.sin(turn), above])
    places = np.array([0.01, -0.02, 0.4]) + local @ frame_of(axis).T
    rays = np.zeros((6, ROOM), np.float32)
    far = np.linalg.norm(places, axis=1)
    rays[:3, ROUND : ROUND + len(off)] = (places / far[:, None]).T
    rays[3, ROUND : ROUND + len(off)], rays[4], rays[5] = far, sigma, 0.49
    return rays


@given(st.floats(-0.15, 0.15), st.floats(-0.6, 0.6), st.floats(0, 40))
def test_a_top_is_where_least_squares_put_it(sunk: float, bent: float, tilt: float) -> None:
    axis = np.array([np.sin(np.radians(tilt)), 0.0, -np.cos(np.radians(tilt))])
    r = np.linspace(0.03, 0.95, 60)
    noise = np.random.default_rng(3).normal(0, 0.01, len(r))
    above = H * np.sqrt(1 - r**2) + sunk + bent * r**2 + noise
    found = rise(parameters(axis), points(axis, R * r, R * above, 0.01 * R), len(r))
    near = r < 0.4
    weight = np.sqrt(0.49) / 0.01
    rows = np.vstack(
        [weight * np.column_stack([np.ones(60), r**2])[near], np.diag([1 / SUNK, 1 / BENT])]
    )
    right = np.append(weight * (sunk + bent * r**2 + noise)[near], [0, 0])
    assert found == pytest.approx(R * np.linalg.lstsq(rows, right)[0][0], abs=2e-7)


def test_the_bulge_of_the_profile_is_no_rise_of_the_top() -> None:
    axis, r = np.array([0.0, 0.0, -1.0]), np.linspace(0.03, 0.95, 60)
    w = 4 * r**2 * (1 - r**2)
    above = H * np.sqrt((1 + 0.1 * w) ** 2 - r**2)
    assert abs(rise(parameters(axis, 0.1), points(axis, R * r, R * above, 1e-4), 60)) < 1e-7


def test_without_points_near_the_axis_the_top_is_the_spheroids() -> None:
    axis, r = np.array([0.0, 0.0, -1.0]), np.linspace(0.5, 0.95, 30)
    assert rise(parameters(axis), points(axis, R * r, 0 * r, 1e-4), 30) == 0.0
    assert rise(parameters(axis), points(axis, R * r, 0 * r, 1e-4), 0) == 0.0


def test_what_lies_on_a_cap_is_not_its_top() -> None:
    axis, r = np.array([0.0, 0.0, -1.0]), np.linspace(0.03, 0.95, 60)
    above = H * np.sqrt(1 - r**2) + np.where(r < 0.2, 0.35, 0.0)
    assert abs(rise(parameters(axis), points(axis, R * r, R * above, 1e-4), 60)) < 1e-7


def test_depth_without_noise_gives_a_number() -> None:
    axis, r = np.array([0.0, 0.0, -1.0]), np.linspace(0.03, 0.95, 60)
    above = H * np.sqrt(1 - r**2) - 0.05
    found = rise(parameters(axis), points(axis, R * r, R * above, 0.0), 60)
    assert found == pytest.approx(-0.05 * R, rel=1e-3)


@pytest.mark.parametrize(("deep_mm", "lean"), [(2.5, 0.0), (2.5, 12.0), (-1.5, 0.0)])
def test_the_apex_of_a_cap_that_is_sunk_in_the_middle_is_its_lowest_point(
    deep_mm: float, lean: float
) -> None:
    true = cap(lean, 40, (0, 0, 0.4), 0.025, 0.3)
    depth, gray = draw([true], 0.44)
    v, u = np.mgrid[: CAMERA.height, : CAMERA.width]
    seen = CAMERA.deproject(np.stack([u, v], axis=-1).astype(float), depth) - true.center
    off = np.linalg.norm(seen - (seen @ true.axis)[..., None] * true.axis, axis=-1) / true.radius
    dent = np.where(off < 0.7, np.cos(np.pi * off / 1.4) ** 2, 0.0) * (depth < 0.44)
    depth += deep_mm / 1000 * dent  # along the ray, which is the axis within 12 degrees
    depth += np.random.default_rng(2).normal(0, 0.0005, depth.shape)
    _, poses, _ = CapFit(up="camera", edge_offset_px=0).process(
        frame_from(depth, gray), circles_of([true])
    )
    apex = true.center + (true.height - deep_mm / 1000) * true.axis
    assert abs((poses.apex[0] - apex) @ true.axis) < 5e-4
