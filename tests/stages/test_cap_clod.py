"""Clods: what looks as the ground does, and not as most caps in view do."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from mushpipe import Circles, RgbdFrame
from mushpipe.core.types import Header
from mushpipe.stages.cap.clod import CLOD_CHANCE
from mushpipe.stages.cap.clod import clods as clods_of
from mushpipe.stages.cap.kin import FEWEST, kin_of
from mushpipe.stages.cap_fit import CapFit
from mushpipe.stages.discs import LIKELY

HEIGHT, WIDTH, RADIUS = 240, 320, 9.0
WHITE, BROWN = np.array([190.0, 180, 165]), np.array([120.0, 80, 55])
SOIL, CLOD = np.array([60.0, 48, 40]), np.array([66.0, 51, 42])


def circles_of(count: int, score: float = 0.95) -> Circles:
    place = np.arange(count)
    center = np.column_stack([25 + 45.0 * (place % 7), 25 + 45.0 * (place // 7)])
    return Circles(center, np.full(count, RADIUS), np.full(count, score))


def bed(
    circles: Circles, tones: np.ndarray, soil: np.ndarray = SOIL, light: float = 1.0
) -> np.ndarray:
    v, u = np.mgrid[:HEIGHT, :WIDTH]
    color = np.broadcast_to(soil, (HEIGHT, WIDTH, 3)).copy()
    for (x, y), tone in zip(circles.center, tones, strict=True):
        color[np.hypot(u - x, v - y) < RADIUS] = tone
    return np.clip(np.rint(color * light), 0, 255).astype(np.uint8)


def tones_of(count: int, usual: np.ndarray, odd: dict[int, np.ndarray]) -> np.ndarray:
    tones = np.tile(usual, (count, 1))
    for row, tone in odd.items():
        tones[row] = tone
    return tones


def clods(color: np.ndarray, circles: Circles) -> np.ndarray:
    return clods_of(color, circles, kin_of(color, circles))


@pytest.mark.parametrize("light", [0.5, 1.0, 1.3])
def test_clods_are_found_among_white_caps_though_the_detector_is_sure_of_several(
    light: float,
) -> None:
    circles, odd = circles_of(30), [2, 9, 11, 16, 23]
    tones = tones_of(30, WHITE, dict.fromkeys(odd, CLOD))
    assert np.flatnonzero(clods(bed(circles, tones, light=light), circles)).tolist() == odd


def test_brown_caps_on_brown_soil_are_none_and_neither_is_a_brown_one_among_white() -> None:
    circles = circles_of(20)
    alike = tones_of(20, SOIL * 1.2, {})
    assert not clods(bed(circles, alike), circles).any()
    mixed = tones_of(20, WHITE, {3: BROWN, 12: BROWN})
    assert not clods(bed(circles, mixed), circles).any()


def test_a_cap_as_dark_as_soil_that_lies_on_something_bright_is_none() -> None:
    circles = circles_of(20)
    color = bed(circles, tones_of(20, WHITE, {8: CLOD}))
    x, y = circles.center[8]
    v, u = np.mgrid[:HEIGHT, :WIDTH]
    away = np.hypot(u - x, v - y)
    color[(away >= RADIUS) & (away < 2 * RADIUS)] = 200
    assert not clods(color, circles).any()


def test_a_clod_on_soil_between_patches_of_mycelium_is_one() -> None:
    circles = circles_of(20)
    color = bed(circles, tones_of(20, WHITE, {8: CLOD, 9: BROWN}))
    v, u = np.mgrid[:HEIGHT, :WIDTH]
    soil = (color == SOIL.astype(np.uint8)).all(axis=2)
    color[soil & ((u // 6 + v // 6) % 2 == 0)] = WHITE
    assert np.flatnonzero(clods(color, circles)).tolist() == [8]


def test_in_the_dark_all_looks_alike_and_nothing_is_said() -> None:
    circles = circles_of(20)
    tones = tones_of(20, WHITE, {4: CLOD})
    assert clods(bed(circles, tones), circles)[4]
    v, u = np.mgrid[:HEIGHT, :WIDTH]
    night = np.hypot(u - circles.center[4, 0], v - circles.center[4, 1]) < 2.2 * RADIUS
    color = bed(circles, tones)
    color[night] = color[night] // 6
    assert not clods(color, circles).any()


def test_few_sure_caps_say_nothing_and_a_clod_in_a_cluster_shows_no_ground() -> None:
    circles = circles_of(FEWEST)
    tones = tones_of(FEWEST, WHITE, {0: CLOD})
    assert clods(bed(circles, tones), circles)[0]
    fewer = circles.take(np.arange(1, FEWEST))
    assert not clods(bed(circles, tones), fewer).any()
    around = 2 * np.pi * np.arange(12) / 12
    ring = circles.center[0] + 14 * np.column_stack([np.cos(around), np.sin(around)])
    for score in (LIKELY, LIKELY - 0.01):  # what is hardly a cap is ground
        crowd = Circles(
            np.vstack([circles.center, ring]), np.full(FEWEST + 12, RADIUS),
            np.append(circles.score, np.full(12, score)),
        )  # fmt: skip
        assert clods(bed(circles, tones), crowd)[0] == (score < LIKELY)


@given(st.integers(0, 2**32 - 1), st.integers(0, 40))
def test_any_circles_on_any_image_have_an_answer(seed: int, count: int) -> None:
    rng = np.random.default_rng(seed)
    center = rng.uniform(-50, 370, (count, 2))
    circles = Circles(center, rng.uniform(0.5, 200, count), rng.uniform(0, 1, count))
    color = rng.integers(0, 256, (30, 40, 3), np.uint8)
    assert clods(color, circles).shape == (count,)


def test_cap_fit_leaves_clods_out() -> None:
    circles = circles_of(30)
    color = bed(circles, tones_of(30, WHITE, {5: CLOD, 6: CLOD, 7: CLOD, 8: CLOD}))
    frame = RgbdFrame(Header(0, 0, "camera"), color)
    stage = CapFit(min_score=0.5)
    stage.open()
    _, _, kept = stage.process(frame, circles)
    assert len(kept) == 26
    _, _, all_of_them = CapFit(min_score=0.0).process(frame, circles)
    assert np.sort(all_of_them.score)[:4] == pytest.approx(np.full(4, CLOD_CHANCE))
