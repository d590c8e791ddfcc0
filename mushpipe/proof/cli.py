"""The verbs `mushpipe compare` and `mushpipe bench`."""

from __future__ import annotations

import sys
from collections.abc import Iterable, Iterator
from itertools import groupby
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

if TYPE_CHECKING:
    from mushpipe.proof.compare import Comparison, Difference


def compare(
    a: Annotated[Path, typer.Argument(help="recording written by a sink mcap")],
    b: Annotated[Path, typer.Argument(help="another, to be the same")],
    tol: Annotated[
        float, typer.Option(min=0, help="what numbers, and which share of pixels, may differ")
    ] = 0.0,
    topics: Annotated[str, typer.Option(help="compare only these, as '/mushpipe/*'")] = "*",
    long: Annotated[bool, typer.Option("--long", help="tell of every frame")] = False,
) -> None:
    """Compare two result recordings; exit with 3 where they differ."""
    from mushpipe.core.errors import EXIT_DIFFERS
    from mushpipe.proof.compare import compare as compare_files

    found = compare_files(a, b, tol, topics)
    for line in _every(found.differences) if long else _summary(found.differences):
        sys.stdout.write(line + "\n")
    sys.stdout.write(_verdict(found) + "\n")
    raise typer.Exit(EXIT_DIFFERS if found.differences else 0)


def _every(differences: Iterable[Difference]) -> Iterator[str]:
    for d in differences:
        yield f"frame {d.sequence:5}  {d.topic}  {d.field or 'message'}: {d.text}"


def _summary(differences: Iterable[Difference]) -> Iterator[str]:
    """Yield one line per topic and field."""

    def place(d: Difference) -> tuple[str, str]:
        return d.topic, d.field

    for (topic, name), group in groupby(sorted(differences, key=place), place):
        members = sorted(group, key=lambda d: d.sequence)
        first = members[0]
        yield (
            f"{topic}  {name or 'message'}: {len(members)} frames differ, "
            f"first frame {first.sequence}: {first.text}"
        )


def _verdict(found: Comparison) -> str:
    number = len(found.differences)
    outcome = f"{number} differences" if number else "the same"
    return f"{found.messages} messages on {len(found.topics)} topics: {outcome}"


def register(app: typer.Typer) -> None:
    """Add the verbs to the program."""
    app.command()(compare)
