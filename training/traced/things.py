"""What stands and lies on a bed: caps on stems, cut stumps, clods, soil."""

from __future__ import annotations

import cv2
import numpy as np

from mushpipe.core.arrays import Floats
from mushpipe.sim.mesh import quads
from training.traced.mesh import Mesh, joined, mixed, waves

SEGMENTS = 96
_STEP = 0.0009  # m between the points of the soil
CAP_COLORS = {
    "white": ((0.86, 0.83, 0.77), (0.72, 0.67, 0.58)),
    "cream": ((0.78, 0.68, 0.52), (0.62, 0.52, 0.38)),
    "brown": ((0.50, 0.35, 0.22), (0.26, 0.16, 0.10)),
}
SOILS = {
    "peat": (0.045, 0.032, 0.024),
    "coir": (0.15, 0.095, 0.055),
    "lime": (0.17, 0.15, 0.13),
}
MYCELIUM = np.array([0.62, 0.60, 0.55])
_GILLS = np.array([0.30, 0.17, 0.13])
_CUT = np.array([0.74, 0.66, 0.52])


def _bezier(points: Floats, count: int) -> Floats:
    """Return points (count, 2) along a cubic Bézier curve of four points."""
    t = np.linspace(0, 1, count)[:, None]
    weights = np.hstack([(1 - t) ** 3, 3 * t * (1 - t) ** 2, 3 * t * t * (1 - t), t**3])
    return np.asarray(weights @ points)


def _turned(profile: Floats) -> tuple[Floats, Floats]:
    """Return the surface of revolution (R, S, 3) of a profile (R, 2), and its angles (S,)."""
    angle = np.linspace(0, 2 * np.pi, SEGMENTS, endpoint=False)
    rho, z = profile[:, :1], profile[:, 1:]
    round_ = np.stack([rho * np.cos(angle), rho * np.sin(angle), z + 0 * angle], -1)
    return round_, angle


def cap(radius: float, color: str, rng: np.random.Generator) -> tuple[Mesh, Mesh]:
    """Return the outside of a cap and its underside, its axis on z, the widest ring at z = 0.

    A button is nearly a sphere, an open cap flat; the margin is rolled in, lobed and wavy.
    """
    open_ = rng.beta(1.3, 2.0)
    height = radius * (1.05 - 0.72 * open_ + rng.normal(0, 0.04))
    under = radius * (0.75 - 0.70 * open_) * rng.uniform(0.5, 1)
    dip = height * max(0.0, rng.normal(-0.1, 0.12))
    shoulder = rng.uniform(0.50, 0.62)
    upper = _bezier(
        np.array([[0, height - dip], [shoulder * radius, height], [radius, 0.6 * height],
                  [radius, 0]]), 44
    )  # fmt: skip
    inward = radius * rng.uniform(0.55, 0.92)
    lower = _bezier(
        np.array([[radius, 0], [radius, -0.55 * under], [inward, -under], [inward, -under]]), 12
    )
    outside, angle = _turned(np.vstack([upper, lower[1:]]))
    outside = _lobed(outside, angle, radius, open_, rng)
    rim = outside[-1]
    inside = np.stack([rim * (1 - t) + t * rim.mean(axis=0) * [1, 1, 0.4] for t in (0, 0.4, 0.75)])
    points = outside.reshape(-1, 3)
    skin = Mesh(points, quads(len(outside), SEGMENTS, True), _skin(points, color, rng))
    gills = inside.reshape(-1, 3)
    shade = np.tile(_GILLS * rng.uniform(0.5, 1.6), (len(gills), 1))
    return skin, Mesh(gills, quads(3, SEGMENTS, True), shade)


def _lobed(
    surface: Floats, angle: Floats, radius: float, open_: float, rng: np.random.Generator
) -> Floats:
    """Return a surface (R, S, 3) out of round, wavy towards its margin, and uneven."""
    order = np.arange(2, 7)[:, None]
    size = np.array([0.035, 0.018, 0.012, 0.008, 0.006])[:, None] * rng.normal(size=(5, 1))
    lobes = (size * np.cos(order * angle + rng.uniform(0, 6.3, (5, 1)))).sum(axis=0)
    sway = np.roll(lobes, rng.integers(SEGMENTS)) * radius * open_
    out = np.minimum(1, np.hypot(surface[..., 0], surface[..., 1]) / radius)
    bent = surface * (1 + lobes * out)[..., None]
    bent[..., 2] += sway * out**3
    uneven = 0.012 * rng.uniform(0.3, 1.6) * radius * waves(surface, 0.45 * radius, rng)
    return np.asarray(bent * (1 + uneven / radius)[..., None])


def _skin(points: Floats, color: str, rng: np.random.Generator) -> Floats:
    """Return the colours of the outside of a cap: blotches, scales, stains and soil on it."""
    light, dark = (np.array(c) for c in CAP_COLORS[color])
    colors = np.tile(light, (len(points), 1)) * rng.uniform(0.8, 1.05)
    colors = mixed(colors, dark, 0.25 + 0.2 * waves(points, 0.012, rng))
    if rng.random() < (0.5 if color == "brown" else 0.25):
        share = (waves(points, 0.0016, rng) - 0.6) * rng.uniform(0.3, 1.2)
        colors = mixed(colors, dark, share)
    if rng.random() < 0.4:
        rust = np.array([0.45, 0.29, 0.14])
        colors = mixed(colors, rust, 0.8 * (waves(points, 0.006, rng) - rng.uniform(1.1, 2)))
    crumbs = waves(points, 0.0022, rng) - rng.uniform(1.6, 2.6)
    return mixed(colors, np.array(SOILS["peat"]), 4 * crumbs)


