"""Thresholds on metrics: ``f>=0.98``, ``|diameter_bias_mm|<0.3``."""

from __future__ import annotations

import math
import operator
import re
from collections.abc import Iterable, Mapping
from dataclasses import dataclass

from mushpipe.core.errors import UsageError, suggest

_FORM = re.compile(r"(\|?)([A-Za-z_][\w-]*)(\|?)\s*(>=|<=|>|<)\s*(\S+)")
_COMPARE = {">=": operator.ge, "<=": operator.le, ">": operator.gt, "<": operator.lt}


@dataclass(frozen=True)
class Threshold:
    """A bound that a metric, or its absolute value, must keep."""

    text: str
    name: str
    absolute: bool
    relation: str
    bound: float

    def kept(self, value: float) -> bool:
        """Return whether a value keeps it; NaN, an unknown value, does not."""
        return bool(_COMPARE[self.relation](abs(value) if self.absolute else value, self.bound))


@dataclass(frozen=True)
class Outcome:
    """A checked threshold."""

    threshold: Threshold
    value: float
    kept: bool


def parse_threshold(text: str) -> Threshold:
    """Read a threshold.

    Raises:
        UsageError: It has another form.
    """
    form = _FORM.fullmatch(text.strip())
    try:
        if form is None or form[1] != form[3] or not math.isfinite(bound := float(form[5])):
            raise ValueError
        return Threshold(text, form[2], bool(form[1]), form[4], bound)
    except ValueError:
        expected = "NAME>=NUMBER or |NAME|<=NUMBER, with a finite number"
        raise UsageError(f"--threshold {text}: expected {expected}") from None


def require_known(thresholds: Iterable[Threshold], known: Iterable[str]) -> None:
    """Check the names of thresholds.

    Raises:
        UsageError: One is unknown; with the nearest that there is.
    """
    names = list(known)
    for threshold in thresholds:
        if threshold.name not in names:
            hint = suggest(threshold.name, names)
            raise UsageError(f"--threshold {threshold.text}: no metric '{threshold.name}'; {hint}")


def check(thresholds: Iterable[Threshold], values: Mapping[str, float]) -> list[Outcome]:
    """Hold values against thresholds."""
    return [Outcome(t, values[t.name], t.kept(values[t.name])) for t in thresholds]
