"""The circle of a fitted cap's outline, and a detected circle improved by it.

An image places an outline to a fraction of a pixel where it shows it, and leaves the rest to guess;
a cap that was fitted to depth as well has its whole outline. So a circle moves towards its cap's,
the more the less of it the image shows, and the farther the two are apart; and the less, the fewer
rays along its outline held the cap, and the worse it fits.
"""

from __future__ import annotations

import numpy as np

from mushpipe.core.arrays import Floats, Singles
from mushpipe.core.jit import borrower
from mushpipe.stages.cap.blocks import Image
from mushpipe.stages.cap.model import Vector
from mushpipe.stages.cap.outline import Lanes, expected_reach
from mushpipe.stages.cap.regrow import beyond
from mushpipe.stages.cap.samples import COMPASS, DIRECTIONS

CLEAR = 0.8  # weight of a detected circle whose outline the image shows all around
APART = 0.15  # distance of the two centres, in radii, at which that weight is halved
HELD = 16  # rays along depth edge and outline that hold a cap; with fewer it moves the circle less;
FEWEST = 0.25  # fewer do where the border cuts the circle: of them this share at least


@borrower
def circle_around(circle: Floats, reach: Singles) -> Vector:
    """Return x, y, radius of the circle with an outline's centroid and area.

    Of r(t) around a centre the area is A = 1/2 int r^2 dt, the centroid int r^3 (cos, sin) dt / 3A;
    sums over equal steps of t are exact for all that is smooth.

    Args:
        circle: (3,) whose centre the outline is seen from, px.
        reach: (DIRECTIONS or more,) how far away it is from there in each direction of `COMPASS`.
    """
    square = x = y = 0.0
    for j in range(DIRECTIONS):
        square += reach[j] ** 2
        x += reach[j] ** 3 * COMPASS[j, 0]
        y += reach[j] ** 3 * COMPASS[j, 1]
    x, y = circle[0] + x / (1.5 * square), circle[1] + y / (1.5 * square)
    return x, y, np.sqrt(square / DIRECTIONS)


@borrower
def improve(
    circle: Floats, cap: Floats, held: tuple[float, float], doubt: float, image: Image, room: Lanes
) -> None:
    """Move a circle (3,) x, y, radius, px, towards the outline of its cap, in place.

    Args:
        circle: As detected, in and out.
        cap: (15,) fitted in it.
        held: Numbers of rays along the depth edge and along the outline in the image, of
            `DIRECTIONS` each.
        doubt: 1 where the cap fits, larger where it fits badly.
        image: Whose rays are taken.
        room: As in `sample_outline`.
    """
    expected_reach(cap, image, circle, *room)
    outline = circle_around(circle, room[0])
    apart = np.hypot(outline[0] - circle[0], outline[1] - circle[1]) / (APART * outline[2])
    step = 1.0 - CLEAR * held[1] / DIRECTIONS / (1.0 + apart * apart)
    seen = max(1.0 - beyond(image, circle), FEWEST)
    step *= min(1.0, (held[0] + held[1]) / (HELD * seen)) ** 2 / doubt
    for i in range(3):
        circle[i] += step * (outline[i] - circle[i])
