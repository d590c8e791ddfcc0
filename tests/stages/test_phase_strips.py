"""Edge points in strips, against looking at every point there is."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray

from mushpipe.stages.phase.edges import Edges
from mushpipe.stages.phase.scratch import scratch_for
from mushpipe.stages.phase.strips import (
    ALIGNED,
    RAY,
    TURNED,
    Strips,
    gather,
    in_strips,
    outline_hits,
)

Points = NDArray[np.float64]
NOTHING = np.zeros((0, 0), np.float32)
SHAPES = st.tuples(
    st.floats(-20, 180), st.floats(-20, 140), st.floats(5, 90), st.floats(-4, 4), st.floats(-4, 4)
)


def scattered(seed: int, width: int = 160, height: int = 120, count: int = 1500) -> Edges:
    """Edge points at places and with normals at random, a few beyond the image."""
    rng = np.random.default_rng(seed)
    x, y = rng.uniform(-2, width + 2, count), rng.uniform(-2, height + 2, count)
    angle, weight = rng.uniform(0, 2 * np.pi, count), rng.uniform(0.1, 1, count)
    columns = (x, y, np.cos(angle), np.sin(angle), weight)
    return Edges(*(column.astype(np.float32) for column in columns))


def seen_from(
    edges: Strips, shape: NDArray[np.float64]
) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
    """Return the angle of all points, their distance from an outline, the cosine to its inside."""
    dx, dy = edges.x - shape[0], edges.y - shape[1]
    angle, d = np.arctan2(dy, dx), np.hypot(dx, dy)
    outline = shape[2] + shape[3] * np.cos(2 * angle) + shape[4] * np.sin(2 * angle)
    facing = -(np.cos(angle) * edges.nx + np.sin(angle) * edges.ny)
    return angle, np.where(d < 1, np.inf, abs(d - outline)), facing


def test_strips_only_reorder() -> None:
    old, new = np.stack(scattered(1)), np.stack(in_strips(scattered(1), 120, 160)[:5])
    assert (old[:, np.lexsort(old)] == new[:, np.lexsort(new)]).all()


@given(seed=st.integers(0, 5), shape=SHAPES, reach=st.floats(1, 30))
def test_all_points_around_an_outline_are_found(
    seed: int, shape: tuple[float, ...], reach: float
) -> None:
    edges, outline = in_strips(scattered(seed), 120, 160), np.array(shape)
    scratch = scratch_for(len(edges.x))
    found = scratch.rows[: gather(edges, NOTHING, 0.0, outline, reach, scratch)]
    _, off, facing = seen_from(edges, outline)
    surely = (off < reach - 1e-3) & (facing > TURNED + 1e-3)
    perhaps = (off < reach + 1e-3) & (facing > TURNED - 1e-3)
    assert set(np.flatnonzero(surely)) <= set(found) <= set(np.flatnonzero(perhaps))
    assert len(set(found)) == len(found)


@pytest.mark.parametrize("place", [(-20.0, 60.0), (80.0, -20.0), (180.0, 60.0), (80.0, 140.0)])
def test_points_beyond_the_image_are_found_from_beyond_it(place: tuple[float, float]) -> None:
    edges, outline = in_strips(scattered(3), 120, 160), np.array([*place, 20.0, 0.0, 0.0])
    scratch = scratch_for(len(edges.x))
    found = scratch.rows[: gather(edges, NOTHING, 0.0, outline, 4.0, scratch)]
    _, off, facing = seen_from(edges, outline)
    assert set(found) == set(np.flatnonzero((off < 4) & (facing > TURNED)))
    assert len(found) > 0


def test_none_where_something_higher_hides_the_outline() -> None:
    edges, outline = in_strips(scattered(2), 120, 160), np.array([80.0, 60.0, 30.0, 0.0, 0.0])
    height = np.zeros((60, 80), np.float32)
    height[:, 56:] = 0.05  # from x = 112 on, 2 px beyond the outline's rightmost point
    scratch = scratch_for(len(edges.x))
    found = scratch.rows[: gather(edges, height, 0.01, outline, 6.0, scratch)]
    angle, off, facing = seen_from(edges, outline)
    around = np.flatnonzero((off < 5.99) & (facing > TURNED + 1e-3))
    hidden = around[abs(angle[around]) < np.radians(15)]
    free = around[abs(angle[around]) > np.radians(60)]
    assert len(hidden) > 3
    assert not set(hidden) & set(found)
    assert set(free) <= set(found)


@given(seed=st.integers(0, 5), shape=SHAPES, n=st.integers(20, 96))
def test_each_direction_gets_its_nearest_point(seed: int, shape: tuple[float, ...], n: int) -> None:
    edges, outline, near = in_strips(scattered(seed), 120, 160), np.array(shape), 4.0
    hits, scratch = np.zeros(96, np.int32), scratch_for(len(edges.x))
    count, rms = outline_hits(edges, outline, near, n, hits, scratch)
    angle, off, facing = seen_from(edges, outline)
    turn = angle % (2 * np.pi) / (2 * np.pi) * n
    beside = abs(turn - np.rint(turn)) * 2 * np.pi * outline[2] / n
    surely = (off < near - 1e-2) & (facing > ALIGNED + 1e-3) & (beside < RAY - 1e-2)
    perhaps = (off < near + 1e-2) & (facing > ALIGNED - 1e-3) & (beside < RAY + 1e-2)
    direction = np.rint(turn).astype(int) % n
    for k in range(n):
        sure, maybe = np.flatnonzero(surely & (direction == k)), perhaps & (direction == k)
        if hits[k] < 0:
            assert len(sure) == 0
            continue
        assert maybe[hits[k]]
        assert off[hits[k]] <= off[sure].min(initial=np.inf) + 2e-3
    assert count == (hits[:n] >= 0).sum()
    assert (hits[n:] == -2).all()
    if count:
        assert rms == pytest.approx(np.sqrt((off[hits[:n][hits[:n] >= 0]] ** 2).mean()), abs=2e-3)
