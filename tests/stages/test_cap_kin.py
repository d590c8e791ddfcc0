"""How unlike circles are to the caps in view: clods among caps, whatever the light."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from mushpipe import Circles, RgbdFrame
from mushpipe.core.types import Header
from mushpipe.stages.cap.kin import (
    DARK,
    FEWEST,
    MOST,
    SURE,
    USUAL,
    alike,
    kin_of,
    sure_of,
    tones_of,
    unlike,
)
from mushpipe.stages.cap_fit import CapFit

HEIGHT, WIDTH, RADIUS = 240, 320, 9.0
CAP, CLOD, SOIL = np.array([190.0, 180, 165]), np.array([60.0, 45, 35]), np.array([40.0, 30, 25])


def circles_of(count: int, score: Any = 0.95) -> Circles:
    """Circles in rows, far enough apart."""
    place = np.arange(count)
    center = np.column_stack([25 + 30.0 * (place % 10), 25 + 30.0 * (place // 10)])
    return Circles(center, np.full(count, RADIUS), np.broadcast_to(score, count))


def bed(circles: Circles, tones: Any, light: Any = 1.0) -> np.ndarray:
    """Discs of a colour each (N, 3) on soil, under light (H, W) or a number."""
    v, u = np.mgrid[:HEIGHT, :WIDTH]
    color = np.broadcast_to(SOIL, (HEIGHT, WIDTH, 3)).copy()
    for (x, y), tone in zip(circles.center, np.broadcast_to(tones, (len(circles), 3)), strict=True):
        color[np.hypot(u - x, v - y) < RADIUS] = tone
    color *= light if np.isscalar(light) else np.asarray(light)[..., None]
    return np.clip(np.rint(color), 0, 255).astype(np.uint8)


@pytest.mark.parametrize("exposure", [0.3, 1.0])
def test_a_clod_among_caps_is_unlike_them_and_caps_are_not(exposure: float) -> None:
    circles = circles_of(30)
    tones = np.tile(CAP, (30, 1))
    tones[[4, 17]] = CLOD
    found = unlike(kin_of(bed(circles, tones, exposure), circles))
    assert (found[[4, 17]] > 3).all()
    assert (np.delete(found, [4, 17]) < 0.2).all()


def test_a_white_cup_among_brown_caps_is_as_unlike_as_the_other_way_round() -> None:
    circles = circles_of(20)
    tones = np.tile(CLOD + 30, (20, 1))
    tones[7] = 230
    found = unlike(kin_of(bed(circles, tones), circles))
    assert found[7] > 3
    assert (np.delete(found, 7) < 0.2).all()


def test_light_that_falls_off_across_the_bed_makes_no_cap_unlike() -> None:
    circles = circles_of(60)
    light = np.exp(np.linspace(0, -1.2, WIDTH))[None].repeat(HEIGHT, axis=0)
    tones = np.tile(CAP, (60, 1))
    tones[22] = CLOD
    found = unlike(kin_of(bed(circles, tones, light), circles))
    assert found[22] > 2
    assert (np.delete(found, 22) < 0.5).all()


def test_caps_of_a_second_kind_have_kin_as_well_and_a_single_one_of_a_third_has_none() -> None:
    circles = circles_of(40)
    tones = np.tile(CAP, (40, 1))
    tones[::5] = [130, 85, 55]  # eight brown caps among white ones
    tones[13] = CLOD
    found = unlike(kin_of(bed(circles, tones), circles))
    assert found[13] > 1.5
    assert (np.delete(found, 13) < 0.2).all()


def test_a_few_clods_that_the_detector_is_sure_of_do_not_vouch_for_each_other() -> None:
    circles = circles_of(60)
    tones = np.tile(CAP, (60, 1))
    clods = [7, 21, 33, 52]
    tones[clods] = CLOD
    found = unlike(kin_of(bed(circles, tones), circles))
    assert (found[clods] > 3).all()
    assert (np.delete(found, clods) < 0.2).all()


@given(st.integers(0, 2**32 - 1))
def test_it_is_the_distance_to_the_nearest_tenth_of_the_sure_circles(seed: int) -> None:
    rng = np.random.default_rng(seed)
    count = int(rng.integers(FEWEST, 60))
    circles = circles_of(count, rng.uniform(0.8, 1, count))
    tones = rng.integers(20, 255, (count, 3)).astype(float)
    found = unlike(kin_of(bed(circles, tones), circles))
    sure = np.flatnonzero(circles.score >= SURE)
    if len(sure) < FEWEST:
        assert np.isnan(found).all()
        return
    r, g, b = np.log(tones + DARK).T
    place = np.column_stack([(r + g + b) / 3, r - g, b - g]) / USUAL / np.sqrt(3)
    for k in range(count):
        others = sure[sure != k]
        away = np.sort(np.linalg.norm(place[others] - place[k], axis=1))
        nearest = away[max(3, -(-len(sure) // 10)) - 1]
        assert found[k] == pytest.approx(min(nearest, MOST), abs=1e-6)


@given(st.integers(FEWEST, 40), st.floats(0.02, 1.0))
def test_it_is_the_difference_in_units_of_the_usual_one(count: int, shade: float) -> None:
    """Equal caps and one doubtful circle of another brightness: a closed form."""
    circles = circles_of(count + 1, np.append(np.full(count, 0.95), 0.4))
    tones = np.tile(CAP, (count + 1, 1))
    tones[-1] = np.rint(CAP * shade)
    found = unlike(kin_of(bed(circles, tones), circles))
    r, g, b = np.log(tones[-1] + DARK) - np.log(CAP + DARK)
    expected = np.sqrt(np.mean((np.array([(r + g + b) / 3, r - g, b - g]) / USUAL) ** 2))
    assert found[-1] == pytest.approx(min(expected, MOST), abs=1e-6)
    assert found[:-1] == pytest.approx(0, abs=1e-6)


def test_a_tone_is_brightness_and_red_and_blue_over_green() -> None:
    circles = circles_of(2)
    tones = np.array([[200.0, 100, 50], [30.0, 60, 90]])
    red, green, blue = np.log(tones + DARK).T
    expected = np.column_stack([(red + green + blue) / 3, red - green, blue - green])
    found = tones_of(bed(circles, tones), circles)
    assert found == pytest.approx(expected / (USUAL * np.sqrt(3)))


def test_the_sure_ones_within_reach_of_each_are_counted_without_itself() -> None:
    tones = np.random.default_rng(0).normal(size=(30, 3))
    sure = np.arange(0, 30, 2)
    apart = np.linalg.norm(tones[:, None] - tones[sure], axis=2)
    apart[sure, np.arange(len(sure))] = np.inf
    assert alike(tones, sure, 1.5).tolist() == (apart <= 1.5).sum(axis=1).tolist()


def test_too_few_sure_caps_tell_nothing_and_circles_beyond_the_image_do_no_harm() -> None:
    few = circles_of(30, np.append(np.full(FEWEST - 1, 0.95), np.full(31 - FEWEST, 0.89)))
    assert np.isnan(unlike(kin_of(bed(few, CAP), few))).all()
    none = Circles(np.zeros((0, 2)), np.zeros(0), np.zeros(0))
    assert len(unlike(kin_of(bed(none, np.zeros((0, 3))), none))) == 0
    circles = circles_of(8)
    outside = Circles(np.vstack([circles.center, [[-50, 500]]]), np.full(9, RADIUS), np.ones(9))
    assert np.isfinite(unlike(kin_of(bed(circles, CAP), outside))).all()


def test_without_depth_a_clod_goes_caps_stay_and_no_score_rises() -> None:
    clod = np.arange(30) == 9
    circles = circles_of(30, np.where(clod, 0.7, 0.93))
    tones = np.tile(CAP, (30, 1))
    tones[clod] = CLOD
    frame = RgbdFrame(Header(1, 0, "camera"), bed(circles, tones))
    locations, poses, found = CapFit(min_score=0.5).process(frame, circles)
    assert len(found) == len(locations) == len(poses) == 29
    assert np.array_equal(found.center, circles.center[~clod])
    assert (found.score <= 0.93).all()
    kept = CapFit().process(frame, circles)[2]
    assert np.array_equal(kept.score, circles.score)


def test_what_is_surely_a_cap_is_so_by_the_detector_and_by_itself() -> None:
    score = np.array([0.95] * 20 + [0.5] * 10)
    lone = np.full(30, 0.95)
    assert sure_of(score).tolist() == list(range(20))
    lone[:9] = 0.6
    assert sure_of(score, lone).tolist() == list(range(9, 20))
    lone[:12] = 0.5  # noisy depth: less is known of each, but nothing speaks against the most
    assert sure_of(score, lone).tolist() == list(range(12, 20))
    lone[:12] = 0.05  # most are no caps: it is not known what caps look like here
    assert len(sure_of(score, lone)) == 0
    assert len(sure_of(score[15:], lone[15:])) == 0  # too few


def test_clods_of_which_a_detector_is_sure_tell_nothing_of_what_caps_look_like() -> None:
    circles = circles_of(30)
    tones = np.tile(CLOD, (30, 1))
    tones[:10] = CAP
    lone = np.array([0.97] * 10 + [0.1] * 20)
    assert np.isnan(unlike(kin_of(bed(circles, tones), circles, lone))).all()
    lone[:18] = 0.97
    assert np.isfinite(unlike(kin_of(bed(circles, tones), circles, lone))).all()
