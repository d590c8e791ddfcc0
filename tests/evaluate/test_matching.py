from __future__ import annotations

import itertools
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from mushpipe.core.truth import Ignore
from mushpipe.evaluate.matching import assign, circle_iou, match
from mushpipe.evaluate.truth import FrameTruth
from tests.evaluate.scenes import bed

seeds = st.integers(0, 2**32 - 1)


def iou_of(a: tuple[float, float, float], b: tuple[float, float, float]) -> float:
    circles = np.array([a, b])
    return float(circle_iou(circles[:1, :2], circles[:1, 2], circles[1:, :2], circles[1:, 2])[0, 0])


def circles(*rows: tuple[float, float, float]) -> tuple[np.ndarray, np.ndarray]:
    array = np.array(rows, float).reshape(-1, 3)
    return array[:, :2], array[:, 2]


def truth_at(*rows: tuple[float, float, float], ignore: tuple[int, ...] = ()) -> FrameTruth:
    center, radius = circles(*rows)
    caps = bed(0).take(slice(0, len(rows)))
    reasons = np.array([*ignore, *[0] * (len(rows) - len(ignore))], np.uint8)
    return FrameTruth(replace(caps, center=center, radius=radius, ignore=reasons))


def test_iou_of_simple_cases() -> None:
    assert iou_of((0, 0, 5), (0, 0, 5)) == 1
    assert iou_of((0, 0, 5), (10, 0, 5)) == 0
    assert iou_of((0, 0, 5), (20, 0, 5)) == 0
    assert iou_of((0, 0, 10), (1, 0, 5)) == pytest.approx(0.25)
    # Two unit circles a radius apart share 2 pi / 3 - sqrt(3) / 2.
    lens = 2 * np.pi / 3 - np.sqrt(3) / 2
    assert iou_of((0, 0, 1), (1, 0, 1)) == pytest.approx(lens / (2 * np.pi - lens))


@given(
    st.floats(3, 30), st.floats(3, 30), st.floats(0, 50), st.floats(0, 2 * np.pi, exclude_max=True)
)
@settings(max_examples=40, deadline=None)
def test_iou_agrees_with_counting_pixels(a: float, b: float, d: float, turn: float) -> None:
    x, y = d * np.cos(turn), d * np.sin(turn)
    fine = np.linspace(-90, 90, 901)
    u, v = np.meshgrid(fine, fine)
    first = u**2 + v**2 <= a**2
    second = (u - x) ** 2 + (v - y) ** 2 <= b**2
    counted = (first & second).sum() / (first | second).sum()
    assert iou_of((0, 0, a), (x, y, b)) == pytest.approx(counted, abs=0.02)
    assert iou_of((x, y, b), (0, 0, a)) == pytest.approx(iou_of((0, 0, a), (x, y, b)), abs=1e-12)


def best_by_force(iou: np.ndarray, threshold: float) -> tuple[int, float]:
    """Largest number of pairs and then largest sum, over every partial one-to-one pairing."""
    if iou.shape[0] > iou.shape[1]:
        iou = iou.T
    n, m = iou.shape
    best = (0, 0.0)
    for columns in itertools.permutations(range(m), n):
        values = [iou[i, j] for i, j in enumerate(columns) if iou[i, j] >= threshold]
        best = max(best, (len(values), sum(values)))
    return best


@given(seeds, st.integers(0, 5), st.integers(0, 6), st.sampled_from([0.3, 0.5]))
@settings(max_examples=150, deadline=None)
def test_assignment_agrees_with_brute_force(seed: int, n: int, m: int, threshold: float) -> None:
    iou = np.random.default_rng(seed).uniform(0, 1, (n, m))
    rows, columns = assign(iou, threshold)
    assert len(set(rows)) == len(rows)
    assert len(set(columns)) == len(columns)
    count, total = best_by_force(iou, threshold)
    assert len(rows) == count
    assert iou[rows, columns].sum() == pytest.approx(total)


@given(seeds)
@settings(max_examples=50, deadline=None)
def test_f_agrees_with_an_independent_count_on_crowded_circles(seed: int) -> None:
    rng = np.random.default_rng(seed)
    n, m = rng.integers(0, 6, 2)
    true = [tuple(row) for row in rng.uniform((0, 0, 8), (30, 30, 14), (n, 3))]
    found = [tuple(row) for row in rng.uniform((0, 0, 8), (30, 30, 14), (m, 3))]
    iou = np.array([[iou_of(a, b) for b in found] for a in true]).reshape(n, m)
    count, _ = best_by_force(iou, 0.5)
    result = match(truth_at(*true), *circles(*found))
    assert len(result.truth) == count
    assert len(result.missed) == n - count
    assert len(result.false) == m - count


def test_more_pairs_go_before_better_pairs() -> None:
    # The first detection fits the first truth best, but only it can be the second one.
    iou = np.array([[0.9, 0.6], [0.55, 0.0]])
    rows, columns = assign(iou, 0.5)
    assert dict(zip(rows, columns, strict=True)) == {0: 1, 1: 0}


def test_ignored_truth_counts_neither_way() -> None:
    truth = truth_at((100, 100, 20), (200, 100, 20), ignore=(Ignore.COUNTS, Ignore.HIDDEN))
    hit = match(truth, *circles((100, 100, 20), (201, 100, 20), (199, 101, 20)))
    assert (list(hit.truth), list(hit.found), list(hit.ignored)) == ([0], [0], [1, 2])
    assert not len(hit.missed)
    assert not len(hit.false)
    nothing = match(truth, *circles())
    assert list(nothing.missed) == [0]
    # Near an ignored truth, but below the threshold: false.
    assert list(match(truth, *circles((215, 100, 20))).false) == [0]


def test_a_truth_that_counts_goes_before_an_ignored_one() -> None:
    truth = truth_at((100, 100, 20), (104, 100, 20), ignore=(Ignore.COUNTS, Ignore.AMBIGUOUS))
    result = match(truth, *circles((104, 100, 20)))
    assert list(result.truth) == [0]
    assert not len(result.ignored)


def test_may_find_excuses_by_the_centre_alone() -> None:
    truth = replace(truth_at((100, 100, 20)), may_find=np.array([[300.0, 300.0, 25.0]]))
    result = match(truth, *circles((310, 300, 3), (310, 300, 80), (326, 300, 20)))
    assert list(result.ignored) == [0, 1]
    assert list(result.false) == [2]
    assert list(result.missed) == [0]


def test_a_second_detection_of_a_mushroom_is_false() -> None:
    result = match(truth_at((100, 100, 20)), *circles((101, 100, 20), (100, 100, 20)))
    assert list(result.found) == [1]
    assert list(result.false) == [0]


def test_nothing_there_and_nothing_found() -> None:
    result = match(truth_at(), *circles())
    assert not any(map(len, vars(result).values()))
