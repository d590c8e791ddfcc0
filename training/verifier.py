"""Make the verifier of `phase-hough` from simulated scenes: `python -m training.verifier`.

In rounds: detect with the verifier there is, label every candidate by the simulator's truth, learn,
and again, since features such as `support` depend on what was accepted. Where there is depth, small
networks learn; without it logistic regressions, since networks that look at simulated images alone
find less in real ones.
"""

from __future__ import annotations

import argparse
import warnings
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from scipy.special import expit, logit

from mushpipe import Circles, Mask, RgbdFrame
from mushpipe.core.arrays import Floats, Ints32, Singles
from mushpipe.core.truth import Ignore
from mushpipe.evaluate.matching import circle_iou
from mushpipe.stages.cap_net import CapNet
from mushpipe.stages.chan_vese import ChanVese
from mushpipe.stages.flatten import Flatten
from mushpipe.stages.opening import Opening
from mushpipe.stages.otsu import Otsu
from mushpipe.stages.phase.features import DEPTH_FEATURES, IMAGE_FEATURES, LEARNED, NAMES
from mushpipe.stages.phase.verifier import FILE
from mushpipe.stages.phase_hough import EVIDENCE, PhaseHough, equal_area_radius
from mushpipe.stages.verifier_net import LIMIT, WIDTHS, write_models
from training import logistic
from training.harder import harder, stained
from training.matching import IOU
from training.net.scenes import VERIFIER_SEED, varied_cases
from training.scenes import Case, more_cases, training_cases

