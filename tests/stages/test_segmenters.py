from __future__ import annotations

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from scipy import ndimage
from skimage.filters import threshold_otsu

from mushpipe import Mask
from mushpipe.stages.chan_vese import ChanVese
from mushpipe.stages.opening import Opening
from mushpipe.stages.otsu import Otsu, otsu_foreground
from tests.stages.scenes import discs, frame_of

BED = [(40.0, 40.0, 15.0), (100.0, 70.0, 20.0)]


@given(arrays(np.uint8, (12, 17), elements=st.integers(0, 255)))
def test_otsu_splits_where_scikit_image_does(levels: np.ndarray) -> None:
    foreground = otsu_foreground((levels / 255).astype(np.float32))
    if levels.min() == levels.max():
        assert not foreground.any()
        return
    # Both thresholds maximise the between-class variance; ties may differ, the variance may not.
    expected = levels > threshold_otsu(levels)
    assert between_variance(levels, foreground) == pytest.approx(
        between_variance(levels, expected), rel=1e-6
    )


def between_variance(levels: np.ndarray, foreground: np.ndarray) -> float:
    weight = foreground.mean()
    if weight in (0.0, 1.0):
        return 0.0
    return weight * (1 - weight) * (levels[foreground].mean() - levels[~foreground].mean()) ** 2


@pytest.mark.parametrize("stage", [Otsu(), ChanVese()])
def test_segmenter_finds_discs_and_keeps_its_initial_contour(stage: Otsu | ChanVese) -> None:
    rng = np.random.default_rng(5)
    clean = discs(BED, 0.8, 0.2)
    mask = stage.process(frame_of(np.clip(clean + rng.normal(0, 0.05, clean.shape), 0, 1)))
    truth = clean > 0.5
    assert (mask.foreground & truth).sum() / (mask.foreground | truth).sum() > 0.98
    assert mask.initial is not None


@pytest.mark.parametrize("stage", [Otsu(), ChanVese()])
@pytest.mark.parametrize("level", [0.0, 0.5, 1.0])
def test_an_image_of_one_level_has_no_foreground(stage: Otsu | ChanVese, level: float) -> None:
    assert not stage.process(frame_of(np.full((120, 160), level))).foreground.any()


@given(arrays(np.bool_, (20, 23)), st.integers(1, 9))
def test_opening_is_part_of_the_mask_and_idempotent(image: np.ndarray, size: int) -> None:
    opened = Opening(size=size).process(Mask(image.copy())).foreground
    assert not (opened & ~image).any()
    again = Opening(size=size).process(Mask(opened)).foreground
    assert (again == opened).all()


def test_opening_removes_specks_and_keeps_discs_in_place() -> None:
    image = discs([(60.0, 60.0, 20.0)], 1, 0) > 0.5
    speckled = image.copy()
    speckled[5, 5] = speckled[100:103, 150:153] = True
    opened = Opening(size=10).process(Mask(speckled)).foreground
    assert not (opened & ~image).any()
    # An even kernel must not move what it keeps.
    assert ndimage.center_of_mass(opened) == pytest.approx((60, 60), abs=0.15)


def test_opening_agrees_with_scipy_where_the_kernel_is_symmetric() -> None:
    rng = np.random.default_rng(0)
    image = ndimage.gaussian_filter(rng.normal(size=(60, 70)), 3) > 0
    inner = slice(10, -10)  # the two differ in what they assume beyond the image
    for size in (3, 5, 7):
        kernel = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (size, size)).astype(bool)
        stage = Opening(size=size).process(Mask(image)).foreground
        expected = ndimage.binary_opening(image, kernel)
        assert (stage[inner, inner] == expected[inner, inner]).all()
