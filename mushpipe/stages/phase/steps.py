"""Steps of the height across an outline: what stands higher outside hides it."""

from __future__ import annotations

import numpy as np

from mushpipe.core.arrays import Floats, Singles
from mushpipe.core.jit import borrower

STEP_UP = 0.004  # m


@borrower
def step_up(radius: float) -> float:
    """Return the difference of heights (m) that counts as a step at a cap of a radius (m)."""
    return max(STEP_UP, 0.15 * radius)


@borrower
def height_at(height: Singles, x: float, y: float) -> float:
    """Return the height (m) at an image point; -1 where it is unknown."""
    u, v = int((x + 0.5) * 0.5), int((y + 0.5) * 0.5)
    right, bottom = height.shape[1] - 1, height.shape[0] - 1
    inside = (x >= 0) & (y >= 0) & (u <= right) & (v <= bottom)  # without branches, for SIMD
    value = height[np.uint32(min(max(v, 0), bottom)), np.uint32(min(max(u, 0), right))]
    return float(value) if inside else -1.0


@borrower
def _raise(
    plane: Singles, x: float, y: float, c: Singles, s: Singles, t: float, out: Singles
) -> None:
    """Raise values to the heights at a distance from a point, all in pixels of the height map."""
    height, width = np.int32(plane.shape[0]), np.int32(plane.shape[1])
    flat, nothing = plane.reshape(-1), np.float32(-1)
    x0, y0, far = np.float32(x + 0.5), np.float32(y + 0.5), np.float32(t)
    for k in range(len(c)):  # without branches, for SIMD
        u, v = x0 + far * c[k], y0 + far * s[k]
        column, row = np.int32(u), np.int32(v)
        inside = (u >= 0) & (v >= 0) & (column < width) & (row < height)
        z = flat[np.uint32(row * width + column) if inside else np.uint32(0)]
        out[k] = max(out[k], z if inside else nothing)


@borrower
def rises(height: Singles, shape: Floats, c: Singles, s: Singles, scratch: Singles) -> None:
    """Write by how much (m) the highest point just outside an outline lies over its inside.

    Negative where everything outside is lower; 0 where nothing is known.

    Args:
        height: (h, w) m at half resolution, -1 where unknown.
        shape: (5,) px of the image.
        c: (N,) cosines of the directions.
        s: (N,) their sines.
        scratch: (2, N) receives the rises in its first row.
    """
    scratch[:] = -1
    outside, inside = scratch
    x, y, radius = shape[0] / 2 - 0.25, shape[1] / 2 - 0.25, shape[2] / 2
    for share in (0.75, 0.85):
        _raise(height, x, y, c, s, share * radius, inside)
    for share in (1.12, 1.2, 1.28):
        _raise(height, x, y, c, s, share * radius + 0.75, outside)
    for k in range(len(c)):
        known = (inside[k] != -1) & (outside[k] != -1)
        outside[k] = outside[k] - inside[k] if known else np.float32(0)
