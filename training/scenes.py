"""Simulated scenes by name, for training (family a), choosing (family a) and judging (family b)."""

from __future__ import annotations

import pickle
from collections.abc import Collection, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from mushpipe import RgbdFrame
from mushpipe.core.truth import TRUTH_TOPIC, Truth
from mushpipe.evaluate.truth import truth_of_recording
from mushpipe.sources.mcap import McapSource
from mushpipe.sources.synthetic import SyntheticSource

CONDITIONS: dict[str, dict[str, Any]] = {
    "even": {},
    "gradient": {"light": "gradient", "light_strength": 0.95},
    "dense": {"count": 150, "cluster": 1.0},
    "brown": {"cap_color": "brown"},
    "tilted": {"tilt_deg": (10, 40), "stumps": 4},
    "fallen": {"tilt_deg": (10, 40), "stumps": 6, "fallen": 3},
    "mixed": {"cap_color": "mixed"},
    "cream": {"cap_color": "cream", "tray": True},
    "side": {"light": "side"},
    "spot": {"light": "spot"},
    "harsh": {"light": "harsh"},
    "near": {"distance": 0.32, "count": 35},
    "far": {"distance": 0.8, "count": 150},
    "oblique": {"camera_tilt_deg": 18, "tilt_deg": (5, 40)},
    "lab": {"scene": "lab", "count": 9},
    "cloth": {"scene": "lab", "count": 9, "table": "cloth"},
    "paint": {"scene": "lab", "count": 9, "table": "paint"},
    "empty": {"count": 0, "mycelium": 1.0, "stumps": 8},
    "bare": {"scene": "lab", "count": 1, "clutter": 12},
    "wood": {
        "scene": "lab",
        "cap_color": "wood",
        "count": 8,
        "distance": 0.3,
        "lean": 0.7,
        "size_mm": (30, 60),
        "tilt_deg": (0, 30),
    },
    "low": {"sunk": 1, "relief_mm": 4, "rubble": 40},
    "lids": {"lids": 15, "relief_mm": 2, "count": 60},
    "few": {"scene": "lab", "count": 3, "clutter": 6},
    "picked": {"count": 5, "stumps": 10, "rubble": 20, "pins": 10},
    "old": {
        "old": 0.7,
        "cap_color": "mixed",
        "deform": 0.5,
        "count": 50,
        "size_mm": (20, 65),
        "tilt_deg": (0, 25),
        "lids": 4,
        "relief_mm": 2,
    },
    "cut": {
        "stumps": 14,
        "fresh": 0.8,
        "count": 35,
        "tilt_deg": (0, 25),
        "lean": 0.5,
        "mycelium": 0.8,
    },
}

# How many frames of each condition a training run takes, seeds from 0 on.
TRAINING = {
    "even": 8, "gradient": 5, "dense": 8, "brown": 6, "tilted": 8, "mixed": 4, "cream": 2,
    "side": 3, "spot": 2, "harsh": 4, "near": 4, "far": 3, "oblique": 4, "lab": 4, "cloth": 2,
    "paint": 2, "empty": 3, "bare": 3, "fallen": 6, "wood": 6,
    "low": 8, "lids": 6, "old": 10, "cut": 10,
}  # fmt: skip
# How many more of them, for what can learn from rare scenes without forgetting the usual ones.
MORE = {"near": 2, "lab": 4, "cloth": 2, "paint": 2, "bare": 7, "wood": 2, "lids": 2}
# How many frames with few caps, of which other things are as many, seeds from `FEW_SEED` on.
FEW = {"bare": 24, "lab": 8, "cloth": 6, "paint": 6, "wood": 8, "few": 16, "picked": 20}
CHOOSING = {
    "even": 3, "gradient": 3, "dense": 3, "brown": 3, "tilted": 4, "harsh": 2, "near": 1,
    "oblique": 1, "lab": 2, "empty": 1, "bare": 1, "fallen": 2, "wood": 2,
    "low": 3, "lids": 2, "old": 4, "cut": 4,
}  # fmt: skip
JUDGED = ("even", "gradient", "dense", "brown", "tilted", "side", "harsh", "lab", "empty", "bare",
          "fallen", "wood", "low", "lids", "old", "cut")  # fmt: skip
CHOOSING_SEED, FEW_SEED, JUDGING_SEED = 900, 2000, 5000


@dataclass(frozen=True)
class Case:
    """One simulated frame with its truth."""

    condition: str
    family: str
    seed: int
    frame: RgbdFrame
    truth: Truth


def render(condition: str, family: str, seed: int, cache: Path) -> Case:
    """Return a frame, from the cache folder where it was rendered before."""
    settings = CONDITIONS[condition] | {"seed": seed, "shape_family": family, "max_frames": 1}
    return stored(cache / f"{condition}-{family}-{seed}.pickle", condition, settings)


def stored(path: Path, condition: str, settings: dict[str, Any]) -> Case:
    """Return the frame that settings make, from a file where it was rendered before."""
    if path.exists():
        case: Case = pickle.loads(path.read_bytes())
        return case
    frame = next(SyntheticSource(**settings).frames())
    family, seed = settings["shape_family"], settings["seed"]
    case = Case(condition, family, seed, frame, frame.attached[TRUTH_TOPIC])
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(pickle.dumps(case))
    return case


def recorded_cases(path: Path) -> Iterator[Case]:
    """Yield the frames of a recording that carries its truth; its name is the condition."""
    source, known = McapSource(path=path), truth_of_recording(path)
    source.open()
    for frame in source.frames():
        place = known.place(frame.header)
        if place is not None:
            truth = known.frames[place].caps
            yield Case(path.stem, "", frame.header.sequence, frame, truth)


def _cases(counts: dict[str, int], first: int, apart: int, cache: Path) -> Iterator[Case]:
    """Yield so many frames of each condition, whose seeds begin so far apart."""
    for number, (condition, count) in enumerate(counts.items()):
        for k in range(count):
            yield render(condition, "a", first + apart * number + k, cache)


def training_cases(cache: Path) -> Iterator[Case]:
    """Yield the frames that the verifier is trained on."""
    return _cases(TRAINING, 0, 20, cache)


def more_cases(cache: Path) -> Iterator[Case]:
    """Yield more frames for training, as `MORE` says."""
    for number, (condition, count) in enumerate(TRAINING.items()):
        for k in range(count, count + MORE.get(condition, 0)):
            yield render(condition, "a", 20 * number + k, cache)


def few_cases(cache: Path) -> Iterator[Case]:
    """Yield frames for training in which few caps are seen, as `FEW` says."""
    return _cases(FEW, FEW_SEED, 50, cache)


def choosing_cases(cache: Path) -> Iterator[Case]:
    """Yield frames for choices of design: the family that was trained on, other seeds."""
    return _cases(CHOOSING, CHOOSING_SEED, 5, cache)


def judging_cases(
    cache: Path, count: int = 3, tables: int = 1, only: Collection[str] = JUDGED
) -> Iterator[Case]:
    """Yield frames for judging only: per condition `count` of each family, unseen seeds.

    Tables hold few caps: so many times as many frames of them.
    """
    for number, condition in enumerate(JUDGED):
        if condition not in only:
            continue
        times = tables if CONDITIONS[condition].get("scene") == "lab" else 1
        for family in "ab":
            for k in range(times * count):
                yield render(condition, family, JUDGING_SEED + 20 * number + k, cache)
