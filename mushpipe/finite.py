"""Numbers of the command line: typer's bounds alone let infinity pass, and some versions NaN."""

from __future__ import annotations

import math

import typer


def finite(value: float) -> float:
    """Return a number, as the callback of an option.

    Raises:
        BadParameter: It is NaN or infinite.
    """
    if not math.isfinite(value):
        raise typer.BadParameter(f"{value} is no finite number")
    return value
