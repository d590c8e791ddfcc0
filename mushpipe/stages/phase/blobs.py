"""Candidates from depth alone: the largest discs that fit into what stands on the bed.

Where an image has no contrast, wood on wood or in dim light, too few edges vote for a cap's centre,
or none hold an outline that starts beside it. Its depth shows it all the same: of all that is
higher than a level, the centres of the largest discs within it are the peaks of its distance
transform (Blum 1967). Several levels part a cap from its stem and from what it touches.
"""

from __future__ import annotations

import math

import cv2
import numpy as np

from mushpipe.core.arrays import Singles
from mushpipe.core.jit import borrower, jit
from mushpipe.stages.discs import LEAST_OF_RANGE, MOST_OF_RANGE, Radii
from mushpipe.stages.phase.depth import CELL, Relief
from mushpipe.stages.phase.votes import highest_around

LEVELS = (0.01, 0.014, 0.02, 0.028, 0.035, 0.05)  # m over the bed
STEP = 2  # px of the height map; a start for a refit need not be more exact
FREE = 0.55  # share of the ring around a disc that is lower, for it to be a thing of its own
RING = 1.25  # radius of that ring, of the disc's
_TURNS = 2 * np.pi * np.arange(16) / 16
_COSINES, _SINES = np.cos(_TURNS), np.sin(_TURNS)


def blobs_of(relief: Relief, radii: Radii) -> Singles:
    """Return the discs of a radius (px) in the range that stand free, as candidates (N, 4)."""
    height, pixel = relief.filled[::STEP, ::STEP], CELL * STEP
    limits = Radii(LEAST_OF_RANGE * radii.smallest / pixel, MOST_OF_RANGE * radii.largest / pixel)
    found = [np.zeros((0, 4), np.float32)]
    for level in LEVELS:
        standing = (height > level).astype(np.uint8)
        away = cv2.distanceTransform(standing, cv2.DIST_L2, cv2.DIST_MASK_5)
        found.append(_discs(np.asarray(away, np.float32), pixel, limits))
    return _distinct(np.concatenate(found))


@jit
def _distinct(discs: Singles) -> Singles:
    """Return discs (N, 4) but for those that are the same, to half a step, as one before."""
    kept = 0
    for k in range(len(discs)):
        new = True
        for other in discs[:kept]:
            away = max(abs(other[0] - discs[k, 0]), abs(other[1] - discs[k, 1]))
            new &= max(away, abs(other[2] - discs[k, 2])) > CELL
        if new:
            discs[kept] = discs[k]
            kept += 1
    return discs[:kept]


@jit
def _discs(away: Singles, pixel: int, limits: Radii) -> Singles:
    height, width = away.shape
    found, count = np.empty((away.size // 4 + 1, 4), np.float32), 0
    for v in range(height):
        for u in range(width):
            r = away[v, u]
            if r < limits.smallest or r > limits.largest or not highest_around(away, u, v):
                continue
            x, y = pixel * (u + 0.5) - 0.5, pixel * (v + 0.5) - 0.5
            if _free(away, u, v):
                found[count, 0], found[count, 1], found[count, 2] = x, y, pixel * r
                found[count, 3] = 1.0
                count += 1
    return found[:count]


@borrower
def _free(away: Singles, u: int, v: int) -> bool:
    """Whether what is around a disc, as far as it lies in the image, is mostly lower."""
    height, width = away.shape
    inside = lower = 0
    for k in range(len(_COSINES)):
        x = math.floor(u + RING * away[v, u] * _COSINES[k] + 0.5)
        y = math.floor(v + RING * away[v, u] * _SINES[k] + 0.5)
        if x < 0 or y < 0 or x >= width or y >= height:
            continue
        inside += 1
        lower += away[y, x] == 0
    return lower >= FREE * inside and 2 * inside >= len(_COSINES)
