"""Source `synthetic`: a simulated mushroom bed, for demos and tests without a camera."""

from __future__ import annotations

from collections.abc import Iterator

import cv2
import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from mushpipe import Camera, Header, ReplaySource, RgbdFrame
from mushpipe.sim.bed import Floats, bed_surface, cast, plant

_EPOCH_NS = 1_700_000_000 * 10**9


class SyntheticSource(ReplaySource):
    """Renders a seeded bed of white caps under a still camera, with sensor noise per frame.

    The same settings give the same frames. Depth has the SR300's unit of 1/8 mm, noise that grows
    with distance, and holes at steep edges.
    """

    max_frames: int | None = Field(10, ge=1, description="number of frames")
    seed: int = Field(0, ge=0, description="seed of bed and noise")
    count: int = Field(40, ge=0, le=400, description="number of mushrooms")
    distance: float = Field(0.5, gt=0.1, le=2, description="distance of the bed from the camera, m")
    tilt_deg: float = Field(15, ge=0, le=45, description="largest tilt of a cap, degrees")
    fps: float = Field(30, gt=0, description="frames per second")

    def frames(self) -> Iterator[RgbdFrame]:
        """Yield frames without end; `max_frames` ends them."""
        camera = Camera(640, 480, 617.0, 617.0, 319.5, 239.5)
        rng = np.random.default_rng(self.seed)
        caps = plant(rng, camera, self.distance, self.count, self.tilt_deg)
        bed, albedo = bed_surface(rng, camera, self.distance)
        depth, normals, labels = cast(camera, caps, bed)
        color = _shade(albedo, normals, labels)
        sequence = 0
        while True:
            noise = np.random.default_rng([self.seed, sequence])
            yield RgbdFrame(
                Header(
                    _EPOCH_NS + round(sequence * 1e9 / self.fps),
                    sequence,
                    "camera_color_optical_frame",
                ),
                np.clip(np.rint(color + noise.normal(0, 2.0, color.shape)), 0, 255).astype("u1"),
                _sense(depth, noise),
                0.000125,
                camera,
            )
            sequence += 1


def _shade(albedo: Floats, normals: Floats, labels: NDArray[np.int32]) -> Floats:
    """Return a (H, W, 3) image in 0..255: Lambert's law under a lamp beside the camera."""
    lamp = np.array([0.35, -0.25, -0.9])
    light = 0.25 + 0.75 * np.clip(normals @ (lamp / np.linalg.norm(lamp)), 0, 1)
    cap = labels >= 0
    tint = np.where(cap[..., None], (0.93, 0.90, 0.84), albedo[..., None] * (1.0, 0.8, 0.6))
    return np.asarray(255 * np.clip(tint * light[..., None], 0, 1))


def _sense(depth: Floats, rng: np.random.Generator) -> NDArray[np.uint16]:
    """Return depth as an SR300 would: noise of 0.3 + 1.2 z[m] mm, no return at steep edges."""
    noisy = depth + rng.normal(0, 1, depth.shape) * (0.0003 + 0.0012 * depth)
    step = cv2.morphologyEx(depth, cv2.MORPH_GRADIENT, np.ones((3, 3), np.uint8))
    lost = (step > 0.008) & (rng.random(depth.shape) < 0.7)
    lost |= rng.random(depth.shape) < 0.01
    units = np.rint(noisy / 0.000125)
    return np.where(lost, 0, np.clip(units, 0, 65535)).astype(np.uint16)
