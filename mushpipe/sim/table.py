"""The lab: a table of wood, cloth or paint, with papers, boxes and cups on it; and a bare plane."""

from __future__ import annotations

from collections.abc import Callable

import cv2
import numpy as np

from mushpipe.core.arrays import Floats, Singles
from mushpipe.sim.ground import Ground, grid_shape
from mushpipe.sim.mesh import Material, Mesh, box, revolve, sheet
from mushpipe.sim.mushroom import about_z
from mushpipe.sim.noise import blurred
from mushpipe.sim.planting import Area

_PAINTS = ((0.05, 0.16, 0.30), (0.07, 0.22, 0.12), (0.42, 0.42, 0.40), (0.30, 0.07, 0.06))


def table(kind: str, area: Area, texel: float, rng: np.random.Generator) -> Ground:
    """Return a table top: ``wood``, ``cloth`` or ``paint``."""
    shape = grid_shape(area, texel)
    make = {"wood": _wood, "cloth": _cloth, "paint": _paint}[kind]
    albedo, height = make(shape, texel, rng)
    return Ground(area, texel, height.astype(np.float32), albedo, Material.TABLE)


def target(area: Area, texel: float) -> Ground:
    """Return a matt, light gray plane for the depth test."""
    shape = grid_shape(area, texel)
    albedo = np.full((*shape, 3), 0.62, np.float32)
    return Ground(area, texel, np.zeros(shape, np.float32), albedo, Material.TARGET)


def _stretched(
    rng: np.random.Generator, shape: tuple[int, int], along: float, across: float
) -> Singles:
    """Return noise with details `along` px long in x and `across` px high in y."""
    small = (shape[0], max(8, round(shape[1] * across / along)))
    field = blurred(rng, small, across)
    return np.asarray(cv2.resize(field, shape[::-1], interpolation=cv2.INTER_CUBIC))


def _wood(
    shape: tuple[int, int], texel: float, rng: np.random.Generator
) -> tuple[Singles, Singles]:
    """Oak: growth rings cut lengthwise, pores as short dark dashes."""
    y = np.arange(shape[0], dtype=np.float32)[:, None] * texel
    bend = _stretched(rng, shape, 0.12 / texel, 0.03 / texel)
    rings = np.sin(2 * np.pi * (y + 0.012 * bend) / 0.011 + 1.2 * bend)
    fine = _stretched(rng, shape, 0.02 / texel, 0.0006 / texel)
    pores = _stretched(rng, shape, 0.006 / texel, 0.0005 / texel) > 1.7
    tone = 1 + 0.10 * rings + 0.10 * fine + 0.08 * blurred(rng, shape, 0.05 / texel)
    base = np.array([0.30, 0.165, 0.075], np.float32) * rng.uniform(0.5, 1.2)
    albedo = base * np.clip(tone, 0.3, 2)[..., None] ** [1.0, 1.15, 1.35]
    albedo = albedo * np.where(pores, 0.55, 1.0)[..., None]
    return albedo.astype(np.float32), -0.0001 * pores.astype(np.float32)


def _cloth(
    shape: tuple[int, int], texel: float, rng: np.random.Generator
) -> tuple[Singles, Singles]:
    """A plain weave with soft folds."""
    y, x = (np.arange(n, dtype=np.float32) * texel for n in shape)
    weave = np.sin(2 * np.pi * x / 0.0017)[None] * np.sin(2 * np.pi * y / 0.0017)[:, None]
    folds = 0.0003 * blurred(rng, shape, 0.03 / texel)
    paint = np.array(_PAINTS[rng.integers(len(_PAINTS))], np.float32)
    tone = 1 + 0.18 * weave + 0.08 * blurred(rng, shape, 1.0)
    return (paint * tone[..., None]).astype(np.float32), folds + 0.00012 * weave


