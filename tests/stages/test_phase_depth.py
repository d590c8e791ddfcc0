from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from mushpipe import Camera, Header, Mask, RgbdFrame
from mushpipe.stages.phase.depth import NO_RELIEF, halved, relief_of
from mushpipe.stages.phase.steps import height_at, rises, step_up
from mushpipe.stages.phase_hough import Evidence, PhaseHough, _foreground


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


def test_each_pixel_of_the_image_has_the_height_of_its_cell() -> None:
    height = np.arange(12, dtype=np.float32).reshape(3, 4) / 100
    for y, x in np.ndindex(6, 8):
        for beside in (-0.4, 0.4):
            found = height_at(height, max(x + beside, 0.0), max(y + beside, 0.0))
            assert found == pytest.approx(height[y // 2, x // 2])
    for x, y in ((-1.0, 2.0), (2.0, -1.0), (8.0, 2.0), (2.0, 6.0)):
        assert height_at(height, x, y) == -1


@pytest.mark.parametrize("seed", range(3))
def test_a_rise_is_the_highest_outside_over_the_highest_inside(seed: int) -> None:
    """One direction after the other, at two places within the outline and three beyond it."""
    rng = np.random.default_rng(seed)
    height = rng.uniform(0, 0.05, (60, 80)).astype(np.float32)
    height[rng.random(height.shape) < 0.3] = -1
    shape = np.array([rng.uniform(10, 150), rng.uniform(10, 110), 21.0, 0.0, 0.0])
    turn = 2 * np.pi * (np.arange(40) + 0.3) / 40
    c, s = np.cos(turn).astype(np.float32), np.sin(turn).astype(np.float32)
    found = np.empty((2, 40), np.float32)
    rises(height, shape, c, s, found)

    def highest(k: int, shares: tuple[float, ...], more: float) -> float:
        places = [(share * shape[2] + more) * np.array([c[k], s[k]]) for share in shares]
        return max(height_at(height, *(shape[:2] + place).tolist()) for place in places)

    for k in range(40):
        inside, outside = highest(k, (0.75, 0.85), 0), highest(k, (1.12, 1.2, 1.28), 1.5)
        expected = 0.0 if -1 in (inside, outside) else outside - inside
        assert found[0, k] == pytest.approx(expected, abs=1e-6)


def test_a_step_is_4_mm_and_more_at_large_caps() -> None:
    assert [step_up(radius) for radius in (0.01, 0.02, 0.06)] == pytest.approx(
        [0.004, 0.004, 0.009]
    )


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


def test_a_pixel_s_size_is_that_of_the_bed_at_its_own_place() -> None:
    """A pixel beside it differs by three parts of ten thousand, or seven."""
    frame = RgbdFrame(
        Header(0, 0, "camera"), np.zeros((240, 320, 3), np.uint8), BED.astype(np.float32), 1, CAMERA
    )
    relief = relief_of(frame)
    assert relief.bed_pixel(U, V) == pytest.approx(BED / 300, rel=2e-5)


def gathered(frame: RgbdFrame, **settings: object) -> Evidence:
    mask = Mask(np.ones(frame.color.shape[:2], bool))
    return PhaseHough.model_validate(settings).gather(frame, mask) or pytest.fail("no evidence")


def test_radii_left_to_depth_are_those_of_the_diameters_anywhere_on_the_bed() -> None:
    """The smallest where the bed is farthest, the largest, and a fifth, where it is nearest."""
    corners = [
        1 + 0.1 * (u - 159.5) / 300 - 0.2 * (v - 119.5) / 300 for u in (0, 320) for v in (0, 240)
    ]
    pixels = 0.5 / np.array(corners) / 300
    found = gathered(seen(BED), radius_px=None, diameter_mm=(24, 60)).radii
    assert found.smallest == pytest.approx(0.012 / pixels.max(), rel=2e-3)
    assert found.largest == pytest.approx(1.2 * 0.03 / pixels.min(), rel=2e-3)
    assert gathered(seen(BED), radius_px=None, diameter_mm=(6, 60)).radii.smallest == 5


@pytest.mark.parametrize(("most", "largest"), [(120, 80), (400, None), (700, 160)])
def test_an_open_range_ends_at_the_largest_cap_or_at_half_the_image(
    most: float, largest: float | None
) -> None:
    found = gathered(seen(BED), radius_px=(8, None), diameter_mm=(6, most)).radii
    expected = largest or most / 2000 * 300 / np.median(BED)
    assert found == pytest.approx((8, expected), rel=0.01)


@pytest.mark.parametrize(("diameter_mm", "possible"), [((36, 44), True), ((46, 120), False)])
def test_a_diameter_is_taken_at_the_height_that_a_cap_stands_at(
    diameter_mm: tuple[float, float], possible: bool
) -> None:
    """40 mm at 0.3 m, 0.1 m over the bed, where a circle as large would be of 53 mm."""
    inside = np.hypot(U - 160, V - 120) < 0.02 * 300 / 0.3
    color = np.where(inside[..., None], 200, 30).astype(np.uint8).repeat(3, axis=2)
    frame = replace(seen(np.where(inside, 0.3, 0.4)), color=color)
    shapes = gathered(frame, diameter_mm=diameter_mm).shapes
    assert (np.abs(shapes[:, :3] - (160, 120, 20)).max(axis=1) < 1).any() == possible


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
