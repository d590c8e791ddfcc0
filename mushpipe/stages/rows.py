"""Row i of circles, locations and poses is the same mushroom: what shows that it is not."""

from __future__ import annotations

import numpy as np

from mushpipe import Camera, Circles, Locations, Poses
from mushpipe.core.arrays import Bools, Floats

_ONE_CHAIN = (
    "circles, locations and poses must come from one chain; what sorts or filters circles belongs "
    "before the localizer"
)
# Radii from the middle of its circle: a location is seen there, the apex of a leaning cap up to two
# away. Neighbours are apart by two where they touch.
LOCATION_WITHIN = 1.0
POSE_WITHIN = 3.0
_ROUNDING = 1e-6  # px: to space and back


def require_same_rows(
    circles: Circles, locations: Locations, poses: Poses, camera: Camera | None
) -> None:
    """Check, as far as can be seen in the image, that no rows were mixed up.

    Raises:
        ValueError: The inputs differ in their number of rows, or are of different circles.
    """
    n = len(circles)
    if not n == len(locations) == len(poses):
        counts = f"{n} circles, {len(locations)} locations, {len(poses)} poses"
        raise ValueError(f"{counts}: {_ONE_CHAIN}")
    if camera is None:
        return
    _require_near(circles, camera.project(locations.position), "location", LOCATION_WITHIN)
    apex = camera.project(poses.apex)
    _require_near(circles, apex, "pose", POSE_WITHIN)
    _require_unexchanged(circles, apex)


def apart(seen: Floats, center: Floats, radius: Floats, within: float) -> Bools:
    """Return which of what is seen (N, 2), px, is farther than so many radii from its circle."""
    return np.asarray(np.linalg.norm(seen - center, axis=1) > within * radius + _ROUNDING)


def _require_near(circles: Circles, seen: Floats, what: str, within: float) -> None:
    """Raise ValueError where what is seen (N, 2), px, is farther than so many radii away."""
    away = apart(seen, circles.center, circles.radius, within)
    if away.any():
        row = int(np.flatnonzero(away)[0])
        (u, v), (x, y) = circles.center[row], seen[row]
        raise ValueError(
            f"row {row}: the circle is at ({u:.0f}, {v:.0f}), its {what} at ({x:.0f}, {y:.0f}): "
            f"{_ONE_CHAIN}"
        )


def _require_unexchanged(circles: Circles, apex: Floats) -> None:
    """Raise ValueError where two apexes (N, 2), px, lie in each other's circle, none in its own.

    One cap may lean over another, never each over the other.
    """
    outside = np.flatnonzero(np.linalg.norm(apex - circles.center, axis=1) > circles.radius)
    others = circles.take(outside)
    within = np.linalg.norm(apex[outside, None] - others.center, axis=2) < others.radius
    exchanged = np.argwhere(within & within.T)
    if len(exchanged):
        row, other = outside[exchanged[0]]
        raise ValueError(
            f"rows {row} and {other}: the pose of each is seen in the circle of the other: "
            f"{_ONE_CHAIN}"
        )
