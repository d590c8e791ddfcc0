"""What a camera sees of a world: per pixel the surface, exactly, before light and noise."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from mushpipe.core.arrays import Bools, Bytes, Floats, Ints, Singles
from mushpipe.sim.mesh import Material
from mushpipe.sim.raycast import rays
from mushpipe.sim.world import View, World


@dataclass(frozen=True, eq=False)
class Surface:
    """The surface behind each of P = H*W pixels, row by row; lengths in m, bed frame.

    Attributes:
        shape: H and W.
        depth: (P,) along the optical axis.
        point: (P, 3).
        normal: (P, 3) unit, towards the camera, smooth over each surface.
        sight: (P, 3) unit, towards the camera.
        texture: (P, 3) coordinates for textures.
        material: (P,) `Material`.
        owner: (P,) number of the mushroom, -1 for everything else.
        outlined: (P,) bool, the part of a mushroom that its outline is drawn around.
        triangle: (P,) row of the world's triangles.
        corners: (P, 3) its vertices.
        weights: (P, 3) barycentric, of those.
    """

    shape: tuple[int, int]
    depth: Floats
    point: Singles
    normal: Singles
    sight: Singles
    texture: Singles
    material: Bytes
    owner: Ints
    outlined: Bools
    triangle: Ints
    corners: Ints
    weights: Singles

    def blend(self, values: Singles) -> Singles:
        """Interpolate a value per vertex, (V,) or (V, C), at each pixel."""
        return blend(values, self.corners, self.weights)

    def incidence(self) -> Singles:
        """Return the cosine (P,) between normal and sight: 1 head on, 0 grazing."""
        return np.asarray(np.einsum("pk,pk->p", self.normal, self.sight))


def blend(values: Singles, corners: Ints, weights: Singles) -> Singles:
    """Interpolate values per vertex, (V,) or (V, C), by barycentric weights (P, 3)."""
    out = np.zeros((len(corners), *values.shape[1:]), np.float32)
    for k in range(3):
        weight = weights[:, k].reshape(-1, *[1] * (values.ndim - 1))
        out += values[corners[:, k]] * weight
    return out


def look(world: World, view: View, pixels: Floats | None = None) -> Surface:
    """Cast a ray through the centre of every pixel, or through the given places (P, 2) px."""
    direction = view.directions(pixels)
    depth, triangle, shares = world.caster.first(rays(view.position, direction))
    point = (view.position + direction * depth[:, None]).astype(np.float32)
    corners, weights = world.triangles[triangle], shares.astype(np.float32)
    sight = -direction / np.linalg.norm(direction, axis=1, keepdims=True)
    sight = sight.astype(np.float32)
    normal = blend(world.normals, corners, weights)
    normal /= np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-12)
    away = np.einsum("pk,pk->p", normal, sight) < 0
    normal[away] -= 2 * np.einsum("pk,pk->p", normal[away], sight[away])[:, None] * sight[away]
    return Surface(
        (len(direction), 1) if pixels is not None else (view.camera.height, view.camera.width),
        depth,
        point,
        normal,
        sight,
        blend(world.texture, corners, weights),
        world.material[triangle],
        world.owner[triangle],
        world.outlined[triangle],
        triangle,
        corners,
        weights,
    )


def is_mushroom(material: Bytes) -> Bools:
    """Return (P,) whether a surface is mushroom: cap, underside, stem or cut."""
    return np.asarray((material >= Material.CAP) & (material <= Material.CUT))
