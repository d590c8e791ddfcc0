"""Judge `phase-hough` on labelled real recordings: `python -m training.field FOLDER`.

The folder holds recordings with labels beside them (`name.mcap`, `name.labels.json`); nothing is
trained on them. Each recording is segmented with and without `flatten`. `fitted` is the detector
with depth and `cap-fit` after it, as in graphs/classic.yaml.
"""

from __future__ import annotations

import argparse
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from mushpipe import Circles, Mask, RgbdFrame
from mushpipe.core.arrays import Floats
from mushpipe.core.truth import Ignore
from mushpipe.evaluate.matching import assign, circle_iou
from mushpipe.evaluate.truth import read_truth
from mushpipe.sources.mcap import McapSource
from mushpipe.stages.phase_hough import PhaseHough
from training.judge import LEAST, kept
from training.matching import IOU
from training.verifier import segmentations

RANGES: dict[str, dict[str, Any]] = {
    "white-bed": {"radius_px": (8, 45)},
    "desk": {"radius_px": None, "diameter_mm": (10, 120)},
    "beds": {"radius_px": (8, 60)},
}


def labelled_frames(path: Path) -> Iterator[tuple[RgbdFrame, Floats, Floats]]:
    """Yield the frames of a recording that have labels beside it.

    With each come the circles (N, 3) that must and those (M, 3) that may be found, px.
    """
    truth = read_truth(path.with_suffix(".labels.json"))
    source = McapSource(path=path)
    source.open()
    for frame in source.frames():
        if (place := truth.place(frame.header)) is not None:
            labels = truth.frames[place]
            circles = np.column_stack([labels.caps.center, labels.caps.radius])
            # How far one at the border goes on beyond it is guessed; that it is a cap is not.
            must = np.isin(labels.caps.ignore, (Ignore.COUNTS, Ignore.AT_BORDER))
            yield frame, circles[must], np.concatenate([circles[~must], labels.may_find])


def found_and_false(circles: Circles, must: Floats, may: Floats) -> tuple[int, int]:
    """Return how many of the circles (N, 3) that must be found are, and how many others are."""
    iou = circle_iou(circles.center, circles.radius, must[:, :2], must[:, 2])
    rows, _ = assign(iou, IOU)
    left = np.setdiff1d(np.arange(len(circles)), rows)
    away = np.linalg.norm(circles.center[left][:, None] - may[None, :, :2], axis=2)
    return len(rows), int((~(away <= may[None, :, 2]).any(axis=1)).sum())


def result(circles: Circles, must: Floats, may: Floats) -> str:
    """Return what was found, missed and false as text."""
    right, false = found_and_false(circles, must, may)
    f = 2 * right / max(1, right + len(must) + false)
    on_cap = [bool((np.hypot(*(circles.center - m[:2]).T) < m[2]).any()) for m in must]
    return f"{right} of {len(must)}, false {false}, F {f:.3f}; on a cap {sum(on_cap)}"


def judge(path: Path) -> Iterator[str]:
    """Yield a line per labelled frame, segmentation and use of depth."""
    settings = next(v for k, v in RANGES.items() if path.stem.startswith(k))
    for frame, *wanted in labelled_frames(path):
        for name, (ready, mask) in zip(("flat", "plain"), segmentations(frame), strict=True):
            for kind in ("depth", "fitted", "image") if frame.depth is not None else ("image",):
                text = result(detect(ready, mask, settings, kind), *wanted)
                yield f"{path.stem:18} #{frame.header.sequence} {name:5} {kind:6}: {text}"


def detect(frame: RgbdFrame, mask: Mask, settings: dict[str, Any], kind: str) -> Circles:
    """Run the detector; without depth, a range in metres becomes one in pixels."""
    if kind == "fitted":
        found = PhaseHough(**settings, min_score=LEAST).process(frame, mask)
        return kept(frame, found)
    chosen = dict(settings, use_depth=kind == "depth")
    if kind == "image" and chosen["radius_px"] is None:
        chosen["radius_px"] = (15, 90)
    return PhaseHough(**chosen).process(frame, mask)


def main() -> None:
    """Read the command line."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("folder", type=Path)
    for path in sorted(parser.parse_args().folder.glob("*.labels.json")):
        for line in judge(path.with_name(path.name.replace(".labels.json", ".mcap"))):
            print(line)


if __name__ == "__main__":
    main()
