"""Other surfaces: grain on caps, a smooth bed, caps that differ and shade each other.

Simulated caps are smooth and alike and soil and stumps are not: it was by that that a network told
them, and it took grainy caps for stumps and smooth lumps for caps.
"""

from __future__ import annotations

import cv2
import numpy as np

from mushpipe.core.arrays import Floats, Singles

# Noise is a stretch of this: to draw it anew took a sixth of a crop's time.
NOISE = np.random.default_rng(0).standard_normal(2_000_000, np.float32)


def textured(image: Singles, cap: Singles, circles: Floats, rng: np.random.Generator) -> Singles:
    """Return an image (H, W, 3) with other surfaces and shadows of caps (N, 3) px, now and then."""
    if rng.random() < 0.15:
        image = individual(image, cap, circles, rng)
    if rng.random() < 0.15:
        image = shadowed(image, circles, rng)
    if rng.random() < 0.2:
        image = smooth_bed(image, cap, float(rng.uniform(0.7, 3)))
    if rng.random() < 0.25:
        image = grained(image, cap, rng)
    return image


def individual(image: Singles, cap: Singles, circles: Floats, rng: np.random.Generator) -> Singles:
    """Return an image (H, W, 3) whose caps (N, 3) px have each a brightness and tint of its own."""
    gain = np.ones((*cap.shape, 3), np.float32)
    spread, tint = rng.uniform(0.1, 0.4), rng.uniform(0, 0.1)
    for x, y, radius in circles:
        own = np.exp(rng.normal(0, spread) + rng.normal(0, tint, 3)).tolist()
        cv2.circle(gain, (round(x), round(y)), max(1, round(radius)), own, -1, cv2.LINE_AA)
    return np.asarray(image * (1 + cap[..., None] * (gain - 1)), np.float32)


def grained(image: Singles, where: Singles, rng: np.random.Generator) -> Singles:
    """Return an image (H, W, 3) with grain of 1 to 4 px in `where` (H, W) 0..1."""
    height, width = where.shape
    size = int(max(height, width) / np.exp(rng.uniform(0, np.log(4))))
    start = rng.integers(len(NOISE) - size * size)
    fine = NOISE[start : start + size * size].reshape(size, size)
    grain = cv2.resize(fine, (width, height), interpolation=cv2.INTER_CUBIC)
    tint = np.exp(rng.normal(0, 0.3, 3)) * np.exp(rng.uniform(np.log(0.02), np.log(0.2)))
    change = (where * grain)[..., None] * tint.astype(np.float32)
    return np.asarray(image * np.maximum(0, 1 + change), np.float32)


def smooth_bed(image: Singles, cap: Singles, sigma: float) -> Singles:
    """Return an image (H, W, 3) blurred by sigma (px) where there is no cap (H, W) 0..1."""
    bed = 1 - cap
    part = cv2.GaussianBlur(np.dstack([image * bed[..., None], bed]), (0, 0), sigma)
    smooth = part[..., :3] / np.maximum(part[..., 3:], 1e-3)
    return np.asarray(image + bed[..., None] * (smooth - image), np.float32)


def shadowed(image: Singles, circles: Floats, rng: np.random.Generator) -> Singles:
    """Return an image (H, W, 3) in which caps (N, 3) px shade themselves and what is behind them.

    As of a lamp from the side: a band as wide as the cap, but for the part that faces the lamp.
    """
    turn, reach, lit = rng.uniform(0, 2 * np.pi), rng.uniform(0.3, 2), rng.uniform(0, 0.8)
    way = np.array([np.cos(turn), np.sin(turn)])
    shade = np.zeros(image.shape[:2], np.uint8)
    for x, y, radius in circles[rng.random(len(circles)) < 0.8]:
        own, place, r = np.zeros_like(shade), np.array((x, y)), max(1, round(radius))
        end = place + reach * radius * way
        cv2.line(own, _pixel(place), _pixel(end), 255, 2 * r, cv2.LINE_AA)
        cv2.circle(own, _pixel(place - lit * radius * way), r, 0, -1, cv2.LINE_AA)
        shade |= own
    dark = cv2.GaussianBlur(shade.astype(np.float32) / 255, (0, 0), rng.uniform(0.5, 3))
    return np.asarray(image * (1 - np.float32(rng.uniform(0.2, 0.8)) * dark)[..., None], np.float32)


def _pixel(place: Floats) -> tuple[int, int]:
    return round(float(place[0])), round(float(place[1]))
