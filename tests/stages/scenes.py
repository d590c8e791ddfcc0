"""Frames with a known answer, drawn by hand: no code of the product is used to make them."""

from __future__ import annotations

import numpy as np

from mushpipe import Camera, Header, RgbdFrame

CAMERA = Camera(160, 120, 200.0, 200.0, 79.5, 59.5)
HEADER = Header(1_000_000_000, 0, "camera_color_optical_frame")


def pixel_grid() -> tuple[np.ndarray, np.ndarray]:
    v, u = np.mgrid[: CAMERA.height, : CAMERA.width].astype(float)
    return u, v


def frame_of(
    gray: np.ndarray, depth: np.ndarray | None = None, camera: Camera | None = CAMERA
) -> RgbdFrame:
    """A frame of a gray image in 0..1 and a depth image in metres (NaN = missing)."""
    color = np.repeat(np.rint(gray * 255).astype(np.uint8)[..., None], 3, axis=2)
    native = None if depth is None else np.nan_to_num(depth).astype(np.float32)
    return RgbdFrame(HEADER, color, native, 1.0, camera)


def discs(circles: list[tuple[float, float, float]], inside: float, outside: float) -> np.ndarray:
    """A gray image of discs, anti-aliased by 8x8 supersampling."""
    offsets = (np.arange(8) + 0.5) / 8 - 0.5
    u, v = pixel_grid()
    image = np.full(u.shape, outside)
    for x, y, r in circles:
        cover = np.mean(
            [(u + du - x) ** 2 + (v + dv - y) ** 2 <= r * r for du in offsets for dv in offsets],
            axis=0,
        )
        image = image * (1 - cover) + inside * cover
    return image


def sphere_depth(center: tuple[float, float, float], radius: float, bed: float) -> np.ndarray:
    """Depth of a sphere before a plane at z = bed, by the closed form of a ray and a sphere."""
    u, v = pixel_grid()
    ray = np.stack([(u - 79.5) / 200, (v - 59.5) / 200, np.ones_like(u)], axis=-1)
    c = np.array(center)
    a, b = (ray**2).sum(-1), ray @ c
    root = b * b - a * (c @ c - radius**2)
    return np.where(root > 0, (b - np.sqrt(np.maximum(root, 0))) / a, bed)
