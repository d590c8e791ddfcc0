"""How the caps of a scene lean, and how high they are: what the single fit cannot know."""

from __future__ import annotations

import numpy as np

from mushpipe.core.arrays import Floats
from mushpipe.core.jit import jit

DEGREES = 4.0  # of freedom of Student's t: how readily a leaning cap is let go
PRIOR_CAPS = 0.1  # the spread that is set counts as much as so many caps
NARROWEST = np.radians(2.0)
SCENES = 0.15  # spread of the aspect of a scene's usual cap; it is part of that of all caps
HELD = 0.95  # most that a fit's aspect may owe to its prior: beyond, its own says nothing


@jit
def spread_of(squares: Floats, variances: Floats, spread: float, out: Floats) -> None:
    """Estimate how far the caps of a scene lean, and what that says of each of them.

    Expectation maximisation for Student's t around the upright: a scene of upright caps holds its
    caps tight, one of leaning caps does not, and a cap that clearly leans is let go in either.

    Args:
        squares: (N,) squared tilt of each fit, rad^2; negative where there is none.
        variances: (N,) its variance per direction, the prior's share included.
        spread: The spread per direction (rad) those fits were made with.
        out: (N,) out: the spread to fit each cap with, rad.
    """
    count, square, before = len(squares), spread**2, spread**2
    data, mean, seen = np.zeros(count), np.zeros(count), np.zeros(count)
    for i in range(count):
        if squares[i] >= 0.0:
            data[i] = max(1.0 / variances[i] - 1.0 / spread**2, 1e-6)
            mean[i] = squares[i] * (1.0 / variances[i] / data[i]) ** 2
            seen[i] = 1.0
    for _ in range(15):
        total, number, per_square = PRIOR_CAPS * spread**2, PRIOR_CAPS, 1.0 / square
        for i in range(count):
            variance = 1.0 / (data[i] + per_square)
            share = data[i] * variance
            expected = mean[i] * share * share + 2.0 * variance
            loose = (DEGREES + 2.0) / (DEGREES + expected * per_square)
            out[i] = loose
            total += seen[i] * 0.5 * loose * expected
            number += seen[i]
        before, square = square, max(total / number, NARROWEST**2)
    for i in range(count):
        out[i] = np.sqrt(before / out[i]) if seen[i] > 0.0 else np.sqrt(before)


@jit
def usual_aspect(aspects: Floats, variances: Floats, aspect: float, sigma: float) -> float:
    """Estimate the aspect h/R of the usual cap of a scene.

    What stands together is of an age, buttons or old caps. A fit whose variance is a share s of
    that of its prior drew its aspect towards the prior by s; without that it is what its own data
    say, with s / (1 - s) of the variance.

    Args:
        aspects: (N,) of each fit; negative where there is none.
        variances: (N,) of these, the prior's share included.
        aspect: The prior of those fits,
        sigma: and its spread.
    """
    total, precision = 0.0, 1.0 / SCENES**2
    for i in range(len(aspects)):
        if aspects[i] >= 0.0:
            held = min(variances[i] / sigma**2, HELD)
            weight = 1.0 / (sigma**2 * held / (1.0 - held) + sigma**2 - SCENES**2)
            total += weight * (aspects[i] - aspect) / (1.0 - held)
            precision += weight
    return aspect + total / precision
