"""Frames of the simulator and of real recordings, small enough for exact references."""

from __future__ import annotations

import os
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from mushpipe import RgbdFrame
from mushpipe.core.truth import INSTANCES_TOPIC
from mushpipe.sources.mcap import McapSource
from mushpipe.sources.synthetic import SyntheticSource

RECORDINGS = ("white-bed-0", "beds-colour-only", "desk-june", "desk-july")
SIMULATED = Path(__file__).parents[2] / "recordings"


@cache
def simulated(seed: int, **settings: Any) -> RgbdFrame:
    """One frame of 320 x 240 px of a bed with 30 mushrooms, if not said otherwise."""
    scene: dict[str, Any] = {"width": 320, "height": 240, "count": 30, **settings}
    return next(SyntheticSource(seed=seed, max_frames=1, **scene).frames())


def truth_of(frame: RgbdFrame) -> np.ndarray:
    """The pixels of all mushrooms of a simulated frame."""
    return np.asarray(frame.attached[INSTANCES_TOPIC].labels > 0)


def field_data() -> Path:
    """The folder of real recordings, or a skip."""
    folder = os.environ.get("MUSHPIPE_FIELD_DATA")
    if folder is None:
        pytest.skip("MUSHPIPE_FIELD_DATA does not name a folder of real recordings")
    return Path(folder)


def recorded(name: str) -> list[RgbdFrame]:
    """The frames of a real recording."""
    path = field_data() / f"{name}.mcap"
    if not path.is_file():
        pytest.skip(f"there is no {path}")
    return list(McapSource(path=path).frames())


def first(name: str) -> RgbdFrame:
    """The first frame of one of the project's recordings."""
    return next(iter(McapSource(path=SIMULATED / f"{name}.mcap").frames()))


def iou(found: np.ndarray, truth: np.ndarray) -> float:
    """Intersection over union of two masks."""
    return float((found & truth).sum() / max(1, (found | truth).sum()))
