"""Whether a circle is a cap, by what a detector could not know when it found it.

How well a spheroid fits, how surely it leans as it does, whether its form is a cap's and its place
the circle's: stones, stems, paper and parts of caps seldom fit. And whether it looks like the caps
around it: clods do not. And, beside a network, what that sees there. The logistic regressions stand
in `fitted.yaml`; `training/fitted.py` makes them.
"""

from __future__ import annotations

from collections.abc import Mapping
from functools import lru_cache

import numpy as np

from mushpipe import Circles
from mushpipe.core.arrays import Bools, Floats
from mushpipe.stages.cap.batch import Fits
from mushpipe.stages.verifier import logistic, logit, package_file, read_models

FILE = "fitted.yaml"
ROUND = 0.6  # height over radius; a rounder cap is no more, and no less, likely one
# So flat are lids, cups upside down, paper, pictures and cut stumps. So are old caps, but they look
# like others, the detector is sure of them, and depth shows their edge. It is a rule because a
# regression over standardised features gives rare ones little weight.
FLAT = 0.15  # height over radius,
EDGED = 5  # unless it has an edge in so many of 32 directions,
ALIKE, PLAIN = 1.0, 0.6  # and is less unlike the sure caps and has a higher score,
KINDRED, SEEN = 0.35, 0.7  # or is like them, as caps of a kind are, and a network sees it plainly
FLAT_CHANCE = 0.01
LEAST_SEEN = 0.005  # logits have no end
STANDS = 2.5  # radii above the ground: what stands higher is no likelier a cap
FORM = ("misfit", "tilt", "aspect", "moved", "resized", "lean")
FIT = (*FORM, "stand")
NAMES = ("score", *FIT, "unlike", "learned")
BESIDE = "_learned"  # ends the name of a model beside a network
# Where few circles are surely caps: beside the cups and boxes of a table, and the clods of a bed.
LONE = FEW, RUBBLE = "fitted_few", "fitted_rubble"
# What is known decides which model is asked; each is over some of these features.
ALONE = {
    "fitted": ("score", *FIT),
    "fitted_kin": ("score", *FIT, "unlike"),
    FEW: ("score", *FORM),
    RUBBLE: ("score", *FIT),
    "seen_kin": ("score", "unlike"),
}
MODELS = ALONE | {name + BESIDE: (*names, "learned") for name, names in ALONE.items()}


def features(
    circles: Circles, unlike: Floats, fits: Fits | None = None, learned: Floats | None = None
) -> Floats:
    """Return the features (N, F) in the order of `NAMES`; NaN where they are not known.

    Logit of the score; log of the misfit over the median in view, since what fits how well depends
    on the sensor; log of the sigma of the tilt, rad; height over radius, up to `ROUND`; how far the
    fit moves the circle, in its radii; log of how much larger or smaller it makes it; how far the
    axis leans off the upright, rad; how far the apex stands above the ground, in radii, up to
    `STANDS`, and that where no ground is seen; how unlike the sure caps it is (`cap.kin`); logit of
    how far it is a circle of the network.
    """
    table = np.full((len(circles), len(NAMES)), np.nan)
    table[:, 0], table[:, -2] = _logit(circles.score, 1e-4), unlike
    if learned is not None:
        table[:, -1] = _logit(learned, LEAST_SEEN)
    if fits is not None and fits.valid.any():
        table[fits.valid, 1:-2] = _of_fits(circles, fits)[fits.valid]
    return table


def _logit(chance: Floats, least: float) -> Floats:
    clipped = np.clip(chance, least, 1 - least)
    return np.asarray(np.log(clipped / (1 - clipped)))


def _of_fits(circles: Circles, fits: Fits) -> Floats:
    usual = max(np.median(fits.misfit[fits.valid]), 1e-6)
    return np.column_stack(
        [
            np.log(np.clip(fits.misfit / usual, 0.1, 10)),
            np.log(np.clip(fits.sigma_tilt, 0.02, 3)),
            np.clip(fits.height / fits.radius, 0.2, ROUND),
            np.linalg.norm(fits.circle[:, :2] - circles.center, axis=1) / circles.radius,
            np.abs(np.log(fits.circle[:, 2] / circles.radius)),
            fits.lean,
            np.nan_to_num(np.clip(fits.stand / fits.radius, 0, STANDS), nan=STANDS),
        ]
    )


