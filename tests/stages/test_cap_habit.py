"""What the caps of a scene say of each other, against exact inference, and what it is worth."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from mushpipe.stages.cap.habit import HELD, SCENES, usual_aspect
from mushpipe.stages.cap.linear import cholesky
from mushpipe.stages.cap.model import UNKNOWNS
from mushpipe.stages.cap.solve import variance_of_aspect
from mushpipe.stages.cap_fit import CapFit
from tests.stages.caps import angle, cap, circles_of, draw, frame_from

USUAL, SIGMA = 0.62, 0.2


def inferred(data: np.ndarray, variances: np.ndarray) -> float:
    """The mean of a scene's aspect given aspects (N,) that were measured, by the joint Gaussian."""
    covariance = SCENES**2 + np.diag(SIGMA**2 - SCENES**2 + variances)
    return float(USUAL + SCENES**2 * np.ones(len(data)) @ np.linalg.solve(covariance, data - USUAL))


@given(st.lists(st.tuples(st.floats(0.1, 1.2), st.floats(1e-4, 0.5)), min_size=1, max_size=30))
def test_the_usual_aspect_is_that_of_exact_inference(caps: list[tuple[float, float]]) -> None:
    data, variances = np.array(caps).T
    own = 1 / (1 / variances + 1 / SIGMA**2)  # what a fit with the prior knows,
    fitted = own * (data / variances + USUAL / SIGMA**2)  # and what it says
    assert (own < HELD * SIGMA**2).all()
    found = usual_aspect(fitted, own, USUAL, SIGMA)
    assert found == pytest.approx(inferred(data, variances), abs=1e-9)


def test_caps_without_a_fit_say_nothing() -> None:
    none = np.full(3, -1.0)
    assert usual_aspect(none, np.ones(3), USUAL, SIGMA) == USUAL
    some = np.array([0.9, -1.0, 0.8]), np.array([0.01, 1.0, 0.02])
    left = np.array([0.9, 0.8]), np.array([0.01, 0.02])
    assert usual_aspect(*some, USUAL, SIGMA) == usual_aspect(*left, USUAL, SIGMA)


def test_the_variance_of_the_aspect_is_that_of_the_inverse() -> None:
    rows = np.random.default_rng(5).normal(size=(30, UNKNOWNS))
    matrix = rows.T @ rows
    direction = np.zeros(UNKNOWNS)
    direction[5], direction[6] = -USUAL, 1.0
    expected = direction @ np.linalg.inv(matrix) @ direction
    assert cholesky(matrix)
    assert variance_of_aspect(matrix, USUAL) == pytest.approx(expected, rel=1e-9)


# high buttons and low caps, in noise that leaves much to the prior; without what the others say
# their axes are off by 5.4 and 0.9 degrees
@pytest.mark.parametrize(("aspect", "noise_mm", "degrees"), [(0.9, 1.5, 4.5), (0.3, 2.5, 0.85)])
def test_caps_unlike_the_usual_ones_are_known_among_their_like(
    aspect: float, noise_mm: float, degrees: float
) -> None:
    places = [(x, y) for x in (-0.09, -0.03, 0.03, 0.09) for y in (-0.055, 0.0, 0.055)]
    caps = [cap(20, 30 * k, (*place, 0.4), 0.018, aspect) for k, place in enumerate(places)]
    depth, gray = draw(caps, 0.44)
    stage = CapFit(up="camera", edge_offset_px=0, depth_noise_mm=noise_mm, depth_noise_per_m=0)
    off = []
    for seed in range(4):
        noise = np.random.default_rng(seed).normal(0, noise_mm / 1000, depth.shape)
        poses = stage.process(frame_from(depth + noise, gray), circles_of(caps))[1]
        off += [angle(axis, true.axis) for axis, true in zip(poses.axis, caps, strict=True)]
    assert np.mean(off) < degrees
