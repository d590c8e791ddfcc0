"""Which image a segmenter looks at: gray, colour, or the channel in which caps stand out most."""

from __future__ import annotations

from typing import Any, Literal

import cv2
import numpy as np

from mushpipe import RgbdFrame
from mushpipe.core.arrays import Bools, Singles
from mushpipe.stages.evidence import BELIEVED, believed_foreground, halved

Channel = Literal["gray", "rgb", "a", "red-blue", "auto", "gray+height"]
MANY = ("rgb", "gray+height")  # channels of more than one plane


def channel_image(frame: RgbdFrame, channel: Channel) -> Singles:
    """Return an (H, W) float32 image in 0..1; (H, W, 3) for ``rgb``, (H, W, 2) for gray+height.

    ``a`` is the green-to-red axis of CIE Lab and ``red-blue`` the difference of both channels,
    each blurred by 1 px and stretched to 0..1 between its extremes: soil and brown caps of one
    brightness differ there. ``auto`` is `best_image`. ``gray+height`` puts the height above the
    bed beside gray; it is gray alone where there is no depth.
    """
    if channel == "auto":
        return best_image(frame)
    if channel == "gray":
        return np.asarray(frame.gray, np.float32)
    if channel == "rgb":
        return np.asarray(frame.color * np.float32(1 / 255), np.float32)
    if channel == "gray+height":
        return _with_height(frame)
    return _stretched(cv2.GaussianBlur(frame.color, (5, 5), 1.0), channel)


def inverted(image: Singles, channel: Channel) -> Singles:
    """Return an image of a channel with dark caps bright; height stays as it is."""
    result = 1 - image
    if channel == "gray+height" and image.ndim == 3:
        result[..., 1] = image[..., 1]
    return result


def _stretched(color: Any, channel: str) -> Singles:
    """Return the channel ``a`` or ``red-blue`` of a blurred image, (H, W) from 0 to 1."""
    if channel == "a":
        plane = cv2.extractChannel(cv2.cvtColor(color, cv2.COLOR_RGB2LAB), 1).astype(np.float32)
    else:
        plane = color[..., 0].astype(np.float32) - color[..., 2]
    low, high = float(plane.min()), float(plane.max())
    return np.asarray((plane - low) / max(high - low, 1e-6), np.float32)


def _with_height(frame: RgbdFrame) -> Singles:
    from mushpipe.stages.height import height_image, height_map

    gray = channel_image(frame, "gray")
    height = height_map(frame)
    return gray if height is None else np.dstack([gray, height_image(height, 0.008, 0.15)])


def best_image(frame: RgbdFrame) -> Singles:
    """Return gray, a colour channel, or their joint membership, whichever the evidence speaks for.

    A colour channel counts where its own split is clearly believed and agrees with that of gray:
    on a wooden table the wood stands out in colour, but nowhere that is bright. It replaces gray
    where it holds most of what gray finds; where it holds part, as on a bed of white and brown
    caps, a pixel is as much cap as the one that says more.
    """
    gray = channel_image(frame, "gray")
    bright, known, _ = believed_foreground(gray)
    small = halved(bright).view(np.bool_)
    candidates: tuple[Channel, ...] = ("a", "red-blue")
    best, chosen, region = known, None, small
    # Of the colours a level of the Gaussian pyramid (Burt & Adelson 1983) will do: in full
    # resolution they are blurred as much.
    color = cv2.pyrDown(frame.color, dstsize=(small.shape[1], small.shape[0]))
    for candidate in candidates:
        found = believed_foreground(_stretched(color, candidate), half=True)
        if found.strength > max(best, 1.25 * BELIEVED) and _agrees(found.region, small) > 0.3:
            best, chosen, region = found.strength, candidate, found.region
    if chosen is None:
        return gray
    image = channel_image(frame, chosen)
    if _agrees(region, small) > 0.7:
        return image
    whole = cv2.resize(region.view(np.uint8), gray.shape[::-1], interpolation=cv2.INTER_NEAREST)
    return np.maximum(_membership(gray, bright), _membership(image, whole.view(np.bool_)))


def _agrees(region: Bools, bright: Bools) -> float:
    """Return the share of the bright region that a region holds; 1 where nothing is bright."""
    count = int(np.count_nonzero(bright))
    return float(np.count_nonzero(region & bright) / count) if count else 1.0


def _membership(image: Singles, region: Bools) -> Singles:
    """Return how much a pixel belongs to a region, 0.5 midway between the means of the sides."""
    c1, c2 = float(image[region].mean()), float(image[~region].mean())
    return np.asarray(np.clip((image - c2) / (c1 - c2), 0, 1), np.float32)
