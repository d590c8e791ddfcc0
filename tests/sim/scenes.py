"""Hand-made mushrooms whose truth is known in closed form."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from mushpipe.sim.mushroom import Kind, Mushroom
from mushpipe.sim.shapes import CapShape, Warp

BALL = CapShape("a", 1.0, (2.0,), 1.0, 0.999, True, Warp())


def ball(
    center: Sequence[float],
    radius: float,
    axis: Sequence[float] = (0.0, 0.0, 1.0),
    kind: Kind = Kind.GROWING,
    shape: CapShape = BALL,
) -> Mushroom:
    """A mushroom whose cap is a whole sphere."""
    middle, foot = np.array(center, float), np.array([*center[:2], 0.0])
    along = np.array(axis, float) / np.linalg.norm(axis)
    return Mushroom(kind, middle, along, 0.3, radius, shape, foot, radius / 3, (0.8, 0.8, 0.8))
