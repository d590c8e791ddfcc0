"""How far off axes, apexes, diameters and surface points are, method by method.

    python benchmarks/pose_accuracy.py --family b --seeds 5000:5006

One row per set and method, and one for all sets together: tilt error in degrees (angle between
axes, no absolute value that would hide a flip), mean z^2 of the stated sigmas, the rest in mm.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable
from pathlib import Path

import numpy as np
from pose_scenes import SETS, detected, frames, true_circles, truth_of

from mushpipe import Circles, Locations, Poses, RgbdFrame, quaternion_from_axis
from mushpipe.stages.cap_fit import CapFit
from mushpipe.stages.depth_correct import DepthCorrect
from mushpipe.stages.fuse_depth import FuseDepth
from mushpipe.stages.nearest_depth import NearestDepth
from mushpipe.stages.registration import Registration
from mushpipe.stages.upright import pixel_rays, upright

EXACT = {
    "offset_mm": 0, "noise": 0, "shadow": False, "grazing": False, "highlights": False,
    "cap_holes": 0, "random_holes": 0, "edges": False,
}  # fmt: skip
FLOOR = {
    "edge_offset_px": 0,
    "depth_noise_mm": 0.05,
    "depth_noise_per_m": 0,
    "circle_sigma_px": 0.3,
}
SLOW = ("registration", "ICP")
Method = Callable[[list[RgbdFrame], Circles], tuple[Locations, Poses]]


def fitted(fused: bool, **settings: float) -> Method:
    """Return cap-fit on the first frame, or on the mean of all."""
    stage = CapFit.model_validate({"depth_bias_mm": 2.85, **settings})
    stage.open()

    def run(taken: list[RgbdFrame], circles: Circles) -> tuple[Locations, Poses]:
        frame, fuse = taken[0], FuseDepth()
        if fused:
            for one in taken:
                frame = fuse.process(one)
        locations, poses, _ = stage.process(frame, circles)
        return locations, poses

    return run


def registered(**settings: str) -> Method:
    """Return the paper's localisation and registration."""
    stage = Registration.model_validate(settings)
    stage.open()

    def run(taken: list[RgbdFrame], circles: Circles) -> tuple[Locations, Poses]:
        frame = DepthCorrect(offset_mm=2.85).process(taken[0])
        locations = NearestDepth().process(frame, circles)
        return locations, stage.process(frame, circles, locations, np.random.default_rng(0))

    return run


def trivial(kind: str) -> Method:
    """Return the answer that looks at nothing: the bed's normal, or towards the camera."""

    def run(taken: list[RgbdFrame], circles: Circles) -> tuple[Locations, Poses]:
        frame = DepthCorrect(offset_mm=2.85).process(taken[0])
        locations = NearestDepth().process(frame, circles)
        axis = -locations.position / locations.distance[:, None]
        if kind == "bed" and frame.camera:
            depth = np.fmax(frame.depth_m, np.float32(0))
            axis = np.where(np.isnan(axis), np.nan, upright("bed", depth, pixel_rays(frame.camera)))
        turn, nan = quaternion_from_axis(axis), np.full(len(circles), np.nan)
        known = np.asarray(np.isfinite(axis).all(axis=1))
        return locations, Poses(turn, axis, locations.position, nan, nan, known)

    return run


