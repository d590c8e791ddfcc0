"""Make the verifier of `cap-fit` from simulated scenes: `python -m training.fitted`.

Circles of `phase-hough`, alone and beside `cap-net`, down to a low score, are fitted, in depth as
it was simulated and in worse, and labelled by the simulator's truth; so are those of the image
alone, without a fit. Where few caps are in view, stumps, stones and cups are as many: a model of
its own learns from such frames.
"""

from __future__ import annotations

import argparse
from collections.abc import Iterable, Iterator
from dataclasses import replace
from itertools import chain
from pathlib import Path

import numpy as np

from mushpipe import Circles, RgbdFrame
from mushpipe.core.arrays import Bools, Floats
from mushpipe.core.truth import Ignore, Truth
from mushpipe.evaluate.matching import circle_iou
from mushpipe.stages.cap_fit import CapFit
from mushpipe.stages.cap_kin import kin_of, unlike
from mushpipe.stages.cap_verify import BESIDE, FEW, FILE, FIT, MODELS, NAMES, features, flat
from mushpipe.stages.phase_hough import PhaseHough
from mushpipe.stages.phase_learned import seen_by
from mushpipe.stages.verifier import LIMIT
from training.harder import harder
from training.logistic import fit, write
from training.matching import counted, matched
from training.net.scenes import VERIFIER_SEED, varied_cases
from training.scenes import Case, few_cases, more_cases, training_cases
from training.verifier import NET, RADII, VARIED, segmentations

LEAST = 0.1  # score
NEUTRAL = 0.3  # IoU with a mushroom that need not be found, from which on a circle teaches nothing
SETTINGS = [
    {"use_learned": net, "use_depth": deep} for deep in (True, False) for net in (False, True)
]
OF_FEW = (FEW, FEW + BESIDE)
SQUARED = ("misfit", "tilt", "aspect", "lean")  # for these
# What they are asked about are caps by so much; a share of half, as in their training, loses caps
# that a stereo camera shows badly, and 0.91, as in all scenes, keeps cups.
SHARE = 0.85
KNOWN = (FIT[0], "unlike", "learned")  # in some samples, and not in others
STAGES = [PhaseHough(radius_px=RADII, min_score=LEAST, **each) for each in SETTINGS]
HEAD = """\
# The verifier of the stage `cap-fit`: logistic regressions over what the fit found, over how like
# other caps a circle looks and, in those called `_learned`, over what a network sees there; made by
# `make verifier` from simulated scenes alone. A feature x (docs/detection.md says what each is)
# adds  weight z + square z^2  to the logit, with z = (x - mean) / scale, clipped to -4..4.
"""


def detected(frame: RgbdFrame) -> Iterator[tuple[Circles, bool, Circles | None]]:
    """Yield the circles of the detector, whether it had depth, and those of the network, if any."""
    alone, bare = segmentations(frame)[0], replace(frame, depth=None)
    beside = {deep: (seen, *NET.process(seen)) for deep, seen in ((True, frame), (False, bare))}
    for stage in STAGES:
        ready = beside[stage.use_depth] if stage.use_learned else (*alone, None)
        yield stage.process(*ready), stage.use_depth, ready[2]


def labels(circles: Circles, truth: Truth, stumps: bool = False) -> Floats:
    """Return 1 for circles (N,) that are a cap's, 0 for others, NaN for those that do not count.

    With `stumps`, those of cut stumps are others; else they do not count.
    """
    counts = counted(truth, *RADII)
    iou = circle_iou(circles.center, circles.radius, truth.center, truth.radius)
    right = np.isin(np.arange(len(circles)), matched(iou, counts)[0])
    excused = ~counts & ~(stumps & (truth.ignore == Ignore.CUT_STUMP))
    neutral = ~right & (iou[:, excused] >= NEUTRAL).any(axis=1)
    return np.where(neutral, np.nan, right.astype(np.float64))


def samples(cases: Iterable[Case], stumps: bool = False) -> tuple[Floats, Floats]:
    """Return features (N, F) and labels (N,) of all circles that a model decides about."""
    stage, rng = CapFit(), np.random.default_rng(7)
    rows, right = [], []
    for case in cases:
        for frame in (case.frame, harder(case, rng).frame):
            if frame.camera is None or frame.depth is None:
                continue
            for circles, deep, learned in detected(frame):
                fits = stage.fit(frame.gray, frame.depth_m, frame.camera, circles) if deep else None
                use = np.isfinite(label := labels(circles, case.truth, stumps))
                other = unlike(kin_of(frame.color, circles))
                seen = None if learned is None else seen_by(learned, circles)
                if fits is not None:
                    use &= fits.valid & ~flat(fits, circles.score, other, seen)
                rows.append(features(circles, other, fits, seen)[use])
                right.append(label[use])
    return np.concatenate(rows), np.concatenate(right)


def teaches(rows: Floats, model: str) -> Bools:
    """Return which rows (N, F) teach a model: those of which it is asked.

    What is fitted is for the models of fits, all else for those without; and what was found beside
    the network for those beside it.
    """
    names = MODELS[model]
    fitted, alike, beside = np.isfinite(rows[:, [NAMES.index(name) for name in KNOWN]]).T
    use = (fitted == (FIT[0] in names)) & (beside == ("learned" in names))
    if model in OF_FEW:
        return np.asarray(use & ~alike)
    return np.asarray(use & np.isfinite(rows[:, [NAMES.index(name) for name in names]]).all(axis=1))


def main() -> None:
    """Read the command line."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--cache", type=Path, default=Path("out/scenes"), help="rendered frames")
    parser.add_argument("--out", type=Path, default=Path(f"mushpipe/stages/{FILE}"))
    parser.add_argument("--ridge", type=float, default=1e-3)
    arguments = parser.parse_args()
    cache = arguments.cache
    varied = varied_cases(cache, VERIFIER_SEED, "a", VARIED)
    usual = samples(chain(training_cases(cache), more_cases(cache), varied))
    few = samples(few_cases(cache), stumps=True)
    all_of_them = tuple(map(np.concatenate, zip(usual, few, strict=True)))
    models = {}
    for model, names in MODELS.items():
        chosen = (all_of_them, SQUARED, SHARE) if model in OF_FEW else (usual, (), None)
        taught, squared, share = chosen
        rows, right = (part[teaches(taught[0], model)] for part in taught)
        table = rows[:, [NAMES.index(name) for name in names]]
        models[model] = fit(table, right, names, arguments.ridge, LIMIT, squared, share)
        print(f"{model}: {len(table)} circles, {right.mean():.2f} right")
    write(models, arguments.out, HEAD)


if __name__ == "__main__":
    main()