Parts = dict[str, Floats]  # of a model, as in `verifier_net.Models`
Trained = dict[str, tuple[Sequence[str], Parts]]  # the features of each model, and its parts
RADII = (8.0, 45.0)
VARIED, FEW = 140, 20  # varied frames, and how many of them regressions learn from
BETTER = 0.15  # of IoU; less gained nothing on scenes that chose nothing
# As in graphs/pick.yaml; what it is unsure of is for the verifier to decide.
NET = CapNet(radius_px=RADII, min_score=0.05, beside_depth=0.8)
RIDGE = 1e-3  # per candidate
DECAY = 1e-4  # of a network's weights
TEACHERS = 5
SCHEDULE = ((20, 2e-3), (10, 2.5e-4))  # passes over the candidates, and the rate of learning
# How to detect, and which model learns from it. A regression beside `cap-net` learns from more than
# it will decide about: without the candidates with little evidence it takes more soil for caps.
PASSES: tuple[tuple[dict[str, Any], str], ...] = (
    ({"use_depth": False}, "image"),
    ({}, "depth"),
    ({"input": "mask"}, "mask"),
    ({"use_depth": False, "use_learned": True, "evidence": EVIDENCE}, "image_learned"),
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


class Prepared(NamedTuple):
    """A frame as the detector gets it.

    Attributes:
        case: The frame, with its truth.
        frame: The frame, perhaps flattened.
        mask: Where caps may be.
        learned: Circles of `cap-net`.
        usual: Whether regressions learn from it, too.
    """

    case: Case
    frame: RgbdFrame
    mask: Mask
    learned: Circles | None
    usual: bool


def segmentations(frame: RgbdFrame) -> list[tuple[RgbdFrame, Mask]]:
    """Return the frame as two chains of stages hand it to the detector."""
    opening, flat = Opening(), Flatten().process(frame)
    return [
        (flat, opening.process(ChanVese().process(flat))),
        (frame, opening.process(Otsu().process(frame))),
    ]


def prepared(cache: Path) -> Iterator[Prepared]:
    """Yield the frames of the training, without and with the circles of `cap-net`.

    Beside `cap-net`, which has a look with depth and one without, its mask takes the place of a
    segmentation. A network is surer of frames like those it was trained on than of any others, so
    each frame comes a second time with `doubtful` circles. And as real caps are not as clean as
    simulated ones, all of that comes once more on a `stained` frame and on a `harder` one.
    """
    rng, other, deep = (np.random.default_rng(seed) for seed in range(3))
    varied = list(varied_cases(cache, VERIFIER_SEED, "a", VARIED))
    usual = [*training_cases(cache), *varied[:FEW]]
    for k, clean in enumerate([*usual, *more_cases(cache), *varied[FEW:]]):
        for case in (clean, stained(clean, other), harder(clean, other)):
            for frame, mask in segmentations(case.frame):
                yield Prepared(case, frame, mask, None, k < len(usual))
            for frame, doubt in ((replace(case.frame, depth=None), rng), (case.frame, deep)):
                mask, circles = NET.process(frame)
                for found in (circles, doubtful(circles, doubt)):
                    yield Prepared(case, frame, mask, found, k < len(usual))


def doubtful(circles: Circles, rng: np.random.Generator) -> Circles:
    """Return the circles of a network less sure of all, and of some much less than of others."""
    less = rng.uniform(0, 4) + rng.normal(0, 2, len(circles))
    score = expit(logit(np.clip(circles.score, 1e-6, 1 - 1e-6)) - less)
    return Circles(circles.center, circles.radius, score).take(score >= NET.min_score)


def labels(case: Case, circles: Circles, order: Ints32) -> Floats:
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
    """Return features (N, F) and labels (N,) of the candidates with depth, or of those without.

    They are accepted by their probability alone: models that learnt from the order that the network
    leads with depth let more false circles pass on the frames for choosing.
    """
    rows, right = [np.zeros((0, len(NAMES)))], [np.zeros(0)]
    for case, frame, mask, learned, _ in cases:
        found = stage.gather(replace(frame), mask, learned)  # what a frame caches takes room
        if found is None or not len(found.shapes):
            continue
        order, chance, *_ = stage.decide(found)
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


def fit_network(features: Floats, right: Floats, teachers: int = 0) -> Parts:
    """Return a network that learnt from features (N, F) and labels (N,).

    With teachers it learns as much from the mean of so many networks as from the labels (Hinton,
    Vinyals & Dean 2015, arXiv 1503.02531): single networks differ where the training says little,
    and so on real frames. Without class weights its probability is calibrated on the scenes of the
    training.
    """
    mean, scale = features.mean(axis=0), np.maximum(features.std(axis=0), 1e-3)
    z = np.clip((features - mean) / scale, -LIMIT, LIMIT).astype(np.float32)
    if teachers:
        logits = [_logits(_trained(z, right, seed), z) for seed in range(teachers)]
        right = (right + expit(np.mean(logits, axis=0))) / 2
    return {"mean": mean, "scale": scale, **_trained(z, right, 0)}


def _trained(z: Singles, chance: Floats, seed: int) -> Parts:
    """Return what a network learnt of which chances (N,) belong to features (N, F).

    The rate of learning drops once, so that the last steps settle.
    """
    from sklearn.neural_network import MLPClassifier

    net = MLPClassifier(WIDTHS, alpha=DECAY, batch_size=512, warm_start=True, random_state=seed)
    doubted = (chance > 0) & (chance < 1)  # such a row is both, with weights
    rows = np.concatenate([z, z[doubted]])
    label = np.concatenate([chance > 0, np.zeros(doubted.sum(), bool)])
    weight = np.concatenate([np.where(chance > 0, chance, 1), 1 - chance[doubted]])
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # that it has not converged after so many passes
        for passes, rate in SCHEDULE:
            net.set_params(max_iter=passes, learning_rate_init=rate)
            net.fit(rows, label, sample_weight=weight)
    (w1, w2, w3), (b1, b2, b3) = net.coefs_, net.intercepts_
    return {"w1": w1, "b1": b1, "w2": w2, "b2": b2, "w3": w3[:, 0], "b3": b3}


def _logits(parts: Parts, z: Singles) -> Floats:
    hidden = np.maximum(0, np.maximum(0, z @ parts["w1"] + parts["b1"]) @ parts["w2"] + parts["b2"])
    return np.asarray(hidden @ parts["w3"] + parts["b3"])


def first_guess(names: tuple[str, ...]) -> Parts:
    """Return a model to start from: edges count for, hidden outline and overlap against."""
    weights = {"support": 6.0, "free": 2.0, "coherence": 3.0, "overlap": -3.0}
    a = np.array([weights.get(name, 0.0) for name in names])
    return {"mean": np.full(len(a), 0.5), "scale": np.ones(len(a)), "a": a, "b3": np.zeros(1)}


def kept(path: Path) -> Trained:
    """Return the models of a file that another `cap-net` changes nothing about."""
    parts: dict[str, Parts] = {name: {} for name in FEATURES if not name.endswith(LEARNED)}
    with np.load(path) as file:
        for name, part in (key.split("/") for key in file):
            if name in parts:
                parts[name][part] = file[f"{name}/{part}"]
    return {name: (each.pop("features").tolist(), each) for name, each in parts.items()}


def train(cache: Path, out: Path, rounds: int, beside: bool) -> None:
    """Train all models and write them; networks have teachers in the last round.

    `beside` trains those beside `cap-net` alone. Discs from depth alone are left out: hardly any is
    a cap that no edges voted for, and learning from them cost 0.1 to 0.2 points of F on the frames
    for choosing.
    """
    cases = [*prepared(cache)]
    models: Trained = {name: (known, first_guess(known)) for name, known in FEATURES.items()}
    fixed = kept(out) if beside else {}
    models |= fixed
    write_models(out, models)
    for turn in range(rounds):
        for settings, name in PASSES:
            if name in fixed:
                continue
            stage = PhaseHough(radius_px=RADII, verifier=out, use_blobs=False, **settings)
            deep, known = name.startswith("depth"), FEATURES[name]
            table, right = samples(stage, [case for case in cases if teaches(case, name)], deep)
            rows = table[:, [NAMES.index(each) for each in known]]
            if deep:
                teachers = TEACHERS if turn == rounds - 1 else 0
                models[name] = known, fit_network(rows, right, teachers)
            else:
                models[name] = known, fit_logistic(rows, right, known)
            print(f"round {turn + 1}, {name}: {len(rows)} candidates", flush=True)
            write_models(out, models)


def teaches(case: Prepared, name: str) -> bool:
    """Return whether a model learns from a frame: those beside `cap-net` from frames that have it.

    A regression has a few dozen weights: what it learns from rare scenes it loses on usual ones.
    Without depth and network a varied bed teaches it little but doubt.
    """
    deep, learned = name.startswith("depth"), name.endswith("learned")
    if (case.learned is not None) != learned or (learned and deep == (case.frame.depth is None)):
        return False
    return deep or (case.usual and (learned or case.case.condition != "varied"))


def main() -> None:
    """Read the command line."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--cache", type=Path, default=Path("out/scenes"), help="rendered frames")
    parser.add_argument("--out", type=Path, default=Path(f"mushpipe/stages/{FILE}"))
    parser.add_argument("--rounds", type=int, default=4)
    parser.add_argument("--beside", action="store_true", help="only the models beside `cap-net`")
    arguments = parser.parse_args()
    train(arguments.cache, arguments.out, arguments.rounds, arguments.beside)


if __name__ == "__main__":
    main()
