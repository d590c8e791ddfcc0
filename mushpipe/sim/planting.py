"""Where mushrooms stand: clusters that touch, lean outwards and overlap at different heights."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from mushpipe.core.arrays import Floats
from mushpipe.sim.mushroom import Kind, Mushroom
from mushpipe.sim.noise import generator
from mushpipe.sim.settings import SceneSettings
from mushpipe.sim.shapes import CapShape, Warp, aged, deformed, draw_shape

_TINTS = {
    "white": (0.83, 0.80, 0.735),
    "cream": (0.74, 0.63, 0.44),
    "brown": (0.27, 0.178, 0.110),
    "wood": (0.50, 0.39, 0.27),
}
_PRINTED = (0.80, 0.795, 0.765)
_FLATNESS = 0.6  # a cap is about this much lower than wide; scales heights when caps collide


@dataclass(frozen=True)
class Area:
    """A rectangle of the bed, m, in the bed frame."""

    x0: float
    x1: float
    y0: float
    y1: float

    @property
    def size(self) -> float:
        """Its area, m^2."""
        return (self.x1 - self.x0) * (self.y1 - self.y0)

    def grown(self, margin: float) -> Area:
        """Return it larger by a margin on every side."""
        return Area(self.x0 - margin, self.x1 + margin, self.y0 - margin, self.y1 + margin)

    def draw(self, rng: np.random.Generator, count: int) -> Floats:
        """Draw points (count, 2)."""
        return rng.uniform((self.x0, self.y0), (self.x1, self.y1), (count, 2))


@dataclass
class _Seats:
    """Mushrooms before they are shaped: kind, radius, place and height of the rim over ground."""

    kind: list[Kind]
    radius: Floats
    place: Floats
    height: Floats
    lean: Floats


def plant(
    settings: SceneSettings,
    area: Area,
    share: float,
    ground: Callable[[Floats], Floats],
    rng: np.random.Generator,
) -> list[Mushroom]:
    """Plant a bed or lay out a lab table.

    Args:
        settings: Counts, sizes, tilts and colours.
        area: Where mushrooms may stand.
        share: Area of `area` over the area in view; counts grow by it.
        ground: Height (N,) m of the ground at points (N, 2) m.
        rng: Draws everything.

    Returns:
        Mushrooms in an order that depends on the seed alone.
    """
    seats = _seat(settings, area, share, rng)
    _part(seats, 1.0 if settings.scene == "bed" else 1.08)
    children = rng.spawn(len(seats.kind))
    return [_grow(settings, seats, row, ground, child) for row, child in enumerate(children)]


def _seat(settings: SceneSettings, area: Area, share: float, rng: np.random.Generator) -> _Seats:
    lab = settings.scene == "lab"
    printed = lab and settings.printed
    wanted = [(Kind.PRINTED if printed else Kind.GROWING, settings.count)]
    if not printed:
        wanted += [(Kind.STUMP, settings.stumps), (Kind.FALLEN, settings.fallen)]
        wanted += [(Kind.PIN, settings.pins)]
    kind = [k for k, number in wanted for _ in range(round(number * share))]
    radius = np.array([_radius(k, settings, rng) for k in kind]).reshape(-1)
    place = _places(kind, radius, settings.cluster, area, rng)
    stem = radius * rng.uniform(0.55, 1.1, len(kind)) + rng.uniform(0.002, 0.008, len(kind))
    above = rng.exponential(0.013, len(kind)) * (radius > 0.009)
    height = stem + (0 if lab else np.minimum(above, 0.035))
    for row, k in enumerate(kind):
        if k == Kind.STUMP:
            height[row] = rng.uniform(0.004, 0.014)
            if _fresh(settings, k, row):
                radius[row] *= generator(settings.seed, "fresh", row, 0).uniform(0.9, 1.5)
                height[row] *= generator(settings.seed, "fresh", row, 1).uniform(0.9, 1.8)
        elif k == Kind.FALLEN:
            height[row] = 0.8 * radius[row]
        elif k == Kind.GROWING and settings.sunk:
            deep = generator(settings.seed, "sunk", row).uniform(0, settings.sunk)
            height[row] *= 1 - deep
    return _Seats(kind, radius, place, height, np.zeros_like(place))


def _radius(kind: Kind, settings: SceneSettings, rng: np.random.Generator) -> float:
    low, high = (size / 2000 for size in settings.size_mm)
    if kind == Kind.PIN:
        return float(rng.uniform(0.0022, 0.0055))
    if kind == Kind.STUMP:
        return float(rng.uniform(0.0055, 0.0095))
    return float(low + (high - low) * rng.beta(1.1, 2.1))


def _places(
    kind: list[Kind], radius: Floats, cluster: float, area: Area, rng: np.random.Generator
) -> Floats:
    """Draw places (N, 2): a share of the mushrooms around cluster centres, the others anywhere."""
    count = len(kind)
    place = area.draw(rng, count)
    centers = area.draw(rng, max(1, round(count / 11)))
    weight = rng.gamma(1.2, size=len(centers))
    member = rng.choice(len(centers), count, p=weight / weight.sum())
    within = np.bincount(member, minlength=len(centers))[member]
    spread = 0.5 * np.sqrt(within) * (float(radius.mean()) if count else 0)
    grouped = rng.random(count) < cluster
    around = centers[member] + rng.normal(0, 1, (count, 2)) * spread[:, None]
    loose = np.array([k == Kind.FALLEN for k in kind], bool)
    return np.asarray(np.where((grouped & ~loose)[:, None], around, place))


def _part(seats: _Seats, gap: float) -> None:
    """Push mushrooms apart until their caps only touch; the sum of pushes is where each leans.

    Heights count less than distances, so that a cap well above another may cover it.
    """
    reach = gap * 0.95 * (seats.radius[:, None] + seats.radius)
    rise = (seats.height[:, None] - seats.height) / _FLATNESS
    np.fill_diagonal(reach, 0)
    mass = seats.radius**2
    yields = mass / np.maximum(mass[:, None] + mass, 1e-12)
    for _ in range(50):
        offset = seats.place[:, None] - seats.place
        flat = np.sqrt((offset**2).sum(axis=-1)) + 1e-9
        needed = np.sqrt(np.maximum(reach**2 - rise**2, 0))
        push = np.maximum(needed - flat, 0) * yields
        step = (offset / flat[..., None] * push[..., None]).sum(axis=1)
        seats.place += 0.6 * step
        seats.lean += step
    near = (flat < 1.3 * reach)[..., None]
    seats.lean += 0.15 * (offset * near).sum(axis=1)


def _grow(
    settings: SceneSettings,
    seats: _Seats,
    row: int,
    ground: Callable[[Floats], Floats],
    rng: np.random.Generator,
) -> Mushroom:
    kind, radius, place = seats.kind[row], float(seats.radius[row]), seats.place[row]
    axis = _axis(settings, kind, seats.lean[row], rng)
    if _fresh(settings, kind, row):  # cut askew
        axis = axis + 0.25 * generator(settings.seed, "fresh", row, 2).normal(size=3) * [1, 1, 0]
        axis /= np.linalg.norm(axis)
    height = float(seats.height[row])
    bend = min(0.75 * height, 0.9 * radius) if kind != Kind.FALLEN else 0.0
    spot = place - bend * axis[:2]
    if settings.lean and kind in (Kind.GROWING, Kind.PRINTED):
        spot = spot - settings.lean * _lean(settings.seed, row, radius)
    foot = np.array([*spot, float(ground(spot[None])[0])])
    center = np.array([*place, foot[2] + height])
    age = rng.beta(1.6, 1.8) if kind in (Kind.GROWING, Kind.FALLEN) else 0.2
    stem = radius if kind == Kind.STUMP else radius * rng.uniform(0.3, 0.46)
    name = settings.cap_color
    if name == "mixed":
        name = ("white", "cream", "brown")[rng.integers(3)]
    printed = kind == Kind.PRINTED
    tint = np.array(_PRINTED if printed and name != "wood" else _TINTS[name])
    dark = {"brown": 0.65, "wood": 0.7}.get(name, 0.9)
    tint = tint * rng.uniform(dark, 1.03) * rng.normal(1, 0.006, 3)
    scaly = rng.uniform(0.4, 1.0) if name == "brown" else rng.choice([0.0, 0.15], p=[0.8, 0.2])
    if name == "wood":
        stem *= 1.5
    return Mushroom(
        kind,
        center,
        axis,
        float(rng.uniform(0, 2 * np.pi)),
        radius,
        _shape(settings, kind, float(age), row, rng),
        foot,
        float(stem),
        (float(tint[0]), float(tint[1]), float(tint[2])),
        0.0 if printed else float(scaly),
        0.0 if printed else float(rng.beta(1.1, 2.5)),
        0.03 if printed else float(rng.uniform(0.02, 0.18)),
        0.07 if name == "wood" else 0.0,
        _fresh(settings, kind, row),
    )


def _fresh(settings: SceneSettings, kind: Kind, row: int) -> bool:
    if kind != Kind.STUMP or not settings.fresh:
        return False
    return bool(generator(settings.seed, "fresh", row).random() < settings.fresh)


def _lean(seed: int, row: int, radius: float) -> Floats:
    """Return how much farther (2,) m than its bend a stem may lean: up to 1.5 cap radii."""
    rng = generator(seed, "lean", row)
    turn, far = rng.uniform(0, 2 * np.pi), 1.5 * radius * rng.uniform(0, 1)
    return np.array([np.cos(turn), np.sin(turn)]) * far


def _shape(
    settings: SceneSettings, kind: Kind, age: float, row: int, rng: np.random.Generator
) -> CapShape:
    shape = draw_shape(rng, settings.shape_family, age)
    if settings.deform:
        shape = deformed(shape, settings.deform, rng)
    if settings.old:
        years = generator(settings.seed, "old", row)
        shape = aged(shape, years) if years.random() < settings.old else shape
    if kind == Kind.PRINTED:  # one CAD model, a little different in print
        return CapShape(shape.family, shape.height, shape.form, shape.lip, shape.curl, True, Warp())
    return shape


def _axis(settings: SceneSettings, kind: Kind, lean: Floats, rng: np.random.Generator) -> Floats:
    low, high = np.radians(settings.tilt_deg)
    tilt = rng.uniform(low, high)
    if kind == Kind.FALLEN:
        tilt = np.radians(rng.uniform(75, 150))
    elif kind == Kind.STUMP:
        tilt = np.radians(rng.uniform(0, 12))
    outwards = np.arctan2(lean[1], lean[0]) if np.hypot(*lean) > 1e-6 else rng.uniform(0, 2 * np.pi)
    turn = outwards + rng.normal(0, 0.6)
    sine = np.sin(tilt)
    return np.array([sine * np.cos(turn), sine * np.sin(turn), np.cos(tilt)])
