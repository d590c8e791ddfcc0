"""Circles as kernels take them, and what two of them share."""

from __future__ import annotations

import math
from typing import Annotated, NamedTuple

import numpy as np
from pydantic import Field

from mushpipe.core.arrays import Floats
from mushpipe.core.geometry import Camera
from mushpipe.core.jit import borrower
from mushpipe.core.tables import Circles

# Radii are no more exact than a tenth: by so much an outline may be beyond a range of radii.
LEAST_OF_RANGE, MOST_OF_RANGE = 0.9, 1.1
LIKELY = 0.5  # score from which on a circle is more likely a cap than not
# A setting: a radius, px, or a diameter, mm. Next to 0, or near infinity, kernels overflow.
Extent = Annotated[float, Field(ge=0.001, le=10_000)]
_MANY = 5  # caps that tell what caps look like here


class Radii(NamedTuple):
    """A range of radii, px."""

    smallest: float
    largest: float


@borrower
def within(radius: float, radii: Radii) -> bool:
    """Whether a radius (px) is within the range, or a tenth beyond."""
    return radii.smallest * LEAST_OF_RANGE <= radius <= radii.largest * MOST_OF_RANGE


def discs_of(circles: Circles) -> Floats:
    """Return x, y and radius (N, 3), px."""
    return np.column_stack([circles.center, circles.radius])


def certain_first(circles: Circles) -> Circles:
    """Return the circles in the order of their scores."""
    return circles.take(np.argsort(-circles.score, kind="stable"))


def many_likely(circles: Circles) -> bool:
    """Return whether enough circles are likely caps to tell what caps look like in this image."""
    return int(np.count_nonzero(circles.score >= LIKELY)) >= _MANY


def radii_on_rays(circles: Circles, camera: Camera) -> Floats:
    """Return the radii (N,) of circles on the plane z = 1, NaN where the lens has no rays.

    From the area that two diameters span there: a lens may show a pixel larger or smaller at the
    border than in the middle.
    """
    reach = circles.radius[:, None]
    ends = [circles.center + reach * np.array(way) for way in ((1, 0), (-1, 0), (0, 1), (0, -1))]
    right, left, down, up = camera.deproject(np.stack(ends), np.ones((4, len(circles))))[..., :2]
    (ax, ay), (bx, by) = (right - left).T, (down - up).T
    return np.asarray(np.sqrt(np.abs(ax * by - ay * bx)) / 2)


@borrower
def lens(distance: float, first: float, second: float) -> float:
    """Return the area that two circles share.

    Args:
        distance: Of their centres.
        first: Radius of one.
        second: Of the other.
    """
    if distance >= first + second:
        return 0.0
    small = min(first, second)
    if distance <= abs(first - second):
        return math.pi * small * small
    a = (distance**2 + first**2 - second**2) / (2 * distance * first)
    b = (distance**2 + second**2 - first**2) / (2 * distance * second)
    k = (first + second - distance) * (distance + first - second)
    k *= (distance - first + second) * (distance + first + second)
    triangle = 0.5 * math.sqrt(max(k, 0.0))
    sectors = first**2 * math.acos(min(1, max(-1, a))) + second**2 * math.acos(min(1, max(-1, b)))
    return sectors - triangle


@borrower
def iou(distance: float, first: float, second: float) -> float:
    """Return the intersection over union of two circles; arguments as `lens`."""
    shared = lens(distance, first, second)
    return shared / (math.pi * (first**2 + second**2) - shared)
