"""What is cut out and looked through at once, against loops over single pixels."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from mushpipe.stages.cap.blocks import (
    CELLS,
    COUNT,
    DEPTH,
    HIDDEN,
    SPREAD,
    Image,
    K,
    Sensor,
    U,
    V,
    average,
    median,
    own_depth,
    room_to_cut,
)
from mushpipe.stages.cap.depth_edge import follow
from mushpipe.stages.cap.samples import (
    COMPASS,
    DIRECTIONS,
    INNER,
    OUTER,
    POINT_SHARE,
    RADII,
    STEP,
    normalise,
    ray_at,
    sample_depth,
)
from tests.stages.caps import CAMERA, image_of

WIDTH, HEIGHT = 64, 48
PLACES = st.tuples(st.floats(-10, 74), st.floats(-10, 58), st.floats(4, 30))


def scene(seed: int) -> Image:
    """Depth with holes, and ranks, of which 0 hides 1."""
    rng = np.random.default_rng(seed)
    depth = rng.uniform(0.4, 0.6, (HEIGHT, WIDTH)).astype(np.float32)
    depth[rng.random(depth.shape) < 0.2] = np.nan
    depth[rng.random(depth.shape) < 0.1] = 0
    rays, ranks = np.zeros((HEIGHT, WIDTH, 2), np.float32), rng.random(depth.shape) > 0.2
    return Image(depth, rays, ranks.astype(np.int16), 400.0)


def pixel(image: Image, u: int, v: int) -> float:
    """Depth of a pixel as circle 1 sees it, 0 where missing or outside, HIDDEN behind circle 0."""
    if not (0 <= u < WIDTH and 0 <= v < HEIGHT):
        return 0.0
    if image.ranks[v, u] < 1:
        return float(HIDDEN)
    return float(image.depth[v, u]) if image.depth[v, u] > 0 else 0.0


@settings(deadline=None)
@given(seed=st.integers(0, 99), place=PLACES, half=st.integers(0, 3))
def test_blocks_are_the_means_of_their_valid_pixels(
    seed: int, place: tuple[float, float, float], half: int
) -> None:
    image = scene(seed)
    circle, cut = np.array(place), room_to_cut(HEIGHT, WIDTH)
    average(own_depth(image, 1, circle, 1.45, cut.own), circle, half, cut)
    blocks = cut.blocks.reshape(-1, K)
    for cell, (x, y) in enumerate(CELLS):
        u0, v0 = np.floor(circle[:2] + circle[2] * np.array([x, y]) + 0.5).astype(int)
        seen = [
            (u, v, pixel(image, u, v))
            for v in range(v0 - half, v0 + half + 1)
            for u in range(u0 - half, u0 + half + 1)
        ]
        valid = np.array([p for p in seen if p[2] > 0]).reshape(-1, 3)
        assert blocks[COUNT, cell] == len(valid)
        if len(valid):
            found = blocks[[U, V, DEPTH], cell]
            assert found == pytest.approx(valid.mean(axis=0), rel=1e-6, abs=1e-5)
            assert blocks[SPREAD, cell] == pytest.approx(valid[:, 2].var(), abs=1e-6)


def followed(
    image: Image, circle: np.ndarray, j: int, gate: tuple[float, float, float, float]
) -> int:
    """The last step of a cap in a direction, -1 where its edge is not to be trusted."""
    best, edge, total, follows, last = 0.0, -1, 0.0, "", np.inf
    low, high, fall, noise = gate
    beyond = pixel(image, *np.floor(circle[:2] + circle[2] * OUTER * COMPASS[j] + 0.5).astype(int))
    close = 0 < beyond < high + noise
    for k in range(RADII):
        far = circle[2] * (INNER + k * STEP)
        u, v = np.floor(circle[:2] + far * COMPASS[j] + 0.5).astype(int)
        z = pixel(image, u, v)
        if close and k <= edge + 4 and z > last + max(fall * np.sqrt(k - edge), noise):
            high = min(high, (last + z) / 2)
        if z == 0:
            total -= 0.15
        elif z < low:
            total -= 0.5
            follows = follows or "nearer"
        elif z > high:
            total -= 1
            if not follows and k <= edge + 4:
                follows = "deeper"
        else:
            total += 1
            if total > best:
                best, edge, follows, last = total, k, "", z
        if edge >= 0 and total < best - 4:
            break
    return edge if follows == "deeper" else -1


@settings(deadline=None)
@given(
    seed=st.integers(0, 99),
    place=PLACES,
    low=st.floats(0.41, 0.45),
    high=st.floats(0.5, 0.59),
    fall=st.sampled_from([0.02, 0.05, 1.0]),
)
def test_edges_are_those_that_single_steps_find(
    seed: int, place: tuple[float, float, float], low: float, high: float, fall: float
) -> None:
    image = scene(seed)
    # places between pixels: single precision does not decide which
    circle = np.round(np.array(place), 1) + 0.037
    own = np.empty(image.depth.size, np.float32)
    window = own_depth(image, 1, circle, 1.45, own)
    state, pixels = np.empty(9 * DIRECTIONS, np.float32), np.empty(DIRECTIONS, np.int32)
    gate = (low, high, fall, 0.06)
    follow(window, own, circle, gate, state, pixels)
    rows = state.reshape(9, DIRECTIONS)
    found = np.where(rows[4] > 0, rows[3], -1)
    expected = [followed(image, circle, j, gate) for j in range(DIRECTIONS)]
    # at a distance that is half a pixel but for rounding either pixel is right
    assert (found != expected).mean() <= 1 / DIRECTIONS


def test_a_circle_beyond_the_image_has_no_depth() -> None:
    image = scene(0)
    circle, cut = np.array([-500.0, 900.0, 20.0]), room_to_cut(HEIGHT, WIDTH)
    window = own_depth(image, 1, circle, 1.45, cut.own)
    average(window, circle, 1, cut)
    assert window.width * window.height == 0
    assert not cut.blocks[:K].any()


@settings(deadline=None)
@given(st.lists(st.floats(0.125, 5, width=32), max_size=K))
def test_the_median_is_that_of_numpy(values: list[float]) -> None:
    room = np.array(values, np.float32)
    expected = np.median(room) if values else 0.0
    assert median(room, len(room)) == pytest.approx(expected, rel=1e-6)


def sampled(depth: np.ndarray, circle: np.ndarray, sensor: Sensor) -> tuple[np.ndarray, int, float]:
    """The rays (6, n) of the points in a circle, how many are of other depth, and their depth."""
    image, cut = image_of(depth), room_to_cut(*depth.shape)
    out = np.full((6, len(CELLS)), np.nan, np.float32)
    window = own_depth(image, 0, circle, 1.45, cut.own)
    n, other, middle = sample_depth(window, cut, image, circle, sensor, out)
    normalise(out, n)
    return out[:, :n].astype(float), other, middle


def test_points_lie_where_their_pixels_are_and_are_as_sure_as_the_sensor_says() -> None:
    """A plane that slopes: the mean of a block is the depth of its middle."""
    v, u = np.mgrid[: CAMERA.height, : CAMERA.width]
    depth = 0.4 + 1e-4 * (u - 200) - 5e-5 * (v - 80)
    circle, sensor = np.array([230.3, 60.6, 30.0]), Sensor(0.0003, 0.0012, 0.005, 0.0)
    rays, other, middle = sampled(depth, circle, sensor)
    assert rays.shape[1] == len(CELLS)
    assert other == 0
    pixels = np.floor(circle[:2] + circle[2] * CELLS + 0.5).astype(int)
    z = depth[pixels[:, 1], pixels[:, 0]]
    points = CAMERA.deproject(pixels.astype(float), z - sensor.bias)
    assert pytest.approx(points, abs=1e-7) == (rays[:3] * rays[3]).T
    assert np.linalg.norm(rays[:3], axis=0) == pytest.approx(1)
    assert middle == pytest.approx(np.median(z), abs=5e-4)
    # of 5 by 5 pixels, whose noise is in part common to all; along the ray it is longer
    sigma = (sensor.noise + sensor.growth * z) * (0.3 + 0.7 / 5) / rays[2]
    assert rays[4] == pytest.approx(sigma, rel=1e-4)
    assert rays[5] == pytest.approx(POINT_SHARE)


@pytest.mark.parametrize("place", [(100.3, 50.6), (7.0, 239.4), (-20.3, 251.7), (331.2, -8.4)])
def test_the_ray_of_any_place_is_the_cameras(place: tuple[float, float]) -> None:
    ray = CAMERA.deproject(np.array([place]), np.ones(1))[0]
    found = ray_at(image_of(np.full((CAMERA.height, CAMERA.width), 0.4)), *place)
    assert found == pytest.approx(ray / np.linalg.norm(ray), abs=1e-7)


@pytest.mark.parametrize("elsewhere", [0.6, 0.2])
def test_what_lies_elsewhere_in_a_circle_is_counted_and_left_out(elsewhere: float) -> None:
    """In the middle the cap, around it more of something else; and what is hardly seen."""
    depth = np.full((CAMERA.height, CAMERA.width), 0.4)
    circle, half = np.array([160.0, 120.0, 33.0]), 3
    v, u = np.mgrid[: CAMERA.height, : CAMERA.width]
    around = np.hypot(u - 160, v - 120) > 0.62 * 33
    depth[around] = elsewhere
    sparse = (u < 155) & (u % 4 > 0)
    depth[sparse] = np.nan
    rays, other, middle = sampled(depth, circle, Sensor(0.0003, 0.0012, 0.0, 0.0))
    inside = outside = 0
    for x, y in np.floor(circle[:2] + 33 * CELLS + 0.5).astype(int):
        block = np.s_[y - half : y + half + 1, x - half : x + half + 1]
        if (~sparse[block]).mean() > 0.4:
            seen = around[block][~sparse[block]]
            inside, outside = inside + (not seen.any()), outside + seen.all()
    assert middle == pytest.approx(0.4)
    assert rays[3] * rays[2] == pytest.approx(0.4)
    assert (rays.shape[1], other) == (inside, outside)
    assert outside > inside > 10


def test_in_a_small_circle_each_pixel_counts_once() -> None:
    depth = np.full((CAMERA.height, CAMERA.width), 0.4)
    circle = np.array([160.2, 120.3, 3.0])
    rays, _, _ = sampled(depth, circle, Sensor(0.0003, 0.0012, 0.0, 0.0))
    pixels = {tuple(place) for place in np.floor(circle[:2] + 3.0 * CELLS + 0.5)}
    assert rays.shape[1] == len(pixels) < len(CELLS)
