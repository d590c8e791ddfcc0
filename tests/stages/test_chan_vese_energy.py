from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from mushpipe.stages.chan_vese_energy import chan_vese_energy, contour_length, region_means
from tests.stages.oracle import naive_energy

UNIT = st.floats(0, 1, width=32)


@given(
    arrays(np.float32, (6, 7), elements=UNIT),
    arrays(np.bool_, (6, 7)),
    st.floats(0.01, 1),
)
def test_energy_is_that_of_a_naive_loop(image: np.ndarray, region: np.ndarray, mu: float) -> None:
    expected = naive_energy(image, region, mu)
    assert chan_vese_energy(image, region, mu) == pytest.approx(expected, rel=1e-5, abs=1e-7)


@given(arrays(np.float32, (5, 4, 3), elements=UNIT), arrays(np.bool_, (5, 4)))
def test_energy_of_channels_is_averaged(image: np.ndarray, region: np.ndarray) -> None:
    expected = naive_energy(image, region, 0.1)
    assert chan_vese_energy(image, region, 0.1) == pytest.approx(expected, rel=1e-5, abs=1e-7)


@pytest.mark.parametrize("radius", [10.0, 25.3, 60.0])
def test_length_of_a_disc_is_its_circumference(radius: float) -> None:
    v, u = np.mgrid[:140, :140]
    disc = (u - 69.7) ** 2 + (v - 70.2) ** 2 < radius**2
    # Four directions approximate the integral over all; the formula is exact to 5 % (Boykov 2003).
    assert contour_length(disc) == pytest.approx(2 * math.pi * radius, rel=0.05)


def test_energy_of_a_disc_has_a_closed_form() -> None:
    v, u = np.mgrid[:100, :100]
    disc = (u - 50) ** 2 + (v - 50) ** 2 < 30**2
    image = np.where(disc, 0.9, 0.1).astype(np.float32)
    # Nothing is left of the fit, so the energy is the length alone.
    expected = 0.2 * 2 * math.pi * 30 / 100**2
    assert chan_vese_energy(image, disc, 0.2) == pytest.approx(expected, rel=0.05)
    # Without a contour the fit is the variance of the image.
    nothing = np.zeros_like(disc)
    assert chan_vese_energy(image, nothing, 0.2) == pytest.approx(image.var(), rel=1e-5)


def test_means_of_an_empty_side_are_zero() -> None:
    image = np.full((3, 4), 0.5, np.float32)
    inside, outside = region_means(image, np.zeros((3, 4), bool))
    assert (inside[0], outside[0]) == (0.0, 0.5)
    inside, outside = region_means(image, np.ones((3, 4), bool))
    assert (inside[0], outside[0]) == (0.5, 0.0)
