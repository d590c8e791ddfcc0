"""Thin edges against a slow reading of their definition with SciPy's interpolation."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter, map_coordinates

from mushpipe.stages.phase.edges import edges_of, gradient_of
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
