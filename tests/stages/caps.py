"""Depth of exact spheroid caps, by a ray caster that shares nothing with the product's."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from mushpipe import Camera, Circles, Header, RgbdFrame
from mushpipe.stages.cap.blocks import Image
from mushpipe.stages.upright import pixel_rays

CAMERA = Camera(320, 240, 400.0, 400.0, 159.5, 119.5)
LIP = 0.25


@dataclass(frozen=True)
class Cap:
    center: np.ndarray
    axis: np.ndarray
    radius: float
    height: float

    @property
    def apex(self) -> np.ndarray:
        return self.center + self.height * self.axis


def cap(tilt: float, turn: float, at: tuple[float, float, float], radius: float, aspect: float):
    """A cap tilted by `tilt` towards `turn` (degrees) off the axis that points at the camera."""
    t, p = np.radians([tilt, turn])
    axis = np.array([np.sin(t) * np.cos(p), np.sin(t) * np.sin(p), -np.cos(t)])
    return Cap(np.array(at), axis, radius, aspect * radius)


def frame_of(axis: np.ndarray) -> np.ndarray:
    """A rotation (3, 3) with the axis as its last column."""
    helper = np.eye(3)[np.argmin(np.abs(axis))]
    x = np.cross(helper, axis)
    x /= np.linalg.norm(x)
    return np.stack([x, np.cross(axis, x), axis], axis=1)


def half_depth(rays: np.ndarray, c: Cap, half_axis: float, upper: bool) -> np.ndarray:
    """Depth of one half, by scaling space until the spheroid is a unit sphere."""
    shrink = (frame_of(c.axis) / [c.radius, c.radius, half_axis]).T
    direction, origin = rays @ shrink.T, -shrink @ c.center
    a, b = (direction**2).sum(-1), direction @ origin
    root = b * b - a * (origin @ origin - 1)
    with np.errstate(invalid="ignore"):
        roots = [(-b + sign * np.sqrt(root)) / a for sign in (-1, 1)]
        depth = np.full(rays.shape[:-1], np.inf)
        for z in roots:
            side = (rays * z[..., None] - c.center) @ c.axis
            good = (root > 0) & (z > 0) & ((side >= 0) if upper else (side <= 0))
            depth = np.where(good, np.minimum(depth, z), depth)
    return depth


def passing(rays: np.ndarray, c: Cap, reach: float) -> np.ndarray:
    """Which rays (H, W, 3) pass within reach of a cap's centre."""
    squares = np.einsum("...k,...k", rays, rays)
    return c.center @ c.center - (rays @ c.center) ** 2 / squares < 1.01 * reach**2


def depth_of(
    caps: list[Cap], bed: float, camera: Camera = CAMERA, du: float = 0.0, dv: float = 0.0
) -> np.ndarray:
    """Depth (H, W) m over a bed at z = bed, of rays so many pixels beside the centres of pixels."""
    v, u = np.mgrid[: camera.height, : camera.width].astype(float)
    rays = camera.deproject(np.stack([u + du, v + dv], axis=-1), np.ones(u.shape))
    z = np.full(u.shape, bed)
    for c in caps:
        near = passing(rays, c, max(c.radius, c.height))
        for half_axis, upper in ((c.height, True), (LIP * c.radius, False)):
            z[near] = np.minimum(z[near], half_depth(rays[near], c, half_axis, upper))
    return z


def draw(caps: list[Cap], bed: float, camera: Camera = CAMERA) -> tuple[np.ndarray, np.ndarray]:
    """Depth (H, W) m over a bed at z = bed, and luma: caps 0.8, bed 0.2, anti-aliased."""
    corners = [(u, v) for u in (-0.25, 0.25) for v in (-0.25, 0.25)]
    seen = [depth_of(caps, bed, camera, *corner) < bed for corner in corners]
    return depth_of(caps, bed, camera), 0.2 + 0.6 * np.mean(seen, axis=0)


def draw_pointed(c: Cap, power: float, bed: float) -> tuple[np.ndarray, np.ndarray]:
    """Depth and luma of a cap (rho/R)^power + (s/h)^power = 1 over its rim, by bisection."""
    v, u = np.mgrid[: CAMERA.height, : CAMERA.width].astype(float)
    rays = CAMERA.deproject(np.stack([u, v], axis=-1), np.ones(u.shape))
    near = passing(rays, c, np.hypot(c.radius, c.height))
    rays = rays[near]

    def inside(z: np.ndarray) -> np.ndarray:
        q = rays * z[..., None] - c.center
        s = q @ c.axis
        rho = np.sqrt(np.maximum((q**2).sum(-1) - s**2, 0)) / c.radius
        high = np.where(s > 0, s / c.height, -s / (LIP * c.radius))
        bend = np.where(s > 0, power, 2.0)
        return rho**bend + high**bend < 1

    steps = np.linspace(c.center[2] - 2 * c.radius, c.center[2] + 2 * c.radius, 200)
    deep = np.full(len(rays), np.inf)
    for z in steps:
        deep = np.where(np.isinf(deep) & inside(np.full(len(rays), z)), z, deep)
    hit = np.isfinite(deep)
    deep = np.where(hit, deep, bed)
    before = deep - (steps[1] - steps[0])
    for _ in range(14):
        middle = (before + deep) / 2
        within = inside(middle)
        before, deep = np.where(within, before, middle), np.where(within, middle, deep)
    depth, luma = np.full(u.shape, bed), np.full(u.shape, 0.2)
    depth[near], luma[near] = np.where(hit, deep, bed), np.where(hit, 0.8, 0.2)
    return depth, luma


def frame_from(depth: np.ndarray, gray: np.ndarray, camera: Camera | None = CAMERA) -> RgbdFrame:
    color = np.repeat(np.rint(gray * 255).astype(np.uint8)[..., None], 3, axis=2)
    native = np.nan_to_num(depth).astype(np.float32)
    return RgbdFrame(Header(1, 0, "optical"), color, native, 1.0, camera)


def angle(a: np.ndarray, b: np.ndarray) -> float:
    """Degrees between two unit vectors."""
    return float(np.degrees(np.arccos(np.clip(a @ b, -1, 1))))


def image_of(depth: np.ndarray, camera: Camera = CAMERA) -> Image:
    """Depth as kernels see it, with ranks of a single circle that covers nothing."""
    nothing = np.ones(depth.shape, np.int16)
    return Image(depth.astype(np.float32), pixel_rays(camera), nothing, camera.focal)


def circle_of(c: Cap, camera: Camera = CAMERA) -> tuple[float, float, float]:
    """Centroid and equal-area radius of the outline of a cap that nothing hides."""
    return circle_around(depth_of([c], 10.0, camera) < 10.0)


def circle_around(shape: np.ndarray) -> tuple[float, float, float]:
    """Centroid and equal-area radius of the pixels that are true."""
    v, u = np.nonzero(shape)
    return float(u.mean()), float(v.mean()), float(np.sqrt(len(u) / np.pi))


def circles_of(caps: list[Cap], camera: Camera = CAMERA) -> Circles:
    table = np.array([circle_of(c, camera) for c in caps]).reshape(-1, 3)
    return Circles(table[:, :2], table[:, 2], np.ones(len(caps)))
