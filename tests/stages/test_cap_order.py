"""Which circle covers which pixel, and which of two is nearer, against plain loops."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from mushpipe.stages.cap.order import by_depth, core_depth, paint

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


@given(st.integers(0, 99), st.floats(-5, 65), st.floats(-5, 45), st.floats(3, 30))
def test_the_depth_of_a_circle_is_the_median_of_what_is_seen_near_its_centre(
    seed: int, x: float, y: float, radius: float
) -> None:
    # places between pixels: rounding does not decide which
    x, y, radius = round(x, 1) + 0.037, round(y, 1) + 0.037, round(radius, 1)
    rng = np.random.default_rng(seed)
    depth = rng.uniform(0.4, 0.6, (HEIGHT, WIDTH)).astype(np.float32)
    depth[rng.random(depth.shape) < 0.2] = 0
    depth[rng.random(depth.shape) < 0.2] = np.nan
    steps = 0.24 * radius * np.arange(-2, 3)
    columns, rows = (np.floor(at + steps + 0.5).astype(int) for at in (x, y))
    places = [(u, v) for u in columns for v in rows]
    inside = [depth[v, u] for u, v in places if 0 <= u < WIDTH and 0 <= v < HEIGHT]
    valid = [z for z in inside if z > 0]
    found = core_depth(depth, np.array([x, y, radius]), np.empty(25, np.float32))
    assert found == pytest.approx(np.median(valid) if valid else 0.0)
