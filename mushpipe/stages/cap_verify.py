"""Whether a fitted circle is a cap: a logistic regression over what the fit found.

A detector decides before anything is fitted. How well a spheroid fits, how surely it leans as it
does, whether its form is a cap's and its place the circle's says more: stones, stems, paper and
parts of caps seldom fit. The weights stand in `fitted.yaml`; `training/fitted.py` makes them.
"""

from __future__ import annotations

from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from mushpipe import Circles
from mushpipe.stages.cap_batch import Fits
from mushpipe.stages.verifier import package_file, probability, read_models

Floats = NDArray[np.float64]
MODEL = "fitted"
FILE = f"{MODEL}.yaml"
ROUND = 0.6  # height over radius; a rounder cap is no more, and no less, likely one
# Flatter than any cap in the training scenes: lids, cups upside down, paper and cut stumps. It is a
# rule because a regression over standardised features gives rare ones little weight.
FLAT = 0.15  # height over radius
FLAT_CHANCE = 0.01  # of 127 that flat in the training scenes none was a cap
NAMES = ("score", "misfit", "tilt", "aspect", "moved", "resized", "lean")


def features(circles: Circles, fits: Fits) -> Floats:
    """Return the features (N, F) in the order of `NAMES`; NaN where nothing was fitted.

    Logit of the score; log of the misfit over the median in view, since what fits how well depends
    on the sensor; log of the sigma of the tilt, rad; height over radius, up to `ROUND`; how far the
    fit moves the circle, in its radii; log of how much larger or smaller it makes it; how far the
    axis leans off the upright, rad.
    """
    score = np.clip(circles.score, 1e-4, 1 - 1e-4)
    usual = max(np.median(fits.misfit[fits.valid]), 1e-6) if fits.valid.any() else 1.0
    table = np.column_stack(
        [
            np.log(score / (1 - score)),
            np.log(np.clip(fits.misfit / usual, 0.1, 10)),
            np.log(np.clip(fits.sigma_tilt, 0.02, 3)),
            np.clip(fits.height / fits.radius, 0.2, ROUND),
            np.linalg.norm(fits.circle[:, :2] - circles.center, axis=1) / circles.radius,
            np.abs(np.log(fits.circle[:, 2] / circles.radius)),
            fits.lean,
        ]
    )
    table[~fits.valid] = np.nan
    return table


def flat(fits: Fits) -> NDArray[np.bool_]:
    """Return which fits (N,) are flatter than a cap; False where nothing was fitted."""
    return np.asarray(fits.valid & (fits.height < FLAT * fits.radius))


def chances(circles: Circles, fits: Fits) -> Floats:
    """Return the probability (N,) of each circle to be a cap; its score where nothing was fitted.

    One whose fit is flat has `FLAT_CHANCE` at most.

    Args:
        circles: As detected, with the scores of `phase-hough`.
        fits: Of these circles.
    """
    chance = probability(features(circles, fits), _weights())
    chance = np.where(flat(fits), np.minimum(chance, FLAT_CHANCE), chance)
    return np.where(fits.valid, chance, circles.score)


@lru_cache(maxsize=1)
def _weights() -> Floats:
    return read_models(package_file(FILE), [MODEL], NAMES)[MODEL]
