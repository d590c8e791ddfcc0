"""Judge `phase-hough` on simulated scenes it was not made from: `python -m training.judge`.

Prints, per condition, F with and without depth and of the literal variant on the mask, beside
OpenCV's Hough transform on the same frames and masks, and the errors of centre and radius. `fitted`
is the detector with depth and `cap-fit` after it, as in graphs/classic.yaml.
"""

from __future__ import annotations

import argparse
from collections import defaultdict
from collections.abc import Iterable
from pathlib import Path
from typing import Any, Protocol

import numpy as np

from mushpipe import Circles, Mask, RgbdFrame
from mushpipe.stages.cap_fit import CapFit
from mushpipe.stages.hough import Hough
from mushpipe.stages.phase_hough import PhaseHough
from training.matching import Score, counted
from training.scenes import Case, choosing_cases, judging_cases
from training.verifier import RADII, segmentations

PAPER = (8.0, 38.0)  # px
BEDS = ("even", "gradient", "dense", "brown", "tilted")
BINS = 5  # of the score, for `reliability`
LEAST = 0.1  # score of what `cap-fit` decides about, as in the graphs


class Detector(Protocol):
    """What finds circles in a mask."""

    def process(self, frame: RgbdFrame, mask: Mask) -> Circles:
        """Return the circles."""


CAP_FIT = CapFit(min_score=0.5)


def kept(frame: RgbdFrame, circles: Circles, learned: Circles | None = None) -> Circles:
    """Return the circles that `cap-fit` takes for caps, improved; `learned` are of `cap-net`."""
    return CAP_FIT.process(frame, circles, learned)[2]


class Fitted:
    """`phase-hough` with depth down to a low score, and `cap-fit`, which decides and improves."""

    _detect = PhaseHough(radius_px=RADII, min_score=LEAST)

    def process(self, frame: RgbdFrame, mask: Mask) -> Circles:
        """Return the circles that stay, improved."""
        return kept(frame, self._detect.process(frame, mask))


DETECTORS: dict[str, Detector] = {
    "depth": PhaseHough(radius_px=RADII),
    "fitted": Fitted(),
    "image": PhaseHough(radius_px=RADII, use_depth=False),
    "mask": PhaseHough(radius_px=RADII, input="mask"),
    "cv-alt": Hough(radius_px=RADII),
    "cv-gradient": Hough(radius_px=RADII, method="gradient"),
    "cv-mask": Hough(radius_px=RADII, method="gradient", input="mask"),
}


def judge(cases: Iterable[Case], names: list[str]) -> dict[tuple[str, str], Score]:
    """Return the score of each detector in each condition."""
    scores: dict[tuple[str, str], Score] = defaultdict(Score)
    for case in cases:
        frame, mask = segmentations(case.frame)[0]
        counts = counted(case.truth, *RADII)
        for name in names:
            circles = DETECTORS[name].process(frame, mask)
            scores[case.condition, name].add(circles, case.truth, counts)
    return scores


def table(scores: dict[tuple[str, str], Score], names: list[str]) -> str:
    """Return the figures as text."""
    conditions = list(dict.fromkeys(c for c, _ in scores))
    lines = ["F (recall/precision) in per cent; errors in px of caps visible to at least a half"]
    lines.append(f"{'':13}" + "".join(f"{name:>20}" for name in names))
    for condition in conditions:
        row = [scores[condition, name] for name in names]
        cells = (f"{s.f:.3f} ({s.recall:.2f}/{s.precision:.2f})" for s in row)
        lines.append(f"{condition:13}" + "".join(f"{cell:>20}" for cell in cells))
    for title, part in (("all", conditions), ("beds", BEDS)):
        present = [condition for condition in part if condition in conditions]
        for name in names if present else ():
            whole = Score()
            for condition in present:
                whole.merge(scores[condition, name])
            lines.append(f"{name:12} {title}: F {whole.f:.4f}, " + errors(whole))
    return "\n".join(lines)


def margins(scores: dict[tuple[str, str], Score]) -> str:
    """Return how much F each condition loses without depth, and leads OpenCV's best by."""
    lines = ["F lost without depth; F over the best of OpenCV's, with depth and without"]
    peers = [name for name in DETECTORS if name.startswith("cv-")]
    for condition in dict.fromkeys(c for c, _ in scores):
        depth, image = (scores[condition, name].f for name in ("depth", "image"))
        best = max(scores[condition, name].f for name in peers)
        lines.append(
            f"{condition:10}{depth - image:+.3f}{depth - best:+10.3f}{image - best:+10.3f}"
        )
    return "\n".join(lines)


def papers_measure(cases: Iterable[Case]) -> str:
    """Return recall, precision and F as Baisa & Al-Diri (2022) count: radii of 8 to 38 px."""
    lines = [
        "Baisa & Al-Diri 2022, their images: recall 99.29 precision 98.99 F 99.14 %",
        "here, radii of 8 to 38 px, IoU >= 0.5, simulated, even light, both shape families:",
    ]
    kinds: dict[str, dict[str, Any]] = {
        "mask, as theirs": {"input": "mask"},
        "image": {"use_depth": False},
        "image and depth": {},
    }
    frames = [(case, *segmentations(case.frame)[0]) for case in cases if case.condition == "even"]
    for name, settings in kinds.items():
        stage, score = PhaseHough(radius_px=PAPER, **settings), Score()
        for case, frame, mask in frames:
            score.add(stage.process(frame, mask), case.truth, counted(case.truth, *PAPER))
        figures = (100 * value for value in (score.recall, score.precision, score.f))
        lines.append("  {:16} recall {:.2f} precision {:.2f} F {:.2f} %".format(name, *figures))
    return "\n".join(lines)


def errors(score: Score) -> str:
    """Return centre and radius errors as text."""
    if not score.errors:
        return "no match"
    away, larger, visible = np.array(score.errors).T
    half = visible >= 0.5
    return (
        f"centre median {np.median(away[half]):.2f} p95 {np.percentile(away[half], 95):.2f}, "
        f"radius bias {np.median(larger[half]):+.2f} mean {larger[half].mean():+.2f}"
    )


def reliability(score: Score) -> str:
    """Return mean score and share of right circles per bin of the score."""
    values = np.array(score.reliability)
    lines = []
    for low in np.linspace(0.5, 1, BINS, endpoint=False):
        part = values[(values[:, 0] >= low) & (values[:, 0] < low + 0.5 / BINS + 1e-9)]
        if len(part):
            said, right = part.mean(axis=0)
            lines.append(f"  score {said:.2f}: right {right:.2f} of {len(part)}")
    return "\n".join(lines)


def main() -> None:
    """Read the command line."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--cache", type=Path, default=Path("out/scenes"), help="rendered frames")
    parser.add_argument("--choosing", action="store_true", help="the frames for choices of design")
    parser.add_argument("--detectors", nargs="+", default=list(DETECTORS), choices=DETECTORS)
    arguments = parser.parse_args()
    cases = choosing_cases if arguments.choosing else judging_cases
    scores = judge(cases(arguments.cache), arguments.detectors)
    print(table(scores, arguments.detectors))
    if set(arguments.detectors) == set(DETECTORS):
        print(margins(scores))
    print(papers_measure(cases(arguments.cache)))
    for name in arguments.detectors:
        whole = Score()
        for (_, detector), score in scores.items():
            if detector == name:
                whole.merge(score)
        print(name, reliability(whole), sep="\n")


if __name__ == "__main__":
    main()
