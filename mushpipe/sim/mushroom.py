"""One mushroom: its parameters, and the meshes of its cap, underside and stem."""

from __future__ import annotations

from dataclasses import dataclass
from enum import IntEnum

import numpy as np

from mushpipe.core.arrays import Floats
from mushpipe.sim.mesh import Material, Mesh, sheet
from mushpipe.sim.shapes import CapShape, dome, margin, shaped, underside


class Kind(IntEnum):
    """What state a mushroom is in."""

    GROWING = 0
    PIN = 1
    STUMP = 2
    FALLEN = 3
    PRINTED = 4


@dataclass(frozen=True)
class Mushroom:
    """A mushroom in the bed frame.

    Attributes:
        kind: Its state.
        center: (3,) m, centre of the rim plane; of a stump, of the cut.
        axis: (3,) unit, out of the cap.
        spin: Turn about the axis, rad.
        radius: Of the rim, m; of a stump, of the stem.
        shape: The cap; unused by a stump.
        foot: (3,) m, where the stem meets the ground.
        stem: Radius of the stem, m.
        tint: Linear RGB albedo of the cap.
        scaly: 0..1, brown scales.
        dirt: 0..1, crumbs of soil on the cap.
        gloss: 0..1, how wet the skin is.
        grain: 0..1, contrast of growth rings, of wood.
        fresh: Whether a stump was cut just now: flat, and as white at its cut as beside it.
    """

    kind: Kind
    center: Floats
    axis: Floats
    spin: float
    radius: float
    shape: CapShape
    foot: Floats
    stem: float
    tint: tuple[float, float, float]
    scaly: float = 0.0
    dirt: float = 0.3
    gloss: float = 0.1
    grain: float = 0.0
    fresh: bool = False


def turned_to(axis: Floats, spin: float) -> Floats:
    """Return a rotation (3, 3) that takes +z to a unit axis, after a turn about z by `spin`."""
    helper = np.array([0.0, 1.0, 0.0] if abs(axis[1]) < 0.9 else [1.0, 0.0, 0.0])
    x = np.cross(helper, axis)
    x /= np.linalg.norm(x)
    basis = np.stack([x, np.cross(axis, x), axis], axis=1)
    return np.asarray(basis @ about_z(spin))


def about_z(turn: float) -> Floats:
    """Return the rotation (3, 3) about z by an angle, rad."""
    c, s = np.cos(turn), np.sin(turn)
    return np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]])


def build(mushroom: Mushroom, pixel: float) -> tuple[list[Mesh], list[Mesh]]:
    """Return the meshes of the outlined part (the cap; of a stump, all of it) and of the rest.

    Args:
        mushroom: What to build.
        pixel: Size of a pixel on the bed, m; sets how fine the mesh is.
    """
    fine = float(np.clip(mushroom.radius / pixel / 20, 0.2, 2.5))
    if mushroom.kind == Kind.STUMP:
        return _stump(mushroom, fine), []
    rings, segments = round(6 + 10 * fine), 4 * round(4 + 7 * fine)
    return _cap(mushroom, rings, segments), _stem(mushroom, segments // 2)


def _cap(mushroom: Mushroom, rings: int, segments: int) -> list[Mesh]:
    shape, stem = mushroom.shape, mushroom.stem / mushroom.radius
    top, edge = dome(shape, rings), margin(shape, max(4, rings // 3))
    outside = tuple(np.concatenate([t, e[1:]]) for t, e in zip(top, edge, strict=True))
    under = underside(shape, stem, 6)
    below = Material.VEIL if shape.veil else Material.GILLS
    return [
        _placed(mushroom, outside, segments, Material.CAP),
        _placed(mushroom, under, segments, below),
    ]


def _placed(
    mushroom: Mushroom, profile: tuple[Floats, ...], segments: int, material: Material
) -> Mesh:
    rings = shaped(mushroom.shape, profile[0], profile[1], segments) * mushroom.radius
    rotation = turned_to(mushroom.axis, mushroom.spin)
    return sheet(rings, material).placed(rotation, mushroom.center)


def _stem(mushroom: Mushroom, segments: int) -> list[Mesh]:
    """Return a curved tube from below the ground to inside the cap, thicker at its foot."""
    if mushroom.kind == Kind.FALLEN:
        length = 1.1 * mushroom.radius
        foot, up = mushroom.center - length * mushroom.axis, mushroom.axis
        t = np.linspace(1, 0, 5)[:, None]
        tube = _tube(mushroom, foot + t * (mushroom.center - foot), up, segments, 1.0)
        return [tube, _disc(mushroom, foot, -up, mushroom.stem, segments)]
    top, foot = mushroom.center, mushroom.foot - [0, 0, 0.004]
    span = float(np.linalg.norm(top - foot))
    t = np.linspace(1, 0, 9)[:, None]
    lower, upper = foot + np.array([0, 0, 0.4 * span]), top - 0.45 * span * mushroom.axis
    curve = t**3 * top + 3 * t**2 * (1 - t) * upper
    curve = curve + 3 * t * (1 - t) ** 2 * lower + (1 - t) ** 3 * foot
    return [_tube(mushroom, curve, mushroom.axis, segments, 1.25)]


def _tube(mushroom: Mushroom, curve: Floats, up: Floats, segments: int, bulge: float) -> Mesh:
    turn = np.arange(segments) * (2 * np.pi / segments)
    frame = turned_to(up, 0.0)
    ring = np.cos(turn)[:, None] * frame[:, 0] + np.sin(turn)[:, None] * frame[:, 1]
    width = mushroom.stem * np.interp(np.linspace(0, 1, len(curve)), [0, 0.6, 1], [1, 1, bulge])
    rings = curve[:, None, :] + width[:, None, None] * ring
    local = np.stack([np.cos(turn), np.sin(turn)], axis=-1) * mushroom.stem
    texture = np.concatenate(
        [
            np.broadcast_to(local, (len(curve), segments, 2)),
            np.broadcast_to(curve[:, None, 2:], (len(curve), segments, 1)),
        ],
        axis=-1,
    )
    return sheet(rings, Material.STEM, texture)


def _disc(mushroom: Mushroom, center: Floats, normal: Floats, radius: float, segments: int) -> Mesh:
    turn = np.arange(segments) * (2 * np.pi / segments)
    circle = np.stack([np.cos(turn), np.sin(turn), np.zeros(segments)], axis=-1)
    sizes = np.array([0.0, 0.35, 0.75, 1.0])[:, None, None] * radius
    deep = 0.0 if mushroom.fresh else radius  # what was cut some time ago has dried
    dent = np.array([-0.12, -0.04, 0.0, 0.0])[:, None, None] * deep * [0, 0, 1]
    rotation = turned_to(normal, mushroom.spin)
    return sheet(sizes * circle + dent, Material.CUT).placed(rotation, center)


def _stump(mushroom: Mushroom, fine: float) -> list[Mesh]:
    segments = 4 * round(6 + 2 * fine)
    foot = mushroom.foot - [0, 0, 0.004]
    curve = foot + np.linspace(1, 0, 5)[:, None] * (mushroom.center - foot)
    return [
        _disc(mushroom, mushroom.center, mushroom.axis, mushroom.stem, segments),
        _tube(mushroom, curve, mushroom.axis, segments, 1.3),
    ]
