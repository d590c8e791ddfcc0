"""A small frame that stages compile their kernels on, so that the first real one pays nothing."""

from __future__ import annotations

import numpy as np

from mushpipe import Header, RgbdFrame


def example_frame(cap: int = 200) -> RgbdFrame:
    """Return a frame of 160 x 128 px with one cap of a gray level on a bed of level 60.

    A frame, since its arrays are read-only, which to the compiler is a type of its own.
    """
    v, u = np.mgrid[:128, :160]
    disc = (u - 80) ** 2 + (v - 64) ** 2 < 36**2
    color = np.repeat(np.where(disc, cap, 60).astype(np.uint8)[..., None], 3, axis=2)
    return RgbdFrame(Header(0, 0, "warm-up"), color, np.where(disc, 470, 500).astype(np.uint16))
