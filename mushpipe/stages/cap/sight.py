"""Fits of caps that the camera cannot have seen in their circles are none.

Of a cap at the border the image shows a sliver, and in a wide view, or far off the optical axis,
what is fitted to it may be anything: with its apex far outside of its circle, or behind the camera.
"""

from __future__ import annotations

from dataclasses import fields

import numpy as np

from mushpipe import Camera
from mushpipe.core.arrays import Floats
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
        away = apart(camera.project(points), fits.circle[:, :2], fits.circle[:, 2], within)
        unseen |= (points[:, 2] <= 0) | away
    for field in fields(fits):
        values = getattr(fits, field.name)
        values[unseen] = np.nan if values.dtype.kind == "f" else 0
    fits.circle[unseen] = circles[unseen]
