"""Which circle covers which pixel, and which of two is nearer, against plain loops."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from mushpipe.stages.cap.order import by_depth, paint

HEIGHT, WIDTH = 40, 60
PLACES = st.floats(-80, 120) | st.sampled_from([-1e9, -34980.0, 35020.0, 1e9])
RADII = st.floats(0.1, 90) | st.sampled_from([3.5e4, 1e9])


@given(st.lists(st.tuples(PLACES, PLACES, RADII), max_size=6), st.randoms())
def test_the_nearest_circle_paints_its_pixels(discs, random) -> None:  # type: ignore[no-untyped-def]
    circles = np.array(discs).reshape(-1, 3)
    order = np.array(random.sample(range(len(circles)), len(circles)), np.int64)
    ranks = np.full((HEIGHT, WIDTH), len(circles), np.int16)
    paint(ranks, circles, order)
    v, u = np.mgrid[:HEIGHT, :WIDTH].astype(float)
    lowest = np.full((HEIGHT, WIDTH), len(circles))
    unsure = np.zeros((HEIGHT, WIDTH), bool)
    for rank in range(len(circles) - 1, -1, -1):
        x, y, r = circles[order[rank]]
        away = np.hypot(u - x, v - y)
        lowest[away <= r] = rank
        unsure |= np.abs(away - r) < 1e-6 * r + 1e-9  # on the outline, to rounding
    assert (ranks == lowest)[~unsure].all()


@pytest.mark.parametrize("far", [0, 1])
def test_a_circle_without_depth_hides_nothing(far: int) -> None:
    depth = np.full((HEIGHT, WIDTH), 0.5, np.float32)
    depth[:, :30] = 0 if far == 0 else 0.4
    circles = np.array([[20.0, 20.0, 12.0], [36.0, 20.0, 12.0]])
    rank, ranks = by_depth(depth, circles)
    assert rank.tolist() == ([1, 0] if far == 0 else [0, 1])
    assert ranks[20, 28] == 0  # both cover it, the nearer one has it
    assert ranks[0, 0] == 2
