"""Seeded randomness and smooth noise, the raw material of every texture and relief."""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter, map_coordinates

from mushpipe.core.arrays import Singles

Reals = NDArray[np.floating[Any]]

_PARTS = (
    "plant", "ground", "texture", "ambient", "light", "photo", "photo frame", "fixed pattern",
    "depth frame", "holes", "lean", "relief", "rubble", "foreign", "sunk", "lids", "old", "fresh",
    "pebbles",
)  # fmt: skip


def generator(seed: int, part: str, *numbers: int) -> np.random.Generator:
    """Return the generator of one part of the simulation.

    Every part draws from a stream of its own, so that switching one off leaves the others as they
    are; `numbers` (the frame's, say) tell streams of a part apart.
    """
    return np.random.default_rng([seed, _PARTS.index(part), *numbers])


def blurred(rng: np.random.Generator, shape: tuple[int, int], sigma: float) -> Singles:
    """Return (H, W) noise of mean 0 and standard deviation 1, correlated over `sigma` px.

    White noise under a Gaussian of that sigma; wide ones are made small and enlarged.
    """
    shrink = max(1, int(sigma / 3))
    h, w = (n // shrink + 8 for n in shape)
    white = rng.standard_normal((h, w), np.float32)
    if sigma <= 0:
        return white[: shape[0], : shape[1]]
    field = cv2.GaussianBlur(white, (0, 0), sigma / shrink)
    if shrink > 1:
        size = (w * shrink, h * shrink)
        field = cv2.resize(field, size, interpolation=cv2.INTER_CUBIC)
    cut = field[: shape[0], : shape[1]]
    return np.asarray(cut / max(float(field.std()), 1e-9), np.float32)


class Noise3:
    """Smooth noise in space: a periodic cube of Gaussian noise, standard deviation about 1.

    Looked up in an object's own coordinates, a texture sticks to its object when the camera moves.
    """

    _SIDE = 64

    def __init__(self, rng: np.random.Generator) -> None:
        white = rng.standard_normal((self._SIDE,) * 3).astype(np.float32)
        cube = gaussian_filter(white, 1.5, mode="wrap")
        self._cube = cube / cube.std()

    def __call__(self, points: Reals, grain: float) -> Singles:
        """Return noise (N,) at points (N, 3) m; details are about `grain` m wide."""
        places = np.ascontiguousarray((np.asarray(points, np.float32) / (grain / 4.0)).T)
        return np.asarray(map_coordinates(self._cube, places, order=1, mode="grid-wrap"))


def smoothstep(low: float, high: float, value: Singles) -> Singles:
    """Return 0 below `low`, 1 above `high`, and the cubic 3t^2 - 2t^3 between."""
    t = np.clip((value - low) / (high - low), 0, 1)
    return np.asarray(t * t * (3 - 2 * t))


def mix(a: Singles, b: Singles | tuple[float, ...], share: Singles) -> Singles:
    """Return a (N, C) faded to b by share (N,) in 0..1."""
    weight = share[:, None]
    return np.asarray(a * (1 - weight) + np.asarray(b, np.float32) * weight, np.float32)
