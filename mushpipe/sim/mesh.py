"""Triangle meshes: surfaces of revolution, height fields, boxes, and their union."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from enum import IntEnum

import numpy as np

from mushpipe.core.arrays import Floats, Ints
from mushpipe.sim.noise import Reals


class Material(IntEnum):
    """What a surface is made of; decides how it is painted."""

    SOIL = 0
    CLOD = 1
    STONE = 2
    MYCELIUM = 3
    CAP = 4
    GILLS = 5
    VEIL = 6
    STEM = 7
    CUT = 8
    TABLE = 9
    PAPER = 10
    CARDBOARD = 11
    PLASTIC = 12
    METAL = 13
    FLOOR = 14
    TARGET = 15
    PEBBLE = 16


@dataclass(frozen=True)
class Mesh:
    """A surface of one material.

    Attributes:
        vertices: (V, 3) m, bed frame.
        triangles: (T, 3) rows of `vertices`, counter-clockwise seen from outside.
        texture: (V, 3) m, the coordinates its texture lives in.
        material: What it is made of.
    """

    vertices: Floats
    triangles: Ints
    texture: Floats
    material: Material

    def placed(self, rotation: Floats, position: Floats) -> Mesh:
        """Return the mesh rotated (3, 3), then moved (3,); its texture goes with it."""
        vertices = self.vertices @ rotation.T + position
        return Mesh(vertices, self.triangles, self.texture, self.material)


def quads(rows: int, columns: int, wrap: bool) -> Ints:
    """Return the triangles of a grid of rows x columns vertices, closed along a row if `wrap`."""
    index = np.arange(rows * columns).reshape(rows, columns)
    right = np.roll(index, -1, axis=1) if wrap else index[:, 1:]
    left = index if wrap else index[:, :-1]
    a, b, c, d = left[:-1], right[:-1], left[1:], right[1:]
    first, second = np.stack([a, c, b], axis=-1), np.stack([b, c, d], axis=-1)
    return np.concatenate([first.reshape(-1, 3), second.reshape(-1, 3)])


def sheet(rings: Floats, material: Material, texture: Floats | None = None) -> Mesh:
    """Close rings (n, m, 3) of points, top first and counter-clockwise, into a surface.

    A first or last ring that is a single point becomes a pole.
    """
    n, m, _ = rings.shape
    triangles = quads(n, m, wrap=True)
    for ring in (0, n - 1):
        if np.ptp(rings[ring], axis=0).max() < 1e-12:
            inside = (triangles >= ring * m) & (triangles < (ring + 1) * m)
            triangles = np.where(inside, ring * m, triangles)
    a, b, c = triangles.T
    triangles = triangles[(a != b) & (b != c) & (c != a)]
    texture = rings if texture is None else texture
    return Mesh(rings.reshape(-1, 3), triangles, texture.reshape(-1, 3), material)


def revolve(rho: Floats, z: Floats, segments: int) -> Floats:
    """Turn a profile (n,) about z into rings (n, segments, 3)."""
    turn = np.arange(segments) * (2 * np.pi / segments)
    x, y = rho[:, None] * np.cos(turn), rho[:, None] * np.sin(turn)
    return np.stack([x, y, np.broadcast_to(z[:, None], x.shape)], axis=-1)


def height_field(x: Reals, y: Reals, height: Reals, material: Material) -> Mesh:
    """Return the surface z = height (H, W) over columns x (W,) and rows y (H,), y descending."""
    grid = np.stack([*np.meshgrid(x, y), height], axis=-1)
    flat = grid.reshape(-1, 3).astype(np.float64)
    return Mesh(flat, quads(len(y), len(x), wrap=False), flat, material)


def box(size: Sequence[float], material: Material) -> Mesh:
    """Return a box (x, y, z) standing on z = 0, centred in x and y, with sharp edges."""
    corner = np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]]) / 2
    faces = []
    for axis in range(3):
        for side in (-0.5, 0.5):
            face = np.insert(corner, axis, side, axis=1)
            faces.append(face if (side > 0) == (axis != 1) else face[::-1])
    vertices = (np.concatenate(faces) + np.array([0, 0, 0.5])) * np.asarray(size)
    first = np.arange(6)[:, None] * 4
    triangles = np.concatenate([first + np.array([0, 1, 2]), first + np.array([0, 2, 3])])
    return Mesh(vertices, triangles, vertices, material)


def vertex_normals(vertices: Floats, triangles: Ints) -> Floats:
    """Return unit normals (V, 3): the area-weighted mean of the triangles around a vertex."""
    a, b, c = (vertices[triangles[:, k]] for k in range(3))
    face = np.cross(b - a, c - a)
    corners, total = triangles.ravel(), np.empty_like(vertices)
    for axis in range(3):
        weights = np.repeat(face[:, axis], 3)
        total[:, axis] = np.bincount(corners, weights, len(vertices))
    length = np.linalg.norm(total, axis=1, keepdims=True)
    return np.asarray(total / np.maximum(length, 1e-30))
