"""The verbs `mushpipe figure` and `mushpipe view`; everything heavy is imported when they run."""

from __future__ import annotations

from enum import StrEnum
from pathlib import Path
from typing import Annotated

import typer


class FigureKind(StrEnum):
    """The figures of the paper."""

    stages = "stages"
    localization = "localization"
    diameter = "diameter"


def register(app: typer.Typer) -> None:
    """Add the verbs to the program."""
    app.command()(figure)


def figure(
    results: Annotated[Path, typer.Argument(help="recording written by a sink mcap")],
    out: Annotated[Path, typer.Option("--out", "-o", help="image to write: .png .jpg .pdf .svg")],
    kind: Annotated[FigureKind, typer.Option(help="which figure")] = FigureKind.stages,
    frame: Annotated[int, typer.Option(help="number of the frame")] = 0,
) -> None:
    """Draw a figure of the paper from a frame of a result recording."""
    from mushpipe.console import set_up_logging
    from mushpipe.core.errors import UsageError
    from mushpipe.figure import KINDS
    from mushpipe.traces import read_trace

    set_up_logging(False)
    drawn = KINDS[kind](read_trace(results, frame))
    try:
        drawn.savefig(out)
    except (OSError, ValueError) as error:  # no such folder; a suffix matplotlib does not know
        raise UsageError(f"{out}: {error}") from error
