"""How unlike circles are, in colour, to those that are surely caps.

Mushrooms in view are of one kind. A clod among white caps may have the form of one, and is as dark
as the soil; how bright a cap is against the soil says nothing of that, for it differs from bed to
bed, and so does the light across an image.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from mushpipe import Circles
from mushpipe.core.jit import borrower, jit
from mushpipe.core.tables import locked
from mushpipe.stages.discs import discs_of
from mushpipe.stages.linear import solve

Floats = NDArray[np.float64]
SURE = 0.9  # score of what is surely a cap
FEWEST = 6  # of them: fewer do not tell what is usual
WITHIN = 0.6  # of the radius: what lies there is no rim and no neighbour
STEPS = 15  # samples across that
DARK = 4.0  # gray levels that are added, since the darkest ones are noise
MOST = 6.0
# Spread among sure caps that says nothing: of the log of brightness, of red and blue over green.
USUAL = np.array([0.2, 0.08, 0.08])
STEEP = 0.4  # spread of the residual over that of the slope of light, per half of an image
ROUNDS = 6


def unlike(color: NDArray[np.uint8], circles: Circles) -> Floats:
    """Return how unlike each circle (N,) is to the sure ones, 0 to `MOST`; NaN where those are few.

    Brightness, and red and blue over green, as logarithms: a plane through those of the sure
    circles (light differs across the image), by least squares with the weights of Geman & McClure
    (1987). A difference counts in units of their spread about it, which `USUAL` bounds below.

    Args:
        color: (H, W, 3) RGB.
        circles: As detected, with the scores of `phase-hough`.
    """
    sure = circles.score >= SURE
    if sure.sum() < FEWEST:
        return np.full(len(circles), np.nan)
    tones = np.empty((len(circles), 3))
    # read-only as a frame's: to the compiler another type, and another kernel
    _tones(locked(color, np.uint8), discs_of(circles), tones)
    half = np.array([color.shape[1], color.shape[0]]) / 2
    departures = _departures(tones, circles.center / half - 1, sure.astype(np.float64), USUAL)
    return np.minimum(departures, MOST)


@borrower
def _tones(color: NDArray[np.uint8], discs: Floats, tones: Floats) -> None:
    """Write log brightness, log red over green and log blue over green of each disc (N, 3)."""
    height, width = color.shape[:2]
    for k in range(len(discs)):
        x, y, reach = discs[k, 0], discs[k, 1], WITHIN * discs[k, 2]
        red = green = blue = count = 0.0
        for i in range(STEPS):
            for j in range(STEPS):
                across, down = 2 * i / (STEPS - 1) - 1, 2 * j / (STEPS - 1) - 1
                if across * across + down * down > 1:
                    continue
                u = min(width - 1, max(0, int(x + reach * across + 0.5)))
                v = min(height - 1, max(0, int(y + reach * down + 0.5)))
                red += color[v, u, 0]
                green += color[v, u, 1]
                blue += color[v, u, 2]
                count += 1
        r, g = math.log(red / count + DARK), math.log(green / count + DARK)
        b = math.log(blue / count + DARK)
        tones[k, 0], tones[k, 1], tones[k, 2] = (r + g + b) / 3, r - g, b - g


@jit
def _departures(tones: Floats, places: Floats, sure: Floats, usual: Floats) -> Floats:
    """Return the root mean square (N,) over tones of how far each is from the sure ones' plane."""
    count = len(tones)
    squares, rest, weight = np.zeros(count), np.empty(count), np.empty(count)
    a, b, row = np.empty((3, 3)), np.empty(3), np.ones(3)
    for channel in range(tones.shape[1]):
        weight[:] = sure
        spread = 0.0
        for _ in range(ROUNDS):
            _plane(tones[:, channel], places, weight, a, b, row)
            for k in range(count):
                rest[k] = tones[k, channel] - b[0] - b[1] * places[k, 0] - b[2] * places[k, 1]
            spread = 1.4826 * np.median(np.abs(rest[sure > 0]))
            for k in range(count):
                weight[k] = sure[k] / (1 + (rest[k] / (2 * spread + 0.1)) ** 2) ** 2
        squares += rest**2 / (spread**2 + usual[channel] ** 2)
    return np.asarray(np.sqrt(squares / tones.shape[1]))


@borrower
def _plane(tone: Floats, places: Floats, weight: Floats, a: Floats, b: Floats, row: Floats) -> None:
    """Write the plane b (3,) through the tones (N,) at places (N, 2), its slopes kept small."""
    a[:] = 0.0
    b[:] = 0.0
    a[1, 1] = a[2, 2] = STEEP**2
    for k in range(len(tone)):
        row[1], row[2] = places[k, 0], places[k, 1]
        for i in range(3):
            b[i] += weight[k] * row[i] * tone[k]
            for j in range(3):
                a[i, j] += weight[k] * row[i] * row[j]
    solve(a, b)
