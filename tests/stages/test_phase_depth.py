from __future__ import annotations

import numpy as np
import pytest

from mushpipe import Camera, Header, RgbdFrame
from mushpipe.stages.phase.depth import NO_RELIEF, halved, relief_of
from mushpipe.stages.phase_hough import _foreground


@pytest.mark.parametrize("shape", [(6, 8), (7, 8), (6, 9), (5, 7)])
@pytest.mark.parametrize("native", [np.uint16, np.float32])
def test_depth_is_halved_to_the_mean_of_what_is_known(shape: tuple[int, int], native: type) -> None:
    rng = np.random.default_rng(3)
    depth = rng.integers(1, 900, shape).astype(native)
    depth[rng.random(shape) < 0.4] = 0
    if native is np.float32:
        depth[rng.random(shape) < 0.2] = np.nan
        depth[0, 0] = np.inf
    else:
        depth[rng.random(shape) < 0.2] = 65535
    small = halved(depth, 0.001)
    assert small.shape == ((shape[0] + 1) // 2, (shape[1] + 1) // 2)
    for y, x in np.ndindex(*small.shape):
        cell = depth[2 * y : 2 * y + 2, 2 * x : 2 * x + 2]
        known = cell[(cell > 0) & (cell < 65535)]
        wanted = 0.001 * known.mean(dtype=float) if len(known) else -1
        assert small[y, x] == pytest.approx(wanted, rel=1e-6)


@pytest.mark.parametrize("shape", [(6, 8), (7, 8), (6, 9), (5, 7)])
def test_what_stands_on_the_bed_is_added_to_the_mask(shape: tuple[int, int]) -> None:
    rng = np.random.default_rng(4)
    mask = (rng.random(shape) < 0.3).astype(np.uint8)
    height = rng.random(((shape[0] + 1) // 2, (shape[1] + 1) // 2)).astype(np.float32) / 100
    both = _foreground(mask, NO_RELIEF._replace(height=height))
    for y, x in np.ndindex(*shape):
        assert both[y, x] == (mask[y, x] or height[y // 2, x // 2] > 0.004)


CAMERA = Camera(320, 240, 300.0, 300.0, 159.5, 119.5)
V, U = np.mgrid[:240, :320].astype(float)
BED = 0.5 / (1 + 0.1 * (U - 159.5) / 300 - 0.2 * (V - 119.5) / 300)  # m, a leaning plane
UNIT = 0.0001


def seen(depth: np.ndarray, camera: Camera | None = CAMERA) -> RgbdFrame:
    color = np.zeros((240, 320, 3), np.uint8)
    native = np.rint(np.nan_to_num(depth) / UNIT).astype(np.uint16)
    return RgbdFrame(Header(0, 0, "camera"), color, native, UNIT, camera)


def test_heights_are_those_over_the_bed_and_pixels_are_as_large_as_there() -> None:
    low, high = np.hypot(U - 90, V - 70) < 25, np.hypot(U - 230, V - 170) < 25
    depth = BED - np.where(low, 0.01, 0) - np.where(high, 0.04, 0)
    depth[:60, 200:] = np.nan
    relief = relief_of(seen(depth))
    assert relief.known
    places = [(90, 70), (230, 170), (160, 120), (250, 30), (-9, 119), (400, 500)]  # x, y
    found = relief.heights(np.column_stack([places, np.full(6, 20.0)]))
    expected = [0.01, 0.04, 0, np.nan, 0, 0]  # beyond the image as at its border
    assert found == pytest.approx(expected, abs=3e-4, nan_ok=True)
    for x, y in places[:3]:
        assert relief.bed_pixel(x, y) == pytest.approx(BED[y, x] / 300, rel=1e-3)
    assert relief.focal == 300
    assert relief.pixel == pytest.approx(np.nanmedian(depth) / 300, rel=0.01)


def test_an_edge_of_depth_is_none_where_nothing_is_known_to_lie_lower() -> None:
    """A block of 40 mm from 100 to 200 px; right of it depth is missing, too wide to be closed."""
    block = (U >= 100) & (U < 200) & (V >= 80) & (V < 160)
    depth = BED - np.where(block, 0.04, 0)
    depth[:, 200:260] = np.nan
    edges = relief_of(seen(depth)).edges()
    middle = (edges.y > 45) & (edges.y < 75)
    assert middle.sum() > 20
    assert 2 * edges.x[middle] == pytest.approx(np.full(middle.sum(), 99), abs=2)
    assert (edges.nx[middle] > 0.9).all()  # into the block


def test_without_depth_calibration_or_a_bed_there_is_no_relief() -> None:
    whole = seen(BED)
    assert relief_of(whole).known
    for frame in (
        seen(BED, None),
        RgbdFrame(whole.header, whole.color, None, 1.0, CAMERA),
        seen(np.full(BED.shape, np.nan)),
    ):
        assert not relief_of(frame).known
