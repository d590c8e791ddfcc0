"""Height over the bed at half resolution, and its edges: what depth adds to a gray image.

The bed is a plane here (see `bed`).
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from mushpipe import RgbdFrame
from mushpipe.core.arrays import Floats, Singles
from mushpipe.core.jit import inlined, jit
from mushpipe.core.types import end_of_scale
from mushpipe.stages.bed import far_cells, fit_plane, plane_depth
from mushpipe.stages.phase.edges import Edges, depth_edges

CELL = 2  # px of the image per px of the height map
GRID = 16  # px of the height map per cell of the bed's fit
FILL = 8  # px of the height map: widest gap that is closed for edges
FARTHEST = np.float32(1e9)  # native; beyond is no depth
STEEP = 1.0  # slope of an edge, height over length


def halved(depth: NDArray[Any], scale: float) -> Singles:
    """Return the mean of the valid depths of each 2 x 2 px in metres, -1 where there is none."""
    odd = depth.shape[0] % 2, depth.shape[1] % 2
    if any(odd):  # a row that stands twice changes no mean
        depth = np.pad(depth, ((0, odd[0]), (0, odd[1])), mode="edge")
    return _halved(depth, scale, min(FARTHEST, end_of_scale(depth)))


@inlined
def _if_known(value: Any, end: np.float32) -> Any:
    """Return 1 for a depth, 0 where there is none: a comparison is false for NaN too."""
    known = (value > np.float32(0)) & (value < end)
    return np.float32(1) if known else np.float32(0)


@jit
def _halved(depth: NDArray[Any], scale: float, end: np.float32) -> Singles:
    """Do the work of `halved` for an even size; without branches, so that SIMD does it."""
    height, width = depth.shape[0] // 2, depth.shape[1] // 2
    out = np.empty((height, width), np.float32)
    none, unit = np.float32(0), np.float32(scale)
    for y in range(height):
        above, below = depth[2 * y], depth[2 * y + 1]
        for x in range(width):
            a, b = np.float32(above[2 * x]), np.float32(above[2 * x + 1])
            c, d = np.float32(below[2 * x]), np.float32(below[2 * x + 1])
            i, j = _if_known(a, end), _if_known(b, end)
            k, n = _if_known(c, end), _if_known(d, end)
            total = (a if i > none else none) + (b if j > none else none)
            total += (c if k > none else none) + (d if n > none else none)
            count = i + j + k + n
            out[y, x] = total / count * unit if count > none else np.float32(-1)
    return out


@jit
def _heights(depth: Singles, plane: Floats) -> Singles:
    """Turn depths into heights over the plane of `fit_plane`; -1 m stands for unknown."""
    height, width = depth.shape
    out = np.empty_like(depth)
    for y in range(height):
        row, step = np.float32(plane[0] + plane[2] * y), np.float32(plane[1])
        for x in range(width):
            inverse = max(row + step * np.float32(x), np.float32(1e-3))
            value = depth[y, x]
            out[y, x] = 1 / inverse - value if value > 0 else np.float32(-1)
    return out


@jit
def closed(height: Singles) -> Singles:
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


class Relief(NamedTuple):
    """The height of what stands on the bed.

    Attributes:
        height: (h, w) m over the bed at half resolution, -1 where unknown; empty without depth.
        filled: (h, w) m, the same with narrow gaps `closed`.
        plane: (3,) of the bed at half resolution, from `fit_plane`.
        focal: px of the full image.
        pixel: Size of a pixel of the full image on the bed, m, in the middle of what is seen.
    """

    height: Singles
    filled: Singles
    plane: Floats
    focal: float
    pixel: float

    @property
    def known(self) -> bool:
        """Whether there is depth."""
        return len(self.height) > 0

    def bed_pixel(self, x: Any, y: Any) -> Floats:
        """Return the size, m, of a pixel of the full image on the bed at x, y (px)."""
        return plane_depth(self.plane, (x - 0.5) / CELL, (y - 0.5) / CELL) / self.focal

    def heights(self, discs: Floats) -> Floats:
        """Return heights (N,) m at the centres of discs x, y, r (N, 3) px; NaN where unknown."""
        bottom, right = (size - 1 for size in self.height.shape)
        u, v = ((discs[:, :2] + 0.5) / CELL).astype(int).T
        height = self.height[v.clip(0, bottom), u.clip(0, right)]
        return np.where(height == -1, np.nan, height)

    def edges(self) -> Edges:
        """Return the depth discontinuities, in px of the height map."""
        edges = depth_edges(np.maximum(self.filled, 0), STEEP * CELL * self.pixel)
        bottom, right = (size - 1 for size in self.filled.shape)
        # Where depth ends, nothing is known to lie lower.
        u = np.rint(edges.x - 2.5 * edges.nx).astype(int).clip(0, right)
        v = np.rint(edges.y - 2.5 * edges.ny).astype(int).clip(0, bottom)
        real = self.filled[v, u] != -1
        return Edges(*(column[real] for column in edges))


_NOTHING = np.zeros((0, 0), np.float32)
NO_RELIEF = Relief(_NOTHING, _NOTHING, np.zeros(3), focal=0.0, pixel=0.0)


def relief_of(frame: RgbdFrame) -> Relief:
    """Return the relief of a frame; none without depth, calibration, or enough of a bed."""
    if frame.depth is None or frame.camera is None or min(frame.depth.shape) < 2 * GRID:
        return NO_RELIEF
    depth = halved(frame.depth, frame.depth_scale)
    plane = fit_plane(far_cells(depth, GRID))
    if plane is None:
        return NO_RELIEF
    height, focal = _heights(depth, plane), frame.camera.focal
    known = depth[depth > 0]
    pixel = float(np.median(known[:: max(1, len(known) // 2000)])) / focal
    return Relief(height, closed(height), plane, focal, pixel)
