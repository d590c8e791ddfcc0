"""A scene as one mesh: ground, mushrooms and everything else, ready for rays."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from mushpipe import Camera
from mushpipe.core.arrays import Bools, Bytes, Floats, Ints, Singles
from mushpipe.sim import ground as grounds
from mushpipe.sim import table as tables
from mushpipe.sim.ground import Ground
from mushpipe.sim.mesh import Material, Mesh, box, vertex_normals
from mushpipe.sim.mushroom import Mushroom, build
from mushpipe.sim.noise import generator
from mushpipe.sim.planting import Area, plant
from mushpipe.sim.raycast import Raycaster
from mushpipe.sim.settings import SceneSettings


@dataclass(frozen=True, eq=False)
class World:
    """All surfaces of a scene, in the bed frame.

    Attributes:
        ground: What everything stands on.
        mushrooms: All of them; row i is number i.
        vertices: (V, 3) m.
        normals: (V, 3) unit, smoothed over each surface.
        texture: (V, 3) m, coordinates for textures.
        triangles: (T, 3) rows of `vertices`.
        material: (T,) `Material`.
        owner: (T,) number of the mushroom, -1 for everything else.
        outlined: (T,) bool, the part of a mushroom that its outline is drawn around.
        bodies: Of each mushroom, the rows of `vertices` of that part.
        caster: Casts rays at the triangles.
    """

    ground: Ground
    mushrooms: list[Mushroom]
    vertices: Floats
    normals: Singles
    texture: Singles
    triangles: Ints
    material: Bytes
    owner: Ints
    outlined: Bools
    bodies: list[slice]
    caster: Raycaster


@dataclass(frozen=True, eq=False)
class View:
    """A camera in the bed frame.

    Attributes:
        camera: Its intrinsics.
        rotation: (3, 3), from the camera's optical frame to the bed frame.
        position: (3,) m in the bed frame.
    """

    camera: Camera
    rotation: Floats
    position: Floats

    def directions(self, pixels: Floats | None) -> Floats:
        """Return directions (P, 3) through pixels (P, 2), all where None, of length 1 along z."""
        if pixels is None:
            v, u = np.mgrid[: self.camera.height, : self.camera.width].reshape(2, -1)
            pixels = np.stack([u, v], axis=-1).astype(np.float64)
        return self.camera.deproject(pixels, np.ones(len(pixels))) @ self.rotation.T

    def seen(self, points: Floats) -> Floats:
        """Take points (N, 3) m from the bed frame to the optical frame."""
        return np.asarray((points - self.position) @ self.rotation)


def view_at(settings: SceneSettings, along: float) -> View:
    """Return the camera after the gantry moved `along` m in x; it looks at the bed below it."""
    tilt = np.radians(settings.camera_tilt_deg)
    c, s = np.cos(tilt), np.sin(tilt)
    lean = np.array([[1, 0, 0], [0, c, s], [0, -s, c]])
    rotation = lean @ np.diag([1.0, -1.0, -1.0])
    back = -settings.distance * rotation[:, 2]
    return View(settings.camera(), rotation, back + np.array([along, 0.0, 0.0]))


def area_in_view(settings: SceneSettings, travel: float) -> tuple[Area, float]:
    """Return the part of the bed that comes into view, and its area over one view's area."""
    x, y = settings.width / 2 * settings.pixel(), settings.height / 2 * settings.pixel()
    y += settings.distance * np.tan(np.radians(settings.camera_tilt_deg)) * 0.5
    area = Area(-x, x + travel, -y, y)
    return area, (2 * x + travel) / (2 * x)


def make_world(settings: SceneSettings, travel: float = 0.0) -> World:
    """Build the scene that a camera sees on its way of `travel` m along x.

    Raises:
        DependencyError: open3d or a library of the system is missing.
    """
    view, share = area_in_view(settings, travel)
    rng, pixel = generator(settings.seed, "ground"), settings.pixel()
    wide, texel = view.grown(0.16 * settings.distance + 0.01), 0.75 * pixel
    if settings.scene == "bed":
        base = grounds.soil(wide, texel, settings.soil, settings.mycelium, rng)
        if settings.relief_mm or settings.wet:
            weather = generator(settings.seed, "relief")
            base = grounds.weathered(base, settings.relief_mm / 1000, settings.wet, weather)
    elif settings.scene == "lab":
        base = tables.table(settings.table, wide, texel, rng)
    else:
        base = tables.target(wide, texel)
    mushrooms = _mushrooms(settings, view, share, base)
    things = _things(settings, view, share, base, mushrooms, rng)
    step = 3.4 if settings.scene == "bed" else 6.0
    return assemble(base, mushrooms, [base.mesh(step * pixel), *things], pixel)


