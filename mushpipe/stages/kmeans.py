"""K-means on gray levels (Masoudian & McIsaac 2013): the paper's only predecessor."""

from __future__ import annotations

import cv2
import numpy as np
from pydantic import Field

from mushpipe import Mask, RgbdFrame, Stage
from mushpipe.core.arrays import Floats


class KMeans(Stage):
    """Segments by k-means on gray levels: caps are the brightest of the clusters.

    With two clusters it is Otsu's threshold by another road; more clusters separate mycelium from
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


def thresholds(histogram: Floats, clusters: int) -> Floats:
    """Return the (clusters - 1,) last levels of all but the brightest cluster of a histogram.

    On a line the clusters are intervals, so dynamic programming finds the exact minimum of the
    squared distances to the means (Fisher 1958), where Lloyd's iteration may end in a local one.
    """
    cost = interval_costs(histogram)
    n = len(histogram)
    best, starts = cost[0], []
    for _ in range(clusters - 1):
        # Row i: the last cluster starts at level i, those before end at i - 1.
        total = np.concatenate([[np.inf], best[:-1]])[:, None] + cost
        starts.append(total.argmin(axis=0))
        best = total.min(axis=0)
    end, found = n - 1, []
    for start in reversed(starts):
        end = int(start[end]) - 1
        found.append(end)
    return np.array(found[::-1], np.float64)


def interval_costs(histogram: Floats) -> Floats:
    """Return (n, n): the sum of squares about their mean of levels i to j; infinite for j < i."""
    value = np.arange(len(histogram))
    sums = [np.cumsum([0.0, *(histogram * value**k)]) for k in range(3)]
    count, first, second = (s[None, 1:] - s[:-1, None] for s in sums)
    spread = second - np.divide(first**2, count, out=np.zeros_like(count), where=count > 0)
    return np.where(value[None] >= value[:, None], np.maximum(spread, 0), np.inf)
