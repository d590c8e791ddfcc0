"""Circles of another detector, beside which `phase-hough` looks for its own."""

from __future__ import annotations

import math

import numpy as np

from mushpipe import Circles
from mushpipe.core.arrays import Bools, Bytes, Floats, Ints32, Singles
from mushpipe.core.jit import borrower, jit
from mushpipe.stages.cap.clod import ODD, darker, ground_of, off_ground
from mushpipe.stages.cap.kin import FEWEST, SURE, alike, tones_of
from mushpipe.stages.discs import (
    LEAST_OF_RANGE,
    LIKELY,
    MOST_OF_RANGE,
    Radii,
    certain_first,
    discs_of,
    iou,
    lens,
)

_AROUND = 4.0  # px; a circle of a network is not more exact than that
_SAME = 0.5  # IoU from which on an outline is that of a circle
_SOIL = 100.0  # gray level; brighter ground holds no clods
_GROUND = 1.5  # distance of tones up to which an unseen circle looks like the soil around it
_EXACTLY = 0.5  # and up to which any does; of 2695 caps of simulated frames on soil one did,
_DOUBTED = 0.9  # but for those that the network sees so plainly
_UNEVEN = 0.12  # spread of the brightness of soil over its mean
_OWN = 0.5  # share of a circle that none that was accepted may cover


def of_radii(learned: Circles, radii: Radii) -> Circles:
    """Return the circles of a radius within the range, or a tenth beyond."""
    enough = learned.radius >= LEAST_OF_RANGE * radii.smallest
    return learned.take(enough & (learned.radius <= MOST_OF_RANGE * radii.largest))


def largest_of(learned: Circles | None) -> float:
    """Return the largest radius, px, and a tenth, of circles that are likely caps; 0 without."""
    if learned is None:
        return 0.0
    return float(MOST_OF_RANGE * learned.radius[learned.score >= LIKELY].max(initial=0.0))


def candidates_of(learned: Circles) -> Singles:
    """Return circles as candidates (N, 4) for a refit."""
    return np.column_stack([learned.center, learned.radius, learned.score]).astype(np.float32)


def add_discs(learned: Circles, foreground: Bytes) -> Bytes:
    """Return a foreground (H, W) with 1 in the circles and a little around them as well."""
    added = foreground.copy()
    _fill(added, learned.center, learned.radius)
    return added


def agreement(shapes: Floats, radius: Floats, learned: Circles) -> Floats:
    """Return how far each outline (N, 5) of a radius (N,) is one of the circles: 0..1.

    The largest score of a circle, times its IoU with the outline's circle.
    """
    return _agreement(shapes, radius, learned.center, learned.radius, learned.score)


def seen_by(learned: Circles, circles: Circles) -> Floats:
    """Return how far each circle (N,) is one of a network's, as from `agreement`."""
    # a copy, for what is read-only needs another kernel
    return agreement(discs_of(circles), np.array(circles.radius), learned)


def without_clods(color: Bytes, circles: Circles, seen: Floats) -> Circles:
    """Return the circles but for those that look like the dark soil they lie on.

    A round clod has the form of a cap in depth as well, and looks just like the soil, as no cap
    does. Caps that the network sees nothing of are few, and do not come near to it, unless it is
    even, and what it is surest of is no clod. White caps on mycelium or a table do look like that,
    and where the border cuts a circle too little of the ground is seen. What looks like half of the
    caps of which image, depth and network are sure, if they are several, is one of them.

    Args:
        color: (H, W, 3) RGB.
        circles: Those accepted.
        seen: (N,) how far each is a circle of the network, from `seen_by`.
    """
    corner = np.array([color.shape[1] - 1, color.shape[0] - 1])
    room = np.minimum(circles.center, corner - circles.center)
    whole, tones = room.min(axis=1) >= circles.radius, tones_of(color, circles)
    # a tone that is within reach of that of soil is no brighter than this
    ground = ground_of(color, circles, whole & darker(tones - _GROUND, _SOIL))
    away = off_ground(tones, ground)
    exactly = (away < _EXACTLY) & (seen < _DOUBTED)
    clod = exactly | ((seen == 0) & (away < _GROUND) & (ground[:, 3] >= _UNEVEN))
    known = np.flatnonzero((circles.score >= SURE) & (seen >= _SAME))
    if len(known) >= FEWEST:
        clod &= 2 * alike(tones, known, ODD) < len(known)
    return circles.take(~(clod & darker(ground, _SOIL)))


def with_bare(
    circles: Circles, sure: Circles, shapes: Floats, radius: Floats, likely: Ints32
) -> Circles:
    """Return the accepted circles, and sure ones of a network that no outline was found of.

    The edges of a dark cap on bright ground face the wrong way, and those of a dim one beside
    something bright may count as none. Where there is an outline, the verifier says what it is.

    Args:
        circles: Those accepted.
        sure: Those of the network, of a radius within the range.
        shapes: (N, 5) outlines that were found.
        radius: (N,) of their circles.
        likely: Rows of those that are more likely caps than not.
    """
    taken = np.zeros(len(shapes), np.bool_)
    taken[likely] = True
    more = sure.take(_bare(sure.center, sure.radius, shapes, radius, taken))
    return certain_first(circles.joined(more))


@jit
def _bare(center: Floats, of: Floats, shapes: Floats, radius: Floats, taken: Bools) -> Bools:
    free = np.ones(len(center), np.bool_)
    for m in range(len(center)):
        own = math.pi * of[m] ** 2
        for k in range(len(shapes)):
            dx, dy = shapes[k, 0] - center[m, 0], shapes[k, 1] - center[m, 1]
            squared = dx * dx + dy * dy
            if squared < (radius[k] + of[m]) ** 2:
                away = math.sqrt(squared)
                covered = taken[k] and lens(away, of[m], radius[k]) > _OWN * own
                if covered or iou(away, of[m], radius[k]) >= _SAME:
                    free[m] = False
                    break
    return free


@borrower
def _fill(foreground: Bytes, center: Floats, radius: Floats) -> None:
    height, width = foreground.shape
    for k in range(len(center)):
        x, y, reach = center[k, 0], center[k, 1], radius[k] + _AROUND
        for v in range(max(0, math.ceil(y - reach)), min(height, math.floor(y + reach) + 1)):
            half = math.sqrt(reach * reach - (v - y) ** 2)
            for u in range(max(0, math.ceil(x - half)), min(width, math.floor(x + half) + 1)):
                foreground[v, u] = 1


@jit
def _agreement(shapes: Floats, radius: Floats, center: Floats, of: Floats, score: Floats) -> Floats:
    best = np.zeros(len(shapes))
    for k in range(len(shapes)):
        for m in range(len(center)):
            dx, dy = shapes[k, 0] - center[m, 0], shapes[k, 1] - center[m, 1]
            squared = dx * dx + dy * dy
            if squared < (radius[k] + of[m]) ** 2:
                best[k] = max(best[k], score[m] * iou(math.sqrt(squared), radius[k], of[m]))
    return best
