"""Steps of the height across an outline: what stands higher outside hides it."""

from __future__ import annotations

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
    if x < 0 or y < 0 or u >= height.shape[1] or v >= height.shape[0]:
        return -1.0
    return float(height[v, u])


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
    if inside == -1 or outside == -1:
        return 0.0
    return outside - inside
