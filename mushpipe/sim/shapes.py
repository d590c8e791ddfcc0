"""Shapes of caps: surfaces of revolution of two disjoint families, slightly deformed.

A cap's own frame has its origin at the centre of the rim (the widest ring), +z along the axis out
of the cap. Every deformation leaves the rim's mean plane where it is, so the axis stays exact.
Lengths of a shape are in units of its rim radius.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Literal

import numpy as np

from mushpipe.core.arrays import Floats
from mushpipe.sim.mesh import revolve

Family = Literal["a", "b"]


@dataclass(frozen=True)
class CapShape:
    """A cap of rim radius 1.

    Attributes:
        family: ``a``: the dome is a superellipse, rho^p + (z/h)^p = 1; ``b``: a cubic Bezier curve
            from (0, h) by (k1, h) and (1, k2 h) to (1, 0).
        height: h, from the rim plane to the middle of the top.
        form: (p,) of family a, (k1, k2) of family b.
        lip: How far the margin hangs below the rim plane.
        curl: How far it rolls inwards.
        veil: Whether the underside is still closed.
        warp: Departures from a surface of revolution.
        sunk: How far a ring around the middle stands above it, or, if negative, below: a hump.
    """

    family: Family
    height: float
    form: tuple[float, ...]
    lip: float
    curl: float
    veil: bool
    warp: Warp
    sunk: float = 0.0


@dataclass(frozen=True)
class Warp:
    """Small departures from revolution: waves (amplitude, order, phase) and a sheared top."""

    rim: tuple[tuple[float, int, float], ...] = ()
    bumps: tuple[tuple[float, int, float], ...] = ()
    flutter: tuple[tuple[float, int, float], ...] = ()
    shear: tuple[float, float] = (0.0, 0.0)


def draw_shape(rng: np.random.Generator, family: Family, age: float) -> CapShape:
    """Draw a cap; age 0 is a closed button, 1 a flat open cap.

    Ranges: aspect, exponent, lip, bumps and shear as in the bench for cap fits this project's pose
    estimator was designed on; family b has no curve in common with family a.
    """
    if family == "a":
        form: tuple[float, ...] = (rng.uniform(1.8, 2.5),)
        height = np.clip(0.86 - 0.42 * age + rng.normal(0, 0.05), 0.34, 0.95)
        lip, curl = 0.34 - 0.24 * age, 0.42 - 0.28 * age
    elif rng.random() < 0.5:  # conical
        form = (rng.uniform(0.12, 0.32), rng.uniform(0.2, 0.42))
        height = np.clip(0.95 - 0.35 * age + rng.normal(0, 0.05), 0.5, 1.05)
        lip, curl = rng.uniform(0.05, 0.4), 0.4 - 0.25 * age
    else:  # flat-topped
        form = (rng.uniform(0.80, 0.95), rng.uniform(0.78, 0.95))
        height = np.clip(0.72 - 0.35 * age + rng.normal(0, 0.05), 0.3, 0.8)
        lip, curl = rng.uniform(0.02, 0.3), 0.35 - 0.2 * age
    return CapShape(family, float(height), form, lip, curl, age < 0.45, draw_warp(rng, age))


def deformed(shape: CapShape, amount: float, rng: np.random.Generator) -> CapShape:
    """Return a cap that is no longer quite of its family: `amount` 1 is a third of its form."""
    stretch, bend = np.exp(amount * rng.normal(0, (0.25, 0.2)))
    warp, grow = shape.warp, 1 + 2 * amount * rng.random()
    oval = (float(rng.normal(0, 0.05 * amount)), 2, float(rng.uniform(0, 2 * np.pi)))
    bumps = tuple((grow * a, order, phase) for a, order, phase in warp.bumps)
    shear = tuple(s + float(rng.normal(0, 0.12 * amount)) for s in warp.shear)
    return replace(
        shape,
        height=float(np.clip(shape.height * stretch, 0.25, 1.2)),
        form=tuple(float(f * bend) for f in shape.form),
        warp=replace(warp, rim=(*warp.rim, oval), bumps=bumps, shear=(shear[0], shear[1])),
    )


def aged(shape: CapShape, rng: np.random.Generator) -> CapShape:
    """Return a cap as old ones are: open, low, its margin unrolled, its middle often sunk."""
    height = rng.uniform(0.08, 0.34)
    sunk = rng.uniform(-0.3 * height, 0.16) if rng.random() < 0.6 else 0.0
    lip, curl = rng.uniform((0.02, 0.03), (0.12, 0.2))
    return replace(
        shape, height=float(height), lip=float(lip), curl=float(curl), veil=False, sunk=float(sunk)
    )


def draw_warp(rng: np.random.Generator, age: float) -> Warp:
    """Draw the asymmetry of a grown cap: rim 1.5 / 0.8 %, bumps 0.6 % x 4, shear 4 %."""

    def wave(amplitude: float, order: int) -> tuple[float, int, float]:
        return float(rng.normal(0, amplitude)), order, float(rng.uniform(0, 2 * np.pi))

    rim = (wave(0.025, 2), wave(0.008, 3))
    bumps = tuple(wave(0.006, order) for order in (1, 2, 3, 4))
    flutter = tuple(wave(0.02 * age**2, order) for order in (3, 5))
    shear = rng.normal(0, 0.04, 2)
    return Warp(rim, bumps, flutter, (float(shear[0]), float(shear[1])))


def dome(shape: CapShape, rings: int) -> tuple[Floats, Floats]:
    """Return the profile (rho, z), each (rings,), from the top (0, h) to the rim (1, 0)."""
    t = np.linspace(0, 1, rings)
    if shape.family == "a":
        power = 2 / shape.form[0]
        rho, z = np.sin(t * np.pi / 2) ** power, np.cos(t * np.pi / 2) ** power
        ring = 4 * rho**2 * (1 - rho**2)
    else:
        k1, k2 = shape.form
        rho = 3 * t * (1 - t) ** 2 * k1 + 3 * t**2 * (1 - t) + t**3
        z = (1 - t) ** 3 + 3 * t * (1 - t) ** 2 + 3 * t**2 * (1 - t) * k2
        ring = np.sin(np.pi * rho) ** 2
    z[-1], rho[-1], rho[0] = 0.0, 1.0, 0.0
    return rho, shape.height * z + shape.sunk * ring


def margin(shape: CapShape, rings: int) -> tuple[Floats, Floats]:
    """Return the profile below the rim, each (rings,): a quarter of an ellipse rolling inwards."""
    t = np.linspace(0, np.pi / 2, rings)
    return 1 - shape.curl * (1 - np.cos(t)), -shape.lip * np.sin(t)


def underside(shape: CapShape, stem: float, rings: int) -> tuple[Floats, Floats]:
    """Return the profile from the margin inwards to a stem of radius `stem`, and on to the axis.

    A veil closes it straight; gills recede into the cap.
    """
    start = 1 - shape.curl
    rho = np.append(np.linspace(start, min(stem, 0.9 * start), rings - 1), 0.0)
    share = np.clip((start - rho) / max(start - stem, 0.05), 0, 1)
    depth = 0.0 if shape.veil else 0.6 * shape.lip + 0.25 * shape.height
    return rho, -shape.lip + depth * np.sin(share * np.pi / 2)


def _waves(waves: tuple[tuple[float, int, float], ...], turn: Floats) -> Floats:
    total = np.zeros_like(turn)
    for amplitude, order, phase in waves:
        total += amplitude * np.cos(order * turn + phase)
    return total


def shaped(shape: CapShape, rho: Floats, z: Floats, segments: int) -> Floats:
    """Turn a profile of the shape into rings (n, segments, 3), deformed by its warp."""
    points = revolve(rho, z, segments)
    turn = np.arctan2(points[..., 1], points[..., 0])
    steep = np.clip(rho, 0, 1)[:, None]
    high = np.clip(z / shape.height, 0, 1)[:, None]
    scale = 1 + _waves(shape.warp.rim, turn) * steep
    # bumps vanish at the pole, where the angle has no meaning, and along the axis at the rim
    scale = scale + _waves(shape.warp.bumps, turn + 3 * high) * np.sin(np.pi * high) * steep
    points = points * scale[..., None]
    points[..., 2] += _waves(shape.warp.flutter, turn) * steep**4
    points[..., :2] += np.asarray(shape.warp.shear) * np.maximum(points[..., 2:], 0)
    return points
