"""A bed drawn at random: where mushrooms stand, how they lean, and what lies between them."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from mushpipe.core.arrays import Floats
from mushpipe.sim.mushroom import turned_to
from training.traced import things
from training.traced.mesh import Mesh, joined

_TRIES = 60


@dataclass(frozen=True, eq=False)
class Mushroom:
    """One mushroom, or the stump of one.

    Attributes:
        axis: (3,) unit normal of the cap.
        position: (3,) m, centre of its widest ring; the top of a stump.
        skin: Outside of the cap, which makes the outline; a whole stump.
        rest: Underside and stem; None for a stump.
    """

    axis: Floats
    position: Floats
    skin: Mesh
    rest: Mesh | None


@dataclass(frozen=True, eq=False)
class Bed:
    """A bed in its own frame.

    Attributes:
        mushrooms: Mushrooms and stumps.
        ground: All that is none of them.
        distance: m from the camera to the bed, along the optical axis.
        rotation: (3, 3) from the bed to the camera's optical frame.
    """

    mushrooms: list[Mushroom]
    ground: Mesh
    distance: float
    rotation: Floats


def drawn(rng: np.random.Generator, half_view: Floats) -> Bed:
    """Return a bed.

    Args:
        rng: Draws it.
        half_view: (2,) half of the view at a distance of 1, as tangents by x and y.
    """
    distance = rng.uniform(0.36, 0.62)
    half = half_view * distance
    color = rng.choice(list(things.CAP_COLORS), p=[0.55, 0.15, 0.3])
    soil = np.array(things.SOILS[rng.choice(list(things.SOILS))]) * rng.uniform(0.6, 1.5)
    places, radii = _places(half, int(rng.integers(30, 160)), rng)
    mushrooms = [_grown(k, places, radii, color, rng) for k in range(len(radii))]
    stumps, lumps = rng.integers(0, 7), rng.integers(20, 400)
    mushrooms += [_cut(_free(half, places, radii, rng), rng) for _ in range(stumps)]
    parts = [things.soil((half[0] * 1.5, half[1] * 1.6), soil, rng.choice([0, 0, 0.1, 0.3]), rng)]
    parts += [_lump(_free(half, places, radii, rng), soil, rng) for _ in range(lumps)]
    tilt = turned_to(_leaning(np.radians(abs(rng.normal(0, 5))), rng), 0.0)
    return Bed(mushrooms, joined(parts), distance, np.diag([1.0, -1, -1]) @ tilt)


def _leaning(angle: float, rng: np.random.Generator) -> Floats:
    """Return a unit vector an angle (rad) off z."""
    around = rng.uniform(0, 2 * np.pi)
    return np.array([np.cos(around) * np.sin(angle), np.sin(around) * np.sin(angle), np.cos(angle)])


def _places(half: Floats, count: int, rng: np.random.Generator) -> tuple[Floats, Floats]:
    """Return places (N, 2) m and radii (N,) m of mushrooms in clusters, touching, none merged."""
    seats = rng.uniform(-1, 1, (rng.integers(3, 9), 2)) * half
    mean = rng.uniform(0.010, 0.022)
    places, radii = np.zeros((0, 2)), np.zeros(0)
    for _ in range(count):
        radius = np.clip(mean * np.exp(rng.normal(0, 0.35)), 0.006, 0.038)
        for _ in range(_TRIES):
            place = seats[rng.integers(len(seats))] + rng.normal(0, 0.045, 2)
            if rng.random() < 0.25:  # one by itself
                place = rng.uniform(-1.1, 1.1, 2) * half
            away = np.linalg.norm(places - place, axis=1)
            if (away > rng.uniform(0.86, 1.1) * (radii + radius)).all():
                places, radii = np.vstack([places, place]), np.append(radii, radius)
                break
    return places, radii


def _free(half: Floats, places: Floats, radii: Floats, rng: np.random.Generator) -> Floats:
    """Return a place (3,) m on the bed, beside the mushrooms where there is room."""
    for _ in range(_TRIES):
        place = rng.uniform(-1, 1, 2) * half
        if (np.linalg.norm(places - place, axis=1) > radii + 0.008).all():
            break
    return np.array([*place, 0.0])


def _grown(k: int, places: Floats, radii: Floats, color: str, rng: np.random.Generator) -> Mushroom:
    """Return a mushroom that leans away from its neighbours, as crowded ones do."""
    way = places[k] - places
    near = np.linalg.norm(way, axis=1) < 1.6 * (radii + radii[k])
    push = (way[near] / radii[k]).sum(axis=0)
    lean = 0.10 * push + rng.normal(0, 0.10, 2)
    lean *= min(1, 0.8 / max(float(np.linalg.norm(lean)), 1e-9))
    axis = np.array([*lean, 1]) / np.sqrt(1 + lean @ lean)
    radius = radii[k]
    skin, gills = things.cap(radius, color, rng)
    position = np.array([*places[k], radius * rng.uniform(0.5, 1.7) + 0.003])
    turn = turned_to(axis, rng.uniform(0, 6.3))
    foot = position - axis * position[2] / axis[2] * 1.1
    top = position + turn @ [0, 0, 0.25 * radius]
    stalk = things.stem(foot - [0, 0, 0.004], top, radius * rng.uniform(0.24, 0.42), rng)
    rest = joined([gills.placed(turn, position), stalk])
    return Mushroom(axis, position, skin.placed(turn, position), rest)


def _cut(place: Floats, rng: np.random.Generator) -> Mushroom:
    up = np.array([0.0, 0, 1])
    length = rng.uniform(0.004, 0.016)
    mesh = things.stump(place - 0.003 * up, rng.uniform(0.004, 0.010), length, rng)
    return Mushroom(up, place + length * up, mesh, None)


def _lump(place: Floats, soil: Floats, rng: np.random.Generator) -> Mesh:
    """Return a clod, a crumb, or now and then a pale stone."""
    color = rng.uniform(0.15, 0.5) * np.array([1, 0.95, 0.88]) if rng.random() < 0.15 else soil
    return things.clod(place, min(0.022, 0.0015 + rng.exponential(0.0025)), color, rng)
