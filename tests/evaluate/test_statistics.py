from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from mushpipe.evaluate import statistics

seeds = st.integers(0, 2**32 - 1)


@given(seeds, st.integers(1, 12))
@settings(max_examples=60, deadline=None)
def test_weighted_statistics_equal_those_of_repeated_rows(seed: int, n: int) -> None:
    rng = np.random.default_rng(seed)
    x, w = rng.normal(1, 2, n), rng.integers(0, 4, (5, n)).astype(float)
    plain = {
        statistics.mean: np.mean,
        statistics.std: np.std,
        statistics.mean_abs: lambda v: np.mean(np.abs(v)),
        statistics.median_abs: lambda v: np.median(np.abs(v)),
        statistics.p95_abs: lambda v: np.quantile(np.abs(v), 0.95),
    }
    for weighted, reference in plain.items():
        values = statistics.evaluate(weighted, x, w)
        for value, weights in zip(values, w.astype(int), strict=True):
            repeated = np.repeat(x, weights)
            if len(repeated):
                assert value == pytest.approx(reference(repeated), abs=1e-6)
            else:
                assert np.isnan(value)


def test_rows_that_are_not_known_do_not_count() -> None:
    x = np.array([1.0, np.nan, 3.0])
    assert statistics.evaluate(statistics.mean, x, np.array([[1.0, 5.0, 3.0]]))[0] == 2.5


def test_nothing_gives_nan() -> None:
    none, w = np.empty(0), np.ones((2, 0))
    for statistic in (statistics.mean, statistics.std, statistics.median_abs, statistics.dice):
        assert np.isnan(statistics.evaluate(statistic, none, w)).all()
    assert np.isnan(statistics.interval(np.array([np.nan]))).all()


def test_draws_are_seeded_and_complete() -> None:
    drawn = statistics.draw(7, 50, seed=3)
    assert drawn.shape == (50, 7)
    assert (drawn.sum(axis=1) == 7).all()
    assert (drawn == statistics.draw(7, 50, seed=3)).all()
    assert (drawn != statistics.draw(7, 50, seed=4)).any()


def test_the_interval_of_a_mean_covers_the_truth_about_as_often_as_it_says() -> None:
    rng = np.random.default_rng(0)
    covered = 0
    for trial in range(200):
        x = rng.normal(5, 1, 60)
        samples = statistics.evaluate(statistics.mean, x, statistics.draw(60, 300, trial))
        low, high = statistics.interval(samples)
        covered += low <= 5 <= high
    assert 0.88 <= covered / 200 <= 0.99
