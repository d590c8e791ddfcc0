from __future__ import annotations

import numpy as np
import orjson
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from mushpipe.stages.cap_fit import CapFit
from mushpipe.stages.cap_net import CapNet
from mushpipe.stages.discs import Radii
from mushpipe.stages.phase.blobs import LEVELS, blobs_of
from mushpipe.stages.phase.depth import NO_RELIEF, Relief
from mushpipe.stages.phase_hough import PhaseHough
from tests.stages.frames import field_data, recorded

HEIGHT, WIDTH = 120, 160  # of the height map, half of the image
EXACT = 7.5  # px of the image: nearly four of the map; heights are looked at in every second


def relief(height: np.ndarray) -> Relief:
    known = height.astype(np.float32)
    return NO_RELIEF._replace(height=known, filled=known)


def disc(x: float, y: float, r: float, height: float = 0.05) -> np.ndarray:
    """A cylinder on a flat bed; px of the image."""
    v, u = np.mgrid[:HEIGHT, :WIDTH]
    return np.where(np.hypot(2 * u + 0.5 - x, 2 * v + 0.5 - y) <= r, height, 0.0)


@settings(max_examples=40, deadline=None)
@given(
    x=st.floats(60, 260), y=st.floats(60, 180), r=st.floats(16, 50), height=st.floats(0.011, 0.09)
)
def test_a_thing_that_stands_alone_is_a_disc_and_at_several_levels_the_same(
    x: float, y: float, r: float, height: float
) -> None:
    found = blobs_of(relief(disc(x, y, r, height)), Radii(8, 60))
    assert np.unique(np.abs(found[:, :3] - (x, y, r)).max(axis=1) <= EXACT).tolist() == [True]
    low = blobs_of(relief(disc(x, y, r, LEVELS[0] + 0.001)), Radii(8, 60))  # seen at one level only
    assert len(found) == len(low)


@settings(max_examples=25, deadline=None)
@given(seed=st.integers(0, 10_000))
def test_discs_fit_into_what_stands_and_touch_its_border(seed: int) -> None:
    """Against the distance to the nearest lower place, taken one by one."""
    rng = np.random.default_rng(seed)
    height = np.zeros((HEIGHT, WIDTH))
    for _ in range(6):
        (x, y), r = rng.uniform(40, (280, 200)), rng.uniform(12, 40)
        height = np.maximum(height, disc(x, y, r, rng.uniform(0.002, 0.06)))
    v, u = np.mgrid[:HEIGHT, :WIDTH]
    found = blobs_of(relief(height), Radii(8, 60))
    assert len(found)
    for x, y, r, _ in found:
        away = np.hypot(2 * u + 0.5 - x, 2 * v + 0.5 - y)
        to_lower = [away[height <= level].min() for level in LEVELS]
        assert np.abs(np.array(to_lower) - r).min() <= EXACT


def test_a_part_of_something_larger_is_none() -> None:
    bar = np.zeros((HEIGHT, WIDTH))
    bar[40:80, 10:150] = 0.05  # the discs along it are lower at two sides alone
    inner = blobs_of(relief(bar), Radii(8, 60))[:, 0]
    assert not ((inner > 70) & (inner < 250)).any()


def test_a_low_cap_is_parted_from_the_stem_that_it_leans_on() -> None:
    v, u = np.mgrid[:HEIGHT, :WIDTH]
    stem = np.hypot((2 * u - 140) / 85, (2 * v - 120) / 44) <= 1
    height = np.maximum(disc(100, 120, 40, 0.034), np.where(stem, 0.024, 0.0))
    found = blobs_of(relief(height), Radii(8, 60))
    assert (np.abs(found[:, :3] - (100, 120, 40)).max(axis=1) <= EXACT).any()


@pytest.mark.parametrize("level", [-1.0, 0.0, 0.003, 0.05])
def test_what_is_all_of_one_height_or_unknown_holds_none(level: float) -> None:
    assert blobs_of(relief(np.full((HEIGHT, WIDTH), level)), Radii(8, 60)).shape == (0, 4)


def test_discs_beyond_the_range_are_left_out() -> None:
    scene = relief(disc(160, 120, 40))
    assert len(blobs_of(scene, Radii(30, 50)))
    assert not len(blobs_of(scene, Radii(8, 30)))
    assert not len(blobs_of(scene, Radii(50, 80)))


def test_a_cap_at_the_border_is_a_disc_that_goes_on_beyond_it() -> None:
    found = blobs_of(relief(disc(0, 120, 40)), Radii(8, 60))
    assert np.abs(found[:, :3] - (0, 120, 40)).max() <= EXACT


def test_dim_wood_on_wood_is_found_where_it_stands() -> None:
    """Five models on a desk; an image this dark shows edges of three or four of them."""
    frame = recorded("desk-july")[0]
    labels = orjson.loads((field_data() / "desk-july.labels.json").read_bytes())
    boxes = np.array([cap["bbox"] for cap in labels["frames"][0]["caps"]])
    mask, learned = CapNet(radius_px=(8, None), min_score=0.05).process(frame)
    fit = CapFit(depth_bias_mm=2.85, min_score=0.5)
    on_cap = {}
    for blobs in (False, True):
        detector = PhaseHough(radius_px=(8, None), min_score=0.1, use_learned=True, use_blobs=blobs)
        circles = fit.process(frame, detector.process(frame, mask, learned), learned)[2]
        inside = (circles.center[:, None] >= boxes[:, :2]) & (
            circles.center[:, None] <= boxes[:, :2] + boxes[:, 2:]
        )
        on_cap[blobs] = int(inside.all(axis=2).any(axis=0).sum())
        assert inside.all(axis=2).any(axis=1).all()  # and none elsewhere
    assert on_cap[True] == len(boxes) > on_cap[False]
