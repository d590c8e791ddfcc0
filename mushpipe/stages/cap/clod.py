"""What looks as the ground around it does, and not as most caps in view do, is a clod.

A round clod may have the form of a cap, in the image and in depth, and a network that never saw
such soil may be sure of it; several of them are then kin (`cap.kin`). But brown caps on brown soil
look like each other, and white ones on mycelium do.
"""

from __future__ import annotations

import math

import numpy as np

from mushpipe import Circles
from mushpipe.core.arrays import Bools, Bytes, Floats, Ints, locked
from mushpipe.core.jit import borrower
from mushpipe.stages.cap.kin import DARK, UNIT, Kin, alike, write_tone
from mushpipe.stages.discs import LIKELY, discs_of

ODD = 1.5  # distance to the nearer half of the sure caps from which on it is none of them
ALIKE = 1.0  # distance to the ground up to which it looks like it
# The ground is looked at from 1.3 to 1.9 radii, so far from all circles that shadows end.
_TURNS, _REACH = 2 * np.pi * (np.arange(32) + 0.5) / 32, np.linspace(1.3, 1.9, 6)
RING = np.stack([np.outer(_REACH, np.cos(_TURNS)), np.outer(_REACH, np.sin(_TURNS))], -1)
RING = np.ascontiguousarray(RING.reshape(-1, 2))
CLEAR = 1.15  # radii of a circle within which there is no ground
LEAST = 20  # samples of the ground
BARE = 0.3  # share of the ground, its darkest, that is soil: the rest may be mycelium
CLOD_CHANCE = 0.05  # of what is one to be a cap; 1 of 68 was on another renderer's frames
SOIL = slice(4, 7)  # columns of what `ground_of` returns
NIGHT = 16.0  # gray levels; darker ground looks like everything


def clods(color: Bytes, circles: Circles, kin: Kin) -> Bools:
    """Return which circles (N,) look as the ground does and not as most sure caps do.

    Between patches of mycelium a clod looks as the soil there does, the darkest of the ground.
    Nothing is one where few circles are sure, and where no ground is seen or it is too dark to
    tell.

    Args:
        color: (H, W, 3) RGB.
        circles: As detected, with the scores of `phase-hough`.
        kin: What they look like.
    """
    if not len(kin.sure):
        return np.zeros(len(circles), np.bool_)
    odd = 2 * alike(*kin, ODD) < len(kin.sure)
    ground = ground_of(color, circles, odd)
    away = np.fmin(off_ground(kin.tones, ground), off_ground(kin.tones, ground[:, SOIL]))
    return away < ALIKE


def ground_of(color: Bytes, circles: Circles, asked: Bools) -> Floats:
    """Return what the ground around circles looks like.

    Args:
        color: (H, W, 3) RGB.
        circles: As detected, with the scores of `phase-hough`.
        asked: (N,) of which circles.

    Returns:
        (N, 7) tone, as by `cap.kin.tones_of`; standard deviation of the brightness over its mean;
        tone of the soil (`SOIL`), which is the darkest of it. NaN where it is not asked for, no
        ground is seen, or it is too dark to tell.
    """
    ground = np.full((len(circles), 7), np.nan)
    discs, likely = discs_of(circles), circles.score >= LIKELY
    near, samples = np.empty(len(discs), np.int64), np.empty((len(RING), 4))
    _grounds(locked(color, np.uint8), discs, asked, likely, near, samples, ground)
    ground[ground[:, 0] < math.log(NIGHT + DARK)] = np.nan
    ground[ground[:, SOIL.start] < math.log(NIGHT + DARK), SOIL] = np.nan
    ground[:, :3] /= UNIT
    ground[:, SOIL] /= UNIT
    return ground


def off_ground(tones: Floats, ground: Floats) -> Floats:
    """Return how far tones (N, 3) of circles are from that (N, 3 or more) of what is around."""
    return np.asarray(np.linalg.norm(tones - ground[:, :3], axis=1))


