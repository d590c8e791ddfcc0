"""Triangle meshes with a colour at each vertex, and the noise that roughens and paints them."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from mushpipe.core.arrays import Floats, Ints

_WAVES = 40


@dataclass(frozen=True, eq=False)
class Mesh:
    """A surface.

    Attributes:
        vertices: (V, 3) m.
        triangles: (T, 3) rows of `vertices`.
        colors: (V, 3) albedo, linear RGB in 0..1.
    """

    vertices: Floats
    triangles: Ints
    colors: Floats

    def placed(self, rotation: Floats, position: Floats) -> Mesh:
        """Return the mesh turned by a (3, 3) rotation, then moved by (3,) m."""
        return replace(self, vertices=self.vertices @ rotation.T + position)


def joined(meshes: list[Mesh]) -> Mesh:
    """Return several meshes as one."""
    first = np.cumsum([0] + [len(mesh.vertices) for mesh in meshes[:-1]])
    return Mesh(
        np.concatenate([mesh.vertices for mesh in meshes]),
        np.concatenate([mesh.triangles + k for mesh, k in zip(meshes, first, strict=True)]),
        np.concatenate([mesh.colors for mesh in meshes]),
    )


def waves(points: Floats, grain: float, rng: np.random.Generator) -> Floats:
    """Return smooth noise (...,) of mean 0 and variance 1 at points (..., 3) m.

    A sum of plane waves of random directions, with wavelengths of about twice the grain (m).
    """
    direction = rng.normal(size=(_WAVES, 3))
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    number = np.pi / grain * rng.uniform(0.4, 1.8, (_WAVES, 1)) * direction
    phase = rng.uniform(0, 2 * np.pi, _WAVES)
    total = np.zeros(points.shape[:-1])
    for k, p in zip(number, phase, strict=True):
        total += np.cos(points @ k + p)
    return np.asarray(total * np.sqrt(2 / _WAVES))


def mixed(colors: Floats, other: Floats, share: Floats) -> Floats:
    """Return colours (V, 3) with a share (V,) of another colour (3,)."""
    return np.asarray(colors + np.clip(share, 0, 1)[:, None] * (other - colors))
