"""Write a trained `cap-net` as the ONNX file that the stage reads: `python -m training.net.export`.

Its scores are calibrated and its threshold is chosen on validation frames of the simulator.
"""

from __future__ import annotations

import argparse
import json
from pathlib import Path

import numpy as np
import onnx
import torch

from mushpipe import Circles, RgbdFrame
from mushpipe.core.arrays import Floats
from mushpipe.core.truth import Ignore
from mushpipe.core.types import Header
from mushpipe.evaluate.matching import circle_iou
from mushpipe.stages.cap_decode import HEAT
from mushpipe.stages.cap_net import KIND
from mushpipe.stages.cap_net import CapNet as Stage
from training.matching import IOU
from training.net.model import CapNet
from training.net.scenes import VALIDATION, VALIDATION_SEED, Picture, pictures

RADII = (8.0, 45.0)


def write(net: CapNet, path: Path, facts: dict[str, str]) -> None:
    """Export a network with free height and width (multiples of 32), and facts about it."""
    free = {2: "height", 3: "width"}
    torch.onnx.export(
        net, (torch.zeros(1, 3, 64, 96),), str(path), dynamo=False, opset_version=17,
        input_names=["image"], output_names=["maps"],
        dynamic_axes={"image": free, "maps": {2: "rows", 3: "columns"}},
    )  # fmt: skip
    model = onnx.load(path)
    onnx.helper.set_model_props(model, {"kind": KIND, **facts})
    onnx.save(model, path)


def mean(weights: list[dict[str, torch.Tensor]]) -> dict[str, torch.Tensor]:
    """Return the mean of networks that went on from the same one.

    It keeps what the first was good at and is as robust as those trained further: Wortsman et al.
    2022, Robust fine-tuning of zero-shot models (arXiv 2109.01903).
    """
    return {
        key: torch.stack([one[key].double() for one in weights]).mean(0).to(first.dtype)
        for key, first in weights[0].items()
    }


def judged(circles: Circles, picture: Picture) -> Floats:
    """Return 1 (right), 0 (false) or NaN (neither) for circles (N,), the most certain first."""
    iou = circle_iou(circles.center, circles.radius, picture.circles[:, :2], picture.circles[:, 2])
    counts = wanted(picture)
    result = np.zeros(len(circles))
    taken = np.zeros(len(counts), bool)
    for row, values in enumerate(iou):
        free = np.where(counts & ~taken, values, 0.0)
        if free.max(initial=0.0) >= IOU:
            taken[free.argmax()], result[row] = True, 1.0
        elif (values[~counts] >= IOU).any():
            result[row] = np.nan
    return result


def wanted(picture: Picture) -> np.ndarray:
    """Return which outlines (N,) must be found."""
    radius = picture.circles[:, 2]
    sized = (radius >= RADII[0]) & (radius <= RADII[1])
    return np.asarray((picture.kind == Ignore.COUNTS) & sized)


def found(stage: Stage, cases: list[Picture]) -> tuple[Floats, Floats, int]:
    """Return scores and labels (N,) of all circles that count, and how many there should be."""
    score, label, total = [np.zeros(0)], [np.zeros(0)], 0
    for case in cases:
        _, circles = stage.process(RgbdFrame(Header(1, 0, "camera"), case.color))
        right = judged(circles, case)
        use = np.isfinite(right)
        score.append(circles.score[use])
        label.append(right[use])
        total += int(wanted(case).sum())
    return np.concatenate(score), np.concatenate(label), total


def best_threshold(score: Floats, label: Floats, total: int) -> tuple[float, float]:
    """Return the threshold of the largest F, and that F."""
    order = np.argsort(-score, kind="stable")
    right = np.cumsum(label[order])
    f = 2 * right / (np.arange(1, len(right) + 1) + total)
    best = int(f.argmax())
    after = score[order[min(best + 1, len(order) - 1)]]
    return float((score[order[best]] + after) / 2), float(f[best])


def calibrated(net: CapNet, score: Floats, label: Floats) -> tuple[float, float]:
    """Rescale the logit of the heat so that a score is a probability (Platt 1999); its a and b."""
    from scipy.optimize import minimize

    logit = np.log(score / (1 - score))

    def loss(ab: Floats) -> float:
        z = ab[0] * logit + ab[1]
        return float((np.logaddexp(0, z) - label * z).mean())

    a, b = minimize(loss, np.array([1.0, 0.0]), method="Nelder-Mead").x
    last = net.head[-1]
    with torch.no_grad():
        last.weight[HEAT] *= a
        last.bias[HEAT] = last.bias[HEAT] * a + b
    return float(a), float(b)


def main() -> None:
    """Read the command line."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--cache", type=Path, default=Path("out/net"), help="rendered frames")
    parser.add_argument("--weights", type=Path, nargs="+", default=[Path("out/net/cap-net.pt")])
    parser.add_argument("--facts", type=json.loads, default={}, help="JSON kept in the file")
    parser.add_argument("--out", type=Path, default=Path("mushpipe/stages/cap_net.onnx"))
    arguments = parser.parse_args()
    net = CapNet().eval()
    net.load_state_dict(mean([torch.load(path) for path in arguments.weights]))
    cases = list(pictures(VALIDATION_SEED, VALIDATION, arguments.cache))
    settings = {"radius_px": RADII, "min_score": 0.02, "model": arguments.out}
    write(net, arguments.out, arguments.facts)
    score, label, total = found(Stage(**settings), cases)
    print("calibration", calibrated(net, score, label))
    write(net, arguments.out, arguments.facts)
    score, label, total = found(Stage(**settings), cases)
    threshold, f = best_threshold(score, label, total)
    print(f"validation: F {f:.4f} at min_score {threshold:.3f}, {total} caps")


if __name__ == "__main__":
    main()
