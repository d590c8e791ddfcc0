"""The circle of a fitted cap against closed forms and against counted pixels."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from mushpipe import Camera, Circles
from mushpipe.stages.cap.circle import circle_around, improve
from mushpipe.stages.cap.model import ROOM as MOST
from mushpipe.stages.cap.model import SIZE, UNKNOWNS, fill_rows, span
from mushpipe.stages.cap.outline import LANES_ROOM, sample_outline
from mushpipe.stages.cap.samples import COMPASS, DIRECTIONS
from mushpipe.stages.cap_fit import CapFit
from tests.stages.caps import CAMERA, Cap, cap, circle_of, circles_of, draw, frame_from, image_of

ROOM = (np.empty(LANES_ROOM, np.float32), np.empty(2 * DIRECTIONS, np.int32))


@settings(max_examples=50, deadline=None)
@given(
    a=st.floats(5, 60), flat=st.floats(0.5, 1), turn=st.floats(0, np.pi),
    away=st.floats(0, 0.3), toward=st.floats(0, 2 * np.pi),
)  # fmt: skip
def test_an_ellipse_seen_from_beside_its_centre(
    a: float, flat: float, turn: float, away: float, toward: float
) -> None:
    b = flat * a
    seen_from = away * b * np.array([np.cos(toward), np.sin(toward)])
    # | M (seen_from + r d) | = 1 with M to the unit circle: a quadratic in r
    c, s = np.cos(turn), np.sin(turn)
    to_unit = np.array([[c / a, s / a], [-s / b, c / b]])
    d, o = COMPASS @ to_unit.T, to_unit @ seen_from
    dd, do = (d**2).sum(axis=1), d @ o
    reach = (-do + np.sqrt(do**2 - dd * (o @ o - 1))) / dd
    found = circle_around(np.array([*seen_from, a]), reach)
    assert found[:2] == pytest.approx((0, 0), abs=2e-3 * a)
    assert found[2] == pytest.approx(np.sqrt(a * b), rel=1e-3)


def parameters(c: Cap) -> np.ndarray:
    state = np.zeros(SIZE)
    state[:9] = *c.center, *c.axis, c.radius, c.height, 0.0
    span(state)
    return state


@pytest.mark.parametrize("tilt", [0, 20, 45])
@pytest.mark.parametrize("place", [(0.0, 0.0, 0.35), (0.09, 0.06, 0.3)])
@pytest.mark.parametrize("k1", [0.0, 0.12])
def test_a_cap_that_the_image_does_not_show_has_the_circle_of_its_outline(
    tilt: float, place: tuple[float, float, float], k1: float
) -> None:
    model = ("brown_conrady", (k1, 0.0, 0.0, 0.0, 0.0)) if k1 else ("none", ())
    camera = Camera(320, 240, CAMERA.fx, CAMERA.fy, CAMERA.cx, CAMERA.cy, *model)
    true = cap(tilt, 70, place, 0.022, 0.7)
    outline = np.array(circle_of(true, camera))
    circle = outline + np.array([2.0, -1.5, 3.0])
    improve(
        circle, parameters(true), (16.0, 0.0), 1.0, image_of(np.zeros((240, 320)), camera), ROOM
    )
    assert np.abs(circle - outline).max() < 0.2


@pytest.mark.parametrize("off", [0.0, 2.0])
def test_the_outline_in_colour_is_where_the_cap_ends_and_no_nearer_one_covers_it(
    off: float,
) -> None:
    true, rays = cap(10, 200, (0, 0, 0.4), 0.022, 0.55), np.zeros((6, DIRECTIONS), np.float32)
    luma = draw([true], 0.44)[1].astype(np.float32)
    circle = np.array(circle_of(true))
    circle[0] += off
    state, image = parameters(true), image_of(np.zeros((240, 320)))
    # a nearer one covers the right half of the image
    half = image._replace(ranks=image.ranks.copy())
    half.ranks[:, 160:] = 0
    for each, count in ((image, DIRECTIONS), (half, DIRECTIONS // 2)):
        n = sample_outline(luma, each, 1, state, circle, 1.5, ROOM, rays)
        assert abs(n - count) <= 1
        rows = np.zeros(14 * MOST, np.float32)
        fill_rows(state, rays, n, rows)
        pixel = true.center[2] / CAMERA.fx
        assert np.abs(rows[UNKNOWNS * MOST :][:n]).max() < 0.35 * pixel
        assert rays[4, :n] == pytest.approx(1.5 * pixel)


def test_a_circle_is_drawn_to_the_cap_where_a_neighbour_hides_the_image_of_it() -> None:
    low = cap(10, 200, (0, 0, 0.4), 0.022, 0.55)
    high = cap(0, 0, (0.024, 0, 0.37), 0.018, 0.6)
    depth, gray = draw([low, high], 0.44)
    true = circles_of([low, high])
    off = np.array([[2.5, 0.0], [0.0, 0.0]])  # under the neighbour, where the image shows nothing
    detected = Circles(true.center + off, true.radius, true.score)
    stage = CapFit(up="camera", edge_offset_px=0)
    _, _, found = stage.process(frame_from(depth, gray), detected)
    error = np.linalg.norm(found.center - true.center, axis=1)
    assert error[0] < 1.2
    assert error[1] < 0.2
    assert np.array_equal(found.score, detected.score)


def test_the_image_has_the_say_where_it_shows_all_of_an_outline() -> None:
    true = cap(0, 0, (0, 0, 0.4), 0.022, 0.55)
    depth, gray = draw([true], 0.44)
    moved = np.roll(depth, 1, axis=1)  # depth that is not quite aligned
    detected = circles_of([true])
    stage = CapFit(up="camera", edge_offset_px=0)
    _, _, found = stage.process(frame_from(moved, gray), detected)
    assert np.linalg.norm(found.center - detected.center) < 0.25
    assert abs(found.radius - detected.radius) < 0.25


def test_a_cap_that_nothing_holds_does_not_move_its_circle() -> None:
    true = cap(0, 0, (0, 0, 0.4), 0.022, 0.55)
    moved = []
    image = image_of(np.zeros((240, 320)))
    detected = np.array(circle_of(true)) + np.array([3.0, 0.0, 0.0])
    for held, doubt in (((16.0, 0.0), 1.0), ((16.0, 0.0), 3.0), ((4.0, 0.0), 1.0)):
        circle = detected.copy()
        improve(circle, parameters(true), held, doubt, image, ROOM)
        moved.append(float(np.linalg.norm(circle[:2] - detected[:2])))
    assert moved[0] == pytest.approx(3.0, abs=0.15)
    assert moved[1] < 1.1
    assert moved[2] < 0.2


def test_where_the_border_cuts_a_cap_fewer_rays_hold_it() -> None:
    moved = []
    image = image_of(np.zeros((240, 320)))
    for x in (0.0, 0.16):  # in the middle; and half of it beyond the right border
        true = cap(0, 0, (x, 0, 0.4), 0.022, 0.55)
        outline = np.array([CAMERA.cx + CAMERA.fx * x / 0.4, CAMERA.cy, CAMERA.fx * 0.022 / 0.4])
        circle = outline - [4.0, 0.0, 4.0]
        improve(circle, parameters(true), (8.0, 0.0), 1.0, image, ROOM)
        moved.append(circle[2] - outline[2] + 4.0)
    assert moved[0] == pytest.approx(1.0, abs=0.3)  # half of what would hold it: a quarter
    assert moved[1] > 2.5
