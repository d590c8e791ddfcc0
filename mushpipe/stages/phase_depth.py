"""Height over the bed at half resolution, and its edges: what depth adds to a gray image.

The bed is a plane, which in inverse depth is affine in the pixel coordinates (see `bed`). It is
fitted here to a coarse grid of far depths by a kernel, within a fraction of a millisecond.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mushpipe import RgbdFrame
from mushpipe.core.jit import jit
from mushpipe.stages.phase_edges import Edges, Plane, depth_edges

CELL = 2  # px of the image per px of the height map
GRID = 12  # px of the height map per cell of the bed's fit
FILL = 8  # px of the height map: widest gap that is closed for edges
STEEP = 1.0  # slope of an edge, height over length
ROUGH = 0.003  # m; roughness of the bed that still counts as bed


@jit
def halved(depth: NDArray[Any], scale: float) -> Plane:
    """Return the mean of the valid depths of each 2 x 2 px in metres, NaN where there is none."""
    height, width = (depth.shape[0] + 1) // 2, (depth.shape[1] + 1) // 2
    out = np.empty((height, width), np.float32)
    for y in range(height):
        for x in range(width):
            total, count = np.float32(0), 0
            for v in range(2 * y, min(2 * y + 2, depth.shape[0])):
                for u in range(2 * x, min(2 * x + 2, depth.shape[1])):
                    value = np.float32(depth[v, u])
                    # a comparison is false for NaN too
                    if value > 0 and value < np.float32(1e9):
                        total += value
                        count += 1
            out[y, x] = total / count * np.float32(scale) if count else np.float32(-1)
    return out


@jit
def _far_cells(depth: Plane) -> NDArray[np.float64]:
    """Return (M, 3): x, y in -0.5..0.5 and depth of the third farthest sample of every cell.

    Its own place, not the cell's middle, since on a slope the far side of a cell lies off it.
    """
    height, width = depth.shape
    found = np.empty(((height // GRID + 1) * (width // GRID + 1), 3))
    count = 0
    for top in range(0, height - GRID + 1, GRID):
        for left in range(0, width - GRID + 1, GRID):
            a = b = c = np.float32(0)
            known = at_a = at_b = at_c = 0
            for y in range(top, top + GRID, 2):
                for x in range(left, left + GRID, 2):
                    value = depth[y, x]
                    if value <= 0:
                        continue
                    known += 1
                    if value > a:
                        a, b, c = value, a, b
                        at_a, at_b, at_c = y * width + x, at_a, at_b
                    elif value > b:
                        b, c = value, b
                        at_b, at_c = y * width + x, at_b
                    elif value > c:
                        c, at_c = value, y * width + x
            if known >= GRID:
                found[count, 0] = (at_c % width + 0.5) / width - 0.5
                found[count, 1] = (at_c // width + 0.5) / height - 0.5
                found[count, 2] = c
                count += 1
    return found[:count]


def bed_plane(depth: Plane) -> NDArray[np.float64] | None:
    """Return (3,) the inverse depth of the bed: constant, per width and per height of the image.

    Caps only rise above the bed: cells above the surface are dropped round by round (Tukey's
    biweight), those below it much later. None where there are too few cells.
    """
    cells = _far_cells(depth)
    if len(cells) < 6:
        return None
    basis: NDArray[Any] = np.column_stack([np.ones(len(cells)), cells[:, :2]])
    far = cells[:, 2]
    weight: NDArray[Any] = np.ones(len(cells))
    solution = np.zeros(3)
    for _ in range(10):
        weighted = basis * weight[:, None]
        normal = weighted.T @ basis + 1e-9 * np.eye(3)
        solution = np.linalg.solve(normal, weighted.T @ (1 / far))
        above = 1 / np.maximum(basis @ solution, 1e-3) - far
        scaled = np.where(above > 0, above / (2 * ROUGH), above / (6 * ROUGH))
        spread = max(1.0, float(np.median(np.abs(scaled))) * 1.5)
        weight = np.maximum(0, 1 - (scaled / spread) ** 2) ** 2 + 1e-6
    return solution


@jit
def _heights(depth: Plane, plane: NDArray[np.float64]) -> Plane:
    """Turn depths into heights over the plane; -1 m stands for unknown."""
    height, width = depth.shape
    out = np.empty_like(depth)
    for y in range(height):
        row = np.float32(plane[0] + plane[2] * ((y + 0.5) / height - 0.5) - plane[1] * 0.5)
        step = np.float32(plane[1] / width)
        for x in range(width):
            inverse = max(row + step * (np.float32(x) + np.float32(0.5)), np.float32(1e-3))
            value = depth[y, x]
            out[y, x] = 1 / inverse - value if value > 0 else np.float32(-1)
    return out


@jit
def closed(height: Plane) -> Plane:
    """Close gaps of up to `FILL` px along rows, then columns, by the lower of both ends.

    What hides behind a cap's rim, or in the shadow of the projector, lies low. Wider gaps stay.
    """
    out = height.copy()
    for turn in range(2):
        view = out if turn == 0 else out.T
        for y in range(view.shape[0]):
            last = -1
            for x in range(view.shape[1]):
                if view[y, x] == np.float32(-1):
                    continue
                if last >= 0 and 1 < x - last <= FILL + 1:
                    low = min(view[y, x], view[y, last])
                    for u in range(last + 1, x):
                        view[y, u] = low
                last = x
    return out


class Relief:
    """The height of what stands on the bed.

    Attributes:
        height: (h, w) m over the bed at half resolution, -1 where unknown.
        depth: (h, w) m, -1 where unknown.
        focal: px of the full image.
        pixel: Size of a pixel of the full image on the bed, m.
    """

    def __init__(self, depth: Plane, height: Plane, focal: float) -> None:
        self.depth, self.height, self.focal = depth, height, focal
        known = depth[depth > 0]
        self.pixel = float(np.median(known[:: max(1, len(known) // 2000)])) / focal

    def edges(self) -> Edges:
        """Return the depth discontinuities, in px of the height map; `pixels` is not kept up."""
        filled = closed(self.height)
        known = np.maximum(filled, 0)
        edges = depth_edges(known, STEEP * CELL * self.pixel)
        # Where depth ends, nothing is known to lie lower.
        u = np.rint(edges.x - 2.5 * edges.nx).astype(int).clip(0, known.shape[1] - 1)
        v = np.rint(edges.y - 2.5 * edges.ny).astype(int).clip(0, known.shape[0] - 1)
        real = filled[v, u] != -1
        kept = [column[real] for column in edges[:6]]
        return Edges(kept[0], kept[1], kept[2], kept[3], kept[4], kept[5], edges.pixels)


def relief_of(frame: RgbdFrame) -> Relief | None:
    """Return the relief of a frame; None without depth, calibration, or enough of a bed."""
    if frame.depth is None or frame.camera is None or min(frame.depth.shape) < 2 * GRID:
        return None
    depth = halved(frame.depth, frame.depth_scale)
    plane = bed_plane(depth)
    if plane is None or not math.isfinite(float(plane.sum())):
        return None
    return Relief(depth, _heights(depth, plane), (frame.camera.fx + frame.camera.fy) / 2)


NO_RELIEF = np.zeros((0, 0), np.float32)
