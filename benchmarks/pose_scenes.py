"""Simulated scenes to measure pose and location on, and circles as a detector finds them."""

from __future__ import annotations

import hashlib
import json
import pickle
from pathlib import Path
from typing import Any

import numpy as np

from mushpipe import Circles, RgbdFrame
from mushpipe.core.truth import TRUTH_TOPIC, Ignore, Truth
from mushpipe.sources.synthetic import SyntheticSource

_HARD = {"size_mm": (20, 60), "tilt_deg": (0, 45), "cluster": 0.4}
# name -> scenes that are pooled
SETS: dict[str, list[dict[str, Any]]] = {
    "paper": [{"distance": 0.33, "size_mm": (34, 48), "tilt_deg": (0, 30), "count": 14}],
    "bed": [{"distance": 0.53, "size_mm": (30, 60), "tilt_deg": (0, 25), "count": 40}],
    "hard": [
        {"distance": distance, "count": count, **_HARD}
        for distance, count in ((0.25, 12), (0.35, 18), (0.5, 24), (0.65, 24), (0.8, 24))
    ],
    "upright": [{"distance": 0.5, "size_mm": (25, 55), "tilt_deg": (0, 5), "count": 40}],
    "crowded": [{"distance": 0.5, "size_mm": (25, 55), "tilt_deg": (0, 25), "count": 90,
                 "cluster": 0.95}],
}  # fmt: skip
SEEN = (Ignore.COUNTS, Ignore.HIDDEN, Ignore.TOO_LARGE, Ignore.AT_BORDER)


def frames(scene: dict[str, Any], seed: int, family: str, count: int, cache: Path | None,
           **more: Any) -> list[RgbdFrame]:  # fmt: skip
    """Render frames of a scene, or take them from the cache."""
    settings = {"pins": 0, "light_strength": 0, "largest_px": 160, **scene, **more}
    settings |= {"seed": seed, "shape_family": family, "max_frames": count}
    key = hashlib.sha256(json.dumps(settings, sort_keys=True).encode()).hexdigest()[:20]
    path = cache / f"{key}.pickle" if cache else None
    if path and path.exists():
        stored: list[RgbdFrame] = pickle.loads(path.read_bytes())
        return stored
    source = SyntheticSource.model_validate(settings).frames()
    taken = [next(source) for _ in range(count)]
    if path:
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_bytes(pickle.dumps(taken))
    return taken


def truth_of(frame: RgbdFrame) -> Truth:
    """Return the truth of a simulated frame."""
    truth = frame.attached[TRUTH_TOPIC]
    assert isinstance(truth, Truth)
    return truth


def circles_in(truth: Truth, seed: int, exact: bool) -> tuple[Circles, np.ndarray]:
    """Return circles of all visible caps, and the rows of the truth they are.

    As a detector finds them: centres 1 to 2 px off in any direction, radii up to 1.5 px.
    """
    rows = np.flatnonzero((truth.visible > 0.3) & (truth.radius > 7) & np.isin(truth.ignore, SEEN))
    rng = np.random.default_rng(seed)
    n = len(rows)
    turn, off = rng.uniform(0, 2 * np.pi, n), rng.uniform(1, 2, n)
    shift = off[:, None] * np.stack([np.cos(turn), np.sin(turn)], axis=1)
    grow = rng.uniform(-1.5, 1.5, n)
    if exact:
        shift, grow = np.zeros_like(shift), np.zeros_like(grow)
    return Circles(truth.center[rows] + shift, truth.radius[rows] + grow, np.ones(n)), rows
