"""What arguments and options of several verbs have in common."""

from __future__ import annotations

import math
from typing import Any

import typer


def file_argument(description: str) -> Any:
    """Return the argument of a verb that names what it reads.

    Whether a file can be read is said where it is read, alike for every verb and for a graph's
    source. Typer would look first, in other words and with another exit code.
    """
    return typer.Argument(help=description, readable=False)


def file_option(description: str) -> Any:
    """Return the same as an option."""
    return typer.Option(help=description, readable=False)


def finite(value: float) -> float:
    """Return a number, as the callback of an option.

    Typer's bounds alone let infinity pass, and some versions NaN.

    Raises:
        BadParameter: It is NaN or infinite.
    """
    if not math.isfinite(value):
        raise typer.BadParameter(f"{value} is no finite number")
    return value


def source_overrides(**options: float | None) -> list[tuple[str, str]]:
    """Return the overrides of options that set the source, each with the option it comes from.

    ``frames=3`` is ``source.max_frames=3`` from ``--frames 3``.
    """
    settings = {"frames": "max_frames", "duration": "max_seconds"}
    return [
        (f"source.{settings.get(name, name)}={value}", f"--{name} {value}")
        for name, value in options.items()
        if value is not None
    ]
