"""K-means on gray levels (Masoudian & McIsaac 2013): the paper's only predecessor."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from mushpipe import Mask, RgbdFrame, Stage


class KMeans(Stage):
    """Segments by k-means on gray levels: caps are the brightest of the clusters.

    With two clusters it is Otsu's threshold by another way; more clusters separate mycelium from
    caps on a dark bed, and cut shaded rims off. Nothing tells it that a bed is empty.
    """

    clusters: int = Field(3, ge=2, le=16, description="number of clusters")

    def process(self, frame: RgbdFrame) -> Mask:
        """Return the pixels of the brightest cluster; empty where there are fewer levels."""
        levels = cv2.convertScaleAbs(frame.gray, alpha=255)
        histogram = np.bincount(levels.ravel(), minlength=256).astype(np.float64)
        if np.count_nonzero(histogram) < self.clusters:
            return Mask(np.zeros(levels.shape, bool))
        return Mask(np.asarray(levels > thresholds(histogram, self.clusters)[-1]))


def thresholds(histogram: NDArray[np.float64], clusters: int) -> NDArray[np.float64]:
    """Return the (clusters - 1,) levels between the clusters of a histogram, by Lloyd's iteration.

    The first centres are the means of equal shares of the pixels, so there is nothing random in it.
    """
    value = np.arange(len(histogram))
    rank = np.cumsum(histogram) / histogram.sum()
    label = np.minimum((rank * clusters - 1e-9).astype(int), clusters - 1)
    middle = np.zeros(clusters - 1)
    for _ in range(100):
        weight = np.bincount(label, histogram, clusters)
        total = np.bincount(label, histogram * value, clusters)
        # A cluster that lost all its pixels stays between its neighbours.
        center = np.where(weight > 0, total / np.maximum(weight, 1e-12), np.nan)
        center = np.interp(np.arange(clusters), np.flatnonzero(weight > 0), center[weight > 0])
        new = (center[1:] + center[:-1]) / 2
        if np.array_equal(new, middle):
            break
        middle = new
        label = np.searchsorted(middle, value, side="left")
    return middle
