"""Procedural colour: what each pixel's surface would reflect, before any light falls on it.

Colours are linear RGB albedo 0..1. Textures are looked up in object coordinates, so they stick to
their object when the camera moves.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from mushpipe.core.arrays import Floats, Ints, Singles
from mushpipe.sim.ground import PEBBLE_APART
from mushpipe.sim.mesh import Material
from mushpipe.sim.mushroom import Kind
from mushpipe.sim.noise import Noise3, mix, smoothstep
from mushpipe.sim.render import Surface, is_mushroom
from mushpipe.sim.world import World

_CRUMB = (0.035, 0.027, 0.021)
_PLAIN: dict[Material, tuple[float, float, float]] = {
    Material.MYCELIUM: (0.70, 0.685, 0.62),
    Material.METAL: (0.20, 0.19, 0.17),
    Material.FLOOR: (0.006, 0.006, 0.006),
    Material.CARDBOARD: (0.36, 0.24, 0.135),
}
_GLOSS = np.zeros(len(Material), np.float32)
_GLOSS[[Material.SOIL, Material.CLOD, Material.STONE]] = 0.04, 0.04, 0.12
_GLOSS[[Material.TABLE, Material.PLASTIC, Material.PEBBLE]] = 0.10, 0.45, 0.06


@dataclass(frozen=True, eq=False)
class Paint:
    """How the surface of each pixel reflects light.

    Attributes:
        albedo: (P, 3) linear RGB.
        gloss: (P,) 0..1, strength of the highlight.
        normal: (P, 3) unit, with fine relief.
    """

    albedo: Singles
    gloss: Singles
    normal: Floats


class Painter:
    """Paints the surfaces of a world."""

    def __init__(self, world: World, rng: np.random.Generator) -> None:
        self._world, self._noise = world, Noise3(rng)
        count = len(world.mushrooms)
        self._offset = rng.uniform(0, 10, (count + 1, 3))
        self._offset[-1] = 0.0  # what belongs to no mushroom
        self._slopes = world.ground.slopes()
        table = world.mushrooms
        self._tint = np.array([m.tint for m in table]).reshape(-1, 3)
        self._scaly = np.array([m.scaly for m in table])
        self._dirt = np.array([m.dirt for m in table])
        self._radius = np.array([m.radius for m in table])
        self._gloss = np.array([m.gloss for m in table], np.float32)
        self._plain = np.array([m.kind == Kind.PRINTED for m in table], bool)
        self._grain = np.array([m.grain for m in table], np.float32)
        self._makers: dict[Material, Callable[[Surface, Ints], Singles]] = {
            Material.SOIL: self._ground,
            Material.TABLE: self._ground,
            Material.TARGET: self._ground,
            Material.CAP: self._cap,
            Material.GILLS: self._gills,
            Material.VEIL: self._stem,
            Material.STEM: self._stem,
            Material.CUT: self._cut,
            Material.CLOD: self._clod,
            Material.STONE: self._stone,
            Material.PEBBLE: self._pebble,
            Material.PAPER: self._paper,
            Material.PLASTIC: self._plastic,
        }

    def __call__(self, surface: Surface) -> Paint:
        """Return the paint of each pixel."""
        albedo = np.empty((len(surface.depth), 3), np.float32)
        for number in np.unique(surface.material):
            material = Material(number)
            rows = np.flatnonzero(surface.material == number)
            make = self._makers.get(material, self._even)
            albedo[rows] = make(surface, rows)
        gloss = _GLOSS[surface.material]
        gloss[surface.material <= Material.CLOD] += np.float32(0.4 * self._world.ground.wet)
        cap = np.flatnonzero(surface.material == Material.CAP)
        gloss[cap] = self._gloss[surface.owner[cap]]
        return Paint(np.clip(albedo, 0.002, 0.95), gloss, self._relief(surface))

    def _at(self, surface: Surface, rows: Ints, grain: float, axis: int = 0) -> Singles:
        """Return noise (N,) of a grain in m, different for each mushroom and each `axis`."""
        shift = self._offset[surface.owner[rows]] + 3.1 * axis
        return self._noise(surface.texture[rows] + shift, grain)

    def _relief(self, surface: Surface) -> Floats:
        """Return normals bent by the ground's fine relief and by the unevenness of skin."""
        normal = surface.normal.copy()
        flat = np.flatnonzero(surface.material == self._world.ground.material)
        slope = self._world.ground.sample(self._slopes, surface.point[flat, :2])
        normal[flat] = np.stack([-slope[:, 0], -slope[:, 1], np.ones(len(flat))], axis=-1)
        rough = np.flatnonzero(is_mushroom(surface.material))
        for axis in range(3):
            bump = 0.016 * self._at(surface, rows=rough, grain=0.006, axis=axis + 1)
            bump += 0.010 * self._at(surface, rows=rough, grain=0.0012, axis=axis + 4)
            normal[rough, axis] += bump
        return np.asarray(normal / np.linalg.norm(normal, axis=1, keepdims=True))

    def _ground(self, surface: Surface, rows: Ints) -> Singles:
        ground = self._world.ground
        return ground.sample(ground.albedo, surface.point[rows, :2])

    def _even(self, surface: Surface, rows: Ints) -> Singles:
        color = np.asarray(_PLAIN[Material(surface.material[rows[0]])], np.float32)
        tone = 1 + 0.05 * self._at(surface, rows, 0.001) + 0.10 * self._at(surface, rows, 0.012)
        return np.asarray(color * tone[:, None], np.float32)

    def _cap(self, surface: Surface, rows: Ints) -> Singles:
        owner = surface.owner[rows]
        q = surface.texture[rows]
        tone = 1 + 0.018 * self._at(surface, rows, 0.012) + 0.010 * self._at(surface, rows, 0.002)
        tone += 0.012 * self._fibres(surface, rows)
        tone += self._grain[owner] * self._rings(surface, rows)
        color = (self._tint[owner] * tone[:, None]).astype(np.float32)
        bare = ~self._plain[owner]
        scales = self._scales(surface, rows) * self._scaly[owner]
        color = mix(color, (0.13, 0.078, 0.046), scales.astype(np.float32) * 0.75)
        pale = smoothstep(0.05, -0.25, (q[:, 2] / self._radius[owner]).astype(np.float32))
        color = mix(color, (0.76, 0.70, 0.60), 0.5 * pale * (self._scaly[owner] > 0.3))
        spread = self._at(surface, rows, 0.016, 7) + 0.35 * self._at(surface, rows, 0.004, 8)
        stain = smoothstep(1.3, 3.2, spread) * bare
        color = mix(color, (0.50, 0.37, 0.20), 0.5 * stain)
        return mix(color, _CRUMB, self._crumbs(surface, rows) * bare)

    def _rings(self, surface: Surface, rows: Ints) -> Singles:
        """Return growth rings (N,) of a cap turned from wood, cut obliquely."""
        q = surface.texture[rows] + 0.004 * self._at(surface, rows, 0.02, 9)[:, None]
        return np.asarray(np.sin(2 * np.pi * (q[:, 0] + 0.6 * q[:, 2]) / 0.004), np.float32)

    def _fibres(self, surface: Surface, rows: Ints) -> Singles:
        """Return streaks (N,) that run from the top of a cap to its rim."""
        q = surface.texture[rows]
        turn = np.arctan2(q[:, 1], q[:, 0])
        around = 0.011 * np.stack([np.cos(turn), np.sin(turn)], axis=-1)
        far = 0.18 * np.hypot(q[:, 0], q[:, 1])
        points = np.column_stack([around, far]) + self._offset[surface.owner[rows]]
        return self._noise(points, 0.0011)

    def _scales(self, surface: Surface, rows: Ints) -> Singles:
        """Return brown scales 0..1: patches in rings, closer together towards the top."""
        q, radius = surface.texture[rows], self._radius[surface.owner[rows]]
        share = np.hypot(q[:, 0], q[:, 1]) / radius
        patches = self._at(surface, rows, 0.0027, 2) + 0.7 * self._fibres(surface, rows)
        edge = (2.1 * share - 0.9).astype(np.float32)
        return smoothstep(-0.3, 0.6, patches - edge)

    def _crumbs(self, surface: Surface, rows: Ints) -> Singles:
        """Return crumbs of soil 0..1: few on most caps, many where a clump fell."""
        dirt = self._dirt[surface.owner[rows]]
        fine = self._at(surface, rows, 0.0011, 5) + 0.9 * self._at(surface, rows, 0.011, 6)
        top = smoothstep(-0.4, 0.5, surface.normal[rows, 2].astype(np.float32))
        return smoothstep(0.0, 0.25, (fine - 3.6 + 1.5 * dirt).astype(np.float32)) * top

    def _gills(self, surface: Surface, rows: Ints) -> Singles:
        q = surface.texture[rows]
        fins = np.sin(np.arctan2(q[:, 1], q[:, 0]) * 70 + 1.5 * self._at(surface, rows, 0.004))
        tone = (0.85 + 0.25 * fins)[:, None]
        return np.asarray(np.array([0.30, 0.185, 0.135]) * tone, np.float32)

    def _stem(self, surface: Surface, rows: Ints) -> Singles:
        owner = surface.owner[rows]
        q = surface.texture[rows] * [1, 1, 0.2]
        streak = self._noise(q + self._offset[owner], 0.0012)
        tone = 1 + 0.05 * streak + 0.05 * self._at(surface, rows, 0.008)
        color = np.where(self._plain[owner][:, None], self._tint[owner], (0.73, 0.685, 0.585))
        color = (color * tone[:, None]).astype(np.float32)
        low = surface.point[rows, 2] - self._world.ground.height_at(surface.point[rows, :2])
        soiled = smoothstep(0.006, 0.0, (low + 0.002 * streak).astype(np.float32))
        return mix(color, _CRUMB, 0.7 * soiled * ~self._plain[owner])

    def _cut(self, surface: Surface, rows: Ints) -> Singles:
        q = surface.texture[rows]
        owner = surface.owner[rows]
        wide = np.array([m.stem for m in self._world.mushrooms])[owner]
        share = (np.hypot(q[:, 0], q[:, 1]) / wide).astype(np.float32)
        tone = 1 + 0.08 * self._at(surface, rows, 0.0012) + 0.06 * self._at(surface, rows, 0.005)
        color = (np.array([0.66, 0.56, 0.42]) * tone[:, None]).astype(np.float32)
        color = mix(color, (0.36, 0.25, 0.15), 0.7 * smoothstep(0.42, 0.2, share))
        color = mix(color, (0.78, 0.72, 0.60), 0.6 * smoothstep(0.86, 0.95, share))
        fresh = np.array([m.fresh for m in self._world.mushrooms])[owner]
        white = (np.array([0.77, 0.725, 0.625]) * (0.9 + 0.1 * tone[:, None])).astype(np.float32)
        return np.where(fresh[:, None], white, color)

    def _clod(self, surface: Surface, rows: Ints) -> Singles:
        base = self._ground(surface, rows).mean(axis=1, keepdims=True)
        tone = np.exp(0.4 * self._at(surface, rows, 0.0015) + 0.3 * self._at(surface, rows, 0.02))
        color = np.array([0.040, 0.033, 0.027], np.float32) * tone[:, None]
        return np.asarray(0.5 * color + 0.7 * np.minimum(base, 0.15), np.float32)

    def _stone(self, surface: Surface, rows: Ints) -> Singles:
        shade = 0.10 + 0.05 * self._at(surface, rows, 0.03)
        tone = 1 + 0.15 * self._at(surface, rows, 0.0012)
        return np.asarray((shade * tone)[:, None] * np.array([1.0, 0.95, 0.87]), np.float32)

    def _pebble(self, surface: Surface, rows: Ints) -> Singles:
        """White, gray or brown, each of one colour with specks."""
        q = surface.texture[rows]
        own = np.round(q / PEBBLE_APART)
        shade = np.clip(0.28 * np.exp(0.8 * self._noise(own * 0.37, 0.1)), 0.04, 0.75)
        warm = smoothstep(-0.3, 1.2, self._noise(own * 0.61, 0.1))[:, None]
        tone = 1 + 0.05 * self._noise(q, 0.03) + 0.05 * self._noise(q, 0.2)
        color = np.array([1.0, 0.98, 0.95]) - warm * np.array([0.0, 0.18, 0.40])
        return np.asarray((shade * tone)[:, None] * color, np.float32)

    def _paper(self, surface: Surface, rows: Ints) -> Singles:
        """White paper with lines of print."""
        q = surface.texture[rows]
        line = np.mod(q[:, 1], 0.006) < 0.0022
        word = self._noise(np.round(q / 0.0011) * [0.9, 3.7, 0], 0.0022) > 0.1
        inside = np.mod(q[:, 0] + 0.02, 0.09) < 0.07
        ink = (line & word & inside)[:, None]
        return np.where(ink, 0.12, 0.80).astype(np.float32) * np.ones((1, 3), np.float32)

    def _plastic(self, surface: Surface, rows: Ints) -> Singles:
        """White, or the colour that comes with the place it stands at."""
        hue = self._noise(np.round(surface.point[rows] / 0.2) * [0.37, 0.61, 0], 0.1)[:, None]
        white, red = np.array([0.72, 0.73, 0.72]), np.array([0.45, 0.10, 0.07])
        return np.where(hue > 0.9, red, white).astype(np.float32)