class Tally:
    """Errors of one method over many mushrooms."""

    def __init__(self) -> None:
        self.rows: list[np.ndarray] = []
        self.missing = 0

    def add(self, locations: Locations, poses: Poses, frame: RgbdFrame, rows: np.ndarray) -> None:
        """Take in one frame; `rows` are the truth's rows of the circles, -1 for none."""
        truth = truth_of(frame)
        counts = (rows >= 0) & (truth.ignore[rows] == 0)
        self.missing += int((counts & ~poses.valid).sum())
        k, t = np.flatnonzero(counts & poses.valid), rows[counts & poses.valid]
        cosine = np.clip((poses.axis[k] * truth.axis[t]).sum(axis=1), -1, 1)
        self.rows.append(
            np.column_stack([
                np.degrees(np.arccos(cosine)),
                np.degrees(poses.sigma_rad[k]),
                1000 * np.linalg.norm(poses.apex[k] - truth.apex[t], axis=1),
                1000 * (locations.diameter[k] - truth.diameter[t]),
                1000 * locations.sigma_diameter[k],
                1000 * (locations.position[k, 2] - truth.surface[t, 2]),
                1000 * locations.sigma_position[k, 2],
                truth.visible[t],
            ])
        )  # fmt: skip

    def take(self, other: Tally) -> None:
        """Take in what another one has."""
        self.rows += other.rows
        self.missing += other.missing

    def row(self) -> str:
        """Return the table's row."""
        tilt, s_tilt, apex, size, s_size, z, s_z, seen = np.concatenate(self.rows).T
        half = s_tilt <= np.median(s_tilt)
        part = (seen >= 0.7) & (seen < 0.85)
        z2 = [np.mean((e / s) ** 2) for e, s in ((tilt, s_tilt), (size, s_size), (z, s_z))]
        size, z = size[np.isfinite(size)], z[np.isfinite(z)]
        return (
            f"{len(tilt):5d} {self.missing:4d} | {tilt.mean():5.2f} {tilt.std():5.2f} "
            f"{np.median(tilt):5.2f} {np.percentile(tilt, 95):5.1f} {z2[0]:5.2f} "
            f"{tilt[half].mean() if half.any() else np.nan:5.2f} "
            f"{tilt[part].mean() if part.any() else np.nan:5.2f} | {apex.mean():5.2f} | "
            f"{size.mean():+5.2f} {size.std():5.2f} {z2[1]:5.2f} | "
            f"{z.mean():+5.2f} {z.std():5.2f} {np.percentile(np.abs(z), 95):5.2f} {z2[2]:5.2f}"
        )


HEAD = (
    f"{'set':9s} {'method':22s} {'n':>5s} {'miss':>4s} | {'tilt':>5s} {'std':>5s} {'med':>5s} "
    f"{'p95':>5s} {'z2':>5s} {'half':>5s} {'70-85':>5s} | {'apex':>5s} | {'diam':>5s} {'std':>5s} "
    f"{'z2':>5s} | {'Z':>5s} {'std':>5s} {'p95':>5s} {'z2':>5s}"
)


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--family", choices=["a", "b"], default="a")
    parser.add_argument("--seeds", default="11:14", help="first:past the last")
    parser.add_argument("--sets", default="paper,bed,hard,upright,crowded")
    parser.add_argument("--cache", type=Path, help="folder that keeps rendered frames")
    parser.add_argument("--registration", type=int, default=1, help="seeds it is run on (slow)")
    options = parser.parse_args()
    first, last = map(int, options.seeds.split(":"))
    methods: dict[str, Method] = {
        "cap-fit": fitted(False),
        "cap-fit, 5 frames": fitted(True),
        "floor: exact": fitted(False, depth_bias_mm=0, **FLOOR),
        "bed normal": trivial("bed"),
        "towards the camera": trivial("camera"),
        "registration": registered(),
        "registration, cap": registered(model="cap"),
        "ICP from upright, cap": registered(
            **{"model": "cap", "global": "none", "local": "point-to-plane"}
        ),
    }
    print(HEAD)
    pooled = {method: Tally() for method in methods}
    for name in options.sets.split(","):
        tallies = {method: Tally() for method in methods}
        for seed in range(first, last):
            for scene in SETS[name]:
                taken = frames(scene, seed, options.family, 5, options.cache)
                circles, rows = detected(taken[0])
                for method, run in methods.items():
                    if method.startswith(SLOW) and seed - first >= options.registration:
                        continue
                    if method.startswith("floor"):
                        clean = frames(scene, seed, options.family, 1, options.cache, sensor=EXACT)
                        true, same = true_circles(clean[0])
                        tallies[method].add(*run(clean, true), clean[0], same)
                    else:
                        tallies[method].add(*run(taken, circles), taken[0], rows)
        for method, tally in tallies.items():
            if tally.rows:
                print(f"{name:9s} {method:22s} {tally.row()}", flush=True)
                pooled[method].take(tally)
    for method, tally in pooled.items():
        if tally.rows and "," in options.sets:
            print(f"{'all':9s} {method:22s} {tally.row()}")


if __name__ == "__main__":
    main()
