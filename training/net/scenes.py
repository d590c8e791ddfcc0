"""Simulated frames that vary in everything the simulator can vary, of shape family a, deformed.

`python -m training.net.scenes` renders them ahead of the training; family b is left for judging.
"""

from __future__ import annotations

import argparse
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import cv2
import numpy as np

from mushpipe.core.arrays import Bools, Bytes, Floats
from mushpipe.core.truth import INSTANCES_TOPIC, TRUTH_TOPIC, Ignore, Instances, Truth
from mushpipe.sources.synthetic import SyntheticSource
from training.scenes import Case, stored

TRAINING_SEED, TABLES_SEED, VALIDATION_SEED, JUDGING_SEED = 200_000, 201_000, 300_000, 400_000
VERIFIER_SEED, CHOOSING_SEED = 500_000, 510_000  # family a
SPARSE_SEED, SPARSE_JUDGING_SEED = 600_000, 610_000
CLUTTERED_SEED, LONE_SEED = 630_000, 632_000
TRAINING, VALIDATION = 640, 60
# What `training.net.tables` learns from: frames of the training, and tables with few caps.
FAMILIAR = [seed + k for seed in (TRAINING_SEED, TABLES_SEED) for k in range(250)]
CLUTTERED = [*range(CLUTTERED_SEED, CLUTTERED_SEED + 600), *range(LONE_SEED, LONE_SEED + 700)]


@dataclass(frozen=True)
class Picture:
    """A frame to learn from.

    Attributes:
        color: (H, W, 3) uint8 RGB.
        cap: (H, W) bool, pixels of caps.
        circles: (N, 3) px: centre and radius of each outline.
        kind: (N,) `Ignore`.
        visible: (N,) 0..1.
    """

    color: Bytes
    cap: Bools
    circles: Floats
    kind: Bytes
    visible: Floats


def settings(seed: int) -> dict[str, Any]:
    """Draw the settings of a scene.

    A quarter of them are tables; half, from `TABLES_SEED` on in the training: there is less on one.
    """
    rng = np.random.default_rng([seed, 8])

    def log(low: float, high: float) -> float:
        return float(np.exp(rng.uniform(np.log(low), np.log(high))))

    def some(share: float, most: float) -> float:
        return float(rng.uniform(0, most)) if rng.random() < share else 0.0

    distance, small, tilt = log(0.28, 0.85), rng.uniform(10, 30), rng.uniform(0, 15)
    count = 0 if rng.random() < 0.05 else log(6, 120) * (distance / 0.5) ** 2
    lab = rng.random() < (0.5 if TABLES_SEED <= seed < VALIDATION_SEED else 0.25)
    drawn = {
        "seed": seed,
        "max_frames": 1,
        "scene": "lab" if lab else "bed",
        "printed": rng.random() < 0.3,
        "table": str(rng.choice(["wood", "cloth", "paint"])),
        "clutter": int(rng.integers(0, 13)),
        "distance": distance,
        "camera_tilt_deg": some(0.5, 20),
        "count": round(min(count * (0.4 if lab else 1), 200)),
        "cluster": float(rng.random()),
        "size_mm": (small, small + rng.uniform(5, 45)),
        "tilt_deg": (tilt, tilt + rng.uniform(5, 30)),
        "cap_color": str(rng.choice(["white", "brown", "cream", "mixed"], p=[0.3, 0.4, 0.1, 0.2])),
        "pins": round(some(0.3 if lab else 0.8, 120)),
        "stumps": round(some(0.6, 14)),
        "fallen": round(some(0.5, 6)),
        "lean": some(0.7, 1),
        "deform": rng.uniform(0.2, 1),
        "mycelium": some(0.8, 1),
        "soil": log(0.3, 6),
        "wet": some(0.4, 1),
        "relief_mm": some(0.7, 6),
        "rubble": round(some(0.75, 130)),
        "foreign": round(some(0.35, 6)),
        "tray": rng.random() < 0.2,
        "light": str(rng.choice(["even", "gradient", "side", "spot", "harsh"])),
        "light_strength": rng.uniform(0.2, 1),
        "color": {
            "exposure": rng.uniform(-1.2, 0.7),
            "blur": rng.uniform(0.2, 1.4),
            "vignette": rng.uniform(0, 0.7),
            "white_balance": some(0.7, 0.15),
            "noise": log(0.4, 4),
            "jpeg_quality": int(rng.choice([0, 60, 80, 92])),
        },
    }
    if lab and rng.random() < 0.5:  # models turned from wood
        drawn |= {"cap_color": "wood", "printed": True, "table": "wood"}
        drawn |= {"count": int(rng.integers(3, 25)), "size_mm": (small + 10, small + 50)}
    return drawn | {"sunk": some(0.4, 1), "lids": round(some(0.3, 10))}


