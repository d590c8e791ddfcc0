"""Which way is up: the normal of the bed, from the depth image alone."""

from __future__ import annotations

from functools import lru_cache
from typing import Annotated, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from mushpipe import Camera
from mushpipe.core.jit import jit

Floats = NDArray[np.float64]
Up = Annotated[
    Literal["bed", "camera"] | tuple[float, float, float],
    Field(
        description="the upright: the bed's normal, towards the camera, or a vector in its frame"
    ),
]
CELL, STRIDE = 32, 8
_SAMPLES = (CELL // STRIDE) ** 2


@jit
def far_points(depth: NDArray[np.float32], rays: NDArray[np.float32], out: Floats) -> int:
    """Fill (M, 3) with the ray (x, y at z = 1) and the 90th percentile of depth of each cell."""
    values = np.empty(_SAMPLES)
    n = 0
    for v0 in range(0, depth.shape[0] - CELL + 1, CELL):
        for u0 in range(0, depth.shape[1] - CELL + 1, CELL):
            count = 0
            for v in range(v0, v0 + CELL, STRIDE):
                for u in range(u0, u0 + CELL, STRIDE):
                    if depth[v, u] > 0 and rays[v, u, 0] < 1e3:
                        values[count] = depth[v, u]
                        count += 1
            if count > 0.3 * _SAMPLES:
                middle = rays[v0 + CELL // 2, u0 + CELL // 2]
                far = np.sort(values[:count])[int(0.9 * count)]
                out[n, 0], out[n, 1], out[n, 2] = middle[0], middle[1], far
                n += 1
    return n


def bed_normal(
    depth: NDArray[np.float32], rays: NDArray[np.float32], rough: float = 0.003
) -> Floats | None:
    """Fit a plane to the bed and return its unit normal (3,), towards the camera.

    1/z = a x + b y + c for a plane a X + b Y + c Z = 1 seen along the ray (x, y, 1), so the fit is
    linear. Caps only ever rise above the bed: what stands above the plane loses its weight sooner
    than what lies below it.

    Args:
        depth: (H, W) m, 0 = missing.
        rays: (H, W, 2) rays at z = 1.
        rough: Roughness of the bed, m.

    Returns:
        None where there is too little depth.
    """
    cells = np.empty(((depth.shape[0] // CELL) * (depth.shape[1] // CELL), 3))
    points = cells[: far_points(depth, rays, cells)]
    if len(points) < 12:
        return None
    basis, inverse = np.insert(points[:, :2], 2, 1.0, axis=1), 1 / points[:, 2]
    weight = np.ones(len(points))
    for _ in range(8):
        weighted = basis * weight[:, None]
        plane = np.linalg.solve(weighted.T @ basis + 1e-9 * np.eye(3), weighted.T @ inverse)
        above = 1 / np.maximum(basis @ plane, 1e-3) - points[:, 2]
        scaled = above / np.where(above > 0, 2 * rough, 6 * rough)
        spread = max(1.0, 1.5 * float(np.median(np.abs(scaled))))
        weight = np.maximum(0, 1 - (scaled / spread) ** 2) ** 2 + 1e-6
    return np.asarray(-plane / np.linalg.norm(plane))


@lru_cache(maxsize=4)
def pixel_rays(camera: Camera) -> NDArray[np.float32]:
    """Return the rays (H, W, 2) of all pixels at z = 1; beyond 1e3 where the lens has none."""
    v, u = np.mgrid[: camera.height, : camera.width]
    points = camera.deproject(np.stack([u, v], axis=-1), np.ones(u.shape))[..., :2]
    rays = np.nan_to_num(points, nan=1e6).astype(np.float32)
    rays.flags.writeable = False
    return rays


def upright(up: Up, depth: NDArray[np.float32], rays: NDArray[np.float32]) -> Floats:
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
