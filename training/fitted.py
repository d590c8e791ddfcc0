"""Make the verifier of `cap-fit` from simulated scenes: `python -m training.fitted`.

Circles of `phase-hough`, alone and beside `cap-net`, down to a low score, are fitted, in depth as
it was simulated and in worse, and labelled by the simulator's truth.
"""

from __future__ import annotations

import argparse
from collections.abc import Iterator
from itertools import chain
from pathlib import Path

import numpy as np

from mushpipe import Circles, RgbdFrame
from mushpipe.core.truth import Truth
from mushpipe.evaluate.matching import circle_iou
from mushpipe.stages.cap_fit import CapFit
from mushpipe.stages.cap_verify import MODEL, NAMES, features, flat
from mushpipe.stages.phase_hough import PhaseHough
from mushpipe.stages.verifier import LIMIT
from training.harder import harder
from training.logistic import Floats, fit, write
from training.matching import counted, matched
from training.net.scenes import VERIFIER_SEED, varied_cases
from training.scenes import more_cases, training_cases
from training.verifier import NET, RADII, VARIED, segmentations

LEAST = 0.1  # score
NEUTRAL = 0.3  # IoU with a mushroom that need not be found, from which on a circle teaches nothing
ALONE = PhaseHough(radius_px=RADII, min_score=LEAST)
BESIDE = PhaseHough(radius_px=RADII, min_score=LEAST, use_learned=True)
HEAD = """\
# The verifier of the stage `cap-fit`: a logistic regression over what the fit found, made by
# `make verifier` from simulated scenes alone. A feature x (docs/detection.md says what each is)
# adds  weight z + square z^2  to the logit, with z = (x - mean) / scale, clipped to -4..4.
"""


def detected(frame: RgbdFrame) -> Iterator[Circles]:
    """Yield the circles of the detector alone, and beside the network."""
    yield ALONE.process(*segmentations(frame)[0])
    yield BESIDE.process(frame, *NET.process(frame))


def labels(circles: Circles, truth: Truth) -> Floats:
    """Return 1 for circles (N,) that are a cap's, 0 for others, NaN for those that do not count."""
    counts = counted(truth, *RADII)
    iou = circle_iou(circles.center, circles.radius, truth.center, truth.radius)
    right = np.isin(np.arange(len(circles)), matched(iou, counts)[0])
    neutral = ~right & (iou[:, ~counts] >= NEUTRAL).any(axis=1)
    return np.where(neutral, np.nan, right.astype(np.float64))


def samples(cache: Path) -> tuple[Floats, Floats]:
    """Return features (N, F) and labels (N,) of all circles whose fit decides, flat ones aside."""
    stage, rng = CapFit(), np.random.default_rng(7)
    varied = varied_cases(cache, VERIFIER_SEED, "a", VARIED)
    rows, right = [], []
    for case in chain(training_cases(cache), more_cases(cache), varied):
        for frame in (case.frame, harder(case, rng).frame):
            if frame.camera is None or frame.depth is None:
                continue
            for circles in detected(frame):
                if not len(circles):
                    continue
                fits = stage.fit(frame.gray, frame.depth_m, frame.camera, circles)
                label = labels(circles, case.truth)
                use = fits.valid & ~flat(fits) & np.isfinite(label)
                rows.append(features(circles, fits)[use])
                right.append(label[use])
    return np.concatenate(rows), np.concatenate(right)


def main() -> None:
    """Read the command line."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--cache", type=Path, default=Path("out/scenes"), help="rendered frames")
    parser.add_argument("--out", type=Path, default=Path(f"mushpipe/stages/{MODEL}.yaml"))
    parser.add_argument("--ridge", type=float, default=1e-3)
    arguments = parser.parse_args()
    rows, right = samples(arguments.cache)
    write({MODEL: fit(rows, right, NAMES, arguments.ridge, LIMIT, ())}, arguments.out, HEAD)
    print(f"{len(right)} circles, {right.mean():.2f} right")


if __name__ == "__main__":
    main()
