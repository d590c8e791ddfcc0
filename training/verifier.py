"""Make the verifier of `phase-hough` from simulated scenes: `python -m training.verifier`.

In rounds: detect with the verifier there is, label every candidate by the simulator's truth, fit
logistic regressions, and again, since features such as `support` depend on what was accepted.
"""

from __future__ import annotations

import argparse
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import yaml
from numpy.typing import NDArray
from scipy.optimize import minimize
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
    kinds,
)
from mushpipe.stages.phase_hough import PhaseHough, equal_area_radius
from mushpipe.stages.verifier import COLUMNS, LIMIT
from training.harder import harder, stained
from training.matching import IOU
from training.net.scenes import varied_cases
from training.scenes import Case, training_cases

Floats = NDArray[np.float64]
RADII = (8.0, 45.0)
Prepared = tuple[Case, RgbdFrame, Mask, Circles | None]
VARIED = 20  # frames
BETTER = 0.15  # of IoU; less gained nothing on scenes that chose nothing
NET = CapNet(radius_px=RADII, min_score=0.05)  # what it is unsure of is for the verifier to decide
MODELS: dict[str, dict[str, Any]] = {
    "image": {"use_depth": False},
    "depth": {},
    "low": {},
    "mask": {"input": "mask"},
    "image_learned": {"use_depth": False},
    "depth_learned": {},
    "low_learned": {},
}
KINDS = {"depth": 1, "low": 2}  # of `phase_features.kinds`; the others are 0
FEATURES = {
    "image": tuple(IMAGE_FEATURES),
    "depth": (*IMAGE_FEATURES, *DEPTH_FEATURES),
    "low": (*IMAGE_FEATURES, *DEPTH_FEATURES),
    "mask": tuple(name for name in IMAGE_FEATURES if name not in ("cover", "texture")),
    "image_learned": (*IMAGE_FEATURES, LEARNED),
    "depth_learned": NAMES,
    "low_learned": NAMES,
}
# An ignored mushroom of these kinds is a cap all the same, or is surely none.
RIGHT, WRONG = (Ignore.AT_BORDER, Ignore.TOO_LARGE), (Ignore.CUT_STUMP,)
HEAD = """\
# The verifier of the stage `phase-hough`: one logistic regression per kind of input, made by
# `make verifier` from simulated scenes alone. A feature x (docs/detection.md says what each is)
# adds  weight z + square z^2  to the logit, with z = (x - mean) / scale, clipped to -2.5..2.5.
"""


def segmentations(frame: RgbdFrame) -> list[tuple[RgbdFrame, Mask]]:
    """Return the frame as two chains of stages hand it to the detector."""
    opening, flat = Opening(), Flatten().process(frame)
    return [
        (flat, opening.process(ChanVese().process(flat))),
        (frame, opening.process(Otsu().process(frame))),
    ]


def prepared(cache: Path) -> Iterator[Prepared]:
    """Yield the frames of the training, without and with the circles of `cap-net`.

    Beside `cap-net` its mask takes the place of a segmentation. What is learnt there is learnt on
    varied frames as well, as that is what it is for. A network is surer of frames like those it was
    trained on than of any others, so each frame comes a second time with a `doubtful` one. And as
    real caps are not as clean as simulated ones, all of that comes once more on a `stained` frame
    and on a `harder` one.
    """
    rng, other = np.random.default_rng(0), np.random.default_rng(1)
    for clean in training_cases(cache):
        for case in (clean, stained(clean, other), harder(clean, other)):
            for frame, mask in segmentations(case.frame):
                yield case, frame, mask, None
            yield from _beside(case, rng)
    for clean in varied_cases(cache, "a", VARIED):
        for case in (clean, stained(clean, other), harder(clean, other)):
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


def samples(stage: PhaseHough, cases: Iterable[Prepared], kind: int) -> tuple[Floats, Floats]:
    """Return features (N, F) and labels (N,) of all candidates of a kind in a pass over the scenes.

    The kind is that of `phase_features.kinds`.
    """
    rows, right = [np.zeros((0, len(NAMES)))], [np.zeros(0)]
    for case, frame, mask, learned in cases:
        found = stage.gather(frame, mask, learned)
        if found is None or not len(found.shapes):
            continue
        order, chance, _ = stage.decide(found)
        circles = Circles(found.shapes[:, :2], equal_area_radius(found.shapes), chance)
        label = labels(case, circles, order)
        use = np.isfinite(label) & (kinds(found.table, found.middle) == kind)
        rows.append(found.table[use])
        right.append(label[use])
    return np.concatenate(rows), np.concatenate(right)


