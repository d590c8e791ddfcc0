"""How far off positions and diameters are with the detector in the loop; fusion; ids; time.

    python benchmarks/localization.py --family b --seeds 5000:5003

The circles are those of `graphs/pick.yaml`, paired with the truth as `mushpipe eval` does.
Errors in mm; z2 is the mean of (error / stated sigma)^2. `seen`: nothing hides the centre;
`holes`: there is no depth at it.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
from pose_scenes import SETS, detected, found_in, frames, true_circles, truth_of

from mushpipe import Circles, DepthSource, Locations, RgbdFrame
from mushpipe.core.truth import INSTANCES_TOPIC
from mushpipe.evaluate.matching import match
from mushpipe.evaluate.truth import FrameTruth
from mushpipe.stages.cap_fit import CapFit
from mushpipe.stages.depth_correct import DepthCorrect
from mushpipe.stages.fuse_depth import FuseDepth
from mushpipe.stages.nearest_depth import NearestDepth
from mushpipe.stages.picks import MakePicks
from mushpipe.stages.surface_fit import SurfaceFit

MOVING = {"distance": 0.5, "size_mm": (20, 55), "count": 70, "step_mm": 15, "travel_mm": 60,
          "fps": 10}  # fmt: skip
TIMED = {"distance": 0.65, "size_mm": (20, 50), "tilt_deg": (0, 25), "count": 240, "cluster": 0.5}
CORRECT = DepthCorrect(offset_mm=2.85)
Method = Callable[[list[RgbdFrame], Circles], Locations]


def methods() -> dict[str, Method]:
    """Return what is compared; all but the first see corrected depth."""
    nearest, surface, cap = NearestDepth(), SurfaceFit(), CapFit()
    for stage in (nearest, surface, cap):
        stage.open()

    def fused(taken: list[RgbdFrame]) -> RgbdFrame:
        fuse = FuseDepth()
        return [fuse.process(CORRECT.process(frame)) for frame in taken][-1]

    return {
        "paper, as it is": lambda taken, c: nearest.process(taken[0], c),
        "paper": lambda taken, c: nearest.process(CORRECT.process(taken[0]), c),
        "surface-fit": lambda taken, c: surface.process(CORRECT.process(taken[0]), c),
        "surface-fit, 5": lambda taken, c: surface.process(fused(taken), c),
        "cap-fit": lambda taken, c: cap.process(CORRECT.process(taken[0]), c)[0],
        "cap-fit, 5": lambda taken, c: cap.process(fused(taken), c)[0],
    }


def errors(found: Locations, taken: list[RgbdFrame], pairs: tuple[np.ndarray, ...]) -> np.ndarray:
    """Return per pair: error and sigma of Z, of the diameter (mm); has a hole; centre is seen."""
    truth, (rows, true) = truth_of(taken[0]), pairs
    # a hole: the pixel at the circle's centre has no depth
    hole = found.source[rows] == DepthSource.NEIGHBOURS
    labels = taken[0].attached[INSTANCES_TOPIC].labels
    u, v = np.rint(truth.center[true]).astype(int).T
    seen = labels[v.clip(0, len(labels) - 1), u.clip(0, labels.shape[1] - 1)] == true + 1
    return np.column_stack([
        1e3 * (found.position[rows, 2] - truth.surface[true, 2]),
        1e3 * found.sigma_position[rows, 2],
        1e3 * (found.diameter[rows] - truth.diameter[true]),
        1e3 * found.sigma_diameter[rows],
        hole,
        seen,
    ])  # fmt: skip


def row(table: np.ndarray) -> str:
    """Return a line of the table."""
    line = f"{len(table):5d} {np.isnan(table[:, 0]).sum():4d} |"
    for column in (0, 2):
        known = table[np.isfinite(table[:, column])]
        error, z2 = known[:, column], np.mean((known[:, column] / known[:, column + 1]) ** 2)
        p95 = np.percentile(np.abs(error), 95)
        line += f" {error.mean():+6.2f} {error.std():5.2f} {p95:5.2f} {z2:5.2f} |"
    return line


def accuracy(options: argparse.Namespace) -> None:
    """Print the table of the methods."""
    first, last = map(int, options.seeds.split(":"))
    tables: dict[str, dict[str, list[np.ndarray]]] = {}
    compared = methods()
    for name, scenes in SETS.items():
        for scene in scenes:
            for seed in range(first, last):
                taken = frames(scene, seed, options.family, 5, options.cache)
                circles, true = detected(taken[0])
                rows = np.flatnonzero(true >= 0)
                for method, locate in compared.items():
                    found = locate(taken, circles)
                    table = errors(found, taken, (rows, true[rows]))
                    tables.setdefault(method, {}).setdefault(name, []).append(table)
    print(f"{'':26s} {'n':>5s} {'miss':>4s} | {'Z bias':>6s} {'std':>5s} {'p95':>5s} {'z2':>5s} | "
          f"{'D bias':>6s} {'std':>5s} {'p95':>5s} {'z2':>5s} |")  # fmt: skip
    for method, sets in tables.items():
        everything = np.concatenate([table for parts in sets.values() for table in parts])
        print(f"{method:16s} {'all':9s} {row(everything)}")
        print(f"{method:16s} {'seen':9s} {row(everything[everything[:, 5] == 1])}")
        print(f"{method:16s} {'holes':9s} {row(everything[everything[:, 4] == 1])}")
        for name, parts in sets.items():
            print(f"{method:16s} {name:9s} {row(np.concatenate(parts))}")


def fusion(options: argparse.Namespace) -> None:
    """Print by how much noise falls, and how far depth edges move, over 5 frames of a still bed."""
    seed = int(options.seeds.split(":")[0])
    taken = frames(SETS["bed"][0], seed, options.family, 10, options.cache)
    halves = []
    for half in (taken[:5], taken[5:]):
        fuse = FuseDepth(frames=5)
        halves.append([fuse.process(frame) for frame in half][-1])
    # what stays from frame to frame drops out of a difference; 99 % of it lies on surfaces
    single, mean = (
        1e3 * (a.depth_m - b.depth_m) for a, b in ((taken[0], taken[5]), (halves[0], halves[1]))
    )
    both = (np.abs(single) < 8) & (np.abs(mean) < 8)
    ratio = single[both].std() / mean[both].std()
    share = [100 * np.isfinite(frame.depth_m).mean() for frame in (taken[0], halves[0])]
    print(f"fuse-depth over 5 frames: noise / {ratio:.2f} (independent frames: {5**0.5:.2f}), "
          f"depth at {share[0]:.1f} -> {share[1]:.1f} % of the pixels")  # fmt: skip
    shift = edge_radius(halves[0]) - np.mean([edge_radius(f) for f in taken[:5]], axis=0)
    print(f"  depth edges of {len(shift)} caps move outwards by {shift.mean():+.3f} px, "
          f"std {shift.std():.3f}")  # fmt: skip


def edge_radius(frame: RgbdFrame) -> np.ndarray:
    """Return the radii, px, of the areas that are nearer than the soil around whole caps."""
    truth = truth_of(frame)
    rows = np.flatnonzero((truth.visible > 0.95) & (truth.ignore == 0))
    v, u = np.mgrid[: frame.color.shape[0], : frame.color.shape[1]]
    radii = []
    for i in rows:
        around = (u - truth.center[i, 0]) ** 2 + (v - truth.center[i, 1]) ** 2
        window = frame.depth_m[around < (1.15 * truth.radius[i]) ** 2]
        rim = truth.surface[i, 2] + 0.6 * truth.diameter[i]
        # half of what is missing is taken for cap
        area = (window < rim).sum() + 0.5 * np.isnan(window).sum()
        radii.append(np.sqrt(area / np.pi))
    return np.array(radii)


def steps(options: argparse.Namespace) -> None:
    """Print how often an id stays with its mushroom while the camera moves 15 mm per frame."""
    first, last = map(int, options.seeds.split(":"))
    kept = total = seen = 0
    for seed in range(first, last):
        locate, pick = SurfaceFit(), MakePicks()
        before: dict[int, int] = {}
        for frame in frames(MOVING, seed, options.family, 6, options.cache):
            circles = found_in(frame)
            picks = pick.process(frame, circles, locate.process(CORRECT.process(frame), circles))
            truth = truth_of(frame)
            paired = match(FrameTruth(truth), picks.center, picks.radius, 0.5)
            now = dict(zip(truth.id[paired.truth], picks.id[paired.found], strict=True))
            both = before.keys() & now.keys()
            kept += sum(before[one] == now[one] for one in both)
            total, seen, before = total + len(both), seen + len(now), now
    print(f"ids under a camera that moves 15 mm per frame: {kept} of {total} steps kept "
          f"({100 * kept / total:.1f} %), {seen} sightings")  # fmt: skip


def times(options: argparse.Namespace) -> None:
    """Print the CPU time of the stages on 150 mushrooms."""
    frame = frames(TIMED, 7, "a", 1, options.cache)[0]
    found, _ = true_circles(frame)
    circles = found.take(np.argsort(-found.radius, kind="stable")[:150])
    surface, nearest, fuse, pick = SurfaceFit(), NearestDepth(), FuseDepth(), MakePicks()
    located = surface.process(frame, circles)
    calls: dict[str, Callable[[], object]] = {
        "nearest-depth": lambda: nearest.process(frame, circles),
        "surface-fit": lambda: surface.process(frame, circles),
        "picks": lambda: pick.process(frame, circles, located),
        "fuse-depth": lambda: fuse.process(replace(frame)),
        "depth-correct": lambda: CORRECT.process(replace(frame)),
    }
    for name, call in calls.items():
        spent = []
        for _ in range(options.repeats):
            start = time.thread_time()
            call()
            spent.append(time.thread_time() - start)
        print(f"{name:14s} {1e3 * np.median(spent):6.2f} ms of CPU for {len(circles)} mushrooms, "
              f"at best {1e3 * min(spent):.2f}")  # fmt: skip


def main() -> None:
    """Print everything that is asked for."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--family", choices=["a", "b"], default="a")
    parser.add_argument("--seeds", default="30:32", help="first:past the last")
    parser.add_argument("--parts", default="accuracy,fusion,ids,time")
    parser.add_argument("--repeats", type=int, default=100)
    parser.add_argument("--cache", type=Path, help="folder that keeps rendered frames")
    options = parser.parse_args()
    parts = options.parts.split(",")
    if "accuracy" in parts:
        accuracy(options)
    if "fusion" in parts:
        fusion(options)
    if "ids" in parts:
        steps(options)
    if "time" in parts:
        times(options)


if __name__ == "__main__":
    main()
