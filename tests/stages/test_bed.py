from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from mushpipe import Camera
from mushpipe.stages.bed import bed_depth, far_cells, fit_plane, plane_depth
from mushpipe.stages.upright import bed_normal, pixel_rays

V, U = np.mgrid[:240, :320].astype(float)
RAY = np.stack([(U - 159.5) / 300, (V - 119.5) / 300, np.ones_like(U)], axis=-1)
RAYS = RAY[..., :2].astype(np.float32)


def normal_of(tilt: float, turn: float) -> np.ndarray:
    """Unit normal towards the camera, tilted by so many degrees."""
    tilt, turn = np.radians([tilt, turn])
    return -np.array([np.sin(tilt) * np.cos(turn), np.sin(tilt) * np.sin(turn), np.cos(tilt)])


def crowded(seed: int, normal: np.ndarray, caps: int) -> tuple[np.ndarray, np.ndarray]:
    """Depth of spheres on a plane 0.45 m away with noise, holes and a rim; of the plane alone."""
    rng = np.random.default_rng(seed)
    bed = depth = -0.45 / (RAY @ normal)
    for _ in range(caps):
        v, u = int(rng.integers(240)), int(rng.integers(320))
        radius = rng.uniform(0.012, 0.025)
        center = RAY[v, u] * bed[v, u] + normal * rng.uniform(0.005, 0.04)
        a, b = (RAY**2).sum(-1), RAY @ center
        root = b * b - a * (center @ center - radius**2)
        hit = np.where(root > 0, (b - np.sqrt(np.maximum(root, 0))) / a, np.inf)
        depth = np.minimum(depth, hit)
    depth = depth + rng.normal(0, 0.001, depth.shape)
    depth[:, :30] -= 0.07
    depth[rng.random(depth.shape) < 0.15] = np.nan
    depth[100:160, 140:200] = np.nan
    return depth.astype(np.float32), bed


@pytest.mark.parametrize("caps", [0, 30, 70])
@pytest.mark.parametrize(("tilt", "turn"), [(0, 0), (10, 40), (20, 250)])
def test_the_bed_is_found_below_caps_beside_a_rim_and_a_hole(
    caps: int, tilt: float, turn: float
) -> None:
    normal = normal_of(tilt, turn)
    depth, bed = crowded(caps, normal, caps)
    plane = bed_depth(depth, relief=False)
    assert plane is not None
    # It follows the far side of the noise.
    assert np.abs(plane - bed).mean() < 0.002
    found = bed_normal(np.nan_to_num(depth), RAYS)
    assert found is not None
    assert np.degrees(np.arccos(found @ normal)) < 0.7


@pytest.mark.parametrize("drop", [0.05, 0.2, 0.8])  # m
@pytest.mark.parametrize("share", [0.2, 0.3])
@pytest.mark.parametrize("where", ["right", "both sides", "corner", "diagonal"])
def test_a_floor_beside_the_bed_does_not_turn_it(where: str, share: float, drop: float) -> None:
    normal = normal_of(8, 130)
    depth, bed = crowded(5, normal, 40)
    x, y = U / 320, V / 240
    beside = {
        "right": x > 1 - share,
        "both sides": np.abs(2 * x - 1) > 1 - share,
        "corner": np.maximum(x, y) < np.sqrt(share),
        "diagonal": x + y < np.sqrt(2 * share),
    }[where]
    floor = -(0.45 + drop) / (RAY @ normal)
    depth[beside] = floor[beside] + np.random.default_rng(0).normal(0, 0.002, beside.sum())
    found = bed_normal(np.nan_to_num(depth), RAYS)
    assert found is not None
    assert np.degrees(np.arccos(found @ normal)) < 1.0
    plane = bed_depth(depth, relief=False)
    assert plane is not None
    assert np.median(np.abs(plane - bed)) < 0.003


