"""Time of the pose stages on a bed of 150 mushrooms, one thread.

OMP_NUM_THREADS=1 python benchmarks/pose.py
"""

from __future__ import annotations

import argparse
import os
import platform
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import cast

import numba
import numpy as np
from pose_scenes import frames, true_circles

from mushpipe import Camera, DepthSource
from mushpipe.core.arrays import Floats
from mushpipe.core.libraries import import_open3d
from mushpipe.stages.cap.attempt import ODD
from mushpipe.stages.cap_fit import CapFit
from mushpipe.stages.depth_correct import DepthCorrect
from mushpipe.stages.fuse_depth import FuseDepth
from mushpipe.stages.nearest_depth import NearestDepth
from mushpipe.stages.registration import Registration

SCENE = {"distance": 0.65, "size_mm": (20, 50), "tilt_deg": (0, 25), "count": 240, "cluster": 0.5}
SEED = 7
ROUNDS = 8  # in which the calls take turns


def milliseconds(calls: dict[str, tuple[Callable[[], object], int]]) -> dict[str, Floats]:
    """Return the least wall and CPU time of each call, ms: what other processes do only adds to it.

    Calls, with how often they are repeated, take turns: a machine's pace changes from one minute to
    the next, and a ratio of times taken in different minutes says little.
    """
    least = {name: np.full(2, np.inf) for name in calls}
    for _ in range(ROUNDS):
        for name, (call, repeats) in calls.items():
            for _ in range(max(repeats // ROUNDS, 1)):
                started = np.array([time.perf_counter(), time.thread_time()])
                call()
                spent = np.array([time.perf_counter(), time.thread_time()]) - started
                least[name] = np.minimum(least[name], 1000 * spent)
    return least


def main() -> None:
    """Print the times."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--count", type=int, default=150)
    parser.add_argument("--repeats", type=int, default=50)
    parser.add_argument("--registrations", type=int, default=12, help="mushrooms to register")
    parser.add_argument("--cache", type=Path, help="folder that keeps rendered frames")
    options = parser.parse_args()
    frame = frames(SCENE, SEED, "a", 1, options.cache)[0]
    found, _ = true_circles(frame)
    circles = found.take(np.argsort(-found.radius, kind="stable")[: options.count])
    fit, nearest, register = CapFit(depth_bias_mm=2.85), NearestDepth(), Registration()
    for stage in (fit, nearest, register):
        stage.open()
    frame.gray, frame.depth_m  # noqa: B018 - shared by all stages of a graph
    print(
        f"{len(circles)} circles, median radius {np.median(circles.radius):.1f} px, seed {SEED}; "
        f"Python {platform.python_version()}, numba {numba.__version__}, "
        f"open3d {import_open3d().__version__}, OMP_NUM_THREADS={os.environ.get('OMP_NUM_THREADS')}"
    )
    camera, measured = cast(Camera, frame.camera), DepthSource.MEASURED
    fits = fit.fit(frame.gray, frame.depth_m, camera, circles)
    holes = np.count_nonzero(fit.process(frame, circles)[0].source != measured)
    print(f"{holes} have a hole at the centre, {np.count_nonzero(fits.misfit > ODD)} fit poorly")
    fuse = FuseDepth()
    fuse.open()
    few = circles.take(np.linspace(0, len(circles) - 1, options.registrations).astype(int))
    where = nearest.process(frame, few)
    often = options.repeats
    times = milliseconds(
        {
            "cap-fit": (lambda: fit.process(frame, circles), often),
            "nearest-depth": (lambda: nearest.process(frame, circles), often),
            "fuse-depth": (lambda: fuse.process(frame), often),
            "depth-correct": (lambda: DepthCorrect(offset_mm=2.85).process(frame), often),
            # each for itself: the least time of a long call would hold more of what disturbs it
            **{
                f"{k}": (partial(register.align, frame, few, where, k, 0), ROUNDS)
                for k in range(len(few))
            },
        }
    )
    times["registration"] = sum((times.pop(f"{k}") for k in range(len(few))), np.zeros(2))
    for name, (wall, cpu) in times.items():
        n = len(few) if name == "registration" else len(circles)
        each = f"{cpu / n * 1000:9.1f} us each"
        print(f"{name:14s} {wall:8.2f} ms wall, {cpu:8.2f} ms CPU for {n}; {each}")
    ratio = times["registration"][1] / len(few) / (times["cap-fit"][1] / len(circles))
    print(f"registration costs {ratio:.0f} times as much CPU per mushroom as cap-fit")


if __name__ == "__main__":
    main()
