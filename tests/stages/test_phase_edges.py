"""Thin edges against a slow reading of their definition with SciPy's interpolation."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter, map_coordinates

from mushpipe.stages.phase.edges import Edges, edges_of, gradient_of
from mushpipe.stages.phase.fuse import fused
from tests.stages.scenes import discs


def scene(name: str) -> np.ndarray:
    rng = np.random.default_rng(8)
    if name == "steps":  # gradients along the axes, exactly
        image = np.zeros((60, 80))
        image[20:41, 30:51] = 0.5
        image[21:40, 31:50] = 1
    elif name == "discs":
        image = discs([(30.3, 25.6, 12.0), (60.1, 40.2, 9.0)], 1, 0)[:60, :80]
    else:
        image = gaussian_filter(rng.random((60, 80)), 2)
    return np.asarray(255 * image, np.float32)


@pytest.mark.parametrize("name", ["steps", "discs", "noise"])
def test_edges_are_the_maxima_along_the_gradient(name: str) -> None:
    image = scene(name)
    gx, gy, size = gradient = gradient_of(image)
    region = np.ones(image.shape, np.uint8)
    region[:, :6] = 0
    threshold = float(np.quantile(size[size > 1e-3], 0.3))
    edges, index = edges_of(image, gradient, region, threshold, threshold)

    v, u = np.nonzero((size > threshold) & (region == 1))
    inner = (u >= 2) & (v >= 2) & (u < 78) & (v < 58)
    v, u = v[inner], u[inner]
    m = size[v, u].astype(float)
    nx, ny = gx[v, u] / m, gy[v, u] / m
    ahead, behind = (
        map_coordinates(size.astype(float), [v + way * ny, u + way * nx], order=1)
        for way in (1, -1)
    )
    clear = 1e-4 * m  # what is a maximum by less is a matter of rounding
    found = index[v, u] >= 0
    assert not found[(ahead > m + clear) | (behind > m + clear)].any()
    top = (ahead < m - clear) & (behind < m - clear)
    assert top.sum() > 50
    # In noise, pixels beside a higher one are left out before anything is interpolated.
    assert found[top].mean() > (0.9 if name == "noise" else 0.98)
    assert found.sum() == len(edges.x) == (index >= 0).sum()

    row = index[v, u][found]
    assert edges.nx[row] == pytest.approx(nx[found], abs=1e-5)
    assert edges.ny[row] == pytest.approx(ny[found], abs=1e-5)
    # Edges are moved along their normals, never across.
    across = (edges.y[row] - v[found]) * nx[found] - (edges.x[row] - u[found]) * ny[found]
    assert np.abs(across).max() < 1e-4


@pytest.mark.parametrize("period", [3, 5, 6, None])
def test_however_many_edges_there_are_all_have_room(period: int | None) -> None:
    stripes = np.random.default_rng(0).integers(0, 256, (64, 64)).astype(np.float32)
    if period:
        stripes = np.broadcast_to(255.0 * (np.arange(64) % period < period / 2), (64, 64))
    image = np.ascontiguousarray(stripes, np.float32)
    gradient = gradient_of(image)
    edges, index = edges_of(image, gradient, np.ones(image.shape, np.uint8), 1e-3, 1.0)
    assert index.max() == len(edges.x) - 1
    assert (index >= 0).sum() == len(edges.x)
    assert (index[60:] >= 0).any()


def column(x: float, rows: range, way: float, weight: float) -> Edges:
    """Edges one below the other, whose normals point to the right (1) or left (-1)."""
    y = np.array(rows, np.float32)
    parts = (np.full_like(y, x), y, np.full_like(y, way), np.zeros_like(y))
    return Edges(*parts, np.full_like(y, weight))


def test_a_depth_edge_confirms_the_gray_one_beside_it_and_stands_where_there_is_none() -> None:
    gray = column(50, range(20, 80), 1.0, 0.9)
    pixels = np.full((100, 120), -1, np.int32)
    pixels[20:80, 50] = np.arange(60)
    # rows 10 to 25 of the height map are rows 20 to 50 of the image; x = 24.5 is 49.5 there
    depth = column(24.5, range(10, 25), 1.0, 0.6)
    away = column(45.0, range(10, 25), 1.0, 0.6)
    turned = column(25.0, range(34, 38), -1.0, 0.6)  # rows 68 to 74
    beyond = column(59.7, range(10, 12), -1.0, 0.6)
    every = Edges(*map(np.concatenate, zip(depth, away, turned, beyond, strict=True)))
    both = fused(gray, pixels, every)
    assert (gray.weight == np.float32(0.9)).all()
    assert both.x[:60].tolist() == [50] * 60
    assert both.weight[20 - 20 : 48 - 20] == pytest.approx(np.full(28, 0.9))
    assert both.weight[54 - 20 : 80 - 20] == pytest.approx(np.full(26, 0.4 * 0.9))
    # a depth camera loses 0.6 px of a surface, so its edge lies that much farther out
    added = np.column_stack([both.x[60:], both.y[60:]])
    rows = 2 * np.arange(10, 25) + 0.5
    assert added[:15] == pytest.approx(np.column_stack([np.full(15, 90.5 - 0.6), rows]))
    rows = 2 * np.arange(34, 38) + 0.5
    assert added[15:] == pytest.approx(np.column_stack([np.full(4, 50.5 + 0.6), rows]))
    assert (both.weight[60:] == np.float32(0.6)).all()


@pytest.mark.parametrize("trust", [0.5, 0.7])
def test_beside_a_gray_edge_that_tells_less_the_depth_edge_stays(trust: float) -> None:
    gray, pixels = column(50, range(20, 40), 1.0, trust), np.full((100, 120), -1, np.int32)
    pixels[20:40, 50] = np.arange(20)
    both = fused(gray, pixels, column(24.5, range(11, 19), 1.0, 0.6))
    assert len(both.x) == 20 + (8 if trust < 0.6 else 0)


@pytest.mark.parametrize("first", [0.5, 0.7])
def test_one_gray_edge_that_tells_more_is_enough(first: float) -> None:
    left, right = column(49, range(20, 40), 1.0, first), column(51, range(20, 40), 1.0, 1.2 - first)
    gray = Edges(*map(np.concatenate, zip(left, right, strict=True)))
    pixels = np.full((100, 120), -1, np.int32)
    pixels[20:40, 49], pixels[20:40, 51] = np.arange(20), np.arange(20, 40)
    assert len(fused(gray, pixels, column(24.5, range(11, 19), 1.0, 0.6)).x) == 40
