"""Otsu's threshold with a test of whether there are two classes at all.

Otsu's method always splits, an empty bed into light and dark soil too. A split is believed when

- the two sides are far apart for their spread, by Ashman's D (Ashman, Bird & Zepf 1994), and the
  bright side is made of compact pieces, by the share s of it that survives an opening of the size
  of a small cap: D sqrt(s) is the evidence;
- most of the difference between the sides is crossed at the contour. Light that falls off over an
  empty bed has two far and compact sides too, but no step between them; nor has the grain of wood.

Where the first split is not believed, its bright side is split again: few caps on a bed with
mycelium stand out in the second or third.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any, NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from mushpipe.core.arrays import Bools, Bytes, Floats, Singles
from mushpipe.core.jit import jit

# A Gaussian split in the middle has D = 2.7, a uniform distribution 3.5, both in scattered pieces.
BELIEVED = 2.6
# Beds of the simulator and real ones step by 0.45 and more, ramps and wood by less than 0.3.
STEP = 0.37
_CAP_HALF_PX = 5  # an opening by 11 px at full resolution
_SPLITS = 3


class Evidence(NamedTuple):
    """A believed split of an image.

    Attributes:
        region: (H, W) its bright side; empty where no split is believed.
        strength: D sqrt(s); 0 where no split is believed.
        floor: Level in 0..1 below which all is bed: the mean of the side that a further split cut
            off, 0 for the first split. An image cut off there has the split as its only one.
    """

    region: Bools
    strength: float
    floor: float


def believed_foreground(image: Singles, half: bool = False) -> Evidence:
    """Return the first believed split of an (H, W) image in 0..1.

    Args:
        image: The image.
        half: It stands at half resolution, in which compactness and step are judged.
    """
    levels = cv2.convertScaleAbs(image, alpha=255)
    histogram = cv2.calcHist([levels], [0], None, [256], [0, 256]).ravel().astype(np.float64)
    start = 0
    for level in splits(histogram):
        region = np.asarray(levels > level)
        small = region.view(np.uint8) if half else halved(region)
        strength = contrast(histogram, level) * compactness(small) ** 0.5
        if strength >= BELIEVED and edge_step(levels, small) >= STEP:
            return Evidence(region, strength, _mean(histogram, start, level) if start else 0.0)
        start = level + 1
    return Evidence(np.zeros(image.shape, bool), 0.0, 0.0)


def _mean(histogram: Floats, first: int, last: int) -> float:
    """Return the mean of the levels from first to last, in 0..1."""
    part = histogram[first : last + 1]
    return float((part * np.arange(first, last + 1)).sum() / part.sum() / 255)


def splits(histogram: Floats) -> Iterator[int]:
    """Yield Otsu's level of a histogram, then of its upper part, and again."""
    start = 0
    for _ in range(_SPLITS):
        part = histogram[start:]
        if np.count_nonzero(part) < 2:
            return
        start += otsu_level(part) + 1
        yield start - 1


def otsu_level(histogram: Floats) -> int:
    """Return the last level of the lower class (Otsu 1979, eq. 18)."""
    share = histogram / histogram.sum()
    weight, first = np.cumsum(share), np.cumsum(share * np.arange(len(share)))
    both = weight * (1 - weight)
    rest = (first[-1] * weight - first) ** 2
    return int(np.argmax(np.divide(rest, both, out=np.zeros_like(both), where=both > 1e-12)))


def contrast(histogram: Floats, level: int) -> float:
    """Return Ashman's D = (c1 - c2) / sqrt((v1 + v2) / 2) of the split above a level.

    c are the means and v the variances of the sides; a spread below one level counts as one.
    """
    value = np.arange(len(histogram))
    moments = []
    for part in (slice(level + 1, None), slice(0, level + 1)):
        count = histogram[part].sum()
        mean = (histogram[part] * value[part]).sum() / count
        moments.append((mean, (histogram[part] * (value[part] - mean) ** 2).sum() / count))
    (c1, v1), (c2, v2) = moments
    return float((c1 - c2) / max(((v1 + v2) / 2) ** 0.5, 1.0))


def halved(region: Bools) -> Bytes:
    """Return an (H, W) region at half resolution, 1 where most of the four pixels are set."""
    size = (max(1, region.shape[1] // 2), max(1, region.shape[0] // 2))
    small = cv2.resize(region.view(np.uint8) * np.uint8(255), size, interpolation=cv2.INTER_AREA)
    return np.asarray(small > 127).view(np.uint8)


def compactness(small: Bytes) -> float:
    """Return the share of a region at half resolution that an opening by a small cap leaves."""
    survives = cv2.countNonZero(cv2.morphologyEx(small, cv2.MORPH_OPEN, _kernel()))
    return float(survives / max(1, cv2.countNonZero(small)))


def edge_step(image: Singles | Bytes, small: Bytes) -> float:
    """Return which share of the difference between two sides is crossed at their contour.

    Args:
        image: (H, W), of any scale.
        small: The region at half resolution; specks and pinholes have no part in its contour,
            or noise would, which always steps at its threshold.

    Returns:
        The mean within 4 px inside of the contour less that within 4 px outside, over the
        difference of the means of the sides; 0 where there is no contour.
    """
    size = (small.shape[1], small.shape[0])
    plane = cv2.resize(image, size, interpolation=cv2.INTER_AREA)
    body = cv2.morphologyEx(small, cv2.MORPH_OPEN, _kernel())
    body = cv2.morphologyEx(body, cv2.MORPH_CLOSE, _kernel())
    inner = body - cv2.erode(body, _kernel(), borderValue=1)
    outer = cv2.dilate(body, _kernel()) - body
    return float(_step(plane, np.stack([inner, outer, small, 1 - small])))


@jit
def _step(plane: NDArray[Any], masks: Bytes) -> float:
    """Return the difference of the means over the first two masks over that over the other two."""
    total, count = np.zeros(4), np.zeros(4)
    for k in range(4):
        for y in range(plane.shape[0]):
            in_row = of_row = np.float32(0)  # keeps the loop vectorised
            for x in range(plane.shape[1]):
                member = np.float32(masks[k, y, x])
                in_row += member
                of_row += member * np.float32(plane[y, x])
            count[k] += in_row
            total[k] += of_row
    if count.min() == 0:
        return 0.0
    mean = total / count
    return float((mean[0] - mean[1]) / max(mean[2] - mean[3], 1e-6))


def _kernel() -> Bytes:
    return np.asarray(
        cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (_CAP_HALF_PX, _CAP_HALF_PX)), np.uint8
    )
