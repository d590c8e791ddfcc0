"""What `cap-fit` says where depth, tilt or calibration are not known."""

from __future__ import annotations

from dataclasses import fields, replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from mushpipe import Camera, Circles, DepthSource, Header, InputError, RgbdFrame
from mushpipe.stages.cap.batch import Fits
from mushpipe.stages.cap.regrow import beyond
from mushpipe.stages.cap_fit import CapFit, _sigma_tilt
from mushpipe.stages.picks import MakePicks
from tests.stages.caps import (
    CAMERA,
    angle,
    cap,
    circles_of,
    draw,
    frame_from,
    image_of,
)
from tests.stages.frames import first
from tests.stages.test_cap_fit import fit

ONE = Circles([[160.0, 120.0]], [20.0], [1.0])


def missing(depth: np.ndarray | None, circles: Circles = ONE) -> None:
    gray = np.full((240, 320), 0.3)
    frame = frame_from(np.zeros((240, 320)) if depth is None else depth, gray)
    if depth is None:
        frame = RgbdFrame(frame.header, frame.color, None, 1.0, CAMERA)
    locations, poses, same = CapFit().process(frame, circles)
    assert np.array_equal(same.center, circles.center)
    assert np.array_equal(same.radius, circles.radius)
    assert locations.source.tolist() == [DepthSource.MISSING] * len(circles)
    assert np.isnan(locations.position).all()
    assert np.isnan(locations.diameter).all()
    assert not poses.valid.any()
    assert np.isnan(poses.sigma_rad).all()


def test_without_depth_everything_is_missing() -> None:
    missing(None)


def test_without_any_valid_pixel_everything_is_missing() -> None:
    missing(np.full((240, 320), np.nan))


def test_depth_only_on_the_soil_is_no_mushroom() -> None:
    depth = np.full((240, 320), 0.44)
    v, u = np.mgrid[:240, :320]
    depth[(u - 160) ** 2 + (v - 120) ** 2 <= 23**2] = np.nan
    missing(depth)


def test_one_pixel_is_not_enough() -> None:
    depth = np.full((240, 320), np.nan)
    depth[120, 160] = 0.4
    missing(depth)


def test_a_circle_outside_of_the_image_is_missing() -> None:
    depth = np.full((240, 320), 0.44)
    missing(depth, Circles([[900.0, 500.0], [-80.0, -5.0]], [20.0, 9.0], [1.0, 1.0]))


def test_infinite_depth_is_missing_depth() -> None:
    depth = np.full((240, 320), np.inf)
    frame = RgbdFrame(
        frame_from(np.zeros((240, 320)), np.zeros((240, 320))).header,
        np.zeros((240, 320, 3), np.uint8),
        depth.astype(np.float32),
        1.0,
        CAMERA,
    )
    locations, *_ = CapFit().process(frame, ONE)
    assert locations.source[0] == DepthSource.MISSING


def test_no_circles_give_nothing() -> None:
    none = Circles(np.zeros((0, 2)), np.zeros(0), np.zeros(0))
    missing(np.full((240, 320), 0.4), none)


def test_depth_without_calibration_is_an_input_error() -> None:
    frame = frame_from(np.full((240, 320), 0.4), np.zeros((240, 320)), None)
    with pytest.raises(InputError, match="without the camera's calibration: record camera_info"):
        CapFit().process(frame, ONE)


def test_where_tilt_cannot_be_seen_the_sigma_says_so() -> None:
    # a hemisphere seen from above looks the same however it leans
    _, ball = fit([cap(0, 0, (0, 0, 0.4), 0.02, 1.0)], tilt_deg=25)
    _, flat = fit([cap(0, 0, (0, 0, 0.4), 0.02, 0.45)], tilt_deg=25)
    assert ball.sigma_rad[0] > 2 * flat.sigma_rad[0]


def test_the_fitness_of_a_cap_is_less_by_what_is_missing_of_it() -> None:
    true = cap(0, 0, (0, 0, 0.4), 0.022, 0.55)
    depth, gray = draw([true], 0.44)
    circles, stage, found = circles_of([true]), CapFit(up="camera"), []
    for first_row in (0, 120):  # all of it; the lower half
        part = np.where(np.arange(240)[:, None] < first_row, np.nan, depth)
        found.append(stage.process(frame_from(part, gray), circles)[1].fitness[0])
    assert found[1] / found[0] == pytest.approx(0.5, abs=0.08)