def _paint(
    shape: tuple[int, int], texel: float, rng: np.random.Generator
) -> tuple[Singles, Singles]:
    """Smooth colour with stains and scratches."""
    paint = np.array(_PAINTS[rng.integers(len(_PAINTS))], np.float32)
    tone = 1 + 0.05 * blurred(rng, shape, 0.04 / texel) + 0.02 * blurred(rng, shape, 1.0)
    albedo = (paint * tone[..., None]).astype(np.float32)
    for _ in range(30):
        ends = rng.integers(0, shape[::-1], (2, 2))
        end = ends[0] + (ends[1] - ends[0]) // 4
        cv2.line(albedo, ends[0].tolist(), end.tolist(), (paint * 1.5).tolist(), 1, cv2.LINE_AA)
    return albedo, np.zeros(shape, np.float32)


def clutter(count: int, area: Area, keep: Floats, rng: np.random.Generator) -> list[Mesh]:
    """Return papers, boxes and cups on the table.

    Args:
        count: How many.
        area: Where they lie.
        keep: (N, 2) m, places of mushrooms; only flat papers may lie there.
        rng: Draws them.
    """
    things = []
    for number in range(count):
        spot = area.draw(rng, 1)[0]
        near = len(keep) and float(np.hypot(*(keep - spot).T).min()) < 0.075
        if near or number % 3 == 0:
            thing = _paper(rng, number)
        else:
            thing = (_carton, _cup)[rng.integers(2)](rng)
        turn = rng.uniform(0, 2 * np.pi)
        things.append(thing.placed(about_z(turn), np.array([*spot, 0.0012])))
    return things


def foreign(
    count: int,
    area: Area,
    keep: Floats,
    ground: Callable[[Floats], Floats],
    rng: np.random.Generator,
) -> list[Mesh]:
    """Return clutter and rails on a ground of a height (N,) m at points (N, 2) m; else as there."""
    things = []
    for thing in clutter(count, area, keep, rng):
        spot = thing.vertices[:, :2].mean(axis=0)
        lift = np.array([0.0, 0.0, float(ground(spot[None])[0]) + 0.002])
        things.append(thing.placed(np.eye(3), lift))
        if rng.random() < 0.25:
            things.append(_rail(area, rng))
    return things


def lids(
    count: int, area: Area, ground: Callable[[Floats], Floats], rng: np.random.Generator
) -> list[Mesh]:
    """Return lids and paper discs of 10 to 60 mm on a ground of a height (N,) m at (N, 2) m."""
    things = []
    for _ in range(count):
        radius, thick = rng.uniform(0.005, 0.03), rng.uniform(0.0003, 0.002)
        profile = np.array([0, 0.9, 0.97, 1.0]) * radius, np.array([1, 1, 0.9, 0.0]) * thick
        kind = (Material.PAPER, Material.PLASTIC)[rng.integers(2)]
        spot = area.draw(rng, 1)[0]
        place = np.array([*spot, float(ground(spot[None])[0]) + 0.002])
        things.append(sheet(revolve(*profile, 48), kind).placed(np.eye(3), place))
    return things


def _rail(area: Area, rng: np.random.Generator) -> Mesh:
    """A bar of metal or plastic across the whole view, on the bed or above it."""
    kind = (Material.METAL, Material.PLASTIC)[rng.integers(2)]
    bar = box((4.0, *rng.uniform(0.006, 0.03, 2)), kind)
    turn = rng.integers(2) * np.pi / 2 + rng.normal(0, 0.05)
    return bar.placed(about_z(turn), np.array([*area.draw(rng, 1)[0], rng.uniform(0.0, 0.05)]))


def _paper(rng: np.random.Generator, number: int) -> Mesh:
    size = (rng.uniform(0.08, 0.21), rng.uniform(0.06, 0.148), 0.0003 * (1 + number))
    return box(size, Material.PAPER)


def _carton(rng: np.random.Generator) -> Mesh:
    return box((*rng.uniform(0.03, 0.11, 2), rng.uniform(0.01, 0.05)), Material.CARDBOARD)


def _cup(rng: np.random.Generator) -> Mesh:
    """A cup upside down or a bottle top: round and pale, and no mushroom."""
    radius, height = rng.uniform(0.010, 0.035), rng.uniform(0.008, 0.06)
    rho = np.array([0, 0.85, 0.92, 1.0, 1.06]) * radius
    z = np.array([1, 1, 0.985, 0.95, 0.0]) * height
    return sheet(revolve(rho, z, 48), Material.PLASTIC)
