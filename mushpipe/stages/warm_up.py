"""A small frame that stages compile their kernels on, so that the first real one pays nothing."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import DTypeLike, NDArray

from mushpipe import Camera, Circles, Header, RgbdFrame

X, Y, RADIUS = 80, 64, 36  # px
CAMERA = Camera(160, 128, 100.0, 100.0, 79.5, 63.5)


def example_frame(cap: int = 200, native: DTypeLike = np.uint16) -> RgbdFrame:
    """Return a frame of 160 x 128 px with one cap of a gray level on a bed of level 60.

    Its depth, mm of a native type, is missing at the middle of the cap, so that what bridges holes
    is compiled as well. A frame, since its arrays are read-only, to the compiler another type.
    """
    v, u = np.mgrid[:128, :160]
    disc = (u - X) ** 2 + (v - Y) ** 2 < RADIUS**2
    color = np.repeat(np.where(disc, cap, 60).astype(np.uint8)[..., None], 3, axis=2)
    depth: NDArray[Any] = np.where(disc, 470, 500).astype(native)
    depth[Y, X] = 0
    return RgbdFrame(Header(0, 0, "warm-up"), color, depth, camera=CAMERA)


def example_circles() -> Circles:
    """Return the circle of its cap."""
    return Circles(np.array([[X, Y]]), np.array([RADIUS]), np.ones(1))