def fit(
    features: Floats,
    right: Floats,
    names: tuple[str, ...],
    ridge: float,
    squared: tuple[str, ...],
) -> dict[str, Any]:
    """Return a model: logistic regression on standardised features (N, F) and the squares of some.

    The ridge (per sample) keeps weights small; without class weights the probability is calibrated
    on the scenes of the training.
    """
    mean, scale = features.mean(axis=0), np.maximum(features.std(axis=0), 1e-3)
    z = np.clip((features - mean) / scale, -LIMIT, LIMIT)
    basis = np.column_stack([np.ones(len(z)), z, z * z * np.isin(names, squared)])

    def loss(w: Floats) -> tuple[float, Floats]:
        logit = basis @ w
        value = np.logaddexp(0, logit).mean() - (right * logit).mean()
        slope = basis.T @ (expit(logit) - right) / len(right)
        slope[1:] += ridge * w[1:]
        return float(value + 0.5 * ridge * (w[1:] ** 2).sum()), slope

    w = minimize(loss, np.zeros(basis.shape[1]), jac=True, method="L-BFGS-B").x
    first, second = w[1 : 1 + len(names)], w[1 + len(names) :]
    table = np.column_stack([mean, scale, first, second]).round(4).tolist()
    values = {n: dict(zip(COLUMNS, row, strict=True)) for n, row in zip(names, table, strict=True)}
    return {"intercept": round(float(w[0]), 4), "features": values}


def first_guess() -> dict[str, Any]:
    """Return a model to start from: edges count for, hidden outline and overlap against."""
    weights = {"support": 6.0, "free": 2.0, "coherence": 3.0, "overlap": -3.0}
    features = {n: dict(zip(COLUMNS, (0.5, 1.0, w, 0.0), strict=True)) for n, w in weights.items()}
    return {"intercept": 0.0, "features": features}


def write(models: dict[str, Any], path: Path, head: str = HEAD) -> None:
    """Write the file of a verifier."""
    lines = [head + "models:"]
    for name, model in models.items():
        lines += [f"  {name}:", f"    intercept: {model['intercept']}", "    features:"]
        for feature, values in model["features"].items():
            text = ", ".join(f"{column}: {value}" for column, value in values.items())
            lines.append(f"      {feature}: {{{text}}}")
    path.write_text("\n".join(lines) + "\n", encoding="utf-8")


def train(cache: Path, out: Path, rounds: int, ridge: float, names: list[str]) -> None:
    """Train the models of these names and write them, beside the others that the file has.

    Discs from depth alone are left out: hardly any is a cap that no edges voted for, and learning
    from them cost 0.1 to 0.2 points of F on the frames for choosing.
    """
    cases = [*prepared(cache)]
    kept = yaml.safe_load(out.read_text(encoding="utf-8"))["models"] if out.exists() else {}
    models = {name: first_guess() for name in MODELS} | kept
    models |= {name: first_guess() for name in names}
    write(models, out)
    for turn in range(rounds):
        for name in names:
            stage = PhaseHough(radius_px=RADII, verifier=out, use_blobs=False, **MODELS[name])
            beside = name.endswith("learned")
            chosen = [case for case in cases if (case[3] is not None) == beside]
            kind = KINDS.get(name.removesuffix("_learned"), 0)
            features, right = samples(stage, chosen, kind)
            columns = [NAMES.index(feature) for feature in FEATURES[name]]
            models[name] = fit(features[:, columns], right, FEATURES[name], ridge, NAMES)
            print(f"round {turn + 1}, {name}: {len(right)} candidates, {right.mean():.2f} right")
        write(models, out)


def main() -> None:
    """Read the command line."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--cache", type=Path, default=Path("out/scenes"), help="rendered frames")
    parser.add_argument("--out", type=Path, default=Path("mushpipe/stages/verifier.yaml"))
    parser.add_argument("--rounds", type=int, default=3)
    parser.add_argument("--ridge", type=float, default=1e-3)
    parser.add_argument("--models", nargs="+", default=list(MODELS), choices=MODELS)
    arguments = parser.parse_args()
    names = arguments.models
    train(arguments.cache, arguments.out, arguments.rounds, arguments.ridge, names)


if __name__ == "__main__":
    main()
