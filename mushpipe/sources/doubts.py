"""What speaks against depth before anything is measured in it."""

from __future__ import annotations

import logging
from collections.abc import Iterator
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mushpipe.core.types import RgbdFrame, end_of_scale

logger = logging.getLogger("mushpipe")
FARTHEST_M = 30.0
COARSE_M = 0.003  # a cap of 30 mm rises by 9
_FEWEST_LEVELS = 6
_FEWEST_EACH = 8  # depths a level: unlike steps, chance seldom meets a level twice


def warned(name: str, frame: RgbdFrame) -> bool:
    """Warn of a recording's depth where it is odd; return whether there is any to be judged by."""
    if frame.depth is None:
        return False
    depth = frame.depth[::8, ::8]
    known = depth[(depth > 0) & (depth < end_of_scale(depth))] * frame.depth_scale
    for doubt in doubts(known):
        logger.warning("%s, frame %d: %s", name, frame.header.sequence, doubt)
    return len(known) > 0


def doubts(depth: NDArray[Any]) -> Iterator[str]:
    """Yield what is odd about depths (N,), m, none of them missing, and what to do about it."""
    if not len(depth):
        return
    if (far := float(np.median(depth))) > FARTHEST_M:
        yield (
            f"half of the depth is beyond {far:.0f} m; where it is in millimetres, set "
            "source.depth_scale: 0.001"
        )
    elif (step := _step(depth)) > COARSE_M:
        yield (
            f"depth comes in steps of {1000 * step:.0f} mm, too coarse for the form of caps, "
            "which may be missed; record it finer (stereo cameras may have a mode called "
            "subpixel), or set source.depth_scale where its unit is another"
        )


def _step(depth: NDArray[Any]) -> float:
    """Return the usual step between depths (N,), m; 0 where they are too few to tell."""
    levels = np.unique(depth)
    if not _FEWEST_LEVELS <= len(levels) <= len(depth) / _FEWEST_EACH:
        return 0.0
    return float(np.median(np.diff(levels)))
