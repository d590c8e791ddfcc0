"""Statistics of weighted samples, many weightings at a time: what the bootstrap is made of.

A bootstrap sample is the original one with integer weights (how often each row was drawn), so
every statistic here equals the plain one on the rows repeated so often, and a thousand samples
are a few array operations. All take ``x`` (N,) without NaN and ``w`` (B, N) integers >= 0 and
return (B,) values, NaN where the weights are all zero.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from mushpipe.core.arrays import Floats, Ints

Statistic = Callable[[Floats, Floats], Floats]
_CHUNK = 2_000_000


def mean(x: Floats, w: Floats) -> Floats:
    """Mean: signed values give the bias."""
    with np.errstate(invalid="ignore", divide="ignore"):
        return np.asarray(w @ x / w.sum(axis=1))


def std(x: Floats, w: Floats) -> Floats:
    """Standard deviation about the mean, divisor N."""
    centred = x - (x.mean() if len(x) else 0.0)
    return np.sqrt(np.maximum(mean(centred**2, w) - mean(centred, w) ** 2, 0))


def mean_abs(x: Floats, w: Floats) -> Floats:
    """Mean of the absolute values."""
    return mean(np.abs(x), w)


def quantile(x: Floats, w: Floats, q: float) -> Floats:
    """Quantile with linear interpolation, as `numpy.quantile` on the repeated rows."""
    if not len(x):
        return np.full(len(w), np.nan)
    order = np.argsort(x)
    ranked, upto = x[order], w[:, order].cumsum(axis=1)
    place = q * np.maximum(upto[:, -1] - 1, 0)
    low = np.floor(place)

    def at(rank: Floats) -> Floats:
        rows = (upto <= rank[:, None]).sum(axis=1)
        return np.asarray(ranked[np.minimum(rows, len(x) - 1)])

    below, above = at(low), at(np.minimum(low + 1, upto[:, -1] - 1))
    return np.where(upto[:, -1] > 0, below + (place - low) * (above - below), np.nan)


def median_abs(x: Floats, w: Floats) -> Floats:
    """Median of the absolute values."""
    return quantile(np.abs(x), w, 0.5)


def p95_abs(x: Floats, w: Floats) -> Floats:
    """95th percentile of the absolute values."""
    return quantile(np.abs(x), w, 0.95)


def dice(x: Floats, w: Floats) -> Floats:
    """F: 2 found / (2 found + missed + false), of x = 1 where found, 0 missed, -1 false.

    Where there is nothing to find it is NaN: it would be 0, however much or little is false.
    """
    found, there, rows = w @ (x > 0), w @ (x >= 0), w.sum(axis=1)
    return np.where(there > 0, 2 * found / np.maximum(found + rows, 1), np.nan)


def evaluate(statistic: Statistic, x: Floats, w: Floats, units: Ints | None = None) -> Floats:
    """Apply a statistic to the rows that are not NaN, in pieces that fit into memory.

    Args:
        statistic: Of values (N,) and weights (K, N).
        x: (N,) values.
        w: (K, N) weights; with `units` (K, U), those of units.
        units: (N,) the unit that each value belongs to.
    """
    known = np.flatnonzero(np.isfinite(x))
    columns = known if units is None else units[known]
    step = max(1, _CHUNK // max(1, len(known)))
    pieces = (w[i : i + step][:, columns] for i in range(0, len(w), step))
    return np.concatenate([statistic(x[known], piece) for piece in pieces])


def draw(units: int, resamples: int, seed: int) -> Floats:
    """Return (resamples, units) how often each unit is drawn; every row sums to ``units``.

    Efron 1979: as many units are drawn with replacement as there are.
    """
    if not units:
        return np.zeros((resamples, 0))
    rng = np.random.default_rng(seed)
    return rng.multinomial(units, np.full(units, 1 / units), resamples).astype(float)


def interval(values: Floats) -> tuple[float, float]:
    """Return the 2.5th and 97.5th percentile of a statistic's values; NaN without any."""
    known = values[np.isfinite(values)]
    if not len(known):
        return np.nan, np.nan
    low, high = np.percentile(known, [2.5, 97.5])
    return float(low), float(high)
