from __future__ import annotations

import cv2
import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

from benchmarks.graph_cut import graph_cut
from mushpipe.stages.chan_vese import ChanVese
from mushpipe.stages.chan_vese_energy import chan_vese_energy
from mushpipe.stages.chan_vese_fast import solve_fast
from mushpipe.stages.otsu import otsu_foreground
from tests.stages.frames import RECORDINGS, recorded, simulated
from tests.stages.scenes import discs, frame_of

MU = 0.1
SCENES = [
    {},
    {"light": "gradient", "light_strength": 0.5},
    {"cap_color": "brown", "shape_family": "b"},
    {"count": 60, "cluster": 1.0},
]


def drawn(seed: int, noise: float) -> np.ndarray:
    rng = np.random.default_rng(seed)
    circles = [(*rng.uniform((0, 0), (160, 120)), rng.uniform(5, 20)) for _ in range(8)]
    clean = discs(circles, 0.7, 0.3)
    return np.clip(clean + rng.normal(0, noise, clean.shape), 0, 1).astype(np.float32)


def ratio(image: np.ndarray, region: np.ndarray) -> float:
    """Energy over the exact minimum."""
    exact = graph_cut(image, otsu_foreground(image), MU)
    return chan_vese_energy(image, region, MU) / chan_vese_energy(image, exact, MU)


def fast(image: np.ndarray) -> np.ndarray:
    return solve_fast(image, otsu_foreground(image), MU)


def test_the_reference_is_a_minimum() -> None:
    image = drawn(0, 0.2)
    exact = graph_cut(image, otsu_foreground(image), MU)
    rng = np.random.default_rng(0)
    lowest = chan_vese_energy(image, exact, MU)
    for y, x in zip(rng.integers(0, 120, 200), rng.integers(0, 160, 200), strict=True):
        other = exact.copy()
        other[y, x] ^= True
        assert chan_vese_energy(image, other, MU) > lowest - 1e-9


@pytest.mark.parametrize("noise", [0.0, 0.05, 0.15])
def test_fast_reaches_the_minimum_on_discs(noise: float) -> None:
    ratios = [ratio(image, fast(image)) for image in (drawn(seed, noise) for seed in range(4))]
    assert min(ratios) > 1 - 1e-4
    assert np.mean(ratios) <= 1.005


def test_fast_reaches_the_minimum_on_simulated_beds() -> None:
    images = [simulated(200 + i, **scene).gray for i, scene in enumerate(SCENES)]
    assert np.mean([ratio(image, fast(image)) for image in images]) <= 1.005


def real_images() -> list[np.ndarray]:
    """The recorded frames at 640 x 480 px: mu counts pixels, so size matters."""
    images = [frame.gray for name in RECORDINGS for frame in recorded(name)]
    return [cv2.resize(image, (640, 480), interpolation=cv2.INTER_AREA) for image in images]


def test_fast_reaches_the_minimum_on_real_frames() -> None:
    ratios = [ratio(image, fast(image)) for image in real_images()]
    assert np.mean(ratios) <= 1.005
    # Wood grain is next to one level: hardly any contour pays, and local minima abound.
    assert max(ratios) <= 1.02


def pde_is_not_lower(images: list[np.ndarray]) -> None:
    """Fast against scikit-image's level set after 500 iterations from the same start."""
    energies = []
    for image in images:
        initial = otsu_foreground(image)
        mu = MU / float(np.ptp(image)) ** 2  # scikit-image stretches the image to 0..1
        pde = ChanVese(solver="pde", iterations=500, tolerance=1e-9, mu=mu)
        found = [solve_fast(image, initial, MU), pde.solve(image, initial)]
        energies.append([chan_vese_energy(image, region, MU) for region in found])
    ours, reference = np.array(energies).T
    assert np.mean(ours / reference) <= 1


def test_fast_is_not_above_the_level_set_on_simulated_beds() -> None:
    pde_is_not_lower([drawn(9, 0.1), *(simulated(s).gray[60:180, 80:240] for s in (200, 210))])


def test_fast_is_not_above_the_level_set_on_real_frames() -> None:
    pde_is_not_lower([image[180:300, 240:400] for image in real_images()])