def sparse(seed: int) -> dict[str, Any]:
    """Draw the settings of a bed with few caps or none, on which other things are more."""
    drawn, rng = settings(seed), np.random.default_rng([seed, 9])
    count = 0 if rng.random() < 0.5 else int(rng.integers(1, 7))
    small, large = drawn["size_mm"]
    color = drawn["cap_color"]
    return drawn | {
        "scene": "bed",
        "count": count,
        "pins": int(rng.integers(0, 30)) if count and rng.random() < 0.4 else 0,
        "fallen": 0,
        "rubble": int(rng.integers(0, 160)),
        "stumps": int(rng.integers(0, 12)),
        "fresh": float(rng.uniform(0, 0.6)) if rng.random() < 0.4 else 0.0,
        "foreign": int(rng.integers(1, 5)) if rng.random() < 0.25 else 0,
        "lids": 0,
        "printed": False,
        "cap_color": "brown" if color == "wood" else color,
        "size_mm": (max(12, small), max(20, large)),
        "pebbles": int(rng.integers(0, 80)) if rng.random() < 0.4 else 0,
    }


def cluttered(seed: int) -> dict[str, Any]:
    """Draw the settings of a table with few caps and more of other things.

    From `LONE_SEED` on there are two caps at most.
    """
    drawn, rng = settings(seed), np.random.default_rng([seed, 10])
    color = drawn["cap_color"]
    drawn |= {
        "scene": "lab",
        "count": int(rng.integers(0, 7)),
        "clutter": int(rng.integers(3, 14)),
        "table": str(rng.choice(["wood", "cloth", "paint"])),
        "pins": 0,
        "stumps": int(rng.integers(0, 3)),
        "fallen": int(rng.integers(0, 2)),
        "lids": 0,
    }
    if rng.random() < 0.3:
        drawn |= {"cap_color": "wood", "printed": True, "size_mm": (25, 60)}
    elif color == "wood":
        drawn["cap_color"] = "brown"
    if seed >= LONE_SEED:
        rng = np.random.default_rng([seed, 12])
        drawn |= {"count": int(rng.integers(0, 3)), "clutter": int(rng.integers(5, 14))}
        drawn["fallen"] = 0
    return drawn


def picture(seed: int, cache: Path) -> Picture:
    """Return a frame, from the cache folder where it was rendered before."""
    path = cache / f"{seed}.npz"
    if not path.exists():
        _render(seed, path)
    with np.load(path) as file:
        color = cv2.imdecode(file["color"], cv2.IMREAD_COLOR_RGB)
        cap = np.asarray(cv2.imdecode(file["cap"], cv2.IMREAD_GRAYSCALE), np.uint8) > 0
        return Picture(
            np.asarray(color, np.uint8), cap, file["circles"], file["kind"], file["visible"]
        )


def _render(seed: int, path: Path) -> None:
    drawn = cluttered(seed) if seed >= CLUTTERED_SEED else settings(seed)
    frame = next(SyntheticSource(**drawn).frames())
    truth, instances = frame.attached[TRUTH_TOPIC], frame.attached[INSTANCES_TOPIC]
    path.parent.mkdir(parents=True, exist_ok=True)
    part = path.with_suffix(".part.npz")
    np.savez(
        part,
        color=cv2.imencode(".png", frame.color[..., ::-1])[1],
        cap=cv2.imencode(".png", cap_mask(truth, instances).astype(np.uint8))[1],
        circles=np.column_stack([truth.center, truth.radius]),
        kind=truth.ignore,
        visible=truth.visible,
    )
    part.rename(path)


def cap_mask(truth: Truth, instances: Instances) -> Bools:
    """Return the pixels (H, W) of caps; those of cut stumps are none."""
    return np.append(False, truth.ignore != Ignore.CUT_STUMP)[instances.labels]


def pictures(first: int, count: int, cache: Path) -> Iterator[Picture]:
    """Yield the frames of `count` seeds from `first` on."""
    for seed in range(first, first + count):
        yield picture(seed, cache)


def varied_cases(cache: Path, first: int, family: Literal["a", "b"], count: int) -> Iterator[Case]:
    """Yield as varied frames with depth, of `count` seeds from `first` on."""
    for seed in range(first, first + count):
        drawn = settings(seed) | {"shape_family": family}
        yield stored(cache / f"varied-{family}-{seed}.pickle", "varied", drawn)


def sparse_cases(cache: Path, first: int, family: Literal["a", "b"], count: int) -> Iterator[Case]:
    """Yield frames of `sparse` beds with depth, of `count` seeds from `first` on."""
    for seed in range(first, first + count):
        drawn = sparse(seed) | {"shape_family": family}
        yield stored(cache / f"sparse-{family}-{seed}.pickle", "sparse", drawn)


def main() -> None:
    """Read the command line."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--cache", type=Path, default=Path("out/net"), help="rendered frames")
    parser.add_argument("--frames", type=int, default=TRAINING, help="to train on")
    parser.add_argument("--tables", action="store_true", help="those of training.net.tables")
    parser.add_argument("--part", type=int, default=0, help="this process' number")
    parser.add_argument("--of", type=int, default=1, help="how many processes share the work")
    arguments = parser.parse_args()
    seeds = [*range(VALIDATION_SEED, VALIDATION_SEED + VALIDATION)]
    if arguments.tables:
        seeds += FAMILIAR + CLUTTERED
    else:
        seeds += range(TRAINING_SEED, TRAINING_SEED + arguments.frames)
    for seed in seeds[arguments.part :: arguments.of]:
        picture(seed, arguments.cache)


if __name__ == "__main__":
    main()
