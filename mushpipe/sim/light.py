"""Light: a soft sky seen through whatever stands around, and lamps that cast shadows.

An upright white surface in even light has the irradiance 1.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from mushpipe.core.arrays import Bools, Floats, Ints, Singles
from mushpipe.sim.material import Paint
from mushpipe.sim.raycast import rays
from mushpipe.sim.render import Surface, is_mushroom
from mushpipe.sim.settings import SceneSettings
from mushpipe.sim.world import World

_RAYS = 10  # to the sky, per vertex
_REACH = 0.15  # m; what stands farther away shades nothing of the sky
_PANEL = 2.5  # how much brighter the sky is overhead: it is a panel of lamps, not a dome
_LIFT = 0.0004  # m; shadow rays start so far above their surface


@dataclass(frozen=True)
class Lamp:
    """A lamp of some spots.

    Attributes:
        spots: (S, 3) m, bed frame.
        power: Irradiance of a surface that faces it from below, at the middle of the bed.
        color: Linear RGB.
        beam: Half width of the bright centre on the bed, m; 0 for all around.
    """

    spots: Floats
    power: float
    color: tuple[float, float, float] = (1.0, 1.0, 1.0)
    beam: float = 0.0


@dataclass(frozen=True)
class Rig:
    """All light of a scene: sky, lamps, and a linear change of both across the view, per m."""

    sky: float
    lamps: tuple[Lamp, ...]
    slope: tuple[float, float] = (0.0, 0.0)


def _lamp(
    rng: np.random.Generator, place: tuple[float, float, float], size: float, power: float,
    spots: int, beam: float = 0.0,
) -> Lamp:  # fmt: skip
    warm = float(rng.normal(0, 0.02))
    around = rng.normal(0, size, (spots, 3))
    return Lamp(np.asarray(place) + around, power, (1 + warm, 1.0, 1 - warm), beam)


def rig_for(settings: SceneSettings, rng: np.random.Generator) -> Rig:
    """Return the lamps of a light preset; `light_strength` fades it to even light."""
    up, s = settings.distance, settings.light_strength
    turn = rng.uniform(0, 2 * np.pi)
    c, d = float(np.cos(turn)), float(np.sin(turn))
    front = (0.18 * c, 0.18 * d, up + 0.12)
    low = (0.75 * up * c, 0.75 * up * d, 0.45 * up + 0.05)
    if settings.light == "gradient":
        slope = 1.35 * s / up
        return Rig(0.62, (_lamp(rng, front, 0.08, 0.40, 2),), (slope * c, slope * d))
    if settings.light == "side":
        lamps = (_lamp(rng, front, 0.08, 0.4 * (1 - s), 2), _lamp(rng, low, 0.03, 1.05 * s, 3))
        return Rig(0.62 - 0.40 * s, lamps)
    if settings.light == "spot":
        beam = up * (1.2 - 0.85 * s)
        return Rig(0.62 - 0.42 * s, (_lamp(rng, front, 0.03, 0.40 + 0.58 * s, 2, beam),))
    if settings.light == "harsh":
        flash = (0.05 * c, 0.05 * d, up)
        lamps = (_lamp(rng, flash, 0.004, 0.4 + 0.6 * s, 1), _lamp(rng, low, 0.01, 0.6 * s, 1))
        slope = 0.8 * s / up
        return Rig(0.62 - 0.45 * s, lamps, (slope * c, slope * d))
    return Rig(0.64, (_lamp(rng, front, 0.08, 0.40, 2),))


def ambient(world: World, surface: Surface, rng: np.random.Generator) -> Singles:
    """Return the share of the sky's light that reaches each vertex (V,) of the world in view.

    Rays are cosine-distributed, turned differently at each vertex, and the result is averaged
    over the neighbours.
    """
    seen = np.zeros(len(world.triangles), bool)
    seen[surface.triangle] = True
    corners = world.triangles[seen]
    used = np.zeros(len(world.vertices), bool)
    used[corners.ravel()] = True
    rows = np.flatnonzero(used)
    turn = rng.uniform(0, 2 * np.pi, len(world.vertices))[rows].astype(np.float32)
    normal = world.normals[rows]
    origin = world.vertices[rows] + _LIFT * normal
    total, weight = np.zeros(len(rows), np.float32), 0.0
    for k in range(_RAYS):
        out = np.sqrt((k + 0.5) / _RAYS)  # Malley: even on the disc is cosine on the sphere
        direction = _around(normal, turn + k * 2.399963, out)
        free = ~world.caster.blocked(rays(origin, direction), _REACH)
        total += np.clip(direction[:, 2], 0, 1) ** _PANEL * free
        weight += float(np.sqrt(1 - out**2)) ** _PANEL
    share = np.full(len(used), 0.5, np.float32)
    share[rows] = total / weight
    return _smoothed(share, corners)


def _around(normal: Singles, turn: Singles, out: float) -> Singles:
    """Return unit directions (N, 3) whose sine with the normals is `out`."""
    helper = np.where(np.abs(normal[:, :1]) < 0.8, [[1.0, 0, 0]], [[0, 1.0, 0]])
    first = np.cross(normal, helper.astype(np.float32))
    first /= np.maximum(np.linalg.norm(first, axis=1, keepdims=True), 1e-9)
    second = np.cross(normal, first)
    flat = np.cos(turn)[:, None] * first + np.sin(turn)[:, None] * second
    return np.asarray(out * flat + np.float32(np.sqrt(1 - out**2)) * normal)


def _smoothed(share: Singles, corners: Ints) -> Singles:
    """Average a value per vertex over the triangles (T, 3) around it, twice."""
    index, size = corners.ravel(), len(share)
    times = np.bincount(index, minlength=size)
    for _ in range(2):
        mean = np.repeat(share[corners].mean(axis=1), 3)
        total = np.bincount(index, mean, size)
        share = np.where(times > 0, total / np.maximum(times, 1), share).astype(np.float32)
    return share


def lit(world: World, surface: Surface, paint: Paint, rig: Rig, sky: Singles) -> Singles:
    """Return the light (P, 3) that each pixel sends to the camera; 1 is a white diffuser.

    Lambert's law, softened on mushrooms, whose flesh scatters light; a highlight by Blinn and
    Phong; light that the pale neighbours of a mushroom throw back.
    """
    soft = is_mushroom(surface.material)
    bounce = np.where(soft, 0.28, 0.03) * (1 - sky)
    light = rig.sky * (sky[:, None] + bounce[:, None] * [1.0, 0.93, 0.78])
    shine = np.zeros(len(surface.depth))
    for lamp in rig.lamps:
        for spot in lamp.spots:
            diffuse, gleam = _spot(world, surface, paint, lamp, spot, soft)
            light += (diffuse * lamp.power / len(lamp.spots))[:, None] * lamp.color
            shine += gleam * lamp.power / len(lamp.spots)
    change = np.clip(1 + surface.point[:, :2] @ np.asarray(rig.slope), 0.12, 2.2)
    return np.asarray((paint.albedo * light + shine[:, None]) * change[:, None], np.float32)


def _spot(
    world: World, surface: Surface, paint: Paint, lamp: Lamp, spot: Floats, soft: Bools
) -> tuple[Floats, Floats]:
    """Return diffuse and mirrored light (P,) of one spot of a lamp of power 1."""
    way = spot - surface.point
    far = np.linalg.norm(way, axis=1)
    way /= far[:, None]
    facing = np.einsum("pk,pk->p", paint.normal, way)
    wrap = np.where(soft, 0.10, 0.0)
    diffuse = np.clip((facing + wrap) / (1 + wrap), 0, 1)
    rows = np.flatnonzero(diffuse > 0)
    start = surface.point[rows] + _LIFT * surface.normal[rows]
    dark = world.caster.blocked(rays(start, spot - start), 1.0)
    fall = (np.linalg.norm(spot) / far) ** 2
    if lamp.beam:
        axis = -spot / np.linalg.norm(spot)
        aside = np.sqrt(np.maximum(1 - (way @ -axis) ** 2, 0)) * far
        fall = fall / (1 + (aside / lamp.beam) ** 4)
    fall[rows[dark]] *= np.where(soft, 0.08, 0.0)[rows[dark]]
    half = way + surface.sight
    half /= np.linalg.norm(half, axis=1, keepdims=True)
    aligned = np.clip(np.einsum("pk,pk->p", paint.normal, half), 0, 1)
    gleam = paint.gloss * aligned**60 * (facing > 0)
    return diffuse * fall, gleam * fall