def _mushrooms(settings: SceneSettings, view: Area, share: float, base: Ground) -> list[Mushroom]:
    if settings.scene == "plane":
        return []
    left = view.x0 + (0.16 * (view.x1 - view.x0) / share if settings.tray else 0.0)
    inside = Area(left, view.x1, view.y0, view.y1)
    rng = generator(settings.seed, "plant")
    return plant(settings, inside, share, base.height_at, rng)


def _things(
    settings: SceneSettings,
    view: Area,
    share: float,
    base: Ground,
    mushrooms: list[Mushroom],
    rng: np.random.Generator,
) -> list[Mesh]:
    floor = box((20.0, 20.0, 0.01), Material.FLOOR)
    things = [floor.placed(np.eye(3), np.array([0.0, 0.0, -0.8]))]
    feet = np.array([m.foot[:2] for m in mushrooms]).reshape(-1, 2)
    flat = generator(settings.seed, "lids")
    things += tables.lids(settings.lids, view, base.height_at, flat)
    if settings.scene == "lab":
        return things + tables.clutter(settings.clutter, view, feet, rng)
    if settings.scene == "bed":
        things += grounds.litter(base, view.grown(0.02), 1500.0, rng)
        things += grounds.primordia(base, feet, settings.mycelium, view, rng)
        count, pixel = round(settings.rubble * share), settings.pixel()
        stones = generator(settings.seed, "rubble")
        things += grounds.rubble(base, view.grown(0.02), count, pixel, stones)
        count, smooth = round(settings.pebbles * share), generator(settings.seed, "pebbles")
        things += grounds.pebbles(base, view.grown(0.02), count, pixel, smooth)
        strange = generator(settings.seed, "foreign")
        things += tables.foreign(settings.foreign, view, feet, base.height_at, strange)
        if settings.tray:
            things += grounds.tray_rim(view.x0 + 0.09 * (view.x1 - view.x0), view.grown(0.3))
    return things


def assemble(base: Ground, mushrooms: list[Mushroom], things: list[Mesh], pixel: float) -> World:
    """Join all meshes into one, remembering what each triangle is.

    Args:
        base: The ground; its mesh is one of `things`.
        mushrooms: Their order gives them their numbers.
        things: Meshes that belong to no mushroom.
        pixel: Size of a pixel on the bed, m; sets how fine mushrooms are meshed.

    Raises:
        DependencyError: open3d or a library of the system is missing.
    """
    entries = [(mesh, -1, False) for mesh in things]
    bodies, size = [], sum(len(mesh.vertices) for mesh in things)
    for number, mushroom in enumerate(mushrooms):
        outlined, rest = build(mushroom, pixel)
        entries += [(m, number, True) for m in outlined] + [(m, number, False) for m in rest]
        bodies.append(slice(size, size + sum(len(m.vertices) for m in outlined)))
        size += sum(len(m.vertices) for m in outlined + rest)
    meshes = [mesh for mesh, _, _ in entries]
    first = np.cumsum([0, *(len(m.vertices) for m in meshes)])[:-1]
    count = [len(m.triangles) for m in meshes]
    vertices = np.concatenate([m.vertices for m in meshes])
    triangles = np.concatenate([m.triangles + k for m, k in zip(meshes, first, strict=True)])
    return World(
        base,
        mushrooms,
        vertices,
        vertex_normals(vertices, triangles).astype(np.float32),
        np.concatenate([m.texture for m in meshes]).astype(np.float32),
        triangles,
        np.repeat(np.array([m.material for m in meshes], np.uint8), count),
        np.repeat(np.array([owner for _, owner, _ in entries]), count),
        np.repeat(np.array([flag for _, _, flag in entries]), count),
        bodies,
        Raycaster(vertices, triangles),
    )