def flat(fits: Fits, score: Floats, unlike: Floats, learned: Floats | None = None) -> Bools:
    """Return which fits (N,) are as flat as hardly a cap, and not plainly a cap all the same.

    Args:
        fits: False where nothing was fitted.
        score: (N,) of `phase-hough`.
        unlike: (N,) as in `chances`.
        learned: (N,) as in `chances`.
    """
    low = fits.valid & (fits.height < FLAT * fits.radius)
    plain = (unlike < ALIKE) & (score > PLAIN)
    if learned is not None:
        plain |= (unlike < KINDRED) & (learned > SEEN)
    return np.asarray(low & ~(plain & (fits.edges >= EDGED)))


def lone_chances(
    circles: Circles,
    fits: Fits,
    learned: Floats | None = None,
    models: Mapping[str, Floats] | None = None,
) -> Floats:
    """Return the probability (N,) of each circle to be a cap by what is known of it alone.

    It must be one beside cups and boxes, and among clods.

    Args:
        circles: As detected, with the scores of `phase-hough`.
        fits: Of these circles.
        learned: (N,) as in `chances`.
        models: Weights, by name, in place of those of the package.
    """
    table = np.nan_to_num(features(circles, np.full(len(circles), np.nan), fits, learned))
    # Of what a network is blind to there, as many are cups and stumps: it has its full say.
    names = [name + BESIDE * (learned is not None) for name in LONE]
    said = [logit(table, (models or _models())[name]) for name in names]
    return np.where(fits.valid, logistic(np.minimum(*said)), circles.score)


def chances(
    circles: Circles,
    unlike: Floats,
    fits: Fits | None = None,
    learned: Floats | None = None,
    lone: Floats | None = None,
) -> Floats:
    """Return the probability (N,) of each circle to be a cap.

    It is what the fit tells, or the score where nothing was fitted; less where the circle looks
    unlike the sure caps. That it looks like them is no reason to believe in it: stems do, too.
    Where few are sure, other things than caps are more of what is seen, and models of their own
    decide. What was fitted as flat, and is not plainly a cap, has `FLAT_CHANCE` at most.

    Args:
        circles: As detected, with the scores of `phase-hough`.
        unlike: (N,) how unlike the sure caps they are, NaN where that is not known.
        fits: Of these circles, if there is depth.
        learned: (N,) how far each is a circle of a network (`phase.learned.agreement`), if there is
            one: it has models of its own. What it speaks for counts, and, but where few are sure,
            what it speaks against counts half: of real caps it is blind to more than of those that
            it was trained on.
        lone: (N,) from `lone_chances`, if that is known.
    """
    table = np.nan_to_num(features(circles, unlike, fits, learned))
    model = {name: _said(name, table, learned is not None) for name in ALONE if name not in LONE}
    chance, alike = circles.score, model["seen_kin"]
    if fits is not None:
        lone = lone_chances(circles, fits, learned) if lone is None else lone
        fitted = np.where(np.isfinite(unlike), model["fitted"], lone)
        chance = np.where(fits.valid, fitted, chance)
        low = flat(fits, circles.score, unlike, learned)
        chance = np.where(low, np.minimum(chance, FLAT_CHANCE), chance)
        alike = np.where(fits.valid, model["fitted_kin"], alike)
    return np.where(np.isfinite(unlike), np.minimum(chance, alike), chance)


def _said(name: str, table: Floats, beside: bool) -> Floats:
    """Return what a model says (N,) of features (N, F), or that and the one beside a network."""
    alone = logit(table, _models()[name])
    if not beside:
        return logistic(alone)
    with_it = logit(table, _models()[name + BESIDE])
    return logistic(np.maximum(with_it, (alone + with_it) / 2))


@lru_cache(maxsize=1)
def _models() -> dict[str, Floats]:
    return read_models(package_file(FILE), list(MODELS), NAMES)