def test_a_cap_of_which_little_is_seen_between_others_may_be_anywhere_there() -> None:
    true = cap(0, 0, (0, 0, 0.4), 0.022, 0.55)
    depth, gray = draw([true], 0.44)
    v, u = np.mgrid[:240, :320]
    over = (np.abs(u - 160) > 11) & (np.hypot(u - 160, v - 120) < 30)
    circles, stage = circles_of([true]), CapFit(up="camera")
    clear, _, _ = stage.process(frame_from(depth, gray), circles)
    hidden, _, _ = stage.process(frame_from(np.where(over, 0.34, depth), gray), circles)
    assert (clear.sigma_position < 0.002).all()
    assert (hidden.sigma_position > hidden.diameter[0] / 2).all()


@pytest.mark.parametrize("aspect", [0.2, 0.5, 0.7])
@pytest.mark.parametrize("correlation", [-0.7, 0.0, 0.8])
def test_the_sigma_of_a_tilt_is_the_mean_over_what_the_aspect_may_be(
    aspect: float, correlation: float
) -> None:
    """Its variance goes by 1 / (1 - a^2)^2; the mean over a, which R and h tell, by quadrature."""
    radius, sigma = 0.02, np.array([0.0002, 0.00015])
    node, weight = np.polynomial.hermite_e.hermegauss(12)
    first, second = np.meshgrid(node, node)
    wider = sigma[0] * first
    higher = sigma[1] * (correlation * first + np.sqrt(1 - correlation**2) * second)
    a = aspect + (higher - aspect * wider) / radius  # small errors
    mean = (np.outer(weight, weight) / (2 * np.pi) * (1 - a**2) ** -2).sum()
    covariance = np.zeros((1, 8, 8))
    covariance[0, 5:7, 5:7] = np.outer(sigma, sigma) * [[1, correlation], [correlation, 1]]
    fits = Fits(**{each.name: np.zeros(1) for each in fields(Fits)})
    fits.radius[:], fits.height[:], fits.sigma_tilt[:] = radius, aspect * radius, 0.1
    found = _sigma_tilt(replace(fits, covariance=covariance))
    growth = mean * (1 - aspect**2) ** 2 - 1
    assert (found / 0.1) ** 2 - 1 == pytest.approx(growth, rel=0.03)


def test_a_cap_that_does_not_fit_the_model_says_so_in_its_sigmas() -> None:
    true = cap(15, 60, (0, 0, 0.4), 0.022, 0.55)
    depth, gray = draw([true], 0.44)
    v, u = np.mgrid[:240, :320]
    knobs = 0.003 * np.sin(u / 5) * np.sin(v / 5)
    stage, circles = CapFit(up="camera"), circles_of([true])
    locations, poses, _ = stage.process(frame_from(depth, gray), circles)
    lumpy = np.where(depth < 0.44, depth + knobs, depth)
    others, lumps, _ = stage.process(frame_from(lumpy, gray), circles)
    assert lumps.sigma_rad[0] > 1.3 * poses.sigma_rad[0]
    assert others.sigma_diameter[0] > 1.2 * locations.sigma_diameter[0]
    assert angle(lumps.axis[0], true.axis) < 3 * np.degrees(lumps.sigma_rad[0])


def test_the_more_the_border_cuts_off_the_less_is_known() -> None:
    sigmas, tilts = [], []
    for x in (0.09, 0.145, 0.165):  # whole, a third cut off, more than half
        true = cap(0, 0, (x, 0, 0.4), 0.03, 0.55)
        locations, poses = fit([true])
        assert abs(locations.diameter[0] - 0.06) < 2 * locations.sigma_diameter[0]
        sigmas.append(locations.sigma_diameter[0])
        tilts.append(poses.sigma_rad[0])
    assert sigmas[2] > 1.5 * sigmas[1] > 2 * sigmas[0]
    assert tilts[2] > 1.5 * tilts[1] > 2 * tilts[0]


