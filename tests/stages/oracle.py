"""References that share no code with the product: naive loops and scipy's operators."""

from __future__ import annotations

import math

import numpy as np
from scipy import ndimage


def naive_energy(image: np.ndarray, region: np.ndarray, mu: float) -> float:
    """The Chan-Vese energy, pixel by pixel and pair by pair."""
    height, width = region.shape
    pixels = image.reshape(height, width, -1).astype(float)
    inside = [pixels[y, x] for y in range(height) for x in range(width) if region[y, x]]
    outside = [pixels[y, x] for y in range(height) for x in range(width) if not region[y, x]]
    total = 0.0
    for side in (inside, outside):
        if side:
            mean = sum(side) / len(side)
            total += sum(float(((p - mean) ** 2).mean()) for p in side)
    for y in range(height):
        for x in range(width):
            for dy, dx in ((0, 1), (1, 0), (1, 1), (1, -1)):
                if 0 <= y + dy < height and 0 <= x + dx < width:
                    cut = region[y, x] != region[y + dy, x + dx]
                    total += mu * math.pi / 8 * cut / math.hypot(dy, dx)
    return total / region.size


ACROSS = np.array([[0, 0, 0], [1, 1, 1], [0, 0, 0]])
LINES = [np.eye(3), np.fliplr(np.eye(3)), ACROSS, ACROSS.T]


def sup_inf(u: np.ndarray) -> np.ndarray:
    """SI of Marquez-Neila et al. 2014, background beyond the image."""
    return np.any([ndimage.binary_erosion(u, line) for line in LINES], axis=0)


def inf_sup(u: np.ndarray) -> np.ndarray:
    """IS of Marquez-Neila et al. 2014, background beyond the image."""
    return np.all([ndimage.binary_dilation(u, line) for line in LINES], axis=0)


def morphological(
    image: np.ndarray, initial: np.ndarray, iterations: int, smoothing: int
) -> np.ndarray:
    """Morphological Chan-Vese by its definition, one step at a time, never stopping early."""
    u, flip = initial.copy(), False
    for _ in range(iterations):
        if u.all() or not u.any():
            break
        c1, c2 = image[u].mean(dtype=float), image[~u].mean(dtype=float)
        middle = np.float32((c1 + c2) / 2)
        band = np.any([np.gradient(u.astype(float), axis=k) != 0 for k in (0, 1)], axis=0)
        nearer = image > middle if c1 > c2 else image < middle
        u = np.where(band, nearer, u)
        for _ in range(smoothing):
            u = inf_sup(sup_inf(u)) if flip else sup_inf(inf_sup(u))
            flip = not flip
    return u
