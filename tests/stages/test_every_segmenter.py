"""What holds for every segmenter: no input makes it fail, and no bed gives no mask."""

from __future__ import annotations

import numpy as np
import pytest

from mushpipe import Mask, RgbdFrame
from mushpipe.stages.chan_vese import ChanVese
from mushpipe.stages.flatten import Flatten
from mushpipe.stages.height import Height
from mushpipe.stages.kmeans import KMeans
from mushpipe.stages.otsu import Otsu
from tests.stages.frames import iou, recorded, simulated, truth_of
from tests.stages.scenes import HEADER

Segmenter = Otsu | KMeans | ChanVese | Height
CHECKED: list[Segmenter] = [
    Otsu(),
    Otsu(channel="auto"),
    ChanVese(),
    ChanVese(channel="auto"),
    ChanVese(channel="rgb"),
    ChanVese(solver="morphological"),
    ChanVese(solver="pde", iterations=3),
    Height(),
]
EVERY: list[Segmenter] = [
    *CHECKED,
    KMeans(),
    Otsu(check=False, channel="a"),
    ChanVese(check=False, channel="red-blue", polarity="dark"),
    ChanVese(check=False, solver="morphological"),
]
every = pytest.mark.parametrize("stage", EVERY, ids=str)


def frame_of(color: np.ndarray, depth: np.ndarray | None = None) -> RgbdFrame:
    return RgbdFrame(HEADER, color, None if depth is None else depth.astype(np.float32), 1.0)


def checked(mask: Mask, shape: tuple[int, ...]) -> None:
    assert mask.foreground.shape == shape
    assert mask.foreground.dtype == bool
    assert mask.initial is None or mask.initial.shape == shape


@every
@pytest.mark.parametrize(
    "shape", [(1, 1), (2, 3), (1, 70), (65, 1), (9, 64), (31, 33), (33, 129), (100, 20)]
)
def test_images_of_any_size(stage: Segmenter, shape: tuple[int, int]) -> None:
    rng = np.random.default_rng(0)
    for color in (rng.integers(0, 256, (*shape, 3)), np.zeros((*shape, 3))):
        frame = frame_of(color.astype(np.uint8), rng.uniform(0.4, 0.6, shape))
        checked(stage.process(frame), shape)
        checked(stage.process(Flatten().process(frame)), shape)


@every
def test_large_images(stage: Segmenter) -> None:
    frame = simulated(207, width=1280, height=720, count=40)
    checked(stage.process(frame), (720, 1280))


@pytest.mark.parametrize("stage", CHECKED, ids=str)
@pytest.mark.parametrize("level", [0, 90, 255])
def test_an_image_of_one_level_is_empty(stage: Segmenter, level: int) -> None:
    frame = frame_of(np.full((120, 160, 3), level, np.uint8), np.full((120, 160), np.nan))
    assert not stage.process(frame).foreground.any()
    assert not stage.process(Flatten().process(frame)).foreground.any()


@pytest.mark.parametrize("stage", CHECKED, ids=str)
@pytest.mark.parametrize("light", ["even", "gradient"])
def test_an_empty_bed_is_empty(stage: Segmenter, light: str) -> None:
    bed = {"width": 640, "height": 480, "count": 0, "pins": 1, "stumps": 0, "light": light}
    frame = simulated(208, **bed)
    found = stage.process(frame).foreground
    # A cut off stem or a knot of mycelium may remain, but no picture full of it.
    assert found.mean() < 0.004


@pytest.mark.parametrize("seed", [7100, 7200])
def test_the_relief_of_soil_alone_has_no_two_sides(seed: int) -> None:
    bed = {"width": 640, "height": 480, "count": 0, "pins": 0, "stumps": 0, "mycelium": 0}
    found = ChanVese(channel="gray+height").process(simulated(seed, **bed)).foreground
    assert found.mean() < 0.015  # bright crumbs; it was a sixth of the picture


@pytest.mark.parametrize("stage", CHECKED, ids=str)
def test_noise_in_colour_is_empty(stage: Segmenter) -> None:
    color = np.random.default_rng(1).normal(90, 12, (240, 320, 3))
    assert not stage.process(frame_of(np.clip(color, 0, 255).astype(np.uint8))).foreground.any()


@every
def test_what_it_is_given_stays_as_it_was_and_calls_repeat(stage: Segmenter) -> None:
    frame = simulated(209)
    color = frame.color.copy()
    first, second = stage.process(frame), stage.process(frame)
    assert (frame.color == color).all()
    assert (first.foreground == second.foreground).all()


@pytest.mark.parametrize("stage", [*CHECKED[:6], KMeans(clusters=2)], ids=str)
def test_a_real_white_bed_is_segmented_alike(stage: Segmenter) -> None:
    (frame,) = recorded("white-bed-0")
    reference = ChanVese(check=False).process(frame).foreground
    assert iou(stage.process(frame).foreground, reference) > 0.9


def test_segmenters_find_a_simulated_bed() -> None:
    frame = simulated(211, width=640, height=480, count=60)
    for stage in CHECKED:
        stage.open()
        assert iou(stage.process(frame).foreground, truth_of(frame)) > 0.88, str(stage)
