"""Make the verifier of `phase-hough` from simulated scenes: `python -m training.verifier`.

In rounds: detect with the verifier there is, label every candidate by the simulator's truth, learn,
and again, since features such as `support` depend on what was accepted. Where there is depth, small
networks learn; without it logistic regressions, since networks that look at simulated images alone
find less in real ones.
"""

from __future__ import annotations

import argparse
import warnings
from collections.abc import Iterable, Iterator
from dataclasses import replace
from itertools import chain
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.special import expit, logit

from mushpipe import Circles, Mask, RgbdFrame
from mushpipe.core.truth import Ignore
from mushpipe.evaluate.matching import circle_iou
from mushpipe.stages.cap_net import CapNet
from mushpipe.stages.chan_vese import ChanVese
from mushpipe.stages.flatten import Flatten
from mushpipe.stages.opening import Opening
from mushpipe.stages.otsu import Otsu
from mushpipe.stages.phase_features import (
    DEPTH_FEATURES,
    IMAGE_FEATURES,
    LEARNED,
    NAMES,
)
from mushpipe.stages.phase_hough import PhaseHough, equal_area_radius
from mushpipe.stages.phase_verifier import FILE
from mushpipe.stages.verifier_net import LIMIT, WIDTHS, write_models
from training import logistic
from training.harder import harder, stained
from training.matching import IOU
from training.net.scenes import VERIFIER_SEED, varied_cases
from training.scenes import Case, training_cases

Floats = NDArray[np.float64]
Parts = dict[str, Floats]  # of a model, as in `verifier_net.Models`
RADII = (8.0, 45.0)
Prepared = tuple[Case, RgbdFrame, Mask, Circles | None]
VARIED = 140  # frames
BETTER = 0.15  # of IoU; less gained nothing on scenes that chose nothing
NET = CapNet(radius_px=RADII, min_score=0.05)  # what it is unsure of is for the verifier to decide
RIDGE = 1e-3  # per candidate
DECAY = 1e-4  # of a network's weights
SCHEDULE = ((20, 2e-3), (10, 2.5e-4))  # passes over the candidates, and the rate of learning
# How to detect, and which model learns from it.
PASSES: tuple[tuple[dict[str, Any], str], ...] = (
    ({"use_depth": False}, "image"),
    ({}, "depth"),
    ({"input": "mask"}, "mask"),
    ({"use_depth": False, "use_learned": True}, "image_learned"),
    ({"use_learned": True}, "depth_learned"),
)
FEATURES = {
    "image": tuple(IMAGE_FEATURES),
    "depth": (*IMAGE_FEATURES, *DEPTH_FEATURES),
    "mask": tuple(name for name in IMAGE_FEATURES if name not in ("cover", "texture")),
    "image_learned": (*IMAGE_FEATURES, LEARNED),
    "depth_learned": NAMES,
}
# An ignored mushroom of these kinds is a cap all the same, or is surely none.
RIGHT, WRONG = (Ignore.AT_BORDER, Ignore.TOO_LARGE), (Ignore.CUT_STUMP,)


def segmentations(frame: RgbdFrame) -> list[tuple[RgbdFrame, Mask]]:
    """Return the frame as two chains of stages hand it to the detector."""
    opening, flat = Opening(), Flatten().process(frame)
    return [
        (flat, opening.process(ChanVese().process(flat))),
        (frame, opening.process(Otsu().process(frame))),
    ]


def prepared(cache: Path) -> Iterator[Prepared]:
    """Yield the frames of the training, without and with the circles of `cap-net`.

    Beside `cap-net` its mask takes the place of a segmentation. A network is surer of frames like
    those it was trained on than of any others, so each frame comes a second time with a `doubtful`
    one. And as real caps are not as clean as simulated ones, all of that comes once more on a
    `stained` frame and on a `harder` one.
    """
    rng, other = np.random.default_rng(0), np.random.default_rng(1)
    for clean in chain(training_cases(cache), varied_cases(cache, VERIFIER_SEED, "a", VARIED)):
        for case in (clean, stained(clean, other), harder(clean, other)):
            for frame, mask in segmentations(case.frame):
                yield case, frame, mask, None
            yield from _beside(case, rng)


def _beside(case: Case, rng: np.random.Generator) -> Iterator[Prepared]:
    mask, circles = NET.process(case.frame)
    yield case, case.frame, mask, circles
    yield case, case.frame, mask, doubtful(circles, rng)


def doubtful(circles: Circles, rng: np.random.Generator) -> Circles:
    """Return the circles of a network less sure of all, and of some much less than of others."""
    less = rng.uniform(0, 4) + rng.normal(0, 2, len(circles))
    score = expit(logit(np.clip(circles.score, 1e-6, 1 - 1e-6)) - less)
    kept = score >= NET.min_score
    return Circles(circles.center[kept], circles.radius[kept], score[kept])


