"""The errors a user can act on, each with the exit code it ends the program with."""

from __future__ import annotations

import difflib
from collections.abc import Iterable, Sequence
from dataclasses import dataclass

EXIT_OK = 0
EXIT_FAILED = 1
EXIT_USAGE = 2
EXIT_DIFFERS = 3
EXIT_DAMAGED = 4
EXIT_NO_DEVICE = 5
EXIT_INTERRUPTED = 130


class MushpipeError(Exception):
    """Base of all errors whose message is meant for the user."""

    exit_code = EXIT_FAILED


class UsageError(MushpipeError):
    """The command line, a setting or an argument is wrong."""

    exit_code = EXIT_USAGE


class PluginError(MushpipeError):
    """A plugin cannot be found, imported or understood."""

    exit_code = EXIT_USAGE


class InputError(MushpipeError):
    """The input is damaged, incomplete or lacks what a stage needs."""

    exit_code = EXIT_DAMAGED


class DeviceError(MushpipeError):
    """A camera is missing or was lost."""

    exit_code = EXIT_NO_DEVICE


class DependencyError(MushpipeError):
    """A library that this graph needs is not usable on this system."""


class StageError(MushpipeError):
    """A stage, source or sink failed on a frame."""

    def __init__(self, message: str, exit_code: int) -> None:
        super().__init__(message)
        self.exit_code = exit_code


@dataclass(frozen=True, order=True)
class Problem:
    """One fault of a graph file, with its place.

    ``line`` and ``column`` count from 1; both are 0 where the fault has no place in the file
    (an override of the command line, say, which ``file`` then names).
    """

    file: str
    line: int
    column: int
    message: str
    hint: str = ""
    excerpt: str = ""

    def __str__(self) -> str:
        place = f"{self.file}:{self.line}:{self.column}" if self.line else self.file
        text = f"{place}: {self.message}"
        if self.excerpt:
            text += f"\n    {self.excerpt}\n    {' ' * (self.column - 1)}^"
        return f"{text}\n    {self.hint}" if self.hint else text


class GraphError(MushpipeError):
    """A graph file is wrong; ``problems`` holds every fault found, in file order."""

    exit_code = EXIT_USAGE

    def __init__(self, problems: Iterable[Problem]) -> None:
        self.problems = sorted(problems)
        super().__init__("\n".join(map(str, self.problems)))


def suggest(name: str, known: Sequence[str]) -> str:
    """Return ``did you mean 'x'?`` for the nearest known name, else the list of known names."""
    near = difflib.get_close_matches(name, known, n=1, cutoff=0.5)
    if not near:  # F is the heading of a table, and OTSU how papers write it
        lowered = {each.lower(): each for each in known}
        found = difflib.get_close_matches(name.lower(), lowered, n=1, cutoff=0.5)
        near = [lowered[each] for each in found]
    if near:
        return f"did you mean '{near[0]}'?"
    return f"known: {', '.join(known)}" if known else "none is known here"
