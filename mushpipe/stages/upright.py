"""Which way is up: the normal of the bed, from the depth image alone."""

from __future__ import annotations

import math
from functools import lru_cache
from typing import Annotated, Literal

import numpy as np
from pydantic import AfterValidator, Field

from mushpipe import Camera
from mushpipe.core.arrays import Floats, Singles
from mushpipe.core.jit import borrower
from mushpipe.stages.bed import CELL, far_cells, fit_plane

Vector = tuple[float, float, float]


def _with_direction(vector: Vector) -> Vector:
    if not 1e-9 <= math.hypot(*vector) <= 1e9:  # of numbers beyond 1e150 the square is infinite
        raise ValueError(
            "the upright has no direction: a vector needs a component that is not 0, and a length "
            "from 1e-9 to 1e9"
        )
    return vector


Up = Annotated[
    Literal["bed", "camera"] | Annotated[Vector, AfterValidator(_with_direction)],
    Field(
        description="the upright: the bed's normal, towards the camera, or a vector in its optical "
        "frame: an accelerometer's reading at rest, as 'mushpipe calibrate up' finds it"
    ),
]


def bed_normal(depth: Singles, rays: Singles) -> Floats | None:
    """Fit a plane to the bed and return its unit normal (3,), towards the camera.

    A plane a X + b Y + c Z = 1 seen along the ray (x, y, 1) is 1/z = a x + b y + c.

    Args:
        depth: (H, W) m, 0 = missing.
        rays: (H, W, 2) rays at z = 1.

    Returns:
        None where there is too little depth.
    """
    far = far_cells(depth, CELL)
    _look(far, rays)
    plane = fit_plane(far)
    if plane is None:
        return None
    c, a, b = plane
    return -np.array([a, b, c]) / float(np.linalg.norm(plane))


@borrower
def _look(far: Floats, rays: Singles) -> None:
    """Put the rays of cells (rows, columns, 3) in the place of their pixels; NaN without one."""
    for i in range(far.shape[0]):
        for j in range(far.shape[1]):
            x, y = rays[int(far[i, j, 1]), int(far[i, j, 0])]
            far[i, j, 0], far[i, j, 1] = x, y
            if x > 1e3:
                far[i, j, 2] = np.nan


@lru_cache(maxsize=4)
def pixel_rays(camera: Camera) -> Singles:
    """Return the rays (H, W, 2) of all pixels at z = 1; beyond 1e3 where the lens has none."""
    v, u = np.mgrid[: camera.height, : camera.width]
    points = camera.deproject(np.stack([u, v], axis=-1), np.ones(u.shape))[..., :2]
    rays = np.nan_to_num(points, nan=1e6).astype(np.float32)
    rays.flags.writeable = False
    return rays


def upright(up: Up, depth: Singles, rays: Singles) -> Floats:
    """Return which way is up, a unit vector (3,) in the optical frame.

    Args:
        up: A setting; where the bed has too little depth, towards the camera.
        depth: (H, W) m, 0 = missing.
        rays: (H, W, 2) rays at z = 1.
    """
    if isinstance(up, tuple):
        vector = np.array(up)
        return np.asarray(vector / np.linalg.norm(vector))
    normal = bed_normal(depth, rays) if up == "bed" else None
    return np.array([0.0, 0.0, -1.0]) if normal is None else normal
