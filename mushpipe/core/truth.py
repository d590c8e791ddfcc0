"""What is really there: the truth a simulator or an annotator knows, one row per mushroom.

It travels beside the frames of a recording, on topics of its own, and never reaches a stage.
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import IntEnum

import numpy as np
from numpy.typing import NDArray

from mushpipe.core.arrays import Bytes, Floats, Ints, locked
from mushpipe.core.columns import Columns, column
from mushpipe.core.tables import Circles, Locations, Picks, Poses, first_of

TRUTH_TOPIC = "/truth/mushrooms"
INSTANCES_TOPIC = "/truth/instances"


class Ignore(IntEnum):
    """Why finding or missing a mushroom counts neither way."""

    COUNTS = 0
    HIDDEN = 1
    TOO_SMALL = 2
    TOO_LARGE = 3
    AT_BORDER = 4
    NOT_UPRIGHT = 5
    CUT_STUMP = 6
    AMBIGUOUS = 7


@dataclass(frozen=True, eq=False)
class Truth(Columns):
    """The true mushrooms of a frame, in the camera's optical frame; NaN where not known.

    Attributes:
        id: (N,) number of the mushroom, the same in all frames of a recording.
        center: (N, 2) px, centre of the amodal outline of the cap: as if nothing hid it.
        radius: (N,) px, of the circle with the area of that outline.
        visible: (N,) 0..1, share of the outline's area that is seen.
        apex: (N, 3) m, top of the cap on its axis.
        surface: (N, 3) m, the cap's surface on the ray of `center`, as if nothing hid it.
        axis: (N, 3) unit cap normal pointing out of the cap.
        diameter: (N,) m, of the circle with the area of the cap seen along its axis.
        diameter_max: (N,) m, largest extent of the cap across its axis.
        ignore: (N,) `Ignore`, 0 where the mushroom counts.
    """

    id: Ints = column(dtype=np.int64)
    center: Floats = column(2)
    radius: Floats = column()
    visible: Floats = column()
    apex: Floats = column(3)
    surface: Floats = column(3)
    axis: Floats = column(3)
    diameter: Floats = column()
    diameter_max: Floats = column()
    ignore: Bytes = column(dtype=np.uint8)

    def check(self) -> None:
        """Outlines are known, fractions within 0..1, axes of length 1."""
        self._require(np.isfinite(self.center), "the centre must be finite")
        self._require((self.radius > 0) & np.isfinite(self.radius), "the radius must be positive")
        self._require(~((self.visible < 0) | (self.visible > 1)), "visible must be within 0..1")
        norm = np.linalg.norm(self.axis, axis=1)
        self._require(~(np.abs(norm - 1) > 1e-6), "axis must have length 1")

    def check_rows(self) -> None:
        """Ids are unique."""
        self._require(first_of(self.id), "ids must be unique")


BUILT_IN = (Circles, Locations, Poses, Picks, Truth)
"""The tables that recordings know by name."""
TABLE = "table"
"""Metadata of a topic: which of them its table is, where that is a subtype of a plugin's."""


def stands_for(table: type[Columns]) -> dict[str, str]:
    """Return the metadata of a topic of tables: none, where its schema says all."""
    base = next((base for base in table.__mro__ if base in BUILT_IN), table)
    return {} if base is table else {TABLE: f"mushpipe.{base.__name__}"}


@dataclass(frozen=True, eq=False)
class Instances:
    """Which pixel belongs to which mushroom: (H, W) uint16, 0 for none, else 1 + row of `Truth`."""

    labels: NDArray[np.uint16]

    def __post_init__(self) -> None:
        labels = locked(self.labels, None)
        if labels.dtype != np.uint16 or labels.ndim != 2:
            raise ValueError(f"Instances.labels is {labels.dtype}{labels.shape}, expected uint16")
        object.__setattr__(self, "labels", labels)
