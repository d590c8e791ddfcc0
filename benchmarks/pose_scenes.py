"""Simulated scenes to measure pose and location on, and the circles found in them."""

from __future__ import annotations

import hashlib
import json
import pickle
from functools import lru_cache
from pathlib import Path
from typing import Any, cast

import numpy as np

from mushpipe import Circles, RgbdFrame
from mushpipe.core.document import read_document
from mushpipe.core.graph import compile_document
from mushpipe.core.plugins import load_registry
from mushpipe.core.truth import TRUTH_TOPIC, Ignore, Truth
from mushpipe.evaluate.matching import match
from mushpipe.evaluate.truth import FrameTruth
from mushpipe.sources.synthetic import SyntheticSource
from mushpipe.stages.cap_fit import CapFit
from mushpipe.stages.cap_net import CapNet
from mushpipe.stages.phase_hough import PhaseHough

GRAPH = Path(__file__).parents[1] / "graphs" / "pick.yaml"
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


@lru_cache
def detector() -> tuple[CapNet, PhaseHough, CapFit]:
    """Return the stages of `graphs/pick.yaml` that find and choose circles, of any size."""
    settings = ["detect.radius_px=null", "pose.depth_bias_mm=2.85"]
    plan = compile_document(read_document(GRAPH), load_registry(), settings)
    stages = {node.name: node.plugin for node in plan.stages}
    net, detect = cast(CapNet, stages["net"]), cast(PhaseHough, stages["detect"])
    pose = cast(CapFit, stages["pose"])
    for stage in (net, detect, pose):
        stage.open()
    return net, detect, pose


def found_in(frame: RgbdFrame) -> Circles:
    """Return the circles that are taken for caps, as they were detected."""
    net, detect, pose = detector()
    mask, learned = net.process(frame)
    circles = detect.process(frame, mask, learned)
    if not len(circles) or frame.camera is None:
        return circles
    fits = pose.fit(frame.gray, frame.depth_m, frame.camera, circles)
    return circles.take(pose.scores(frame, circles, fits, learned) >= (pose.min_score or 0.0))


def detected(frame: RgbdFrame) -> tuple[Circles, np.ndarray]:
    """Return the circles that are found, and for each the row of its mushroom, -1 for none."""
    circles = found_in(frame)
    rows = np.full(len(circles), -1)
    matching = match(FrameTruth(truth_of(frame)), circles.center, circles.radius)
    rows[matching.found] = matching.truth
    return circles, rows


def true_circles(frame: RgbdFrame) -> tuple[Circles, np.ndarray]:
    """Return the true circles of all visible caps, and the rows of the truth they are."""
    truth = truth_of(frame)
    rows = np.flatnonzero((truth.visible > 0.3) & (truth.radius > 7) & np.isin(truth.ignore, SEEN))
    return Circles(truth.center[rows], truth.radius[rows], np.ones(len(rows))), rows
