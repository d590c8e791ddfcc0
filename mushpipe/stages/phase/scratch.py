"""Room that the detector's kernels work in, made once for all outlines of a frame."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from mushpipe.core.arrays import Floats, Ints32, Singles
from mushpipe.core.jit import jit
from mushpipe.stages.verifier_net import WIDTHS

DIRECTIONS = 96  # in which an outline is looked at, at most
FIRST, SECOND = WIDTHS


class Scratch(NamedTuple):
    """Room to work in, made once for all outlines.

    Attributes:
        rows: (M,) of edge points, M their number.
        near: (M,) what is known of them.
        off: (DIRECTIONS,) distances of hits, in 1/1000 px.
        under: (DIRECTIONS,) whether accepted outlines cover a direction.
        lanes: (2, DIRECTIONS) of whatever has a number per direction.
        a: (5, 5) normal matrix.
        b: (5,) its right side.
        first: (H,) hidden units of a verifier.
        second: (K,) those of its next layer.
    """

    rows: Ints32
    near: Ints32
    off: Ints32
    under: Ints32
    lanes: Singles
    a: Floats
    b: Floats
    first: Singles
    second: Singles


@jit
def scratch_for(count: int) -> Scratch:
    """Return room to work in with so many edge points."""
    rows, lanes = np.empty((2, count), np.int32), np.empty((2, DIRECTIONS), np.int32)
    planes = np.empty((2, DIRECTIONS), np.float32)
    first, second = np.empty(FIRST, np.float32), np.empty(SECOND, np.float32)
    a, b = np.empty((5, 5)), np.empty(5)
    return Scratch(rows[0], rows[1], lanes[0], lanes[1], planes, a, b, first, second)
