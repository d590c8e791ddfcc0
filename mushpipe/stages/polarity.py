"""Which side of a contour is the mushrooms: the one that is nearer to the camera."""

from __future__ import annotations

import numpy as np

from mushpipe import RgbdFrame
from mushpipe.core.arrays import Bools
from mushpipe.core.types import known
from mushpipe.stages.linear import least_squares

_STEP = 8
_FEWEST = 50


def rise(frame: RgbdFrame, region: Bools) -> float:
    """Return by how many metres a region stands above the rest; NaN where depth cannot tell.

    Least squares of inverse depth on 1, u, v and membership, from every eighth pixel each way: in
    inverse depth the bed is affine in u and v, however the camera is tilted.
    """
    if frame.depth is None:
        return float("nan")
    native = frame.depth[::_STEP, ::_STEP]
    depth = native * frame.depth_scale
    inside = region[::_STEP, ::_STEP]
    v, u = np.nonzero(known(native))
    member = inside[v, u]
    if min(member.sum(), (~member).sum()) < _FEWEST:
        return float("nan")
    inverse = 1 / np.asarray(depth[v, u], np.float64)
    height, width = depth.shape
    columns = np.column_stack([np.ones(len(u)), u / width, v / height, member])
    solution = least_squares(columns, inverse)
    return float(solution[3] / np.median(inverse) ** 2)
