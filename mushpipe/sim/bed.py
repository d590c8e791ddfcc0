"""A simple mushroom bed, ray cast exactly: spheroid caps above a rough plane.

Every cap is an oblate spheroid; its visible surface is the nearer root of the quadratic along the
pixel's ray, so depth and normals are exact before noise is added.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from mushpipe import Camera

Floats = NDArray[np.float64]


@dataclass(frozen=True)
class Caps:
    """Spheroids: ``center`` (N, 3) m, unit ``axis`` (N, 3), ``radius`` and ``height`` (N,) m."""

    center: Floats
    axis: Floats
    radius: Floats
    height: Floats


def plant(
    rng: np.random.Generator, camera: Camera, distance: float, count: int, tilt_deg: float
) -> Caps:
    """Place caps on a bed at a distance, none overlapping by more than a tenth of its radius."""
    centers: list[Floats] = []
    radii: list[float] = []
    for _ in range(60 * count):
        radius = rng.uniform(0.012, 0.026)
        pixel = rng.uniform((0, 0), (camera.width, camera.height))
        center = camera.deproject(pixel, np.array(distance - rng.uniform(0.9, 1.6) * radius))
        others = zip(centers, radii, strict=True)
        if all(np.hypot(*(center - c)[:2]) > 0.9 * (radius + r) for c, r in others):
            centers.append(center)
            radii.append(radius)
        if len(centers) == count:
            break
    tilt = np.radians(rng.uniform(0, tilt_deg, len(radii)))
    turn = rng.uniform(0, 2 * np.pi, len(radii))
    sine = np.sin(tilt)
    axis = np.stack([sine * np.cos(turn), sine * np.sin(turn), -np.cos(tilt)], axis=1)
    height = np.array(radii) * rng.uniform(0.5, 0.8, len(radii))
    return Caps(np.array(centers).reshape(-1, 3), axis, np.array(radii), height)


def bed_surface(rng: np.random.Generator, camera: Camera, distance: float) -> tuple[Floats, Floats]:
    """Return depth (H, W) in metres and gray albedo (H, W) of rough soil."""
    shape = (camera.height, camera.width)
    relief = sum(
        cv2.GaussianBlur(rng.standard_normal(shape), (0, 0), sigma) * sigma * weight
        for sigma, weight in ((2.0, 0.0015), (8.0, 0.004), (30.0, 0.006))
    )
    albedo = 0.16 + 0.05 * cv2.GaussianBlur(rng.standard_normal(shape), (0, 0), 1.2)
    return distance - np.asarray(relief), np.clip(albedo, 0.05, 0.4)


def cast(camera: Camera, caps: Caps, depth: Floats) -> tuple[Floats, Floats, NDArray[np.int32]]:
    """Put caps in front of a bed.

    Args:
        camera: The camera.
        caps: The caps.
        depth: (H, W) depth of the bed in metres.

    Returns:
        Depth (H, W), unit normals (H, W, 3), and labels (H, W): the cap's row, -1 for the bed.
    """
    v, u = np.mgrid[: camera.height, : camera.width].astype(np.float64)
    rays = camera.deproject(np.stack([u, v], axis=-1), np.ones_like(u))
    points = rays * depth[..., None]
    normals = np.cross(np.gradient(points, axis=0), np.gradient(points, axis=1))
    depth, labels = depth.copy(), np.full(depth.shape, -1, np.int32)
    for row in range(len(caps.radius)):
        box = _box(camera, caps.center[row], caps.radius[row])
        z, normal = _spheroid(rays[box], caps, row)
        nearer = z < depth[box]
        depth[box] = np.where(nearer, z, depth[box])
        labels[box] = np.where(nearer, row, labels[box])
        normals[box] = np.where(nearer[..., None], normal, normals[box])
    normals /= np.linalg.norm(normals, axis=-1, keepdims=True)
    facing = np.sign((normals * rays).sum(axis=-1, keepdims=True))
    return depth, -normals * facing, labels


def _box(camera: Camera, center: Floats, radius: float) -> tuple[slice, slice]:
    u, v = camera.project(center)
    r = camera.fx * radius / (center[2] - radius) + 2
    rows = slice(max(0, int(v - r)), max(0, int(v + r) + 1))
    return rows, slice(max(0, int(u - r)), max(0, int(u + r) + 1))


def _spheroid(rays: Floats, caps: Caps, row: int) -> tuple[Floats, Floats]:
    """Intersect rays (z = 1) with |p|^2/R^2 + (1/h^2 - 1/R^2)(p.n)^2 = 1; inf where they miss."""
    center, axis = caps.center[row], caps.axis[row]
    inverse = 1 / caps.radius[row] ** 2
    extra = 1 / caps.height[row] ** 2 - inverse
    along, offset = rays @ axis, center @ axis
    a = inverse * (rays**2).sum(axis=-1) + extra * along**2
    b = inverse * (rays @ center) + extra * along * offset
    c = inverse * (center @ center) + extra * offset**2 - 1
    root = b * b - a * c
    z = np.where(root > 0, (b - np.sqrt(np.maximum(root, 0))) / a, np.inf)
    p = rays * np.where(np.isfinite(z), z, 1.0)[..., None] - center
    return z, inverse * p + extra * (p @ axis)[..., None] * axis