def darker(tones: Floats, level: float) -> Bools:
    """Return which tones (N, 3 or more) are darker than a gray level."""
    return np.asarray(tones[:, 0] < math.log(level + DARK) / UNIT[0])


@borrower
def _grounds(
    color: Bytes, discs: Floats, asked: Bools, likely: Bools,
    near: Ints, samples: Floats, ground: Floats,
) -> None:  # fmt: skip
    """Write (N, 7) what the ground around the discs (N, 3) is like that are asked for.

    `near` (N,) and `samples` (S, 4), one for each of `RING`, are room to work in.
    """
    height, width = color.shape[:2]
    for k in range(len(discs)):
        if not asked[k]:
            continue
        count = _neighbours(k, discs, likely, near)
        seen = 0
        for s in range(len(RING)):
            x, y = discs[k, 0] + discs[k, 2] * RING[s, 0], discs[k, 1] + discs[k, 2] * RING[s, 1]
            u, v = math.floor(x + 0.5), math.floor(y + 0.5)
            if 0 <= u < width and 0 <= v < height and _free(x, y, discs, near[:count]):
                for c in range(3):
                    samples[seen, c] = color[v, u, c]
                samples[seen, 3] = samples[seen, 0] + samples[seen, 1] + samples[seen, 2]
                seen += 1
        if seen >= LEAST:
            _describe(samples[:seen], ground[k])


@borrower
def _describe(samples: Floats, ground: Floats) -> None:
    """Write (7,) what samples (S, 4) of the ground are like: red, green, blue and their sum."""
    mean = _write_mean(samples, math.inf, ground[:3])
    squares = 0.0
    for s in range(len(samples)):
        squares += samples[s, 3] ** 2
    deviation = math.sqrt(max(0.0, squares / len(samples) - mean * mean))
    ground[3] = deviation / (mean + 3 * DARK)
    _write_mean(samples, _darkest(samples[:, 3]), ground[4:])


@borrower
def _write_mean(samples: Floats, limit: float, tone: Floats) -> float:
    """Write the tone (3,) of the mean of the samples (S, 4) up to a brightness, and return that."""
    red = green = blue = 0.0
    count = 0
    for s in range(len(samples)):
        if samples[s, 3] <= limit:
            red, green, blue = red + samples[s, 0], green + samples[s, 1], blue + samples[s, 2]
            count += 1
    write_tone(red / count, green / count, blue / count, tone)
    return float((red + green + blue) / count)


@borrower
def _darkest(brightness: Floats) -> float:
    """Return the level up to which samples (S,), 0 to 765, are the darkest: a share `BARE` of all.

    Found by halving: sorting needs room, and comparing all with all takes milliseconds on a bed.
    """
    level, above = 0, 766
    while above - level > 1:
        middle, darker = (level + above) // 2, 0
        for each in brightness:
            darker += each < middle
        if darker <= BARE * len(brightness):
            level = middle
        else:
            above = middle
    return float(level)


@borrower
def _neighbours(k: int, discs: Floats, likely: Bools, near: Ints) -> int:
    """Write the rows of the discs that may be caps and reach the ground of one; return how many."""
    count = 0
    for m in range(len(discs)):
        apart = math.hypot(discs[k, 0] - discs[m, 0], discs[k, 1] - discs[m, 1])
        if likely[m] and apart < _REACH[-1] * discs[k, 2] + CLEAR * discs[m, 2]:
            near[count] = m
            count += 1
    return count


@borrower
def _free(x: float, y: float, discs: Floats, rows: Ints) -> bool:
    """Whether a point lies in none of the discs of some rows, nor close to one."""
    for m in rows:
        squared = (x - discs[m, 0]) ** 2 + (y - discs[m, 1]) ** 2
        if squared < (CLEAR * discs[m, 2]) ** 2:
            return False
    return True
