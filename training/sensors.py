"""Depth cameras that are worse than the simulated one, for what must not rely on a good one."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import replace
from typing import Any

import cv2
import numpy as np

from mushpipe import RgbdFrame
from mushpipe.core.arrays import Singles


def _mismatched(depth: Singles, rng: np.random.Generator) -> Singles:
    """Patches as far as what lies behind them, in a third of the frames.

    So a stereo camera sees smooth caps in which it finds nothing to match.
    """
    if rng.random() > 1 / 3:
        return depth
    width = 2 * int(rng.integers(15, 45)) + 1
    behind = cv2.GaussianBlur(cv2.dilate(depth, np.ones((width, width), np.uint8)), (0, 0), 4)
    cloud = _blurred(depth.shape, rng.uniform(8, 25), rng)
    beyond = cloud - np.float32(rng.uniform(1, 2))
    lost = (depth == 0) | (np.abs(beyond) < 0.1)
    return np.where(lost, np.float32(0), np.where(beyond > 0, behind, depth))


def _coarser(depth: Singles, rng: np.random.Generator) -> Singles:
    """Every second or third pixel only, in half of the frames."""
    if rng.random() < 0.5:
        return depth
    step, (height, width) = int(rng.integers(2, 4)), depth.shape
    return depth[::step, ::step].repeat(step, axis=0).repeat(step, axis=1)[:height, :width]


def _shifted(depth: Singles, rng: np.random.Generator) -> Singles:
    """Aligned to colour but for a pixel or two."""
    x, y = rng.normal(0, 1.2, 2)
    shift = np.array([[1, 0, x], [0, 1, y]], np.float32)
    size = (depth.shape[1], depth.shape[0])
    moved: Any = cv2.warpAffine(depth, shift, size, flags=cv2.INTER_NEAREST, borderValue=(0.0,))
    return np.asarray(moved, np.float32)


def _blurred(shape: tuple[int, int], sigma: float, rng: np.random.Generator) -> Singles:
    noise = cv2.GaussianBlur(rng.normal(0, 1, shape).astype(np.float32), (0, 0), sigma)
    return np.asarray(noise / noise.std(), np.float32)


def _noisier(depth: Singles, rng: np.random.Generator) -> Singles:
    """Up to three times the noise that `cap-fit` expects, with neighbours alike."""
    noise = _blurred(depth.shape, rng.uniform(0.3, 2.5), rng)
    sigma = rng.uniform(0, 3) * (0.0003 + 0.0012 * depth)
    return np.asarray(np.where(depth > 0, depth + sigma * noise, 0), np.float32)


def _without_edges(depth: Singles, rng: np.random.Generator) -> Singles:
    """Missing up to 3 px around depth edges, here and there."""
    width = int(rng.integers(0, 4))
    if width == 0:
        return depth
    around = np.ones((2 * width + 1, 2 * width + 1), np.uint8)
    step = cv2.dilate(depth, around) - cv2.erode(depth, around)
    lost = (step > 0.006 + 0.004 * width) & (rng.random(depth.shape) < rng.uniform(0.3, 1))
    return np.where(lost, np.float32(0), depth)


def _with_holes(depth: Singles, rng: np.random.Generator) -> Singles:
    cloud = _blurred(depth.shape, rng.uniform(2, 8), rng)
    return np.where(cloud > rng.uniform(1.5, 3.5), np.float32(0), depth)


Damage = Callable[[Singles, np.random.Generator], Singles]
DAMAGES: dict[str, Damage] = {
    "mismatched": _mismatched,
    "coarser": _coarser,
    "shifted": _shifted,
    "noisier": _noisier,
    "without edges": _without_edges,
    "with holes": _with_holes,
}


def worse(
    frame: RgbdFrame, rng: np.random.Generator, damages: Iterable[Damage] = DAMAGES.values()
) -> RgbdFrame:
    """Return a frame with mismatched, coarse, shifted, noisy depth that lacks edges and patches."""
    if frame.depth is None:
        return frame
    depth = frame.depth.astype(np.float32) * np.float32(frame.depth_scale)
    for damage in damages:
        depth = damage(depth, rng)
    native = np.clip(np.rint(depth / frame.depth_scale), 0, 65535).astype(np.uint16)
    return replace(frame, depth=native)