def test_the_fit_takes_rays_and_pixels_alike() -> None:
    bed = (-0.45 / (RAY @ normal_of(15, 30))).astype(np.float32)
    rays = np.dstack([RAYS, bed])[::8, ::8]
    for points, x, y in ((rays, RAY[..., 0], RAY[..., 1]), (np.dstack([U, V, bed]), U, V)):
        coefficients = fit_plane(points)
        assert coefficients is not None
        np.testing.assert_allclose(plane_depth(coefficients, x, y), bed, atol=1e-5)


def test_no_ray_means_no_point() -> None:
    rays = RAYS.copy()
    rays[:, 160:] = 1e6
    bed = -0.45 / (RAY @ normal_of(12, 70))
    found = bed_normal(bed.astype(np.float32), rays)
    assert found == pytest.approx(normal_of(12, 70), abs=1e-3)


@pytest.mark.parametrize("missing", [0.0, np.nan])
def test_too_little_depth_is_no_bed(missing: float) -> None:
    depth = np.full((240, 320), missing, np.float32)
    depth[:60, :60] = 0.5
    assert bed_depth(depth) is None
    assert fit_plane(far_cells(depth, 32)) is None
    assert bed_normal(np.nan_to_num(depth), RAYS) is None


@given(st.integers(0, 2**32 - 1), st.floats(0, 1), st.sampled_from([8, 16, 32]))
def test_far_cells_are_the_far_percentile(seed: int, share: float, cell: int) -> None:
    rng = np.random.default_rng(seed)
    depth = rng.uniform(0.4, 0.6, (70, 75)).astype(np.float32)
    depth[rng.random(depth.shape) > share] = np.nan
    far = far_cells(depth, cell)
    assert far.shape == (70 // cell, 75 // cell, 3)
    for i, j in np.ndindex(far.shape[:2]):
        samples = depth[i * cell : (i + 1) * cell, j * cell : (j + 1) * cell]
        samples = samples[:: cell // 4, :: cell // 4]
        known = np.sort(samples[np.isfinite(samples)])[::-1]
        if 3 * len(known) < 16:
            assert np.isnan(far[i, j, 2])
        else:
            x, y, z = far[i, j]
            assert z == known[len(known) // 10] == depth[int(y), int(x)]
            assert (int(y) // cell, int(x) // cell) == (i, j)


@pytest.mark.parametrize("size", [(240, 320), (239, 319), (231, 310)])
@pytest.mark.parametrize("relief", [True, False])
def test_a_leaning_plane_goes_on_to_the_border(size: tuple[int, int], relief: bool) -> None:
    height, width = size
    plane = (-0.45 / (RAY @ normal_of(20, 250)))[:height, :width]
    found = bed_depth(plane.astype(np.float32), relief)
    assert found is not None
    np.testing.assert_allclose(found, plane, rtol=0, atol=3e-4)


LENSES = {  # px and coefficients at 640 x 480, as the cameras' colour streams have them
    "D435": (605.0, (-0.055, 0.065, 0.0, 0.0, -0.02)),
    "D405": (435.0, (-0.054, 0.058, 0.0, 0.0, -0.02)),
    "pincushion": (605.0, (0.15, -0.5, 0.0, 0.0, 0.45)),
}


@pytest.mark.parametrize("lens", LENSES)
@pytest.mark.parametrize("turn", [0, 45, 200])
def test_a_camera_s_lens_bends_the_plane_of_pixels_little(lens: str, turn: float) -> None:
    f, coefficients = LENSES[lens]
    rays = pixel_rays(Camera(640, 480, f, f, 319.5, 239.5, "brown_conrady", coefficients))
    seen = np.dstack([rays, np.ones(rays.shape[:2])]) @ normal_of(20, turn)
    plane = (-0.45 * np.cos(np.radians(20)) / seen).astype(np.float32)
    found = bed_depth(plane)
    assert found is not None
    np.testing.assert_allclose(found, plane, rtol=0, atol=1e-3)
    assert np.abs(found - plane).mean() < 2e-4
