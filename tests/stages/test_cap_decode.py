from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from mushpipe.stages.cap_decode import CHANNELS, HEAT, OFFSET, RADIUS, circles_of, first_of_each


def painted(circles: list[tuple[float, float, float]], peaks: list[float]) -> np.ndarray:
    """Maps (5, 30, 40) that say exactly these circles (x, y, r px), each with a peak (logit)."""
    maps = np.full((CHANNELS, 30, 40), -9.0, np.float32)
    v, u = np.mgrid[:30, :40]
    for (x, y, r), peak in zip(circles, peaks, strict=True):
        # cell k covers the pixels 4 k to 4 k + 3, so its middle is pixel 4 k + 1.5
        dx, dy = (x - 1.5) / 4 - u, (y - 1.5) / 4 - v
        heat = peak - (dx**2 + dy**2)
        nearer = heat > maps[HEAT]
        maps[HEAT][nearer] = heat[nearer]
        maps[RADIUS][nearer] = np.log(r / 4)
        maps[OFFSET][:, nearer] = np.stack([dx, dy])[:, nearer]
    return maps


def test_centres_and_radii_come_back_to_the_hundredth_of_a_pixel() -> None:
    wanted = [(40.3, 30.9, 12.0), (100.0, 81.7, 33.5), (140.2, 20.1, 8.25)]
    circles, score = circles_of(painted(wanted, [3.0, 2.0, 1.0]), 0.5)
    assert circles == pytest.approx(np.array(wanted), abs=0.01)
    assert (np.diff(score) < 0).all()
    assert score == pytest.approx(1 / (1 + np.exp(-np.array([3.0, 2.0, 1.0]))), abs=0.05)


def test_what_is_below_the_threshold_is_left_out() -> None:
    maps = painted([(40, 30, 12), (100, 80, 30)], [3.0, -1.0])
    assert len(circles_of(maps, 0.5)[0]) == 1
    assert len(circles_of(maps, 0.2)[0]) == 2
    assert len(circles_of(maps, 1.0)[0]) == 0


def test_a_peak_at_the_border_of_the_map_is_a_peak() -> None:
    circles, _ = circles_of(painted([(0.0, 0.0, 20.0), (158.0, 118.0, 20.0)], [2.0, 2.0]), 0.5)
    assert sorted(map(tuple, circles.round(2))) == [(0.0, 0.0, 20.0), (158.0, 118.0, 20.0)]


def test_maps_of_anything_give_finite_circles() -> None:
    maps = np.random.default_rng(0).normal(0, 50, (CHANNELS, 30, 40)).astype(np.float32)
    circles, score = circles_of(maps, 0.0)
    assert np.isfinite(circles).all()
    assert (circles[:, 2] > 0).all()
    assert ((score >= 0) & (score <= 1)).all()


def shared(a: np.ndarray, b: np.ndarray) -> float:
    """IoU of two circles by counting points of a fine grid."""
    v, u = np.mgrid[-30:60:0.1, -30:60:0.1]
    first = np.hypot(u - a[0], v - a[1]) < a[2]
    second = np.hypot(u - b[0], v - b[1]) < b[2]
    return float((first & second).sum() / (first | second).sum())


@settings(max_examples=15, deadline=None)
@given(st.lists(st.tuples(*[st.floats(0, 30)] * 2, st.floats(4, 20)), max_size=6))
def test_suppression_is_the_greedy_one(rows: list[tuple[float, float, float]]) -> None:
    circles = np.array(rows).reshape(-1, 3)
    kept: list[int] = []
    for k, circle in enumerate(circles):
        overlaps = [shared(circle, circles[j]) for j in kept]
        if any(abs(value - 0.4) < 0.01 for value in overlaps):
            return  # too near for the grid
        if all(value <= 0.4 for value in overlaps):
            kept.append(k)
    assert first_of_each(circles, 0.4).tolist() == kept
