"""The top of a cap: sunk, or a hump, where the spheroid is round."""

from __future__ import annotations

import numpy as np

from mushpipe.core.arrays import Floats, Singles
from mushpipe.core.jit import borrower
from mushpipe.stages.cap.model import BULGE, HEIGHT, RADIUS, N
from mushpipe.stages.cap.solve import ROUND

# In rim radii: how near the axis points tell of the top, and how far off the dome they are another
# thing's; least sigma of a point; spread of how far a top is off, and of how that changes with r^2.
NEAR, OTHER, FINEST = 0.4, 0.3, 0.001
SUNK, BENT = 0.08, 0.8


@borrower
def rise(cap: Floats, rays: Singles, count: int) -> float:
    """Return how far (m) the points near a cap's axis lie above its dome, at the axis.

    With s along the axis from the rim plane and r off it, in rim radii, y = s - h sqrt((1 + b w)^2
    - r^2), w = 4 r^2 (1 - r^2), is regressed on 1 and r^2. Where no point is near, it is 0; what
    lies on the cap or before it does not count.

    Args:
        cap: (15,) the cap.
        rays: (6, M) its rays; after those around the circle come its points.
        count: Of the points.
    """
    size, height = cap[RADIUS], cap[HEIGHT] / cap[RADIUS]
    one, square, fourth = 1.0 / SUNK**2, 0.0, 1.0 / BENT**2
    first = second = 0.0
    for j in range(ROUND, ROUND + count):
        along = off = 0.0
        for i in range(3):
            away = (rays[i, j] * rays[3, j] - cap[i]) / size
            along += away * cap[N + i]
            off += away * away
        off -= along * along
        if off < NEAR * NEAR:
            swell = 1.0 + cap[BULGE] * 4.0 * off * (1.0 - off)
            above = along - height * np.sqrt(swell * swell - off)
            counts = abs(above) < OTHER
            weight = counts * rays[5, j] / max(rays[4, j] / size, FINEST) ** 2
            one, square, fourth = one + weight, square + weight * off, fourth + weight * off * off
            first, second = first + weight * above, second + weight * above * off
    top = (fourth * first - square * second) / (one * fourth - square * square)
    return float(size * top)
