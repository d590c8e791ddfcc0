"""What the caps of a scene say of each other, against exact inference, and what it is worth."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from mushpipe import Camera
from mushpipe.stages.cap.habit import HELD, NARROWEST, SCENES, spread_of, usual_aspect
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


def spreads(true: np.ndarray, sigma: float, prior: float) -> np.ndarray:
    """What tilts (N, 2) say that were measured so well and fitted with a prior; NaN: none is."""
    measured = true + np.random.default_rng(1).normal(0, sigma, true.shape)
    variance = 1 / (1 / sigma**2 + 1 / prior**2)
    fitted = measured * variance / sigma**2
    squares = np.where(np.isnan(true[:, 0]), -1.0, (fitted**2).sum(axis=1))
    out = np.empty(len(true))
    spread_of(squares, np.full(len(true), variance), prior, out)
    return out


@pytest.mark.parametrize("spread", [0.08, 0.2])
@pytest.mark.parametrize("sigma", [0.005, 0.05])
@pytest.mark.parametrize("prior", [0.15, 0.4])
def test_the_spread_of_tilts_is_the_one_they_were_drawn_with(
    spread: float, sigma: float, prior: float
) -> None:
    """Student's t of 4 degrees of freedom; a cap without a fit gets the spread itself."""
    rng = np.random.default_rng(0)
    scale = spread / np.sqrt(rng.chisquare(4, (4000, 1)) / 4)
    true = np.vstack([rng.normal(size=(4000, 2)) * scale, np.full((4000, 2), np.nan)])
    assert spreads(true, sigma, prior)[-1] == pytest.approx(spread, rel=0.1)


def test_a_cap_that_leans_among_upright_ones_is_let_go() -> None:
    true = np.zeros((501, 2))
    true[-1] = 0.3, 0.4
    out = spreads(true, 1e-4, 0.4)
    # of t with 4 degrees of freedom: (4 + tilt^2 / spread^2) / (4 + 2) times the variance
    assert out[:-1] == pytest.approx(np.full(500, NARROWEST * np.sqrt(4 / 6)), rel=0.01)
    assert out[-1] == pytest.approx(np.sqrt((4 * NARROWEST**2 + 0.25) / 6), rel=0.01)


def test_where_all_stand_upright_the_tilt_of_one_is_better_known_than_where_all_lean() -> None:
    small, sigmas = Camera(160, 120, 200, 200, 79.5, 59.5), []
    places = [(x, y) for x in (-0.08, 0.0, 0.08) for y in (-0.04, 0.04)]
    for tilt in (0, 25):
        caps = [cap(tilt, 60 * k, (*place, 0.4), 0.02, 0.6) for k, place in enumerate(places)]
        depth, gray = draw(caps, 0.44, small)
        depth += np.random.default_rng(0).normal(0, 0.002, depth.shape)
        stage = CapFit(up="camera", edge_offset_px=0, depth_noise_mm=2, depth_noise_per_m=0)
        poses = stage.process(frame_from(depth, gray, small), circles_of(caps, small))[1]
        sigmas.append(np.median(poses.sigma_rad))
    assert sigmas[0] < 0.8 * sigmas[1]


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
