"""Fits of caps that the camera cannot have seen in their circles are none.

Of a cap at the border the image shows a sliver, and in a wide view, or far off the optical axis,
what is fitted to it may be anything: with its apex far outside of its circle, or behind the camera.
"""

from __future__ import annotations

from dataclasses import fields

import numpy as np

from mushpipe import Camera
from mushpipe.core.arrays import Bools, Floats
from mushpipe.stages.cap.batch import Fits
from mushpipe.stages.rows import LOCATION_WITHIN, POSE_WITHIN, apart


def drop_unseen(fits: Fits, circles: Floats, camera: Camera) -> None:
    """Take fits for none, in place, that are not seen where their circles are.

    Args:
        fits: In and out; such circles are again as detected.
        circles: (N, 3) x, y, radius, px, as detected.
        camera: Intrinsics.
    """
    unseen = np.zeros(len(circles), np.bool_)
    for points, within in ((fits.surface, LOCATION_WITHIN), (fits.apex, POSE_WITHIN)):
        unseen |= _unseen(points, fits.circle, camera, within)
    for field in fields(fits):
        values = getattr(fits, field.name)
        values[unseen] = np.nan if values.dtype.kind == "f" else 0
    fits.circle[unseen] = circles[unseen]


def _unseen(points: Floats, circles: Floats, camera: Camera, within: float) -> Bools:
    """Return which points (N, 3) lie behind the camera, or so many radii beside their circles."""
    away = apart(camera.project(points), circles[:, :2], circles[:, 2], within)
    return np.asarray((points[:, 2] <= 0) | away)
