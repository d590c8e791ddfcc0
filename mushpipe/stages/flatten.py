"""Illumination: a smooth light field fitted together with the two classes, and divided out.

The logarithm of the image is modelled as a level per class plus a quadratic light field (the
bias field of Wells et al. 1996 and Li et al. 2011, with the two phases of Chan-Vese). The classes
are part of the fit because dividing by a local mean would take dense caps for light.
"""

from __future__ import annotations

from dataclasses import replace
from functools import lru_cache

import cv2
import numpy as np
from pydantic import Field

from mushpipe import RgbdFrame, Stage
from mushpipe.core.arrays import Bools, Bytes, Floats, Singles
from mushpipe.core.jit import jit
from mushpipe.stages.linear import normal_equations, solve
from mushpipe.stages.otsu import otsu_foreground
from mushpipe.stages.warm_up import example_frame

_DARK = 2.0  # keeps the logarithm of black finite, on 0..255
# Noise in the logarithm goes with the inverse of brightness: what is darker than this counts
# little. The gaps of a real bed are black in any light.
_DIM = 20.0
_HIGHEST = 10  # times the thumbnail's width: a narrow strip would take all memory


class Flatten(Stage):
    """Evens out the light over the image; colour stays, brightness is divided by the light field.

    An image of one class or with nothing to fit is handed on as it is.
    """

    width: int = Field(80, ge=16, le=320, description="width of the fit's thumbnail, px")
    iterations: int = Field(
        6, ge=1, le=1000, description="most rounds of fitting field and classes"
    )

    def open(self) -> None:
        """Compile the kernel."""
        self.process(example_frame())

    def process(self, frame: RgbdFrame) -> RgbdFrame:
        """Return the frame under even light; depth and calibration are untouched."""
        height, width = frame.gray.shape
        size = (self.width, max(8, round(self.width * min(height / width, _HIGHEST))))
        thumbnail = cv2.resize(frame.gray, size, interpolation=cv2.INTER_AREA)
        field = light_field(np.asarray(thumbnail, np.float32) * 255, self.iterations)
        gain = cv2.resize(np.exp(-field).astype(np.float32), (width, height))
        return replace(frame, color=apply_gain(frame.color, np.asarray(gain, np.float32)))


def light_field(gray: Singles, iterations: int) -> Singles:
    """Return the logarithm of the light over an (H, W) image in 0..255, with mean 0."""
    h = np.log(gray + _DARK)
    basis = _quadratic(*gray.shape)
    detail = h - cv2.blur(h, (31, 31))
    low, high = float(detail.min()), float(detail.max())
    if high - low < 1e-6:
        return np.zeros(gray.shape, np.float32)
    u = otsu_foreground((detail - low) / (high - low)).ravel()
    weight = np.asarray(gray / (gray + _DIM), np.float64).ravel() + 1e-3
    field = _fit(h.ravel().astype(np.float64), weight, basis, u, iterations)
    return np.asarray((field - field.mean()).reshape(gray.shape), np.float32)


@lru_cache(maxsize=4)
def _quadratic(height: int, width: int) -> Floats:
    """Return (H W, 5): x, y, x^2, xy, y^2 on -1..1."""
    y, x = np.mgrid[-1 : 1 : height * 1j, -1 : 1 : width * 1j]
    return np.column_stack([t.ravel() for t in (x, y, x * x, x * y, y * y)])


@jit
def _fit(h: Floats, weight: Floats, basis: Floats, u: Bools, rounds: int) -> Floats:
    """Fit h = level of the class + basis k, and assign the classes u anew, round by round.

    Returns the light field basis k (M,); u is changed.
    """
    field = np.zeros(len(h))
    fixed, fixed_right = normal_equations(basis, h, weight)
    for _ in range(rounds):
        inside = np.count_nonzero(u)
        if inside in (0, len(u)):
            break
        normal, right = np.zeros((7, 7)), np.zeros(7)
        normal[2:, 2:], right[2:] = fixed, fixed_right
        for m in range(len(h)):
            row = 0 if u[m] else 1
            normal[row, row] += weight[m]
            right[row] += weight[m] * h[m]
            for k in range(5):
                normal[row, 2 + k] += weight[m] * basis[m, k]
        normal[2:, :2] = normal[:2, 2:].T
        solve(normal, right)
        middle, moved = (right[0] + right[1]) / 2, False
        for m in range(len(h)):
            light = 0.0
            for k in range(5):
                light += basis[m, k] * right[2 + k]
            bright = h[m] - light > middle
            moved = moved or bright != u[m]
            field[m], u[m] = light, bright
        if not moved:
            break
    return field


@jit
def apply_gain(color: Bytes, gain: Singles) -> Bytes:
    """Multiply an (H, W, 3) image by an (H, W) gain, rounded and clipped to 0..255."""
    out = np.empty_like(color)
    for y in range(color.shape[0]):
        for x in range(color.shape[1]):
            factor = gain[y, x]
            for c in range(3):
                out[y, x, c] = np.uint8(min(np.float32(255), color[y, x, c] * factor + 0.5))
    return out
