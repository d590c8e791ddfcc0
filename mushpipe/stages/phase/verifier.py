"""The verifier of `phase-hough`: its models, by what is known of a candidate."""

from __future__ import annotations

from pathlib import Path

from mushpipe.stages.phase.features import NAMES
from mushpipe.stages.verifier import package_file
from mushpipe.stages.verifier_net import Models, read_models

FILE = "verifier.npz"


def load_verifier(path: Path | None = None, literal: bool = False) -> Models:
    """Read the four models of a verifier from a file, by default the package's own.

    They are for candidates without depth and with depth, then for the same beside another
    detector's circles. `literal` is for edges of the mask, whose candidates have no depth.

    Raises:
        UsageError: It is none; see `read_models`.
    """
    names = ["mask" if literal else "image", "depth", "image_learned", "depth_learned"]
    return read_models(path or package_file(FILE), names, NAMES)
