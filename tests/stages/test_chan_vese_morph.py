from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from skimage.segmentation import morphological_chan_vese

from mushpipe.stages.chan_vese_energy import chan_vese_energy
from mushpipe.stages.chan_vese_morph import (
    attachment_step,
    change_of_region,
    curvature_step,
    pack,
    solve_morphological,
    unpack,
)
from tests.stages.oracle import inf_sup, morphological, sup_inf
from tests.stages.test_chan_vese_fast import drawn

WIDTHS = st.sampled_from([1, 2, 3, 5, 17, 31, 62, 63, 64, 65, 66, 67, 127, 128, 129, 131])
MASKS = st.tuples(st.integers(1, 9), WIDTHS).flatmap(lambda shape: arrays(np.bool_, shape))


def tail(width: int) -> np.uint64:
    return np.uint64(2 ** ((width - 1) % 64 + 1) - 1)


@given(MASKS)
def test_unpack_undoes_pack_and_spare_bits_are_clear(mask: np.ndarray) -> None:
    words = pack(mask)
    assert words.shape == (mask.shape[0], -(-mask.shape[1] // 64))
    assert (unpack(words, mask.shape[1]) == mask).all()
    assert int(np.bitwise_count(words).sum()) == mask.sum()


@given(MASKS)
def test_curvature_operators_are_those_of_scipy(mask: np.ndarray) -> None:
    words = pack(mask)
    out = np.empty_like(words)
    for sup_first, reference in ((False, sup_inf), (True, inf_sup)):
        curvature_step(words, out, tail(mask.shape[1]), sup_first)
        assert (unpack(out, mask.shape[1]) == reference(mask)).all()
        assert int(np.bitwise_count(out).sum()) == reference(mask).sum()


@given(MASKS.filter(lambda m: min(m.shape) > 1), st.integers(0, 2**32 - 1))
def test_attachment_moves_where_the_gradient_is_not_zero(mask: np.ndarray, seed: int) -> None:
    inside = np.random.default_rng(seed).random(mask.shape) > 0.5
    words, width = pack(mask), mask.shape[1]
    out = np.empty_like(words)
    attachment_step(words, pack(inside), out, width)
    band = np.any([np.gradient(mask.astype(float), axis=k) != 0 for k in (0, 1)], axis=0)
    assert (unpack(out, width) == np.where(band, inside, mask)).all()


@given(MASKS, st.integers(0, 2**32 - 1))
def test_growth_of_a_region_is_counted(old: np.ndarray, seed: int) -> None:
    rng = np.random.default_rng(seed)
    image, new = rng.random(old.shape, np.float32), rng.random(old.shape) > 0.5
    count, total = change_of_region(image, pack(old), pack(new))
    assert count == int(new.sum()) - int(old.sum())
    assert total == pytest.approx(float(image[new].sum()) - float(image[old].sum()), abs=1e-3)


@settings(max_examples=40)
@given(
    st.sampled_from([5, 33, 63, 64, 65, 127, 128, 129]),
    st.integers(2, 30),
    st.integers(0, 10_000),
    st.integers(0, 3),
    st.integers(1, 12),
)
def test_solver_is_the_reference_pixel_for_pixel(
    width: int, height: int, seed: int, smoothing: int, iterations: int
) -> None:
    rng = np.random.default_rng(seed)
    image = (rng.integers(0, 256, (height, width)) / 255).astype(np.float32)
    initial = rng.random((height, width)) > 0.6
    found = solve_morphological(image, initial, iterations, smoothing)
    assert (found == morphological(image, initial, iterations, smoothing)).all()


def test_solver_is_that_of_scikit_image_in_what_it_finds() -> None:
    image = drawn(4, 0.1)
    initial = image > 0.5
    found = solve_morphological(image, initial, 35, 1)
    theirs = morphological_chan_vese(image, 35, init_level_set=initial, smoothing=1) > 0
    # scikit-image weighs the two sides the same way; only its gradient's rounding differs.
    assert np.mean(found != theirs) < 0.01
    energies = [chan_vese_energy(image, region, 0.1) for region in (found, theirs)]
    assert energies[0] == pytest.approx(energies[1], rel=0.02)


def test_a_region_at_rest_stops_early() -> None:
    image = drawn(5, 0.05)
    short, long = (solve_morphological(image, image > 0.5, n, 1) for n in (1000, 1001))
    # Even where the region swings between two states, the result is one of them.
    assert np.mean(short != long) < 0.01


def test_dark_inside_stays_inside() -> None:
    image = drawn(6, 0.05)
    bright = solve_morphological(image, image > 0.5, 20, 1)
    dark = solve_morphological(1 - image, image > 0.5, 20, 1)
    assert np.mean(bright != dark) < 0.001


@pytest.mark.parametrize("fill", [False, True])
def test_a_region_with_one_side_is_left_as_it_is(fill: bool) -> None:
    initial = np.full((20, 70), fill)
    assert (solve_morphological(drawn(0, 0.1)[:20, :70], initial, 5, 1) == initial).all()
