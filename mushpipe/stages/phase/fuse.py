"""Gray and depth edges as one set: where both agree, the gray one is an outline."""

from __future__ import annotations

import numpy as np

from mushpipe.core.arrays import Bools, Ints32, Singles
from mushpipe.core.jit import jit
from mushpipe.stages.phase.depth import CELL
from mushpipe.stages.phase.edges import DEPTH_ALONE, Edges

REACH = 3  # px; so far a gray edge may lie from its depth edge
UNCONFIRMED = 0.4  # weight of a gray edge without a depth edge beside it
DEPTH_OUTWARD = 0.6  # px; a depth camera loses that much of a surface at its edge


@jit
def confirm(depth: Edges, gray: Edges, pixels: Ints32, trust: Singles) -> Bools:
    """Give the gray edges that a depth edge runs along their trust; return the edges without one.

    Args:
        depth: Edges (M) of depth, in the pixels of the image.
        gray: Edges whose weight is raised.
        pixels: (H, W) row of the gray edge at a pixel, -1 for none.
        trust: (N,) to what it is raised.

    Returns:
        (M,) True where there is no better gray edge of about the same direction.
    """
    height, width = pixels.shape
    alone, near = np.ones(len(depth.x), np.bool_), np.empty((2 * REACH + 1) ** 2, np.int32)
    for k in range(len(depth.x)):
        u, v, count = int(depth.x[k] + 0.5), int(depth.y[k] + 0.5), 0
        left, right = max(u - REACH, 0), min(u + REACH + 1, width)
        for row in range(max(v - REACH, 0), min(v + REACH + 1, height)):
            for column in range(left, right):
                j = pixels[row, column]
                near[count] = j
                count += j >= 0  # a branch would be guessed wrong
        for j in near[:count]:
            if depth.nx[k] * gray.nx[j] + depth.ny[k] * gray.ny[j] >= 0.8:
                alone[k] &= trust[j] <= DEPTH_ALONE
                gray.weight[j] = trust[j]
    return alone


def fused(gray: Edges, pixels: Ints32, depth: Edges) -> Edges:
    """Return gray edges, and the depth edges that lie where there is no gray one.

    A gray edge without a depth edge beside it may be a shadow, dirt or shading: it weighs less.

    Args:
        gray: Edges of the image.
        pixels: (H, W) row of the gray edge at a pixel, -1 for none.
        depth: Edges of a height map, in its pixels.
    """
    half = np.float32(0.5)
    x = (depth.x + half) * np.float32(CELL) - half - np.float32(DEPTH_OUTWARD) * depth.nx
    y = (depth.y + half) * np.float32(CELL) - half - np.float32(DEPTH_OUTWARD) * depth.ny
    raised = gray._replace(weight=gray.weight * np.float32(UNCONFIRMED))
    placed = depth._replace(x=x, y=y)
    alone = confirm(placed, raised, pixels, gray.weight)
    height, width = pixels.shape
    alone &= (x >= 0) & (y >= 0) & (x < width - 1) & (y < height - 1)
    pairs = zip(raised, placed, strict=True)
    return Edges(*(np.concatenate([one, other[alone]]) for one, other in pairs))
