"""How high a cap stands over the ground around it.

A cap stands on a stem. A clod or a pebble lies on the soil, mostly sunk in: its top is seldom more
than its radius above it.
"""

from __future__ import annotations

import numpy as np

from mushpipe.core.arrays import Floats
from mushpipe.core.jit import jit
from mushpipe.stages.cap.blocks import Image, median

# The ground is looked at from 1.3 to 1.9 radii away.
_TURNS = 2 * np.pi * (np.arange(24) + 0.5) / 24
RING = np.stack([np.outer([1.3, 1.6, 1.9], f(_TURNS)).ravel() for f in (np.cos, np.sin)], axis=-1)
LEAST = 12  # samples of it


@jit
def stands(image: Image, circles: Floats, apexes: Floats, up: Floats, bias: float) -> Floats:
    """Return how far apexes (N,) lie above the ground around their caps, m; NaN if none is seen.

    The ground is what no circle covers; its height is the median.

    Args:
        image: The depth, with all circles ranked.
        circles: (N, 3) x, y, radius, px.
        apexes: (N, 3) m.
        up: (3,) unit vector.
        bias: Of the depth, m; apexes are without it.
    """
    height, width = image.depth.shape
    found, level = np.full(len(circles), np.nan), np.empty(len(RING), np.float32)
    for k in range(len(circles)):
        x, y, radius = circles[k]
        seen = 0
        for s in range(len(RING)):
            u = int(np.floor(x + radius * RING[s, 0] + 0.5))
            v = int(np.floor(y + radius * RING[s, 1] + 0.5))
            if not (0 <= u < width and 0 <= v < height):
                continue
            depth, ray = image.depth[v, u], image.rays[v, u]
            if ray[0] > 1e3:
                continue  # where the lens has none
            if depth > 0 and image.ranks[v, u] == len(circles):
                level[seen] = (depth - bias) * (ray[0] * up[0] + ray[1] * up[1] + up[2])
                seen += 1
        if seen >= LEAST:
            top = apexes[k, 0] * up[0] + apexes[k, 1] * up[1] + apexes[k, 2] * up[2]
            found[k] = top - median(level, seen)
    return found
