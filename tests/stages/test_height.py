from __future__ import annotations

import numpy as np
import pytest

from mushpipe import Camera, RgbdFrame
from mushpipe.stages.bed import bed_depth
from mushpipe.stages.height import (
    Height,
    filled,
    height_image,
    height_map,
    without_crumbs,
)
from tests.stages.frames import iou, simulated, truth_of
from tests.stages.scenes import HEADER

V, U = np.mgrid[:240, :320].astype(float)
RAY = np.stack([(U - 159.5) / 300, (V - 119.5) / 300, np.ones_like(U)], axis=-1)
CAMERA = Camera(320, 240, 300.0, 300.0, 159.5, 119.5)
SPHERES = [((-0.05, -0.02, 0.50), 0.022), ((0.04, 0.01, 0.49), 0.03), ((0.09, 0.06, 0.5), 0.02)]


def sphere(center: tuple[float, float, float], radius: float) -> np.ndarray:
    """Depth of a sphere by the closed form of a ray and a sphere, infinite beside it."""
    c = np.array(center)
    a, b = (RAY**2).sum(-1), RAY @ c
    root = b * b - a * (c @ c - radius**2)
    return np.where(root > 0, (b - np.sqrt(np.maximum(root, 0))) / a, np.inf)


def plane(tilt: float) -> np.ndarray:
    """Depth of a plane 0.51 m away, tilted by so many degrees."""
    normal = np.array([np.sin(np.radians(tilt)), 0.5 * np.sin(np.radians(tilt)), 1.0])
    return 0.51 / (RAY @ normal)


def scene(bed: np.ndarray, noise: float = 0.001) -> tuple[np.ndarray, np.ndarray]:
    """Depth of spheres before a bed, and where they rise above it by 8 mm."""
    caps = np.min([sphere(c, r) for c, r in SPHERES], axis=0)
    depth = np.minimum(bed, caps) + np.random.default_rng(0).normal(0, noise, bed.shape)
    return depth, bed - caps > 0.008


def frame_of(depth: np.ndarray | None) -> RgbdFrame:
    shape = (240, 320) if depth is None else depth.shape
    camera = CAMERA if shape == (240, 320) else None
    color = np.full((*shape, 3), 90, np.uint8)
    native = None if depth is None else depth.astype(np.float32)
    return RgbdFrame(HEADER, color, native, 1.0, camera)


@pytest.mark.parametrize("tilt", [0, 10, 20])
@pytest.mark.parametrize("relief", [True, False])
def test_spheres_on_a_tilted_plane(tilt: float, relief: bool) -> None:
    depth, truth = scene(plane(tilt))
    assert iou(Height(relief=relief).process(frame_of(depth)).foreground, truth) > 0.9


def test_spheres_on_a_bumpy_plane_need_the_relief() -> None:
    bumps = 0.007 * np.sin(U / 45) * np.cos(V / 40)
    depth, truth = scene(plane(5) + bumps)
    plain, bent = (
        iou(Height(relief=relief).process(frame_of(depth)).foreground, truth)
        for relief in (False, True)
    )
    assert bent > 0.95
    assert bent > plain + 0.1


def test_the_bed_is_the_plane_that_was_put_in() -> None:
    bed = plane(12)
    depth, truth = scene(bed)
    found = bed_depth(depth.astype(np.float32))
    assert found is not None
    # It follows the far side: of the noise, and of each cell of the slope.
    assert -0.001 < np.median(found - bed) < 0.0035
    assert np.abs(found - bed)[~truth].max() < 0.006


def test_holes_and_shadows_are_filled() -> None:
    depth, truth = scene(plane(5))
    rng = np.random.default_rng(1)
    depth[rng.random(depth.shape) < 0.3] = np.nan
    shadow = np.roll(truth, 6, axis=1) & ~truth
    depth[shadow] = np.nan
    assert iou(Height().process(frame_of(depth)).foreground, truth) > 0.85


def test_large_gaps_leave_the_rest_as_it_is() -> None:
    depth, truth = scene(plane(5))
    depth[:, 250:] = np.nan
    found = Height().process(frame_of(depth)).foreground
    assert iou(found[:, :240], truth[:, :240]) > 0.9


