"""What the verifier of `phase-hough` is taught beside a network."""

from __future__ import annotations

import numpy as np

from mushpipe import Circles
from training.verifier import NET, doubtful


def test_a_doubtful_network_finds_fewer_circles_with_lower_scores_and_no_others() -> None:
    rng = np.random.default_rng(0)
    center, radius = rng.uniform(0, 400, (300, 2)), rng.uniform(8, 40, 300)
    circles = Circles(center, radius, rng.uniform(NET.min_score, 1, 300))
    told = {tuple(place): score for place, score in zip(center, circles.score, strict=True)}
    less = doubtful(circles, rng)
    assert 0 < len(less) < 300
    assert less.score.min() >= NET.min_score
    before = np.array([told[tuple(place)] for place in less.center])
    assert less.score.mean() < before.mean() - 0.05
