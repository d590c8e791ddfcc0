"""Whether depth and a network, which sees colour alone, speak of the same scene."""

from __future__ import annotations

import logging

import numpy as np

from mushpipe import Circles
from mushpipe.core.arrays import Bools
from mushpipe.stages.discs import LIKELY

logger = logging.getLogger("mushpipe")
EACH = 15  # frames, of which one is looked at
ENOUGH = 8  # caps to judge by
# Share of caps that only one of both knows. On simulated scenes, tables with cups among them, it is
# 0.38 at most (`python -m training.net.judge` has such frames).
MOST = 0.5
SURE = 0.8  # score of a network's circle
_SUGGESTION = (
    "depth may stand still, be of another scene or unit, or lie beside colour; positions are not "
    "to be trusted before that is known"
)


class Contradiction:
    """Warns, once, where most caps of a frame are known to depth alone, or to the network alone."""

    def __init__(self) -> None:
        self._told = False

    def look(self, number: int, circles: Circles, unseen: Bools, learned: Circles) -> None:
        """Look at a frame.

        Args:
            number: Of the frame, by which it is chosen: two frames may be here at once.
            circles: By depth and colour together; the likely ones count.
            unseen: (N,) of which of them the network sees nothing.
            learned: Circles of the network.
        """
        if self._told or number % EACH:
            return
        sure = learned.take(learned.score >= SURE)
        likely = circles.score >= LIKELY
        circles, alone = circles.take(likely), int(unseen[likely].sum())
        if len(circles) >= ENOUGH and alone > MOST * len(circles):
            self._told = True
            logger.warning(
                "frame %d: of %d of the %d caps that depth shows cap-net sees nothing in colour: "
                "the image may be too dark for it; else %s",
                *(number, alone, len(circles), _SUGGESTION),
            )
        elif len(sure) >= ENOUGH and (lost := _lost(sure, circles)) > MOST * len(sure):
            self._told = True
            logger.warning(
                "frame %d: depth does not show %d of the %d caps that cap-net is sure of: %s",
                *(number, lost, len(sure), _SUGGESTION),
            )


def _lost(sure: Circles, circles: Circles) -> int:
    """Return on how many circles of a network no circle has its centre."""
    away = np.linalg.norm(sure.center[:, None] - circles.center, axis=2)
    return int((away > sure.radius[:, None]).all(axis=1).sum())
