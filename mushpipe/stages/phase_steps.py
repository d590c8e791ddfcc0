"""Steps of the height across an outline: what stands higher outside hides it."""

from __future__ import annotations

import numpy as np

from mushpipe.core.jit import jit
from mushpipe.stages.phase_edges import Plane

STEP_UP = 0.004  # m


@jit
def step_up(radius: float) -> float:
    """Return the difference of heights (m) that counts as a step at a cap of a radius (m)."""
    return max(STEP_UP, 0.15 * radius)


@jit
def height_at(height: Plane, x: float, y: float) -> float:
    """Return the height (m) at an image point; -1 where it is unknown."""
    u, v = int((x + 0.5) * 0.5), int((y + 0.5) * 0.5)
    right, bottom = height.shape[1] - 1, height.shape[0] - 1
    inside = (x >= 0) & (y >= 0) & (u <= right) & (v <= bottom)  # without branches, for SIMD
    value = height[np.uint32(min(max(v, 0), bottom)), np.uint32(min(max(u, 0), right))]
    return float(value) if inside else -1.0


@jit
def rise(height: Plane, x: float, y: float, c: float, s: float, radius: float) -> float:
    """Return by how much (m) the highest point just outside an outline lies over its inside.

    Negative where everything outside is lower; 0 where nothing is known.
    """
    inside = max(
        height_at(height, x + 0.75 * radius * c, y + 0.75 * radius * s),
        height_at(height, x + 0.85 * radius * c, y + 0.85 * radius * s),
    )
    outside = -1.0
    for k in range(3):
        t = radius * (1.12 + 0.08 * k) + 1.5
        outside = max(outside, height_at(height, x + t * c, y + t * s))
    return outside - inside if (inside != -1) & (outside != -1) else 0.0
