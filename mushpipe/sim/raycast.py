"""Ray casting on a triangle mesh; the only module that knows open3d.

One thread, so that the same rays give the same bytes.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from mushpipe.core.arrays import Bools, Floats, Ints, Singles
from mushpipe.core.libraries import import_open3d
from mushpipe.sim.noise import Reals


class Raycaster:
    """Casts rays at triangles, with Embree as open3d's `RaycastingScene` wraps it.

    A ray is a row (6,) of float32: origin and direction; distances come in lengths of its
    direction.

    Args:
        vertices: (V, 3) m.
        triangles: (T, 3) rows of `vertices`.

    Raises:
        DependencyError: open3d or a library of the system is missing.
    """

    def __init__(self, vertices: Floats, triangles: Ints) -> None:
        self._core = import_open3d()
        self._scene = self._core.t.geometry.RaycastingScene(nthreads=1)
        self._scene.add_triangles(
            self._tensor(vertices.astype(np.float32)), self._tensor(triangles.astype(np.uint32))
        )

    def _tensor(self, array: NDArray[Any]) -> Any:
        return self._core.core.Tensor(np.ascontiguousarray(array))

    def first(self, rays: Singles) -> tuple[Floats, Ints, Floats]:
        """Return what rays (N, 6) hit first.

        Returns:
            Distance (N,), inf where nothing; triangle (N,), -1 where none; and barycentric weights
            (N, 3) of its corners.
        """
        if not len(rays):  # Embree as open3d calls it crashes on none
            return np.empty(0), np.empty(0, np.int64), np.empty((0, 3))
        hit = self._scene.cast_rays(self._tensor(rays), nthreads=1)
        distance = hit["t_hit"].numpy().astype(np.float64)
        uv = hit["primitive_uvs"].numpy().astype(np.float64)
        weights = np.stack([1 - uv[:, 0] - uv[:, 1], uv[:, 0], uv[:, 1]], axis=-1)
        triangle = hit["primitive_ids"].numpy().astype(np.int64)
        return distance, np.where(np.isfinite(distance), triangle, -1), weights

    def blocked(self, rays: Singles, far: float) -> Bools:
        """Return (N,) whether anything stands on a ray before the distance `far`."""
        if not len(rays):
            return np.empty(0, np.bool_)
        found = self._scene.test_occlusions(self._tensor(rays), 0.0, far, nthreads=1)
        return np.asarray(found.numpy(), np.bool_)

    def every(self, rays: Singles) -> tuple[Ints, Floats, Ints]:
        """Return all crossings (M,) of rays (N, 6): ray, distance and triangle."""
        if not len(rays):
            return np.empty(0, np.int64), np.empty(0), np.empty(0, np.int64)
        hit = self._scene.list_intersections(self._tensor(rays), nthreads=1)
        return (
            hit["ray_ids"].numpy().astype(np.int64),
            hit["t_hit"].numpy().astype(np.float64),
            hit["primitive_ids"].numpy().astype(np.int64),
        )


def rays(origins: Reals, directions: Reals) -> Singles:
    """Return rays (N, 6) float32 from origins (N, 3) or (3,) and directions (N, 3)."""
    out = np.empty((len(directions), 6), np.float32)
    out[:, :3], out[:, 3:] = origins, directions
    return out
