"""Gray and depth edges as one set: where both agree, the gray one is an outline."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from mushpipe.core.jit import jit
from mushpipe.stages.phase_edges import DEPTH_ALONE, Edges, Rows, Singles

UNCONFIRMED = 0.4  # weight of a gray edge without a depth edge beside it
DEPTH_OUTWARD = 0.6  # px; a depth camera loses that much of a surface at its edge


@jit
def confirm(
    x: Singles, y: Singles, nx: Singles, ny: Singles, gray: Edges, trust: Singles, reach: int
) -> NDArray[np.bool_]:
    """Give the gray edges that a depth edge runs along their trust; return the edges without one.

    Args:
        x: (M,) px, depth edges in the pixels of the image.
        y: (M,) px.
        nx: (M,) unit normals.
        ny: (M,)
        gray: Edges whose weight is raised.
        trust: (N,) to what it is raised.
        reach: How far (px) a gray edge may lie from its depth edge.

    Returns:
        (M,) True where there is no better gray edge of about the same direction.
    """
    height, width = gray.pixels.shape
    alone = np.ones(len(x), np.bool_)
    for k in range(len(x)):
        u, v = int(x[k] + 0.5), int(y[k] + 0.5)
        for row in range(max(v - reach, 0), min(v + reach + 1, height)):
            for column in range(max(u - reach, 0), min(u + reach + 1, width)):
                j = gray.pixels[row, column]
                if j < 0 or nx[k] * gray.nx[j] + ny[k] * gray.ny[j] < 0.8:
                    continue
                if trust[j] > DEPTH_ALONE:
                    alone[k] = False
                gray.weight[j] = trust[j]
    return alone


@jit
def enter(index: Rows, x: Singles, y: Singles, rows: Rows) -> None:
    """Enter edge points into the index: over what is there, and where it is empty next to them.

    Points of a coarser grid leave gaps, through which a ray across the outline would slip.
    """
    for k in range(len(x)):
        index[int(y[k] + 0.5), int(x[k] + 0.5)] = rows[k]
    for k in range(len(x)):
        u, v = int(x[k] + 0.5), int(y[k] + 0.5)
        for row in range(max(v - 1, 0), min(v + 2, index.shape[0])):
            for column in range(max(u - 1, 0), min(u + 2, index.shape[1])):
                if index[row, column] < 0:
                    index[row, column] = rows[k]


def fused(gray: Edges, depth: Edges, scale: float) -> Edges:
    """Return gray edges, and the depth edges that lie where there is no gray one.

    A gray edge without a depth edge beside it may be a shadow, dirt or shading: it weighs less.

    Args:
        gray: Edges of the image.
        depth: Edges of a height map.
        scale: Size of a pixel of the height map in image pixels.
    """
    half = np.float32(0.5)
    x = (depth.x + half) * np.float32(scale) - half - np.float32(DEPTH_OUTWARD) * depth.nx
    y = (depth.y + half) * np.float32(scale) - half - np.float32(DEPTH_OUTWARD) * depth.ny
    weight = gray.weight * np.float32(UNCONFIRMED)
    raised = gray._replace(weight=weight)
    alone = confirm(x, y, depth.nx, depth.ny, raised, gray.weight, 3)
    height, width = gray.pixels.shape
    alone &= (x >= 0) & (y >= 0) & (x < width - 1) & (y < height - 1)
    rows = np.arange(len(gray.x), len(gray.x) + int(alone.sum()), dtype=np.int32)
    enter(gray.pixels, x[alone], y[alone], rows)
    return Edges(
        np.concatenate([gray.x, x[alone]]),
        np.concatenate([gray.y, y[alone]]),
        np.concatenate([gray.nx, depth.nx[alone]]),
        np.concatenate([gray.ny, depth.ny[alone]]),
        np.concatenate([weight, depth.weight[alone]]),
        gray.pixels,
    )
