"""The verifier of `phase-hough`: its models, by what is known of a candidate."""

from __future__ import annotations

from dataclasses import dataclass, fields
from pathlib import Path

import numpy as np

from mushpipe.stages.phase_features import NAMES
from mushpipe.stages.phase_refit import Table
from mushpipe.stages.verifier import package_file, read_models

FILE = "verifier.yaml"


@dataclass(frozen=True, eq=False)
class Verifier:
    """Weights of models, each (F + 1, 4) as `weights_of`.

    ``image`` and ``mask`` are for candidates without depth, ``depth`` for those with, ``low`` for
    those that hardly stand out from the bed; ``.._learned`` beside another detector's circles.
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
        UsageError: It is none; see `read_models`.
    """
    names = [field.name for field in fields(Verifier)]
    return Verifier(**read_models(path or package_file(FILE), names, NAMES))
