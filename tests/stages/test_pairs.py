"""Distances and assignment, beside SciPy's."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import array_shapes, arrays
from numpy.typing import NDArray
from scipy.optimize import linear_sum_assignment
from scipy.spatial.distance import cdist

from mushpipe.stages.pairs import assigned, distances

# few values, so that many pairs are as good as others
COSTS = st.one_of(st.sampled_from([0.0, 0.25, 1.0, np.inf]), st.floats(0, 1.5))


@given(arrays(float, array_shapes(min_dims=2, max_dims=2, min_side=0, max_side=8), elements=COSTS))
def test_no_assignment_costs_less(pairs: NDArray[np.float64]) -> None:
    """As many pairs as there can be, at the least cost: a row alone costs more than all of them."""
    n = len(pairs)
    alone = np.where(np.eye(n, dtype=bool), 1e6, np.inf)
    cost = np.hstack([pairs, alone])
    columns = assigned(cost)
    assert len(set(columns.tolist())) == n
    rows, best = linear_sum_assignment(np.minimum(cost, 1e9))
    assert cost[np.arange(n), columns].sum() == pytest.approx(cost[rows, best].sum(), rel=1e-12)


def test_many_rows_that_want_the_same_column() -> None:
    rng = np.random.default_rng(3)
    cost = rng.random((60, 90)) ** 4
    rows, best = linear_sum_assignment(cost)
    assert cost[np.arange(60), assigned(cost)].sum() == pytest.approx(cost[rows, best].sum())


@pytest.mark.parametrize(("n", "m"), [(0, 0), (0, 3), (3, 0), (5, 7)])
def test_distances_are_those_of_scipy_and_unknown_where_a_place_is(n: int, m: int) -> None:
    rng = np.random.default_rng(n)
    a, b = rng.normal(size=(n, 3)), rng.normal(size=(m, 3))
    a[1:2], b[2:3, 1] = np.nan, np.nan
    expected = cdist(a, b) if n and m else np.zeros((n, m))
    np.testing.assert_allclose(distances(a, b), expected, rtol=1e-14)