def labels(case: Case, circles: Circles, order: NDArray[np.intp]) -> Floats:
    """Return 1 for right, 0 for wrong, NaN for candidates (N,) that teach nothing.

    The first of the accepted candidates (`order`) on a cap is right, all others on it are wrong;
    where none was accepted, each that fits is right. A candidate is wrong, too, where another one
    fits the cap better by `BETTER`: so the more precise one comes first.
    """
    truth = case.truth
    cap = (truth.ignore == 0) | np.isin(truth.ignore, RIGHT)
    iou = circle_iou(circles.center, circles.radius, truth.center, truth.radius)
    result = np.zeros(len(circles))
    neutral = ~cap & ~np.isin(truth.ignore, WRONG)
    result[(iou[:, neutral] >= 0.3).any(axis=1)] = np.nan
    result[((iou[:, cap] > 0.35) & (iou[:, cap] < 0.65)).any(axis=1)] = np.nan
    taken = np.zeros(len(truth), bool)
    rest = np.setdiff1d(np.arange(len(circles)), order)
    for k in [*order, *rest]:
        best = int(np.argmax(np.where(cap, iou[k], -1))) if cap.any() else -1
        if best >= 0 and iou[k, best] >= 0.65:
            result[k] = 0.0 if taken[best] else 1.0
        if best >= 0 and iou[k, best] >= IOU and k in order:
            taken[best] = True
    best = np.where(cap, iou, 0).max(axis=0, initial=0)
    worse = (iou >= 0.35) & (iou < best - BETTER) & (best >= 0.65) & cap
    result[worse.any(axis=1)] = 0.0
    return result


def samples(stage: PhaseHough, cases: Iterable[Prepared], deep: bool) -> tuple[Floats, Floats]:
    """Return features (N, F) and labels (N,) of the candidates with depth, or of those without."""
    rows, right = [np.zeros((0, len(NAMES)))], [np.zeros(0)]
    for case, frame, mask, learned in cases:
        found = stage.gather(replace(frame), mask, learned)  # what a frame caches takes room
        if found is None or not len(found.shapes):
            continue
        order, chance, _ = stage.decide(found)
        circles = Circles(found.shapes[:, :2], equal_area_radius(found.shapes), chance)
        label = labels(case, circles, order)
        use = np.isfinite(label) & (np.isfinite(found.middle) == deep)
        rows.append(found.table[use])
        right.append(label[use])
    return np.concatenate(rows), np.concatenate(right)


def fit_logistic(features: Floats, right: Floats, names: tuple[str, ...]) -> Parts:
    """Return a logistic regression on features (N, F) and their squares."""
    model = logistic.fit(features, right, names, RIDGE, LIMIT, names)
    columns = np.array([[*model["features"][name].values()] for name in names]).T
    parts = dict(zip(("mean", "scale", "a", "s"), columns, strict=True))
    return parts | {"b3": np.array([model["intercept"]])}


def fit_network(features: Floats, right: Floats, seed: int) -> Parts:
    """Return a network that learnt from features (N, F) and labels (N,).

    Without class weights its probability is calibrated on the scenes of the training. The rate of
    learning drops once, so that the last steps settle.
    """
    from sklearn.neural_network import MLPClassifier

    mean, scale = features.mean(axis=0), np.maximum(features.std(axis=0), 1e-3)
    z = np.clip((features - mean) / scale, -LIMIT, LIMIT).astype(np.float32)
    net = MLPClassifier(WIDTHS, alpha=DECAY, batch_size=512, warm_start=True, random_state=seed)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # that it has not converged after so many passes
        for passes, rate in SCHEDULE:
            net.set_params(max_iter=passes, learning_rate_init=rate)
            net.fit(z, right)
    (w1, w2, w3), (b1, b2, b3) = net.coefs_, net.intercepts_
    return {"mean": mean, "scale": scale, "w1": w1, "b1": b1, "w2": w2, "b2": b2, "w3": w3[:, 0],
            "b3": b3}  # fmt: skip


def first_guess(names: tuple[str, ...]) -> Parts:
    """Return a model to start from: edges count for, hidden outline and overlap against."""
    weights = {"support": 6.0, "free": 2.0, "coherence": 3.0, "overlap": -3.0}
    a = np.array([weights.get(name, 0.0) for name in names])
    return {"mean": np.full(len(a), 0.5), "scale": np.ones(len(a)), "a": a, "b3": np.zeros(1)}


def train(cache: Path, out: Path, rounds: int, seed: int) -> None:
    """Train all models and write them.

    Discs from depth alone are left out: hardly any is a cap that no edges voted for, and learning
    from them cost 0.1 to 0.2 points of F on the frames for choosing.
    """
    cases = [*prepared(cache)]
    models = {name: (known, first_guess(known)) for name, known in FEATURES.items()}
    write_models(out, models)
    for turn in range(rounds):
        for settings, name in PASSES:
            stage = PhaseHough(radius_px=RADII, verifier=out, use_blobs=False, **settings)
            deep, known = name.startswith("depth"), FEATURES[name]
            table, right = samples(stage, [case for case in cases if teaches(case, name)], deep)
            rows = table[:, [NAMES.index(each) for each in known]]
            fitted = fit_network(rows, right, seed) if deep else fit_logistic(rows, right, known)
            models[name] = known, fitted
            print(f"round {turn + 1}, {name}: {len(rows)} candidates", flush=True)
            write_models(out, models)


def teaches(case: Prepared, name: str) -> bool:
    """Return whether a model learns from a frame: those beside `cap-net` from frames that have it.

    Without depth and network a varied bed teaches a regression little but doubt.
    """
    beside = case[3] is not None
    varied = case[0].condition == "varied"
    return beside == name.endswith("learned") and (name not in ("image", "mask") or not varied)


def main() -> None:
    """Read the command line."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--cache", type=Path, default=Path("out/scenes"), help="rendered frames")
    parser.add_argument("--out", type=Path, default=Path(f"mushpipe/stages/{FILE}"))
    parser.add_argument("--rounds", type=int, default=3)
    parser.add_argument("--seed", type=int, default=0)
    arguments = parser.parse_args()
    train(arguments.cache, arguments.out, arguments.rounds, arguments.seed)


if __name__ == "__main__":
    main()
