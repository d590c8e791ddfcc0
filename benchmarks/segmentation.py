"""Time and energy of the Chan-Vese solvers, against the exact minimum and scikit-image.

    python benchmarks/segmentation.py [--frames 8] [--reference-frames 4] [recording.mcap ...]

Frames are of the simulator, 640 x 480 px, and of the recordings named, scaled to that size. Times
are of the CPU, on one thread, the best of some repeats, and hold Otsu's start. The exact minimum
is a graph cut (PyMaxflow) of the same discrete energy, alternating with the means.
"""

from __future__ import annotations

import argparse
import importlib.metadata
import math
import platform
import time
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any, TypeVar

import cv2
import numpy as np
from graph_cut import graph_cut

from mushpipe import RgbdFrame
from mushpipe.core.arrays import Bools, Singles
from mushpipe.sources.mcap import McapSource
from mushpipe.sources.synthetic import SyntheticSource
from mushpipe.stages.chan_vese import ChanVese
from mushpipe.stages.chan_vese_energy import chan_vese_energy
from mushpipe.stages.flatten import Flatten
from mushpipe.stages.height import Height
from mushpipe.stages.kmeans import KMeans
from mushpipe.stages.opening import Opening
from mushpipe.stages.otsu import Otsu, otsu_foreground

T = TypeVar("T")
MU = 0.1
SEED = 7000
Segmenter = Otsu | KMeans | ChanVese | Height | Flatten
SCENES: list[dict[str, Any]] = [
    {"shape_family": "a"},
    {"shape_family": "b", "count": 150, "cluster": 1.0},
    {"shape_family": "a", "light": "gradient", "light_strength": 0.5},
    {"shape_family": "b", "cap_color": "brown"},
]
FULL = ChanVese(solver="pde", iterations=500, tolerance=1e-12)
SOLVERS = {
    "fast": ChanVese(),
    "morphological": ChanVese(solver="morphological"),
    "scikit-image, 500 iterations": FULL,
    "scikit-image, until it stops": ChanVese(solver="pde", iterations=500),
    "Otsu alone": None,
}


def main() -> None:
    """Print the tables."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("recordings", nargs="*", type=Path)
    parser.add_argument("--frames", type=int, default=8, help="simulated frames; 0 for none")
    parser.add_argument("--reference-frames", type=int, default=4, help="of them for scikit-image")
    args = parser.parse_args()
    cv2.setNumThreads(1)
    print(f"{versions()}\nsimulator seeds {SEED} to {SEED + args.frames - 1}, mu {MU}\n")
    frames = [bed(i) for i in range(args.frames)]
    if frames:
        solvers("simulated", [frame.gray for frame in frames], args.reference_frames)
    for path in args.recordings:
        images = [resized(frame.gray) for frame in McapSource(path=path).frames()]
        solvers(path.stem, images, args.reference_frames)
    if frames:
        stages(frames)


def versions() -> str:
    """Return the versions of what is measured."""
    names = ("numpy", "numba", "opencv-python-headless", "scikit-image", "PyMaxflow")
    found = [f"{name} {importlib.metadata.version(name)}" for name in names]
    return f"Python {platform.python_version()}, " + ", ".join(found)


def bed(number: int) -> RgbdFrame:
    """Return a frame of the simulator."""
    scene = SCENES[number % len(SCENES)]
    return next(SyntheticSource(seed=SEED + number, max_frames=1, **scene).frames())


def resized(gray: Singles) -> Singles:
    """Return an image at 640 x 480 px."""
    if gray.shape == (480, 640):
        return gray
    return np.asarray(cv2.resize(gray, (640, 480), interpolation=cv2.INTER_AREA), np.float32)


def solvers(title: str, images: list[Singles], few: int) -> None:
    """Print time and energy of each solver on some images."""
    lowest = [
        chan_vese_energy(image, graph_cut(image, otsu_foreground(image), MU), MU)
        for image in images
    ]
    print(f"{title}: {len(images)} frames of 640 x 480\n")
    print("| solver | frames | ms | times fast | E / minimum, mean | max | of fast there |")
    print("|---|---|---|---|---|---|---|")
    fast_ms, fast = measured(SOLVERS["fast"], images, lowest, 15)
    for name, stage in SOLVERS.items():
        slow = stage is not None and stage.solver == "pde"
        some = images[:few] if slow else images
        ms, ratios = measured(stage, some, lowest, 1 if slow else 15)
        there = np.mean(fast[: len(some)])
        print(
            f"| {name} | {len(some)} | {ms:.2f} | {ms / fast_ms:.3g} "
            f"| {np.mean(ratios):.4f} | {max(ratios):.4f} | {there:.4f} |"
        )
    print()


def measured(
    stage: ChanVese | None, images: list[Singles], lowest: list[float], repeats: int
) -> tuple[float, list[float]]:
    """Return the mean time of a solver, ms, and the energy of each result over the lowest."""
    done = [timed(partial(solve, stage, image), repeats) for image in images]
    ratios = [
        chan_vese_energy(image, region, MU) / least
        for image, (region, _), least in zip(images, done, lowest, strict=False)
    ]
    return 1e3 * float(np.mean([seconds for _, seconds in done])), ratios


def solve(stage: ChanVese | None, image: Singles) -> Bools:
    """Run a solver from Otsu's start."""
    initial = otsu_foreground(image)
    if stage is not None and stage.solver == "pde":
        stage = stage.model_copy(update={"mu": mu_stretched(image, MU)})
    return initial if stage is None else stage.solve(image, initial)


def mu_stretched(image: Singles, mu: float) -> float:
    """Return the weight with which scikit-image, which stretches images to 0..1, minimises E."""
    return mu / float(np.ptp(image)) ** 2


def timed(call: Callable[[], T], repeats: int) -> tuple[T, float]:
    """Return a result and the least CPU time of a call, s; the first of many calls is a warm-up."""
    best = math.inf
    for _ in range(max(1, repeats)):
        start = time.thread_time()
        result = call()
        best = min(best, time.thread_time() - start)
    return result, best


def stages(frames: list[RgbdFrame]) -> None:
    """Print the time of whole stages, each on its own copy of the frame's images."""
    gray = ChanVese()
    table: dict[str, Segmenter] = {
        "otsu": Otsu(),
        "otsu, check: false": Otsu(check=False),
        "kmeans": KMeans(),
        "chan-vese": gray,
        "chan-vese, channel: auto": ChanVese(channel="auto"),
        "chan-vese, channel: rgb": ChanVese(channel="rgb"),
        "chan-vese, solver: morphological": ChanVese(solver="morphological"),
        "height": Height(),
        "flatten": Flatten(),
    }
    print("| stage | ms per frame |\n|---|---|")
    for name, stage in table.items():
        stage.open()
        print(f"| {name} | {stage_ms(stage, frames):.2f} |")
    opening = Opening()
    masks = [gray.process(frame) for frame in frames]
    best = [timed(partial(opening.process, mask), 15)[1] for mask in masks]
    print(f"| opening | {1e3 * float(np.mean(best)):.2f} |")


def stage_ms(stage: Segmenter, frames: list[RgbdFrame]) -> float:
    """Return the mean over frames of the least time; gray and metric depth are made anew."""
    times = []
    for frame in frames:
        best = math.inf
        for _ in range(7):
            fresh = replace(frame)
            start = time.thread_time()
            stage.process(fresh)
            best = min(best, time.thread_time() - start)
        times.append(best)
    return 1e3 * float(np.mean(times))


if __name__ == "__main__":
    main()