def stem(start: Floats, end: Floats, radius: float, rng: np.random.Generator) -> Mesh:
    """Return a bent stem (m) from the soil to below a cap, thicker at its foot."""
    t = np.linspace(0, 1, 14)
    bend = rng.normal(0, 0.12, 2) * np.linalg.norm(end - start)
    line = start + t[:, None] * (end - start)
    line[:, :2] += (4 * t * (1 - t))[:, None] * bend
    thick = radius * (1 + rng.uniform(0, 0.5) * (1 - t) ** 2)
    angle = np.linspace(0, 2 * np.pi, SEGMENTS // 2, endpoint=False)
    ring = np.stack([np.cos(angle), np.sin(angle), 0 * angle], -1)
    points = (line[:, None] + thick[:, None, None] * ring).reshape(-1, 3)
    points += 0.03 * radius * waves(points, 0.4 * radius, rng)[:, None] * [1, 1, 0]
    colors = np.tile(np.array([0.76, 0.71, 0.62]) * rng.uniform(0.7, 1.1), (len(points), 1))
    colors = mixed(colors, np.array(SOILS["peat"]), 0.5 * (waves(points, 0.003, rng) - 1))
    return Mesh(points, quads(14, len(angle), True), colors)


def stump(place: Floats, radius: float, length: float, rng: np.random.Generator) -> Mesh:
    """Return what is left of a stem (m) whose mushroom was cut."""
    lean = np.array([*rng.normal(0, 0.15, 2), 1])
    side = stem(place, place + length * lean, radius, rng)
    rim = side.vertices[-(SEGMENTS // 2) :]
    middle = rim.mean(axis=0)
    rings = np.stack([middle + share * (rim - middle) for share in (1.0, 0.8, 0.4, 0.01)])
    points = rings.reshape(-1, 3)
    colors = np.tile(_CUT * rng.uniform(0.6, 1.1), (len(points), 1))
    colors = mixed(colors, np.array([0.4, 0.26, 0.15]), 0.3 * waves(points, 0.003, rng))
    return joined([side, Mesh(points, quads(4, SEGMENTS // 2, True), colors)])


def clod(place: Floats, radius: float, color: Floats, rng: np.random.Generator) -> Mesh:
    """Return a lump of soil or a stone around a place (m)."""
    rows = max(6, min(28, int(radius / 0.0006)))
    polar = np.linspace(0, np.pi, rows)
    sphere, _ = _turned(np.stack([np.sin(polar), np.cos(polar)], -1))
    sphere = sphere[:, :: max(1, SEGMENTS // (2 * rows))]
    points = radius * sphere.reshape(-1, 3) * rng.uniform([0.8, 0.8, 0.5], [1.2, 1.2, 1])
    rough = rng.uniform(0.05, 0.22)
    lumps = waves(points, 0.5 * radius, rng) + waves(points, 0.2 * radius, rng) / 2
    points *= 1 + rough * lumps[:, None]
    shade = 1 + 0.35 * waves(points, 0.25 * radius, rng)
    colors = np.clip(color * shade[:, None], 0.005, 0.9)
    return Mesh(points + place, quads(rows, sphere.shape[1], True), colors)


def soil(half: tuple[float, float], color: Floats, white: float, rng: np.random.Generator) -> Mesh:
    """Return the bed, grains of soil on gentle hills, with a share of it white with mycelium."""
    x, y = (np.arange(-h, h, _STEP) for h in half)
    shape = len(y), len(x)
    relief = rng.uniform(0.4, 1.6)
    height = np.zeros(shape)
    for grain, size in ((0.05, 3.0), (0.02, 1.8), (0.007, 1.2), (0.003, 0.8), (0.0015, 0.5)):
        height += 0.001 * size * relief * np.abs(_field(shape, grain, rng)) ** 1.3
    points = np.stack([*np.meshgrid(x, y), height - height.mean()], -1).reshape(-1, 3)
    grains = np.exp(rng.uniform(0.2, 0.6) * _field(shape, 0.0013, rng))
    colors = np.clip(color * grains.reshape(-1, 1), 0.004, 0.9)
    if white:
        patch = (_field(shape, 0.03, rng) + 0.6 * _field(shape, 0.004, rng)).ravel()
        colors = mixed(colors, MYCELIUM, 2 * (patch - np.quantile(patch, 1 - white)))
    return Mesh(points, quads(*shape, False), colors)


def _field(shape: tuple[int, int], grain: float, rng: np.random.Generator) -> Floats:
    """Return smooth noise (R, C) of mean 0 and variance 1 on the grid of the soil."""
    fewer = max(1, int(grain / _STEP / 4))  # wide noise is drawn on fewer points
    rough = rng.standard_normal([n // fewer + 2 for n in shape])
    smooth = cv2.GaussianBlur(rough, (0, 0), max(0.6, grain / _STEP / fewer / 2))
    smooth = cv2.resize(smooth, shape[::-1], interpolation=cv2.INTER_CUBIC)
    return np.asarray((smooth - smooth.mean()) / smooth.std())
