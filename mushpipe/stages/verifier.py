"""The verifier: logistic models over named features, read from a file of the package.

`training/verifier.py` makes the file from the simulator alone.
"""

from __future__ import annotations

from dataclasses import dataclass, fields
from importlib import resources
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from mushpipe.stages.phase_features import NAMES
from mushpipe.stages.phase_refit import Table

FILE = "verifier.yaml"
COLUMNS = ("mean", "scale", "weight", "square")


@dataclass(frozen=True, eq=False)
class Verifier:
    """Weights of models, each (F + 1, 4).

    ``image`` and ``mask`` are for candidates without depth, ``depth`` for those with, ``low`` for
    those that hardly stand out from the bed; ``.._learned`` beside another detector's circles.

    Row k holds mean, scale, weight and weight of the square of feature k, the last row the
    intercept as its weight. A feature that a model does not name has no weight in it.
    """

    image: Table
    depth: Table
    low: Table
    mask: Table
    image_learned: Table
    depth_learned: Table
    low_learned: Table

    def stacked(self, literal: bool) -> Table:
        """Return (6, F + 1, 4): without depth, with, low, then beside another detector.

        `literal` is for edges of the mask, whose candidates have no depth.
        """
        alone = (self.mask if literal else self.image, self.depth, self.low)
        return np.stack([*alone, self.image_learned, self.depth_learned, self.low_learned])


def load_verifier(path: Path | None = None) -> Verifier:
    """Read a verifier from a file, by default the package's own.

    Raises:
        ValueError: The file names a feature that does not exist, or lacks a model.
    """
    text = (path or resources.files("mushpipe.stages") / FILE).read_text(encoding="utf-8")
    content = yaml.safe_load(text)
    missing = {field.name for field in fields(Verifier)} - set(content["models"])
    if missing:
        raise ValueError(f"the verifier lacks the models {sorted(missing)}")
    return Verifier(**{name: weights_of(model) for name, model in content["models"].items()})


def weights_of(model: dict[str, Any]) -> Table:
    """Return the weights of a model as it stands in the file.

    Raises:
        ValueError: It names a feature that does not exist.
    """
    unknown = set(model["features"]) - set(NAMES)
    if unknown:
        raise ValueError(f"the verifier names unknown features {sorted(unknown)}")
    weights = np.zeros((len(NAMES) + 1, len(COLUMNS)))
    weights[:, 1] = 1
    for name, values in model["features"].items():
        weights[NAMES.index(name)] = [values[column] for column in COLUMNS]
    weights[-1, 2] = model["intercept"]
    return weights