@pytest.mark.parametrize("depth", [None, np.full((240, 320), np.nan), np.zeros((240, 320))])
def test_without_depth_there_is_nothing(depth: np.ndarray | None) -> None:
    frame = frame_of(depth)
    assert height_map(frame) is None
    assert not Height().process(frame).foreground.any()


def test_an_empty_bed_is_empty() -> None:
    noisy = plane(8) + np.random.default_rng(2).normal(0, 0.002, U.shape)
    assert not Height().process(frame_of(noisy)).foreground.any()


@pytest.mark.parametrize("shape", [(1, 1), (2, 3), (15, 40), (17, 16), (48, 64)])
def test_tiny_images(shape: tuple[int, int]) -> None:
    mask = Height().process(frame_of(np.full(shape, 0.5)))
    assert mask.foreground.shape == shape
    assert not mask.foreground.any()


def test_what_is_too_high_is_no_mushroom() -> None:
    depth = plane(0)
    depth[60:180, 100:220] -= 0.2
    depth[20:50, 20:50] -= 0.03
    found = Height().process(frame_of(depth)).foreground
    assert not found[70:170, 110:210].any()
    assert found[25:45, 25:45].all()


@pytest.mark.parametrize(
    ("settings", "found"),
    [
        ({}, [False, True, True, True]),
        ({"min_mm": 3}, [True, True, True, True]),
        ({"min_mm": 20}, [False, False, True, True]),
        ({"max_mm": 30}, [False, True, False, False]),
        ({"smallest_px": 30}, [False, True, True, False]),
    ],
)
def test_blocks_are_told_by_their_height_and_size(
    settings: dict[str, float], found: list[bool]
) -> None:
    depth, blocks = plane(5), []
    for x, side, high in ((40, 40, 0.005), (110, 40, 0.012), (180, 40, 0.04), (250, 20, 0.04)):
        blocks.append((slice(100, 100 + side), slice(x, x + side)))
        depth[blocks[-1]] -= high
    region = Height.model_validate(settings).process(frame_of(depth)).foreground
    assert [bool(region[block].mean() > 0.5) for block in blocks] == found


def test_height_scales_to_half_at_the_middle() -> None:
    image = height_image(np.array([[-0.01, 0.0, 0.008, 0.016, 0.1, 0.2]], np.float32), 0.008, 0.15)
    np.testing.assert_allclose(image, [[0, 0, 0.5, 1, 1, 0]], atol=1e-6)


def test_filling_takes_the_lower_of_opposite_sides() -> None:
    height = np.full((5, 7), np.nan, np.float32)
    height[2, 0], height[2, 6], height[0, 2], height[4, 2] = 1.0, 4.0, 2.0, 3.0
    full = filled(height)
    assert full[2, 2] == pytest.approx((min(1.0, 4.0) + min(2.0, 3.0)) / 2)
    assert full[4, 4] == 0
    assert full[2, 4] == pytest.approx(min(1.0, 4.0) / 2)
    assert (full[np.isfinite(height)] == height[np.isfinite(height)]).all()


def test_filling_reaches_no_farther_than_a_shadow() -> None:
    height = np.full((3, 200), np.nan, np.float32)
    height[:, 0] = height[:, 199] = 0.05
    assert (filled(height)[:, 33:167] == 0).all()
    depth, _ = scene(plane(5))
    depth[:, 240:] = np.nan
    found = Height().process(frame_of(depth)).foreground
    assert not found[:, 250:].any()


@pytest.mark.parametrize("seed", [203, 204])
def test_brown_caps_of_the_simulator_are_found(seed: int) -> None:
    frame = simulated(seed, width=640, height=480, count=60, cap_color="brown")
    assert iou(Height().process(frame).foreground, truth_of(frame)) > 0.85


def test_pieces_smaller_than_a_cap_are_dropped() -> None:
    region = np.zeros((60, 80), bool)
    region[10:19, 10:19] = True  # 81 px, a disc of 10 px has 79
    region[30:38, 40:49] = True  # 72 px
    kept = without_crumbs(region, 10)
    assert kept[14, 14]
    assert kept.sum() == 81
    assert (without_crumbs(region, 0) == region).all()
