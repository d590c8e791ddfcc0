"""Which image a segmenter looks at: gray, colour, or the channel in which caps stand out most."""

from __future__ import annotations

from typing import Literal

import cv2
import numpy as np
from numpy.typing import NDArray

from mushpipe import RgbdFrame

Channel = Literal["gray", "rgb", "a", "red-blue", "auto"]
Plane = NDArray[np.float32]
_CANDIDATES: tuple[Channel, ...] = ("gray", "a", "red-blue")
_THUMBNAIL = (160, 120)


def channel_image(frame: RgbdFrame, channel: Channel) -> Plane:
    """Return an (H, W) float32 image in 0..1, or (H, W, 3) for ``rgb``.

    ``a`` is the green-to-red axis of CIE Lab and ``red-blue`` the difference of both channels,
    each blurred by 1 px and stretched to 0..1 between its extremes: soil and brown caps of one
    brightness differ there. ``auto`` takes the one of them or gray with the largest separability.
    """
    if channel == "auto":
        thumbnail = cv2.resize(frame.color, _THUMBNAIL, interpolation=cv2.INTER_AREA)
        scores = {name: separability(_plane(thumbnail, name)) for name in _CANDIDATES}
        channel = max(_CANDIDATES, key=lambda name: scores[name])
    if channel == "gray":
        return np.asarray(frame.gray, np.float32)
    if channel == "rgb":
        return np.asarray(frame.color * np.float32(1 / 255), np.float32)
    return _plane(cv2.GaussianBlur(frame.color, (5, 5), 1.0), channel)


def _plane(color: NDArray[np.uint8], channel: Channel) -> Plane:
    if channel == "gray":
        gray = cv2.cvtColor(color, cv2.COLOR_RGB2GRAY)
        return np.asarray(gray * np.float32(1 / 255), np.float32)
    if channel == "a":
        plane = cv2.cvtColor(color, cv2.COLOR_RGB2LAB)[..., 1].astype(np.float32)
    else:
        plane = color[..., 0].astype(np.float32) - color[..., 2]
    low, high = float(plane.min()), float(plane.max())
    return np.asarray((plane - low) / max(high - low, 1e-6), np.float32)


def separability(image: Plane) -> float:
    """Return Otsu's criterion: the largest share of the variance that two classes explain, 0..1."""
    levels = np.bincount(np.rint(image.ravel() * 255).astype(np.uint8), minlength=256)
    share = levels / levels.sum()
    value = np.arange(256)
    weight, first = np.cumsum(share), np.cumsum(share * value)
    mean = first[-1]
    variance = (share * (value - mean) ** 2).sum()
    with np.errstate(divide="ignore", invalid="ignore"):
        between = (mean * weight - first) ** 2 / (weight * (1 - weight))
    return float(np.nanmax(between) / variance) if variance > 0 else 0.0
