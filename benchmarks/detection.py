"""Time and F of segmentation plus detection beside the naive chain.

Run it with `python benchmarks/detection.py`. The naive chain is scikit-image's Chan-Vese (500
iterations) from Otsu's contour, the same opening, and OpenCV's HoughCircles. Both run on the same
simulated frames of 150 mushrooms in clusters, on one thread; a CPU time is that thread's. Both keep
the memory they free, as in a run.
"""

from __future__ import annotations

import argparse
import ctypes
import platform
import statistics
import sys
import time
from collections.abc import Callable
from dataclasses import replace
from importlib.metadata import version
from pathlib import Path

import cv2
import numba
import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from mushpipe import Circles, RgbdFrame
from mushpipe.stages.cap_net import CapNet
from mushpipe.stages.chan_vese import ChanVese
from mushpipe.stages.flatten import Flatten
from mushpipe.stages.hough import Hough
from mushpipe.stages.opening import Opening
from mushpipe.stages.phase_hough import PhaseHough
from training.matching import Score, counted
from training.scenes import JUDGING_SEED, render
from training.verifier import RADII

Chain = Callable[[RgbdFrame], Circles]


def chain(segment: ChanVese, detect: PhaseHough | Hough, flat: Flatten | None) -> Chain:
    """Return segmentation, opening and detection as one function."""
    opening = Opening()
    for stage in (segment, detect, flat):
        if stage is not None:
            stage.open()

    def run(frame: RgbdFrame) -> Circles:
        frame = flat.process(frame) if flat else frame
        return detect.process(frame, opening.process(segment.process(frame)))

    return run


def network() -> Chain:
    """Return the learned detector, which needs no segmentation, as one function."""
    stage = CapNet(radius_px=RADII)
    stage.open()
    return lambda frame: stage.process(frame)[1]


def keep_freed_memory() -> None:
    """Let glibc keep what is freed for the next call; elsewhere nothing happens.

    In a run it comes to keep nearly all by itself: of 640x480 px, a frame costs fewer than ten page
    faults. In these loops, where nothing larger than an image is ever freed, it would fetch every
    image anew, page by page: 2000 faults a frame, a fifth of the time of the fast chains.
    """
    mallopt = getattr(ctypes.CDLL(None), "mallopt", None)
    if mallopt is not None:
        mallopt(-3, 32 << 20)  # M_MMAP_THRESHOLD: larger blocks are mapped one by one
        mallopt(-1, 1 << 30)  # M_TRIM_THRESHOLD: how much may stay free at the end of the heap


def tiled(frame: RgbdFrame, times: int) -> RgbdFrame:
    """Return a frame of `times` x `times` copies: so many more pixels, and caps."""
    color = np.tile(frame.color, (times, times, 1))
    depth = None if frame.depth is None else np.tile(frame.depth, (times, times))
    height, width = color.shape[:2]
    camera = frame.camera and replace(frame.camera, width=width, height=height)
    return RgbdFrame(frame.header, color, depth, frame.depth_scale, camera)


def cpu_ms(run: Chain, frame: RgbdFrame, repeats: int) -> float:
    """Return the median CPU time of a chain on a frame, ms."""
    times = []
    for _ in range(repeats):
        again = replace(frame)  # without what it has cached: gray, depth in metres
        started = time.thread_time()
        run(again)
        times.append((time.thread_time() - started) * 1e3)
    return statistics.median(times)


def measured(run: Chain, cases: list, repeats: int) -> tuple[float, float, Score]:  # type: ignore[type-arg]
    """Return median CPU and wall time, ms per frame, and the score."""
    score, cpu, wall = Score(), [], []
    for case in cases:
        for turn in range(repeats):
            frame = replace(case.frame)
            began, started = time.perf_counter(), time.thread_time()
            circles = run(frame)
            cpu.append((time.thread_time() - started) * 1e3)
            wall.append((time.perf_counter() - began) * 1e3)
            if turn == 0:
                score.add(circles, case.truth, counted(case.truth, *RADII))
    return statistics.median(cpu), statistics.median(wall), score


def main() -> None:
    """Run both chains."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--cache", type=Path, default=Path("out/scenes"), help="rendered frames")
    parser.add_argument("--frames", type=int, default=2)
    parser.add_argument("--repeats", type=int, default=20, help="runs per frame of the fast chains")
    parser.add_argument("--iterations", type=int, default=500, help="of the naive Chan-Vese")
    arguments = parser.parse_args()
    cv2.setNumThreads(1)
    keep_freed_memory()
    seeds = [JUDGING_SEED + 40 + k for k in range(arguments.frames)]
    cases = [render("dense", "b", seed, arguments.cache) for seed in seeds]
    naive = ChanVese(solver="pde", iterations=arguments.iterations, tolerance=1e-12)
    chains = {
        "naive": (chain(naive, Hough(radius_px=RADII), None), 1),
        "naive, gradient": (chain(naive, Hough(radius_px=RADII, method="gradient"), None), 1),
        "fast with depth": (
            chain(ChanVese(), PhaseHough(radius_px=RADII), None), arguments.repeats,
        ),
        "fast, no depth": (
            chain(ChanVese(), PhaseHough(radius_px=RADII, use_depth=False), None),
            arguments.repeats,
        ),
        "with flatten": (
            chain(ChanVese(), PhaseHough(radius_px=RADII), Flatten()), arguments.repeats,
        ),
        "cap-net": (network(), arguments.repeats),
    }  # fmt: skip
    print(f"python {platform.python_version()}, numpy {np.__version__}, numba {numba.__version__},")
    opencv, scikit = version("opencv-python-headless"), version("scikit-image")
    print(f"opencv {opencv}, scikit-image {scikit}; {platform.processor()}")
    print(f"scene dense, family b, seeds {seeds}, 640x480")
    reference = 0.0
    for name, (run, repeats) in chains.items():
        cpu, wall, score = measured(run, cases, repeats)
        reference = reference or cpu
        print(
            f"{name:16} CPU {cpu:9.2f} ms  wall {wall:9.2f} ms  F {score.f:.4f} "
            f"(recall {score.recall:.3f}, precision {score.precision:.3f})  "
            f"{reference / cpu:7.0f} x faster"
        )
    run, _ = chains["fast with depth"]
    for times in (1, 2, 3):
        frame = tiled(cases[0].frame, times)
        cpu = cpu_ms(run, frame, arguments.repeats) / times**2
        print(f"{640 * times}x{480 * times}: {cpu:.2f} ms of CPU per 640x480 px")


if __name__ == "__main__":
    main()
