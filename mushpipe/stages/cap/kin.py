"""How unlike circles are, in colour, to those that are surely caps.

Mushrooms in view are of a kind, or of a few. A clod among white caps may have the form of one, and
is as dark as the soil; how bright a cap is against the soil says nothing of that, for it differs
from bed to bed.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from mushpipe import Circles
from mushpipe.core.arrays import Bytes, Floats, Ints, locked
from mushpipe.core.jit import borrower, jit
from mushpipe.stages.discs import discs_of

SURE = 0.9  # score of what is surely a cap,
ALONE = 0.7  # where it is one by itself with such a chance,
TRUST = 0.6  # and all that have such a score are caps with such a chance in the mean
FEWEST = 6  # of them: fewer do not tell what is usual
WITHIN = 0.6  # of the radius: what lies there is no rim and no neighbour
_STEPS = np.linspace(-1, 1, 15)
_GRID = np.stack(np.meshgrid(_STEPS, _STEPS), axis=-1).reshape(-1, 2)
SAMPLES = WITHIN * _GRID[np.hypot(*_GRID.T) <= 1]  # (S, 2) x and y over the radius
DARK = 4.0  # gray levels that are added, since the darkest ones are noise
MOST = 6.0
# Differences between caps of a kind: of the log of brightness, of red and blue over green.
USUAL = np.array([0.2, 0.08, 0.08])
UNIT = USUAL * np.sqrt(len(USUAL))
KIN, PART = 3, 10  # so many sure caps like it, and one in so many of them, are its kind


class Kin(NamedTuple):
    """What circles look like, and which of them tell what caps look like here.

    Attributes:
        tones: (N, 3) log brightness, log red over green and log blue over green, so that the
            distance of two is the root mean square of their differences in units of `USUAL`.
        sure: Rows of those that are surely caps; none where they are fewer than `FEWEST`.
    """

    tones: Floats
    sure: Ints


def kin_of(color: Bytes, circles: Circles, lone: Floats | None = None) -> Kin:
    """Return what circles look like.

    Args:
        color: (H, W, 3) RGB.
        circles: As detected, with the scores of `phase-hough`.
        lone: As in `sure_of`.
    """
    sure = sure_of(circles.score, lone)
    if not len(sure):
        return Kin(np.full((len(circles), 3), np.nan), sure)
    return Kin(tones_of(color, circles), sure)


def sure_of(score: Floats, lone: Floats | None = None) -> Ints:
    """Return the rows of what is surely a cap; none where fewer than `FEWEST` are.

    Args:
        score: (N,) of `phase-hough`.
        lone: (N,) chance of each to be a cap by what is known of it alone, where there are fits.
            Where it is low for most of what has a high score, nothing is sure: a detector that
            takes clods for caps takes many of them.
    """
    chance = score if lone is None else lone
    likely = np.flatnonzero(score >= SURE)
    sure = likely[chance[likely] >= ALONE]
    return sure if len(sure) >= FEWEST and chance[likely].mean() >= TRUST else sure[:0]


def tones_of(color: Bytes, circles: Circles) -> Floats:
    """Return the tone (N, 3) of circles in an image (H, W, 3) RGB, in units as those of `Kin`."""
    tones = np.empty((len(circles), 3))
    # read-only as a frame's: to the compiler another type, and another kernel
    _tones(locked(color, np.uint8), discs_of(circles), tones)
    return np.asarray(tones / UNIT)


def unlike(kin: Kin) -> Floats:
    """Return how unlike each circle (N,) is to its kind, 0 to `MOST`; NaN where few are sure.

    Its distance to the `KIN`th nearest of the sure circles, or to the nearest tenth of them if
    those are more.
    """
    if not len(kin.sure):
        return np.full(len(kin.tones), np.nan)
    return np.minimum(distances(*kin, max(KIN, -(-len(kin.sure) // PART))), MOST)


@borrower
def _tones(color: Bytes, discs: Floats, tones: Floats) -> None:
    height, width = color.shape[:2]
    for k in range(len(discs)):
        x, y, radius = discs[k, 0] + 0.5, discs[k, 1] + 0.5, discs[k, 2]
        red = green = blue = 0
        for s in range(len(SAMPLES)):
            u = min(width - 1, max(0, int(x + radius * SAMPLES[s, 0])))
            v = min(height - 1, max(0, int(y + radius * SAMPLES[s, 1])))
            red += int(color[v, u, 0])
            green += int(color[v, u, 1])
            blue += int(color[v, u, 2])
        write_tone(red / len(SAMPLES), green / len(SAMPLES), blue / len(SAMPLES), tones[k])


@borrower
def write_tone(red: float, green: float, blue: float, tone: Floats) -> None:
    """Write log brightness, log red over green and log blue over green (3,) of gray levels."""
    r, g, b = math.log(red + DARK), math.log(green + DARK), math.log(blue + DARK)
    tone[0], tone[1], tone[2] = (r + g + b) / 3, r - g, b - g


@jit
def alike(tones: Floats, sure: Ints, reach: float) -> Ints:
    """Return how many of the sure ones, itself aside, are within a distance of each (N,)."""
    found, square = np.zeros(len(tones), np.int64), reach * reach
    for k in range(len(tones)):
        for m in sure:
            squares = 0.0
            for tone in range(tones.shape[1]):
                squares += (tones[k, tone] - tones[m, tone]) ** 2
            found[k] += squares <= square and m != k
    return found


@jit
def distances(tones: Floats, sure: Ints, nearest: int) -> Floats:
    """Return how far each (N,) is from the so many nearest of the sure ones, itself aside."""
    found, least = np.empty(len(tones)), np.empty(nearest)  # the squares so far, in order
    for k in range(len(tones)):
        least[:] = np.inf
        for m in sure:
            squares = 0.0
            for tone in range(tones.shape[1]):
                squares += (tones[k, tone] - tones[m, tone]) ** 2
            place = nearest - 1
            if m == k or squares >= least[place]:
                continue
            while place > 0 and least[place - 1] > squares:
                least[place] = least[place - 1]
                place -= 1
            least[place] = squares
        found[k] = math.sqrt(least[nearest - 1])
    return found
