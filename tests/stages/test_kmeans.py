from __future__ import annotations

from itertools import combinations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from skimage.filters import threshold_multiotsu

from mushpipe.stages.evidence import otsu_level
from mushpipe.stages.kmeans import KMeans, thresholds
from tests.stages.frames import simulated
from tests.stages.scenes import discs, frame_of


def within(histogram: np.ndarray, middle: np.ndarray) -> float:
    """Sum of the squares within the clusters that thresholds make."""
    value = np.arange(len(histogram))
    label = np.searchsorted(middle, value, side="left")
    total = 0.0
    for cluster in range(len(middle) + 1):
        weight = histogram * (label == cluster)
        if weight.sum():
            mean = (weight * value).sum() / weight.sum()
            total += float((weight * (value - mean) ** 2).sum())
    return total


def histograms() -> list[np.ndarray]:
    images = [simulated(200).gray, simulated(210, light="gradient").gray]
    images.append(discs([(40.0, 40.0, 15.0), (100.0, 70.0, 20.0)], 0.8, 0.2))
    rng = np.random.default_rng(0)
    images.append(rng.uniform(size=(100, 100)))
    images.append(np.clip(rng.normal([0.2, 0.5, 0.8], 0.05, (5000, 3)), 0, 1))
    return [np.bincount(np.rint(i * 255).astype(int).ravel(), minlength=256) for i in images]


@pytest.mark.parametrize("row", range(5))
def test_two_clusters_have_the_variance_of_otsu(row: int) -> None:
    histogram = histograms()[row].astype(float)
    otsu = within(histogram, np.array([otsu_level(histogram)]))
    assert within(histogram, thresholds(histogram, 2)) == pytest.approx(otsu, rel=1e-9)


@pytest.mark.parametrize("clusters", [3, 4])
@pytest.mark.parametrize("row", range(5))
def test_more_clusters_have_the_variance_of_multi_otsu(row: int, clusters: int) -> None:
    histogram = histograms()[row].astype(float)
    best = threshold_multiotsu(hist=(histogram, np.arange(256)), classes=clusters)
    expected = within(histogram, best)
    # scikit-image sums in float32.
    assert within(histogram, thresholds(histogram, clusters)) <= expected * (1 + 1e-5)


@given(arrays(np.int64, 9, elements=st.integers(0, 9)), st.integers(2, 4))
def test_no_other_thresholds_are_better(histogram: np.ndarray, clusters: int) -> None:
    if np.count_nonzero(histogram) < clusters:
        return
    found = thresholds(histogram.astype(float), clusters)
    assert (np.diff(found) > 0).all()
    lowest = min(
        within(histogram, np.array(levels)) for levels in combinations(range(8), clusters - 1)
    )
    assert within(histogram, found) == pytest.approx(lowest, abs=1e-9)


def test_the_brightest_cluster_is_the_mask() -> None:
    image = np.full((60, 90), 0.1)
    image[:, 30:60], image[:, 60:] = 0.5, 0.9
    assert (
        KMeans(clusters=3).process(frame_of(image, camera=None)).foreground == (image > 0.7)
    ).all()
    assert (
        KMeans(clusters=2).process(frame_of(image, camera=None)).foreground == (image > 0.3)
    ).any()


def test_fewer_levels_than_clusters_make_an_empty_mask() -> None:
    image = np.where(np.arange(90) < 30, 0.2, 0.8)[None].repeat(60, 0)
    assert not KMeans(clusters=3).process(frame_of(image, camera=None)).foreground.any()
    assert KMeans(clusters=2).process(frame_of(image, camera=None)).foreground.any()
