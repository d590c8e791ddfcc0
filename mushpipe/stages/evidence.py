"""Otsu's threshold with a test of whether there are two classes at all.

Otsu's method always splits, an empty bed into light and dark soil too. A split is believed when the
two sides are far apart for their spread, by Ashman's D (Ashman, Bird & Zepf 1994), and the bright
side is made of compact pieces, by the share of it that survives an opening of the size of a
small cap. Where the first split is not believed, its bright side is split again: few caps on
a bed with mycelium stand out in the second or third.
"""

from __future__ import annotations

from collections.abc import Iterator

import cv2
import numpy as np
from numpy.typing import NDArray

Plane = NDArray[np.float32]
Region = NDArray[np.bool_]
# A Gaussian split in the middle has D = 2.7, a uniform distribution 3.5, both in scattered pieces.
BELIEVED = 2.6
_CAP_HALF_PX = 5  # an opening by 11 px at full resolution
_SPLITS = 3


def believed_foreground(image: Plane) -> tuple[Region, float]:
    """Return the first believed split of an (H, W) image in 0..1, and its evidence D sqrt(s).

    The region is empty and the evidence 0 where no split is believed.
    """
    levels = cv2.convertScaleAbs(image, alpha=255)
    histogram = cv2.calcHist([levels], [0], None, [256], [0, 256]).ravel().astype(np.float64)
    for level in splits(histogram):
        region = np.asarray(levels > level)
        found = contrast(histogram, level) * compactness(region) ** 0.5
        if found >= BELIEVED:
            return region, found
    return np.zeros(image.shape, bool), 0.0


def splits(histogram: NDArray[np.float64]) -> Iterator[int]:
    """Yield Otsu's level of a histogram, then of its upper part, and again."""
    start = 0
    for _ in range(_SPLITS):
        part = histogram[start:]
        if np.count_nonzero(part) < 2:
            return
        start += otsu_level(part) + 1
        yield start - 1


def otsu_level(histogram: NDArray[np.float64]) -> int:
    """Return the last level of the lower class (Otsu 1979, eq. 18)."""
    share = histogram / histogram.sum()
    weight, first = np.cumsum(share), np.cumsum(share * np.arange(len(share)))
    both = weight * (1 - weight)
    rest = (first[-1] * weight - first) ** 2
    return int(np.argmax(np.divide(rest, both, out=np.zeros_like(both), where=both > 1e-12)))


def contrast(histogram: NDArray[np.float64], level: int) -> float:
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


def compactness(region: Region) -> float:
    """Return the share of a region, at half resolution, that an opening by a small cap leaves."""
    half = (max(1, region.shape[1] // 2), max(1, region.shape[0] // 2))
    small = cv2.resize(region.view(np.uint8) * np.uint8(255), half, interpolation=cv2.INTER_AREA)
    mask = (small > 127).view(np.uint8)
    kernel = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (_CAP_HALF_PX, _CAP_HALF_PX))
    survives = cv2.countNonZero(cv2.morphologyEx(mask, cv2.MORPH_OPEN, kernel))
    return float(survives / max(1, cv2.countNonZero(mask)))
