from __future__ import annotations

from itertools import pairwise

import cv2
import numpy as np
import pytest
from hypothesis import assume, given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from skimage.filters import threshold_otsu

from mushpipe.stages.chan_vese import ChanVese
from mushpipe.stages.evidence import (
    believed_foreground,
    compactness,
    contrast,
    edge_step,
    halved,
    otsu_level,
    splits,
)
from tests.stages.frames import iou
from tests.stages.scenes import discs, frame_of

COUNTS = arrays(np.int64, 32, elements=st.integers(0, 9))


def noise(sigma: float, seed: int = 0) -> np.ndarray:
    return np.random.default_rng(seed).normal(0, sigma, (480, 640))


def believed(image: np.ndarray) -> np.ndarray:
    return believed_foreground(np.clip(image, 0, 1).astype(np.float32)).region


@given(COUNTS)
def test_levels_split_where_scikit_image_does(histogram: np.ndarray) -> None:
    assume(np.count_nonzero(histogram) > 1)
    values = np.arange(32)
    found = otsu_level(histogram.astype(float))
    expected = int(threshold_otsu(hist=(histogram, values)))
    # Of levels with an equal variance either may be taken.
    assert between(histogram, found) == pytest.approx(between(histogram, expected), rel=1e-9)


def between(histogram: np.ndarray, level: int) -> float:
    """Variance between the classes up to a level and above it."""
    value = np.arange(len(histogram))
    low, high = histogram[: level + 1], histogram[level + 1 :]
    if not low.sum() or not high.sum():
        return 0.0
    means = (low * value[: level + 1]).sum() / low.sum(), (high * value[level + 1 :]).sum()
    return float(low.sum() * high.sum() * (means[0] - means[1] / high.sum()) ** 2)


@given(COUNTS)
def test_each_further_split_is_one_of_the_bright_side(histogram: np.ndarray) -> None:
    levels = list(splits(histogram.astype(float)))
    assert levels == sorted(set(levels))
    assert len(levels) <= 3
    for before, level in pairwise(levels):
        above = histogram.copy()
        above[: before + 1] = 0
        expected = int(threshold_otsu(hist=(above, np.arange(32))))
        assert between(above, level) == pytest.approx(between(above, expected), rel=1e-9)


def test_contrast_is_ashmans_d() -> None:
    histogram = np.zeros(256)
    histogram[[90, 110, 180, 220]] = 5
    # Means 100 and 200, variances 100 and 400.
    assert contrast(histogram, 150) == pytest.approx(100 / np.sqrt(250))
    histogram[:] = 0
    histogram[[10, 20]] = 1
    assert contrast(histogram, 15) == 10  # no spread counts as one level


def test_compactness_tells_a_cap_from_specks() -> None:
    v, u = np.mgrid[:480, :640]
    cap = (u - 300) ** 2 + (v - 200) ** 2 < 20**2
    assert compactness(halved(cap)) > 0.95
    assert compactness(halved((u % 8 < 2) & (v % 8 < 2))) == 0
    assert compactness(halved(np.zeros((480, 640), bool))) == 0
    half = cap | ((u % 16 < 4) & (v % 16 < 4) & (v > 400))
    expected = cap.sum() / half.sum()
    assert compactness(halved(half)) == pytest.approx(expected, abs=0.05)


def test_the_step_of_a_sharp_edge_is_all_and_that_of_a_ramp_nothing() -> None:
    v, u = np.mgrid[:480, :640]
    cap = (u - 300) ** 2 + (v - 200) ** 2 < 60**2
    image = np.where(cap, 0.8, 0.2).astype(np.float32)
    assert edge_step(image, halved(cap)) == pytest.approx(1, abs=0.15)
    dome = image - np.hypot(u - 300, v - 200).astype(np.float32) / 60 * 0.3 * cap
    assert 0.5 < edge_step(dome, halved(cap)) < 0.9
    ramp = (u / 640).astype(np.float32)
    assert edge_step(ramp, halved(ramp > 0.5)) < 0.02
    assert edge_step(image, halved(np.zeros_like(cap))) == 0
    assert edge_step(image, halved(np.ones_like(cap))) == 0


@pytest.mark.parametrize("level", [0.0, 0.02, 0.5, 1.0])
def test_one_level_is_no_evidence(level: float) -> None:
    assert not believed(np.full((480, 640), level)).any()


@pytest.mark.parametrize("sigma", [0.01, 0.05, 0.2])
def test_noise_of_one_kind_is_no_evidence(sigma: float) -> None:
    assert not believed(0.5 + noise(sigma)).any()
    grainy = cv2.GaussianBlur(noise(1, 1), (0, 0), 2)
    assert not believed(0.5 + sigma * grainy / grainy.std()).any()


@pytest.mark.parametrize("slope", [0.1, 0.3, 0.9])
@pytest.mark.parametrize("sigma", [0.0, 0.02, 0.05, 0.1])
def test_a_gradient_of_light_on_noise_is_no_evidence(slope: float, sigma: float) -> None:
    ramp = np.linspace(0.5 - slope / 2, 0.5 + slope / 2, 640)
    assert not believed(ramp + noise(sigma)).any()


@pytest.mark.parametrize("radius", [15, 40, 120])
@pytest.mark.parametrize("sigma", [0.0, 0.03])
def test_one_disc_is_found(radius: int, sigma: float) -> None:
    v, u = np.mgrid[:480, :640]
    disc = (u - 320) ** 2 + (v - 200) ** 2 < radius**2
    image = 0.2 + 0.5 * disc + noise(sigma)
    assert iou(believed(image), disc) > 0.98


def test_few_caps_on_a_bed_of_two_shades_are_found_by_a_further_split() -> None:
    v, u = np.mgrid[:480, :640]
    specks = cv2.GaussianBlur(noise(1, 3), (0, 0), 1.5) > 0.05
    disc = (u - 320) ** 2 + (v - 200) ** 2 < 20**2
    image = np.where(disc, 0.9, 0.15 + 0.15 * specks) + noise(0.02)
    found = believed_foreground(np.clip(image, 0, 1).astype(np.float32))
    assert iou(found.region, disc) > 0.95
    # What the first split took for bright is bed here, and the floor its mean.
    assert found.floor == pytest.approx(0.3, abs=0.02)
    # The energy's two phases would be the two shades, had it not been cut off at the floor.
    assert iou(ChanVese().process(frame_of(image, camera=None)).foreground, disc) > 0.95


def test_evidence_of_small_drawn_discs() -> None:
    clean = discs([(40.0, 40.0, 15.0), (100.0, 70.0, 20.0)], 0.8, 0.2)
    region, strength, floor = believed_foreground(clean.astype(np.float32))
    assert iou(region, clean > 0.5) > 0.98
    assert strength > 10
    assert floor == 0
