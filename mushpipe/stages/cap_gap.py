"""How far outside of the edges of caps in colour those in depth lie.

A structured-light camera loses a little of each edge, a stereo camera shows caps wider than they
are, by what it matches at once. `cap-fit` takes that off, if it is told by how much.
"""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from mushpipe import Circles, RgbdFrame

Floats = NDArray[np.float64]
MOST, LEAST_RADIUS = 40, 14  # circles that are looked at: so many, of this radius, px, or more
_DIRECTIONS, _STEP = 32, 0.5  # px between places along a direction
_REACH, _SHARE = 8.0, 0.3  # looked at to both sides of a circle: px, or share of its radius
_DROP_M, _DROP_SHARE = 0.004, 0.25  # least fall of an edge in depth: m, or share of the radius
_WIDE = 2  # steps to either side that a fall of luma is taken over
_LEAST_FALL = 0.06  # of luma


def edge_gaps(frame: RgbdFrame, circles: Circles) -> Floats:
    """Return by how much edges in depth lie outside of those in colour (K,), px.

    Looked for along 32 directions across the largest circles, where all of the depth is known.

    Args:
        frame: With depth and calibration.
        circles: Outlines of caps.
    """
    if frame.camera is None:
        raise ValueError("a frame without calibration")
    large = np.argsort(-circles.radius, kind="stable")[:MOST]
    large = large[circles.radius[large] >= LEAST_RADIUS]
    depth = np.nan_to_num(frame.depth_m)
    found = [
        _gaps(frame.gray, depth, frame.camera.fx, circles.center[k], float(circles.radius[k]))
        for k in large
    ]
    return np.concatenate([np.zeros(0), *found])


def _gaps(
    gray: NDArray[np.float32], depth: NDArray[np.float32], fx: float, center: Floats, radius: float
) -> Floats:
    reach = min(_REACH, _SHARE * radius)
    away = np.arange(-reach, reach + 1e-6, _STEP)
    angle = np.arange(_DIRECTIONS)[:, None] * (2 * np.pi / _DIRECTIONS)
    x = (center[0] + np.cos(angle) * (radius + away)).astype(np.float32)
    y = (center[1] + np.sin(angle) * (radius + away)).astype(np.float32)
    height, width = gray.shape
    inside = ((x >= 0) & (x <= width - 1) & (y >= 0) & (y <= height - 1)).all(axis=1)
    luma = cv2.remap(gray, x[inside], y[inside], cv2.INTER_LINEAR)
    z = cv2.remap(depth, x[inside], y[inside], cv2.INTER_NEAREST)
    known = (z > 0).all(axis=1)
    luma, z = luma[known], z[known]
    if not len(z):
        return np.zeros(0)
    rows = np.arange(len(z))
    drop = z[:, 2:] - z[:, :-2]
    edge = drop.argmax(axis=1)
    last = drop.shape[1] - 1 - drop[:, ::-1].argmax(axis=1)  # a sheer drop is seen from both sides
    least = np.maximum(_DROP_M, _DROP_SHARE * radius * z[:, 0] / fx)
    fall = np.abs(luma[:, 2 * _WIDE :] - luma[:, : -2 * _WIDE])
    steepest = fall.argmax(axis=1)
    good = (drop[rows, edge] >= least) & (fall[rows, steepest] >= _LEAST_FALL)
    good &= (steepest > 0) & (steepest < fall.shape[1] - 1)  # at an end it may lie beyond
    middle = (away[edge + 1] + away[last + 1]) / 2
    return np.asarray(middle[good] - away[steepest[good] + _WIDE])
