"""Make the verifier of `cap-fit` from simulated scenes: `python -m training.fitted`.

Circles of `phase-hough`, alone and beside `cap-net`, down to a low score, are fitted, in depth as
it was simulated and in worse, and labelled by the simulator's truth; so are those of the image
alone, without a fit. Where few caps are in view, stumps, stones and cups are as many: models of
their own learn from such frames.
"""

from __future__ import annotations

import argparse
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import replace
from itertools import chain
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import yaml

from mushpipe import Circles, RgbdFrame
from mushpipe.core.arrays import Bools, Floats
from mushpipe.core.truth import Ignore, Truth
from mushpipe.evaluate.matching import circle_iou
from mushpipe.stages.cap.batch import Fits
from mushpipe.stages.cap.kin import Kin, sure_of, tones_of, unlike
from mushpipe.stages.cap.verify import (
    ALONE,
    BESIDE,
    FEW,
    FILE,
    FIT,
    LONE,
    MODELS,
    NAMES,
    RUBBLE,
    features,
    flat,
    lone_chances,
)
from mushpipe.stages.cap_fit import CapFit
from mushpipe.stages.phase.learned import seen_by
from mushpipe.stages.phase_hough import PhaseHough
from mushpipe.stages.verifier import LIMIT, weights_of
from training.harder import harder
from training.logistic import fit, write
from training.matching import counted, matched
from training.net.scenes import SPARSE_SEED, VERIFIER_SEED, sparse_cases, varied_cases
from training.scenes import Case, few_cases, more_cases, training_cases
from training.verifier import NET, RADII, VARIED, segmentations

LEAST = 0.1  # score
NEUTRAL = 0.3  # IoU with a mushroom that need not be found, from which on a circle teaches nothing
SETTINGS = [
    {"use_learned": net, "use_depth": deep} for deep in (True, False) for net in (False, True)
]
SQUARED = ("misfit", "tilt", "aspect", "lean")
# So much of what a lone circle's models are asked is a cap; in their training it is less, which
# would lose caps that a stereo camera shows badly. Both of them must take it for one.
SHARE = {FEW: 0.9, RUBBLE: 0.6}
SPARSE = 160  # frames
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


class Found(NamedTuple):
    """Circles of one frame that the models decide about.

    Attributes:
        circles: As detected.
        tones: (N, 3) as by `tones_of`.
        fits: Of these circles, if the detector had depth.
        seen: (N,) how far each is a circle of the network, if there was one.
        label: (N,) as by `labels`.
    """

    circles: Circles
    tones: Floats
    fits: Fits | None
    seen: Floats | None
    label: Floats


def found(cases: Iterable[Case], stumps: bool = False) -> Iterator[Found]:
    """Yield what is found in the frames of cases, as they are and harder to see."""
    stage, rng = CapFit(), np.random.default_rng(7)
    for case in cases:
        for frame in (case.frame, harder(case, rng).frame):
            if frame.camera is None or frame.depth is None:
                continue
            for circles, deep, learned in detected(frame):
                yield Found(
                    circles,
                    tones_of(frame.color, circles),
                    stage.fit(frame.gray, frame.depth_m, frame.camera, circles) if deep else None,
                    None if learned is None else seen_by(learned, circles),
                    labels(circles, case.truth, stumps),
                )


def samples(
    frames: Iterable[Found], lone: Mapping[str, Floats] | None = None
) -> tuple[Floats, Floats]:
    """Return features (N, F) and labels (N,) of all circles that a model decides about.

    Args:
        frames: What was found.
        lone: Weights of the models of lone circles, which say with the detector what is surely a
            cap; without them every circle is a lone one.
    """
    rows, right = [], []
    for circles, tones, fits, seen, label in frames:
        other = np.full(len(circles), np.nan)
        if lone is not None:
            chance = None if fits is None else lone_chances(circles, fits, seen, lone)
            other = unlike(Kin(tones, sure_of(circles.score, chance)))
        use = np.isfinite(label)
        if fits is not None:
            use &= fits.valid & ~flat(fits, circles.score, other, seen)
        rows.append(features(circles, other, fits, seen)[use])
        right.append(label[use])
    return np.concatenate(rows), np.concatenate(right)


def teaches(rows: Floats, model: str) -> Bools:
    """Return which rows (N, F) teach a model: those of which it is asked.

    What is fitted is for the models of fits, all else for those without; what was found beside the
    network for those beside it; and what looks like sure caps or not for those of no lone circles.
    """
    names = MODELS[model]
    fitted, alike, beside = np.isfinite(rows[:, [NAMES.index(name) for name in KNOWN]]).T
    use = (fitted == (FIT[0] in names)) & (beside == ("learned" in names))
    return np.asarray(use & (alike == (model.removesuffix(BESIDE) not in LONE)))


def taught(model: str, samples: tuple[Floats, Floats], ridge: float) -> dict[str, Any]:
    """Return a model that has learnt from those samples of which it is asked."""
    names, share = MODELS[model], SHARE.get(model.removesuffix(BESIDE))
    rows, right = (part[teaches(samples[0], model)] for part in samples)
    print(f"{model}: {len(rows)} circles, {right.mean():.2f} right")
    table = rows[:, [NAMES.index(name) for name in names]]
    return fit(table, right, names, ridge, LIMIT, SQUARED, share)


def kept(path: Path) -> dict[str, Any]:
    """Return the models of a file that another `cap-net` changes nothing about."""
    models = yaml.safe_load(path.read_text(encoding="utf-8"))["models"]
    return {name: models[name] for name in ALONE}


def main() -> None:
    """Read the command line."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--cache", type=Path, default=Path("out/scenes"), help="rendered frames")
    parser.add_argument("--out", type=Path, default=Path(f"mushpipe/stages/{FILE}"))
    parser.add_argument("--ridge", type=float, default=1e-3)
    parser.add_argument("--beside", action="store_true", help="only the models beside `cap-net`")
    arguments = parser.parse_args()
    cache, ridge = arguments.cache, arguments.ridge
    varied = varied_cases(cache, VERIFIER_SEED, "a", VARIED)
    usual = list(found(chain(training_cases(cache), more_cases(cache), varied)))
    lone = [frame for frame in usual if not len(sure_of(frame.circles.score))]
    lone += found(few_cases(cache), stumps=True)
    sparse = found(sparse_cases(cache, SPARSE_SEED, "a", SPARSE), stumps=True)
    learnt = {FEW: samples(lone), RUBBLE: samples([*lone, *sparse])}
    models = kept(arguments.out) if arguments.beside else {}
    models |= {
        name: taught(name, rows, ridge)
        for model, rows in learnt.items()
        for name in (model, model + BESIDE)
        if name not in models
    }
    weights = {name: weights_of(model, NAMES) for name, model in models.items()}
    rows = samples(usual, weights)
    models |= {name: taught(name, rows, ridge) for name in MODELS if name not in models}
    write({name: models[name] for name in MODELS}, arguments.out, HEAD)


if __name__ == "__main__":
    main()
