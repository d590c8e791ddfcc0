"""The depth camera: an SR300-like sensor whose every fault can be switched off.

Sources. Axial noise sigma(z) = 0.3 + 1.2 z[m] mm and the +2.85 mm offset follow the depth accuracy
table (Table I: +2.7 to +3.0 mm, about 1.1 mm at 0.5 to 0.8 m) of Baisa and Al-Diri 2022,
"Mushrooms Detection, Localization and 3D Pose Estimation using RGB-D Sensor for Robotic-picking
Applications". The unit of 1/8 mm and the range are the SR300's (librealsense `sr300.cpp`; spec
sheet); so is the baseline of 47 mm between projector and infrared camera. The split of the noise
into white, correlated and fixed parts, the cut at a cosine of 0.35, and the faults at edges are a
model in line with published characterisations of the camera (Carfagni et al. 2017, "On the
Performance of the Intel SR300 Depth Camera"), not a measurement.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Self

import cv2
import numpy as np
from numpy.typing import NDArray
from pydantic import Field, model_validator

from mushpipe.core.arrays import Bools, Floats, Singles
from mushpipe.core.group import Group
from mushpipe.sim.material import Paint
from mushpipe.sim.noise import blurred, generator
from mushpipe.sim.raycast import rays
from mushpipe.sim.render import Surface
from mushpipe.sim.world import View, World

BASELINE = 0.047  # m from the infrared camera to the projector, along -x
GRAZING = 0.35  # cosine between normal and sight under which too little light comes back
EDGE = 0.006  # m between neighbouring pixels from which on a pixel counts as an edge
# Shares of sigma; their squares add up to 1. The paper's sigma holds all of them.
WHITE, CORRELATED, FIXED_FINE, FIXED_WIDE = np.array([0.8, 0.35, 0.35, 0.3]) / np.sqrt(0.975)
_GLOSSY = 0.15
_MIRROR = 0.9985


def axial_sigma(depth: Singles) -> Singles:
    """Return the standard deviation (m) of the depth at a depth (m)."""
    return np.asarray(0.0003 + 0.0012 * depth, np.float32)


@dataclass(frozen=True, eq=False)
class Exact:
    """What the sensor looks at: exact depth (H, W) m, and where nothing can come back."""

    depth: Singles
    lost: Bools


class DepthSensor(Group):
    """The faults of the depth camera."""

    offset_mm: float = Field(2.85, ge=-20, le=20, description="constant error of depth, mm")
    unit_mm: float = Field(0.125, ge=0.01, le=1, description="unit of the depth image, mm")
    noise: float = Field(1.0, ge=0, le=10, description="axial noise; 1: 0.3 + 1.2 z[m] mm")
    white: bool = Field(True, description="the part of the noise new at each pixel and frame")
    correlated: bool = Field(True, description="the part shared by neighbours (2 px), per frame")
    fixed_pattern: bool = Field(True, description="the part that stays from frame to frame")
    shadow: bool = Field(True, description="holes where the projector's light does not reach")
    grazing: bool = Field(True, description="holes where the surface is seen at a grazing angle")
    highlights: bool = Field(True, description="holes where a wet surface mirrors the projector")
    cap_holes: float = Field(0.25, ge=0, le=1, description="share of caps with a hole at the top")
    random_holes: float = Field(0.01, ge=0, le=0.5, description="share of pixels lost at random")
    edges: bool = Field(True, description="jitter, flying pixels and losses at depth edges")
    range_m: tuple[float, float] = Field((0.2, 1.5), description="nearest and farthest depth, m")

    @model_validator(mode="after")
    def _ordered(self) -> Self:
        if not 0 <= self.range_m[0] < self.range_m[1] <= 100:
            raise ValueError("range_m must be [nearest, farthest], in m, at most 100")
        return self

    def scan(self, world: World, view: View, surface: Surface, paint: Paint, seed: int) -> Exact:
        """Return exact depth and the holes that stay as long as nothing moves."""
        depth = surface.depth.reshape(surface.shape).astype(np.float32)
        lost = (depth < self.range_m[0]) | (depth > self.range_m[1])
        projector = view.position + view.rotation @ [-BASELINE, 0, 0]
        if self.shadow:
            lost |= _shadow(world, surface, projector).reshape(lost.shape)
        if self.grazing:
            lost |= (surface.incidence() < GRAZING).reshape(lost.shape)
        if self.highlights:
            lost |= _mirrors(surface, paint, projector).reshape(lost.shape)
        if self.cap_holes:
            rng = generator(seed, "holes")
            lost |= _cap_holes(world, surface, self.cap_holes, rng).reshape(lost.shape)
        return Exact(depth, lost)

    def sense(self, exact: Exact, seed: int, frame: int) -> NDArray[np.uint16]:
        """Return the depth image (H, W) uint16 in units of `unit_mm`, 0 where missing."""
        rng = generator(seed, "depth frame", frame)
        depth, lost = exact.depth, exact.lost.copy()
        # Drawn in any case: switching a fault off must not change the noise.
        jittered, torn = _edges(depth, rng)
        holes = _random_holes(depth.shape, self.random_holes, rng)
        if self.edges:
            depth, lost = jittered, lost | torn
        lost |= holes
        error = self.noise * axial_sigma(depth) * self._pattern(depth.shape, seed, rng)
        measured = depth + error + np.float32(self.offset_mm / 1000)
        units = np.rint(measured.astype(np.float64) / (self.unit_mm / 1000))
        lost |= units > np.iinfo(np.uint16).max
        return np.where(lost, 0, np.maximum(units, 0)).astype(np.uint16)

    def _pattern(self, shape: tuple[int, int], seed: int, rng: np.random.Generator) -> Singles:
        """Return noise (H, W) of standard deviation 1, or less where parts are switched off."""
        total = np.zeros(shape, np.float32)
        fine = rng.standard_normal(shape, np.float32)
        smooth = blurred(rng, shape, 2.0)
        if self.white:
            total += np.float32(WHITE) * fine
        if self.correlated:
            total += np.float32(CORRELATED) * smooth
        if self.fixed_pattern:
            own = generator(seed, "fixed pattern")
            total += np.float32(FIXED_FINE) * blurred(own, shape, 2.5)
            total += np.float32(FIXED_WIDE) * blurred(own, shape, 25.0)
        return total


def _shadow(world: World, surface: Surface, projector: Floats) -> Bools:
    start = surface.point + 0.0004 * surface.normal
    return world.caster.blocked(rays(start, projector - start), 1.0)


def _mirrors(surface: Surface, paint: Paint, projector: Floats) -> Bools:
    way = projector - surface.point
    half = way / np.linalg.norm(way, axis=1, keepdims=True) + surface.sight
    half /= np.linalg.norm(half, axis=1, keepdims=True)
    aligned = np.einsum("pk,pk->p", surface.normal, half)
    return np.asarray((aligned > _MIRROR) & (paint.gloss > _GLOSSY))


def _cap_holes(world: World, surface: Surface, share: float, rng: np.random.Generator) -> Bools:
    """Lose 8 to 22 % of the radius around the top of a share of the caps."""
    count = len(world.mushrooms)
    chosen = rng.random(count) < share
    size = rng.uniform(0.08, 0.22, count) * [m.radius for m in world.mushrooms]
    tops = np.array([m.center + m.shape.height * m.radius * m.axis for m in world.mushrooms])
    rows = np.flatnonzero(surface.owner >= 0)
    owner = surface.owner[rows]
    lost = np.zeros(len(surface.depth), bool)
    if len(rows):
        away = np.linalg.norm(surface.point[rows] - tops[owner], axis=1)
        lost[rows] = chosen[owner] & (away < size[owner])
    return lost


def _edges(depth: Singles, rng: np.random.Generator) -> tuple[Singles, Bools]:
    """Tear depth edges: jitter of 0.42 px, a quarter flies between, a third is lost."""
    kernel = np.ones((3, 3), np.uint8)
    near, far = cv2.erode(depth, kernel), cv2.dilate(depth, kernel)
    edge = far - near > EDGE
    shift = [0.42 * blurred(rng, depth.shape, 1.0) for _ in range(2)]
    luck, share = (rng.random(depth.shape, np.float32) for _ in range(2))
    rows, columns = np.indices(depth.shape, np.float32)
    places = columns + shift[0], rows + shift[1]
    jittered = cv2.remap(depth, *places, cv2.INTER_NEAREST, borderMode=cv2.BORDER_REPLICATE)
    flying = edge & (luck < 0.25)
    torn = np.where(flying, near + share * (far - near), np.where(edge, jittered, depth))
    return torn.astype(np.float32), edge & (luck > 0.67)


def _random_holes(shape: tuple[int, int], share: float, rng: np.random.Generator) -> Bools:
    """Lose a share of the pixels: half of it one by one, half in blobs of a few px."""
    single = rng.random(shape, np.float32) < share / 2
    blob = blurred(rng, shape, 1.6)
    return np.asarray(single | (blob > np.quantile(blob, 1 - share / 2)))