@pytest.mark.parametrize("share", [0.8, 0.9])
@pytest.mark.parametrize("x", [0.16, 0.168])
def test_a_circle_too_small_for_what_the_border_cuts_off_does_not_hold_its_cap(
    x: float, share: float
) -> None:
    depth, _ = draw([cap(8, 120, (x, 0, 0.4), 0.03, 0.55)], 0.44)
    center = CAMERA.cx + CAMERA.fx * x / 0.4  # at the border, and a quarter radius beyond
    v, u = np.mgrid[:240, :320]
    away = np.hypot(u - center, v - CAMERA.cy)
    depth[(away > 24) & (away < 45)] = np.nan  # and no edge shows where it ends
    frame = frame_from(depth, np.full(depth.shape, 0.4))
    # as detectors have it: it touches the rim that is seen
    small = Circles([[center - (1 - share) * 30, CAMERA.cy]], [share * 30], [1.0])
    locations, *_ = CapFit(up=(0, 0, -1)).process(frame, small)
    assert locations.diameter[0] == pytest.approx(0.06, rel=0.07)


@given(st.floats(0, 400), st.floats(0, 300), st.floats(5, 60))
def test_the_share_of_a_circle_beyond_the_image_is_that_of_its_arc(
    x: float, y: float, radius: float
) -> None:
    image = image_of(np.full((CAMERA.height, CAMERA.width), 0.4))
    turn = np.linspace(0, 2 * np.pi, 7200, endpoint=False)
    u, v = x + radius * np.cos(turn), y + radius * np.sin(turn)
    out = (u < -0.5) | (v < -0.5) | (u > CAMERA.width - 0.5) | (v > CAMERA.height - 0.5)
    # of 32 directions; at each end of an arc one may be in or out
    assert beyond(image, np.array([x, y, radius])) == pytest.approx(out.mean(), abs=4 / 32)


def test_an_upright_without_direction_is_refused() -> None:
    with pytest.raises(ValueError, match="the upright has no direction"):
        CapFit.model_validate({"up": [0, 0, 0]})


def test_a_centre_beyond_the_image_where_the_lens_has_no_ray_ends_no_run() -> None:
    lens = (-0.375, 0.023, 0.0056, -0.0064, 0.0)
    camera = Camera(640, 480, 511.0, 511.0, 319.5, 239.5, "brown_conrady", lens)
    circles = Circles([[-13.7, 321.8]], [57.7], [1.0])
    assert np.isnan(camera.deproject(circles.center, np.ones(1))).any()
    color, depth = np.full((480, 640, 3), 90, np.uint8), np.full((480, 640), 0.45, np.float32)
    frame = RgbdFrame(Header(0, 0, "camera"), color, depth, 1.0, camera)
    locations, poses, _ = CapFit(up="camera").process(frame, circles)
    assert locations.source[0] != DepthSource.MEASURED
    assert not poses.valid[0] or poses.sigma_rad[0] > 1


@pytest.mark.parametrize(
    ("name", "focal", "cx", "circle"),
    [
        ("dense", 432.0, 319.5, (639, 455, 35)),
        ("sparse", 617.0, -192.0, (637, 167, 10)),
        ("dense", 617.0, -192.0, (637, 23, 16)),
    ],
)
def test_a_sliver_at_the_border_ends_no_run(
    name: str, focal: float, cx: float, circle: tuple[float, float, float]
) -> None:
    """In a wide view, or in a part of one; what is fitted to it would be seen far beside it."""
    camera = Camera(640, 480, focal, focal, cx, 239.5)
    frame = replace(first(name), camera=camera)
    x, y, radius = circle
    caps = Circles([[x, y], [320.0, 240]], [radius, 20.0], [1.0, 1.0])
    found, poses, kept = CapFit().process(frame, caps)
    assert found.missing.tolist() == [True, False]
    assert poses.valid.tolist() == [False, True]
    assert kept.center[0].tolist() == [x, y]
    picks = MakePicks().process(frame, kept, found, poses)
    assert len(picks) == 2
