"""The colour camera: from light to the bytes of an image."""

from __future__ import annotations

import cv2
import numpy as np
from pydantic import Field

from mushpipe.core.arrays import Bytes, Singles
from mushpipe.core.group import Group


class ColorCamera(Group):
    """What a colour camera does to the light: each part can be switched off by its zero."""

    exposure: float = Field(0.05, ge=-4, le=4, description="exposure, stops")
    blur: float = Field(0.65, ge=0, le=5, description="blur of the lens, sigma in px")
    vignette: float = Field(0.25, ge=0, le=1, description="loss of light in the corners, share")
    white_balance: float = Field(0.03, ge=0, le=0.5, description="spread of the colour gains")
    noise: float = Field(
        1.0, ge=0, le=10, description="noise; 1: about 1.5 gray levels at mid-gray"
    )
    jpeg_quality: int = Field(
        90, ge=0, le=100, description="quality of the camera's own JPEG; 0: none"
    )

    def expose(self, light: Singles, rng: np.random.Generator) -> Singles:
        """Return light (H, W, 3) behind the lens: blurred, vignetted, with its colour cast."""
        h, w = light.shape[:2]
        y, x = (np.linspace(-1, 1, n, dtype=np.float32) ** 2 for n in (h, w))
        falloff = 1 - self.vignette * (y[:, None] + x) / 2
        gains = np.exp(rng.normal(0, self.white_balance, 3)).astype(np.float32)
        image = light * (falloff[..., None] * gains * 2.0**self.exposure).astype(np.float32)
        if self.blur:
            image = cv2.GaussianBlur(image, (0, 0), self.blur)
        return np.asarray(image)

    def develop(self, image: Singles, rng: np.random.Generator) -> Bytes:
        """Return the picture (H, W, 3) uint8 RGB of exposed light, with this frame's noise.

        Shot and read noise in linear light, a curve that bends into white, the gamma of sRGB.
        """
        if self.noise:
            sigma = self.noise * np.sqrt(2.0e-5 + 1.1e-4 * np.maximum(image, 0))
            grain = rng.standard_normal(image.shape, np.float32)
            color = cv2.GaussianBlur(grain, (0, 0), 0.6) * 1.6  # demosaicing spreads noise
            image = image + sigma * color
        codes = np.rint(255 * srgb(_shoulder(_contrast(image)))).astype(np.uint8)
        return _jpeg(codes, self.jpeg_quality) if self.jpeg_quality else codes


def _contrast(image: Singles) -> Singles:
    """Darken the shadows, as the picture styles of cameras do; 0 and 1 stay."""
    return np.asarray(np.maximum(image, 0) ** 1.25)


def _shoulder(image: Singles) -> Singles:
    """Bend what is brighter than 0.7 towards 1, as cameras do before they clip."""
    over = np.maximum(image - 0.7, 0)
    return np.asarray(np.minimum(image, 0.7) + 0.3 * (1 - np.exp(-over / 0.3)))


def srgb(linear: Singles) -> Singles:
    """Encode linear light 0..1 by the transfer curve of IEC 61966-2-1."""
    x = np.clip(linear, 0, 1)
    return np.asarray(np.where(x < 0.0031308, 12.92 * x, 1.055 * x ** (1 / 2.4) - 0.055))


def _jpeg(codes: Bytes, quality: int) -> Bytes:
    _, packed = cv2.imencode(".jpg", codes[..., ::-1], [cv2.IMWRITE_JPEG_QUALITY, quality])
    image = np.asarray(cv2.imdecode(packed, cv2.IMREAD_COLOR), np.uint8)
    return np.ascontiguousarray(image[..., ::-1])
