"""Mask IoU of every segmenter against the simulator's truth, one condition per row.

    python benchmarks/masks.py [--seeds 7100 7101] [--opening 10] [--sheet contact.jpg]

Every seed is rendered in shape families a and b; a figure is the mean over them. A mask is opened
as in the graphs (`--opening 1`: as it comes). Where a bed is empty the figure is the share of the
image that the mask covers, which should be 0.
"""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from mushpipe import RgbdFrame
from mushpipe.core.arrays import Bools, Bytes
from mushpipe.core.truth import INSTANCES_TOPIC
from mushpipe.sources.synthetic import SyntheticSource
from mushpipe.stages.chan_vese import ChanVese
from mushpipe.stages.flatten import Flatten
from mushpipe.stages.height import Height
from mushpipe.stages.kmeans import KMeans
from mushpipe.stages.opening import Opening
from mushpipe.stages.otsu import Otsu

EMPTY: dict[str, Any] = {"count": 0, "pins": 1, "stumps": 0}
CONDITIONS: dict[str, dict[str, Any]] = {
    "even": {},
    "gradient 0.95": {"light": "gradient", "light_strength": 0.95},
    "side": {"light": "side"},
    "harsh": {"light": "harsh"},
    "brown": {"cap_color": "brown"},
    "brown, gradient": {"cap_color": "brown", "light": "gradient", "light_strength": 0.95},
    "mixed colours": {"cap_color": "mixed"},
    "dense": {"count": 160, "cluster": 1.0},
    "sparse": {"count": 8, "cluster": 0, "pins": 5},
    "lab table": {"scene": "lab", "count": 9},
    "lab, no clutter": {"scene": "lab", "count": 9, "clutter": 0},
    "empty bed": EMPTY,
    "empty, gradient": {**EMPTY, "light": "gradient"},
}
FLAT = "flatten, "
SEGMENTERS: dict[str, Otsu | KMeans | ChanVese | Height] = {
    "kmeans": KMeans(),
    "otsu": Otsu(),
    "chan-vese": ChanVese(),
    "morphological": ChanVese(solver="morphological"),
    "auto": ChanVese(channel="auto"),
    "gray+height": ChanVese(channel="gray+height"),
    FLAT + "chan-vese": ChanVese(),
    FLAT + "auto": ChanVese(channel="auto"),
    "height": Height(),
}


def main() -> None:
    """Print the table; with ``--sheet`` also draw the first frame of each condition."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seeds", type=int, nargs="+", default=[7100, 7101])
    parser.add_argument("--opening", type=int, default=10, help="size of the opening, px")
    parser.add_argument("--sheet", type=Path, help="contact sheet, a JPEG")
    args = parser.parse_args()
    cv2.setNumThreads(1)
    print(f"seeds {args.seeds}, shape families a and b, opening {args.opening}\n")
    print("| | " + " | ".join(SEGMENTERS) + " |\n|---" + "|---" * len(SEGMENTERS) + "|")
    strips = []
    for name, scene in CONDITIONS.items():
        frames = [bed(seed, family, scene) for seed in args.seeds for family in "ab"]
        masks = [segmented(frame, Opening(size=args.opening)) for frame in frames]
        print(row(name, frames, masks), flush=True)
        strips.append(strip(name, frames[0], masks[0]))
    if args.sheet is not None:
        cv2.imwrite(str(args.sheet), np.vstack([header(), *strips]), [cv2.IMWRITE_JPEG_QUALITY, 55])


def bed(seed: int, family: str, scene: dict[str, Any]) -> RgbdFrame:
    """Return a simulated frame with its truth."""
    source = SyntheticSource(seed=seed, shape_family=family, max_frames=1, **scene)
    return next(source.frames())


def segmented(frame: RgbdFrame, opening: Opening) -> dict[str, Bools]:
    """Return the mask of each segmenter."""
    flat = Flatten().process(frame)
    return {
        name: opening.process(stage.process(flat if name.startswith(FLAT) else frame)).foreground
        for name, stage in SEGMENTERS.items()
    }


def row(name: str, frames: list[RgbdFrame], masks: list[dict[str, Bools]]) -> str:
    """Return a row of the table."""
    figures = []
    for segmenter in SEGMENTERS:
        values = [score(m[segmenter], truth(f)) for m, f in zip(masks, frames, strict=True)]
        figures.append(f"{np.mean(values):.3f}")
    return f"| {name} | " + " | ".join(figures) + " |"


def truth(frame: RgbdFrame) -> Bools:
    """Return the pixels of all mushrooms."""
    return np.asarray(frame.attached[INSTANCES_TOPIC].labels > 0)


def score(mask: Bools, true: Bools) -> float:
    """Return the IoU, or the share of the image that is covered where next to nothing is there."""
    if true.mean() < 0.001:
        return float(mask.mean())
    return float((mask & true).sum() / max(1, (mask | true).sum()))


def strip(name: str, frame: RgbdFrame, masks: dict[str, Bools]) -> Bytes:
    """Return a row of the contact sheet: the frame, then each mask's contour; truth in yellow."""
    tiles = [tile(frame, np.zeros_like(truth(frame)), name)]
    return np.hstack(tiles + [tile(frame, mask, "") for mask in masks.values()])


def tile(frame: RgbdFrame, mask: Bools, text: str, width: int = 128) -> Bytes:
    """Return a small picture: what is found in green, what is missed in blue, invented in red."""
    image = frame.color[..., ::-1].astype(np.float32)
    true = truth(frame)
    for region, tint in ((mask & true, (0, 255, 0)), (mask & ~true, (0, 0, 255))):
        image[region] = 0.45 * image[region] + 0.55 * np.array(tint)
    if mask.any():
        image[true & ~mask] = 0.45 * image[true & ~mask] + np.array((140, 40, 0))
    height = round(width * image.shape[0] / image.shape[1])
    small = cv2.resize(image, (width, height), interpolation=cv2.INTER_AREA).astype(np.uint8)
    cv2.putText(small, text, (3, 12), cv2.FONT_HERSHEY_SIMPLEX, 0.35, (255, 255, 255), 1)
    return np.asarray(small, np.uint8)


def header(width: int = 128) -> Bytes:
    """Return the row of names above the contact sheet."""
    titles = []
    for name in ("", *SEGMENTERS):
        blank = np.zeros((20, width, 3), np.uint8)
        cv2.putText(blank, name, (3, 14), cv2.FONT_HERSHEY_SIMPLEX, 0.35, (255, 255, 255), 1)
        titles.append(blank)
    return np.hstack(titles)


if __name__ == "__main__":
    main()
