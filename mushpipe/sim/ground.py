"""What mushrooms grow on: casing soil with clods, stones, mycelium and the rim of the tray."""

from __future__ import annotations

from dataclasses import dataclass, replace

import cv2
import numpy as np

from mushpipe.core.arrays import Floats, Singles
from mushpipe.sim.mesh import Material, Mesh, box, height_field, revolve, sheet
from mushpipe.sim.mushroom import about_z
from mushpipe.sim.noise import Reals, blurred, mix, smoothstep
from mushpipe.sim.planting import Area

RIM_HEIGHT = 0.035
PEBBLE_APART = 10.0  # in texture coordinates, by which each has a colour of its own


@dataclass(frozen=True)
class Ground:
    """A surface z = height(x, y) with its colour, on a grid of square texels.

    Attributes:
        area: What it covers; row 0 lies at y1.
        texel: Size of a texel, m.
        height: (H, W) m.
        albedo: (H, W, 3) linear RGB.
        material: How it is painted.
        wet: 0..1, how much it gleams.
    """

    area: Area
    texel: float
    height: Singles
    albedo: Singles
    material: Material
    wet: float = 0.0

    def sample(self, layer: Singles, points: Reals) -> Singles:
        """Interpolate a layer (H, W[, C]) at points (N, 2) m; the border goes on outside."""
        if not len(points):
            return np.zeros((0, *layer.shape[2:]), np.float32)
        column = ((points[:, 0] - self.area.x0) / self.texel).astype(np.float32)
        row = ((self.area.y1 - points[:, 1]) / self.texel).astype(np.float32)
        # remap holds at most 32767 rows: fold the list of points into a table
        width = min(4096, len(column))
        rest = -len(column) % width
        x, y = (np.pad(axis, (0, rest)).reshape(-1, width) for axis in (column, row))
        found = cv2.remap(layer, x, y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
        return np.asarray(found.reshape(-1, *layer.shape[2:])[: len(column)])

    def height_at(self, points: Reals) -> Floats:
        """Return the height (N,) m at points (N, 2) m."""
        return np.asarray(self.sample(self.height, points), np.float64)

    def slopes(self) -> Singles:
        """Return the gradient (H, W, 2) of the height along x and y."""
        along_row, along_column = np.gradient(self.height, self.texel)
        return np.stack([along_column, -along_row], axis=-1).astype(np.float32)

    def mesh(self, step: float) -> Mesh:
        """Return it as a mesh of about `step` m."""
        h, w = self.height.shape
        every = max(1, round(step / self.texel))
        smooth = cv2.blur(self.height, (every, every)) if every > 1 else self.height
        rows, columns = np.arange(0, h, every), np.arange(0, w, every)
        x = self.area.x0 + columns * self.texel
        y = self.area.y1 - rows * self.texel
        return height_field(x, y, smooth[np.ix_(rows, columns)].astype(float), self.material)


def grid_shape(area: Area, texel: float) -> tuple[int, int]:
    """Return rows and columns of texels that cover an area."""
    return (
        int(np.ceil((area.y1 - area.y0) / texel)) + 1,
        int(np.ceil((area.x1 - area.x0) / texel)) + 1,
    )


def soil(
    area: Area, texel: float, bright: float, mycelium: float, rng: np.random.Generator
) -> Ground:
    """Return crumbly casing soil, overgrown with mycelium to a share of 0..1."""
    shape = grid_shape(area, texel)

    def noise(grain: float) -> Singles:
        return blurred(rng, shape, grain / texel)

    crumbs = noise(0.0022)
    height = 0.0035 * noise(0.03) + 0.0012 * noise(0.008)
    height = height + 0.0011 * np.sqrt(np.maximum(crumbs, 0)) + 0.0003 * noise(0.0008)
    tone = 0.30 * noise(0.0009) + 0.22 * noise(0.004) + 0.22 * noise(0.02) + 0.12 * crumbs
    red = 0.06 * noise(0.006)
    peat, clay = np.array([0.026, 0.022, 0.019]), np.array([0.021, 0.0225, 0.0245])
    base = (bright * (peat + rng.uniform(0, 1) * (clay - peat))).astype(np.float32)
    tilt = np.stack([1 + red, np.ones(shape), 1 - red], axis=-1)
    albedo = (base * np.exp(tone)[..., None] * tilt).astype(np.float32)
    _fibres(albedo, texel, area, rng)
    cover = _mycelium(shape, texel, mycelium, area, rng)
    white = (0.50, 0.50, 0.48)
    albedo = mix(albedo.reshape(-1, 3), white, cover.ravel()).reshape(albedo.shape)
    height = height + 0.0007 * cover
    return Ground(area, texel, height.astype(np.float32), albedo, Material.SOIL)


def weathered(ground: Ground, relief: float, wet: float, rng: np.random.Generator) -> Ground:
    """Return soil with lumps of a standard deviation `relief` (m), wet to a degree of 0..1."""
    shape, texel = ground.height.shape, ground.texel
    lumps = blurred(rng, shape, rng.uniform(0.008, 0.02) / texel)
    lumps = lumps + 0.5 * blurred(rng, shape, 0.004 / texel)
    puddles = smoothstep(-1.0, 1.0, blurred(rng, shape, 0.03 / texel))
    albedo = ground.albedo * (1 - 0.65 * wet * puddles)[..., None]
    height = ground.height + relief * lumps
    return replace(
        ground, height=height.astype(np.float32), albedo=albedo.astype(np.float32), wet=wet
    )


def _fibres(albedo: Singles, texel: float, area: Area, rng: np.random.Generator) -> None:
    """Draw bits of peat fibre and straw, and pale specks of lime."""
    for _ in range(round(2500 * area.size)):
        start = np.array([rng.uniform(0, albedo.shape[1]), rng.uniform(0, albedo.shape[0])])
        turn, length = rng.uniform(0, np.pi), rng.uniform(0.002, 0.012) / texel
        end = start + length * np.array([np.cos(turn), np.sin(turn)])
        color = np.array([0.075, 0.052, 0.032]) * rng.uniform(0.4, 1.5)
        ends = [tuple(int(v * 8) for v in p) for p in (start, end)]
        cv2.line(albedo, ends[0], ends[1], color.tolist(), 1, cv2.LINE_AA, 3)
    specks = area.draw(rng, round(1200 * area.size))
    column = ((specks[:, 0] - area.x0) / texel).astype(int)
    row = ((area.y1 - specks[:, 1]) / texel).astype(int)
    albedo[row, column] = rng.uniform(0.1, 0.4, (len(specks), 1))


def _mycelium(
    shape: tuple[int, int], texel: float, amount: float, area: Area, rng: np.random.Generator
) -> Singles:
    """Return how white mycelium covers each texel: webbed patches and branching threads."""

    def noise(grain: float) -> Singles:
        return blurred(rng, shape, grain / texel)

    patch = smoothstep(1.9 - 1.2 * amount, 3.0 - 1.2 * amount, noise(0.02) + 0.7 * noise(0.006))
    web = np.exp(-((noise(0.001) / 0.3) ** 2)) + np.exp(-((noise(0.003) / 0.15) ** 2))
    cover = patch * np.clip(0.10 + 0.40 * web + 0.30 * noise(0.0025) + 0.12 * noise(0.0008), 0, 1)
    threads = np.zeros(shape, np.float32)
    for _ in range(round(260 * amount * area.size)):
        steps = np.cumsum(rng.normal(0, 0.35, 30)) + rng.uniform(0, 2 * np.pi)
        path = np.cumsum(np.stack([np.cos(steps), np.sin(steps)], axis=-1), axis=0)
        start = rng.uniform((0, 0), shape[::-1])
        points = start + path * rng.uniform(0.0006, 0.0022) / texel
        shade = float(rng.uniform(0.15, 0.6))
        line = np.round(points * 8).astype(np.int32)[:, None]
        cv2.polylines(threads, [line], False, shade, 1, cv2.LINE_AA, 3)
    return np.asarray(np.clip(np.maximum(cover, threads), 0, 0.95), np.float32)


def _lumps(
    rng: np.random.Generator, rings: int, material: Material, knobs: float = 0.16
) -> list[Mesh]:
    """Return some different balls of radius about 1 around the origin, with such `knobs`."""
    t = np.linspace(0, np.pi, rings)
    ball = revolve(np.sin(t), np.cos(t), 2 * rings)
    ball[[0, -1], :, :2] = 0
    kinds = []
    for _ in range(12):
        turns, phase = rng.normal(0, 2.2, (3, 3)), rng.uniform(0, 2 * np.pi, 3)
        bent = 1 + knobs * np.cos(ball @ turns + phase).sum(axis=-1, keepdims=True)
        kinds.append(sheet(ball * bent * rng.uniform(0.7, 1.15, 3), material))
    return kinds


def _scatter(
    kinds: list[Mesh], spots: Floats, radius: Floats, rng: np.random.Generator
) -> list[Mesh]:
    """Put one of the kinds, of a radius (N,) m and turned somehow, at each spot (N, 3) m."""
    which, turn = rng.integers(len(kinds), size=len(spots)), rng.uniform(0, 7, len(spots))
    return [
        kinds[k].placed(about_z(t) * r, spot)
        for k, t, r, spot in zip(which, turn, radius, spots, strict=True)
    ]


def litter(ground: Ground, area: Area, density: float, rng: np.random.Generator) -> list[Mesh]:
    """Scatter clods and stones over a ground.

    Args:
        ground: They lie on it, sunk in a little.
        area: Where.
        density: Pieces per m^2.
        rng: Draws them.
    """
    pieces = []
    for share, rings, material in ((0.94, 7, Material.CLOD), (0.06, 9, Material.STONE)):
        flat = area.draw(rng, round(share * density * area.size))
        radius = 0.0015 + 0.0065 * rng.beta(1, 4.5, len(flat))
        # a few as large as small caps: what detectors mistake for one
        large = rng.random(len(flat)) < 0.025
        radius[large] = rng.uniform(0.005, 0.010, int(large.sum()))
        z = ground.height_at(flat) + radius * rng.uniform(-0.2, 0.5, len(flat))
        spots = np.column_stack([flat, z])
        pieces += _scatter(_lumps(rng, rings, material), spots, radius, rng)
    return pieces


def rubble(
    ground: Ground, area: Area, count: int, pixel: float, rng: np.random.Generator
) -> list[Mesh]:
    """Scatter clods, stones and overgrown lumps of 5 to 20 pixels (m each), as large as caps."""
    pieces = []
    kinds = ((0.55, Material.CLOD), (0.3, Material.STONE), (0.15, Material.MYCELIUM))
    for share, material in kinds:
        flat = area.draw(rng, round(share * count))
        radius = pixel * np.exp(rng.uniform(np.log(5), np.log(20), len(flat)))
        z = ground.height_at(flat) + radius * rng.uniform(-0.3, 0.5, len(flat))
        pieces += _scatter(_lumps(rng, 15, material), np.column_stack([flat, z]), radius, rng)
    return pieces


def pebbles(
    ground: Ground, area: Area, count: int, pixel: float, rng: np.random.Generator
) -> list[Mesh]:
    """Scatter smooth stones of 4 to 22 pixels (m each), sunk in by a fifth to four."""
    flat = area.draw(rng, count)
    radius = pixel * np.exp(rng.uniform(np.log(4), np.log(22), count))
    z = ground.height_at(flat) + radius * rng.uniform(-0.6, 0.6, count)
    kinds = _lumps(rng, 15, Material.PEBBLE, knobs=0.015)
    pieces = _scatter(kinds, np.column_stack([flat, z]), radius, rng)
    return [
        replace(piece, texture=piece.texture + PEBBLE_APART * number)
        for number, piece in enumerate(pieces)
    ]


def primordia(
    ground: Ground, around: Floats, amount: float, area: Area, rng: np.random.Generator
) -> list[Mesh]:
    """Return clumps of white beads of 1 to 5 mm: mushrooms that have only begun.

    Args:
        ground: They sit on it.
        around: (N, 2) m, places of mushrooms; half of the clumps keep near them.
        amount: 0..1.
        area: Where they may be.
        rng: Draws them.
    """
    clumps = area.draw(rng, round(430 * amount * area.size))
    near = np.flatnonzero(rng.random(len(clumps)) < (0.5 if len(around) else 0))
    if len(near):
        hosts = around[rng.integers(len(around), size=len(near))]
        clumps[near] = hosts + rng.normal(0, 0.016, (len(near), 2))
    number = 1 + rng.exponential(11, len(clumps)).astype(int)
    spread = 0.00125 * np.sqrt(number)[:, None] * rng.uniform(0.5, 1.6, (len(clumps), 2))
    flat = np.repeat(clumps, number, axis=0)
    flat = flat + rng.normal(0, 1, flat.shape) * np.repeat(spread, number, axis=0)
    radius = np.clip(rng.gamma(2.0, 0.00062, len(flat)), 0.0004, 0.003)
    spots = np.column_stack(
        [flat, ground.height_at(flat) + radius * rng.uniform(0.3, 1.6, len(flat))]
    )
    return _scatter(_lumps(rng, 5, Material.MYCELIUM), spots, radius, rng)


def tray_rim(x: float, area: Area) -> list[Mesh]:
    """Return the plank along the left side of a tray whose inner face is at x."""
    length = area.y1 - area.y0
    plank = box((0.016, length, 0.08), Material.METAL)
    middle = (area.y0 + area.y1) / 2
    return [plank.placed(np.eye(3), np.array([x - 0.008, middle, RIM_HEIGHT - 0.08]))]