def test_the_weight_of_the_level_set_is_on_the_stretched_image() -> None:
    bright = np.rint(drawn(9, 0.1) * 255)
    dim = np.rint(bright / 2) * 2  # the same levels in both
    solved = [
        ChanVese(solver="pde", iterations=30).solve(image, otsu_foreground(dim / 255))
        for image in ((dim / 255).astype(np.float32), (dim / 510 + 0.2).astype(np.float32))
    ]
    np.testing.assert_array_equal(*solved)


def test_chan_vese_lowers_the_energy_of_its_start() -> None:
    frame = frame_of(drawn(1, 0.15))
    mask = ChanVese(mu=0.2, check=False).process(frame)
    assert mask.initial is not None
    start, end = (chan_vese_energy(frame.gray, u, 0.2) for u in (mask.initial, mask.foreground))
    assert end < 0.9 * start


def test_three_equal_channels_give_the_gray_result() -> None:
    image = drawn(3, 0.1)
    initial = otsu_foreground(image)
    rgb = solve_fast(np.repeat(image[..., None], 3, axis=2), initial, MU)
    # The channels are summed in another order; a pixel on the very border may fall either way.
    assert np.count_nonzero(rgb != solve_fast(image, initial, MU)) <= 3


def test_colour_separates_what_gray_cannot() -> None:
    frame = frame_of(np.full((120, 160), 0.5))
    color = frame.color.copy()
    truth = discs([(80.0, 60.0, 30.0)], 1, 0) > 0.5
    color[truth] = (180, 110, 110)
    color[~truth] = (110, 138, 180)
    found = solve_fast((color / 255).astype(np.float32), truth[::-1, ::-1].copy(), MU)
    assert np.count_nonzero(found != truth) <= 4


@pytest.mark.parametrize("radius", [4, 6, 8, 9, 10, 12, 14])
def test_a_small_cap_alone_in_view_is_not_lost(radius: int) -> None:
    """At the coarsest levels of the pyramid it is no pixel any more."""
    rng = np.random.default_rng(radius)
    v, u = np.mgrid[:480, :640]
    for x, y in rng.uniform([40, 40], [600, 440], (10, 2)):
        cap = np.hypot(u - x, v - y) <= radius
        gray = np.clip(0.2 + 0.6 * cap + rng.normal(0, 0.016, cap.shape), 0, 1)
        mask = ChanVese(check=False).process(frame_of(gray, camera=None)).foreground
        assert np.count_nonzero(mask ^ cap) <= 0.1 * np.count_nonzero(cap)


@given(
    caps=st.lists(
        st.tuples(st.floats(0, 160), st.floats(0, 120), st.floats(3, 15)), min_size=1, max_size=12
    ),
    contrast=st.floats(0.2, 0.8),
    mu=st.sampled_from([0.005, 0.02, 0.1]),
)
@example(caps=[(0.0, 1.0, 7.0)], contrast=0.21875, mu=0.02)  # the pyramid ends beside the minimum
@settings(max_examples=60, deadline=None)
def test_no_mask_of_discs_costs_more_than_the_start(
    caps: list[tuple[float, float, float]], contrast: float, mu: float
) -> None:
    image = discs(caps, 0.1 + contrast, 0.1).astype(np.float32)
    start = otsu_foreground(image)
    limit = chan_vese_energy(image, start, mu)
    assert chan_vese_energy(image, solve_fast(image, start, mu), mu) <= (1 + 1e-5) * limit


def test_known_levels_are_kept() -> None:
    image = np.full((64, 64), 0.3, np.float32)
    image[20:40, 20:40] = 0.4
    # Between 1 and 0 all of it is nearer to 0.
    assert not solve_fast(image, image > 0.35, 0.01, levels=(1.0, 0.0)).any()
    assert solve_fast(image, image > 0.35, 0.01)[22:38, 22:38].all()


@pytest.mark.parametrize("fill", [False, True])
def test_a_region_with_one_side_is_left_as_it_is(fill: bool) -> None:
    initial = np.full((40, 50), fill)
    assert (solve_fast(drawn(0, 0.1)[:40, :50], initial, MU) == initial).all()
