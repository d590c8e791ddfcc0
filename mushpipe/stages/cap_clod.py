"""What looks as the ground around it does, and not as most caps in view do, is a clod.

A round clod may have the form of a cap, in the image and in depth, and a network that never saw
such soil may be sure of it; several of them are then kin (`cap_kin`). But brown caps on brown soil
look like each other, and white ones on mycelium do.
"""

from __future__ import annotations

import math

import numpy as np

from mushpipe import Circles
from mushpipe.core.arrays import Bools, Bytes, Floats, Ints, locked
from mushpipe.core.jit import borrower
from mushpipe.stages.cap_kin import DARK, UNIT, Kin, alike, write_tone
from mushpipe.stages.discs import LIKELY, discs_of

ODD = 1.5  # distance to the nearer half of the sure caps from which on it is none of them
ALIKE = 1.0  # distance to the ground up to which it looks like it
# The ground is looked at from 1.3 to 1.9 radii, so far from all circles that shadows end.
_TURNS, _REACH = 2 * np.pi * (np.arange(32) + 0.5) / 32, np.linspace(1.3, 1.9, 6)
RING = np.stack([np.outer(_REACH, np.cos(_TURNS)), np.outer(_REACH, np.sin(_TURNS))], -1)
RING = np.ascontiguousarray(RING.reshape(-1, 2))
CLEAR = 1.15  # radii of a circle within which there is no ground
LEAST = 20  # samples of the ground
CLOD_CHANCE = 0.05  # of what is one to be a cap; 1 of 68 was on another renderer's frames
NIGHT = 16.0  # gray levels; darker ground looks like everything


def clods(color: Bytes, circles: Circles, kin: Kin) -> Bools:
    """Return which circles (N,) look as the ground does and not as most sure caps do.

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
    return off_ground(kin.tones, ground_of(color, circles, odd)) < ALIKE


def ground_of(color: Bytes, circles: Circles, asked: Bools) -> Floats:
    """Return what the ground around circles looks like.

    Args:
        color: (H, W, 3) RGB.
        circles: As detected, with the scores of `phase-hough`.
        asked: (N,) of which circles.

    Returns:
        (N, 4) tone, as by `cap_kin.tones_of`, and standard deviation of the brightness over its
        mean. NaN where it is not asked for, no ground is seen, or it is too dark to tell.
    """
    ground = np.full((len(circles), 4), np.nan)
    discs, likely = discs_of(circles), circles.score >= LIKELY
    near = np.empty(len(discs), np.int64)
    _grounds(locked(color, np.uint8), discs, asked, likely, near, ground)
    ground[ground[:, 0] < math.log(NIGHT + DARK)] = np.nan
    ground[:, :3] /= UNIT
    return ground


def off_ground(tones: Floats, ground: Floats) -> Floats:
    """Return how far the tones (N, 3) of circles are from that of the ground (N, 4) around them."""
    return np.asarray(np.linalg.norm(tones - ground[:, :3], axis=1))


def darker(tones: Floats, level: float) -> Bools:
    """Return which tones (N, 3 or more) are darker than a gray level."""
    return np.asarray(tones[:, 0] < math.log(level + DARK) / UNIT[0])


@borrower
def _grounds(
    color: Bytes, discs: Floats, asked: Bools, likely: Bools, near: Ints, ground: Floats
) -> None:
    """Write tone and unevenness (N, 4) of the ground around the discs (N, 3) that are asked for.

    `near` (N,) is room to work in.
    """
    height, width = color.shape[:2]
    for k in range(len(discs)):
        if not asked[k]:
            continue
        count = _neighbours(k, discs, likely, near)
        red = green = blue = squares = seen = 0
        for s in range(len(RING)):
            x, y = discs[k, 0] + discs[k, 2] * RING[s, 0], discs[k, 1] + discs[k, 2] * RING[s, 1]
            u, v = math.floor(x + 0.5), math.floor(y + 0.5)
            if 0 <= u < width and 0 <= v < height and _free(x, y, discs, near[:count]):
                red += int(color[v, u, 0])
                green += int(color[v, u, 1])
                blue += int(color[v, u, 2])
                gray = int(color[v, u, 0]) + int(color[v, u, 1]) + int(color[v, u, 2])
                squares += gray * gray
                seen += 1
        if seen >= LEAST:
            write_tone(red / seen, green / seen, blue / seen, ground[k])
            mean = (red + green + blue) / seen
            ground[k, 3] = math.sqrt(max(0.0, squares / seen - mean * mean)) / (mean + 3 * DARK)


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
