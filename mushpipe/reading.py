"""Files that verbs read, as their arguments and options.

Whether a file can be read is said where it is read, alike for every verb and for a graph's source.
Typer would look first, in other words and with another exit code.
"""

from __future__ import annotations

from typing import Any

import typer


def file_argument(description: str) -> Any:
    """Return the argument of a verb that names what it reads."""
    return typer.Argument(help=description, readable=False)


def file_option(description: str) -> Any:
    """Return the same as an option."""
    return typer.Option(help=description, readable=False)
