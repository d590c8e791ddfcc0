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
    grain = _field(where.shape, np.exp(rng.uniform(0, np.log(4))), rng)
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


def worn(image: Singles, cap: Singles, circles: Floats, rng: np.random.Generator) -> Singles:
    """Return an image (H, W, 3) with caps (N, 3) px and a bed unlike simulated ones."""
    if rng.random() < 0.2:
        image = overgrown(image, cap, rng)
    for _ in range(rng.choice(3, p=[0.55, 0.35, 0.1])):
        image = cracked(image, cap, rng)
    if rng.random() < 0.1:  # so that scales alone make no cap
        image = cracked(image, 1 - cap, rng)
    if rng.random() < 0.15:
        image = dotted(image, cap, circles, rng)
    return image


def cracked(image: Singles, where: Singles, rng: np.random.Generator) -> Singles:
    """Return an image (H, W, 3) with sharp specks, scales or cracks in `where` (H, W) 0..1."""
    field = _field(where.shape, np.exp(rng.uniform(np.log(1.5), np.log(12))), rng)
    edge = rng.uniform(0.3, 2)
    if rng.random() < 0.4:  # cracks run where the field changes its sign
        field, edge = -np.abs(field), -rng.uniform(0.05, 0.4)
    change = np.clip((field - np.float32(edge)) * np.float32(rng.uniform(2, 10)) + 0.5, 0, 1)
    if rng.random() < 0.5:
        change *= _field(where.shape, max(where.shape) / rng.uniform(2, 8), rng) > 0
    gain = np.exp(rng.uniform(-2, 0.4) + rng.normal(0, 0.25, 3)).astype(np.float32)
    return np.asarray(image * (1 + (where * change)[..., None] * (gain - 1)), np.float32)


def dotted(image: Singles, cap: Singles, circles: Floats, rng: np.random.Generator) -> Singles:
    """Return an image (H, W, 3) with drops, or lamps mirrored, on caps (N, 3) px."""
    dots, most = np.zeros(cap.shape, np.uint8), rng.uniform(1, 12)
    for x, y, radius in circles:
        places = rng.normal(0, 0.4, (rng.poisson(most), 2)) * radius + (x, y)
        for place in places:
            size = max(1, round(radius * rng.uniform(0.03, 0.14)))
            cv2.circle(dots, _pixel(place), size, 255, -1, cv2.LINE_AA)
    cover = (cap * dots * np.float32(rng.uniform(0.5, 1) / 255))[..., None]
    return np.asarray(image + cover * (np.float32(rng.uniform(0, 1.2)) - image), np.float32)


def overgrown(image: Singles, cap: Singles, rng: np.random.Generator) -> Singles:
    """Return an image (H, W, 3) whose bed is overgrown with what is about as bright as caps."""
    usual = np.median(image[cap > 0.9], axis=0) if (cap > 0.9).any() else np.full(3, 0.5)
    patches = _field(cap.shape, np.exp(rng.uniform(np.log(4), np.log(60))), rng)
    cover = np.clip(patches * np.float32(rng.uniform(1, 4)) + np.float32(rng.normal(0, 1.5)), 0, 1)
    light = image.mean(axis=2)
    light = np.clip(light / (cv2.GaussianBlur(light, (0, 0), 10) + 0.02), 0.5, 1.6)  # as of lumps
    light = light * np.maximum(0, 1 + 0.15 * _field(cap.shape, rng.uniform(1, 3), rng))
    white = light[..., None] * (usual * rng.uniform(0.5, 1.1)).astype(np.float32)
    cover = ((1 - cap) * cover * np.float32(rng.uniform(0.4, 1)))[..., None]
    return np.asarray(image + cover * (white - image), np.float32)


def _field(shape: tuple[int, ...], grain: float, rng: np.random.Generator) -> Singles:
    """Return noise (H, W) of about a standard deviation of 1, smooth over `grain` px."""
    height, width = shape
    size = max(2, int(max(height, width) / grain))
    start = rng.integers(len(NOISE) - size * size)
    fine = NOISE[start : start + size * size].reshape(size, size)
    field = cv2.resize(fine, (width, height), interpolation=cv2.INTER_CUBIC)
    return np.asarray(field, np.float32)


def _pixel(place: Floats) -> tuple[int, int]:
    return round(float(place[0])), round(float(place[1]))
