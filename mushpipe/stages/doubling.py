"""From half resolution back to full: each pixel stands for four."""

from __future__ import annotations

import numpy as np

from mushpipe.core.arrays import Bytes
from mushpipe.core.jit import jit


@jit
def doubled(small: Bytes, height: int, width: int) -> Bytes:
    """Return an image at full size, (height, width).

    Args:
        small: (h, w) half of it, where a size is odd rounded up or down; rounded down, its last row
            and column stand thrice.
        height: px.
        width: px.
    """
    out = np.empty((height, width), np.uint8)
    for y in range(height):
        row, line = small[min(y // 2, len(small) - 1)], out[y]
        for x in range(width // 2):
            line[2 * x] = line[2 * x + 1] = row[x]
        line[-1] = row[-1]
    return out
