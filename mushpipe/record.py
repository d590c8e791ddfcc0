"""The verb `mushpipe record`: a source into a recording, or into a pipe."""

from __future__ import annotations

import logging
from enum import StrEnum
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from mushpipe.core.errors import UsageError
from mushpipe.core.paths import STDIO
from mushpipe.options import source_overrides

if TYPE_CHECKING:
    from mushpipe.core.plan import Plan
    from mushpipe.core.report import RunReport

logger = logging.getLogger("mushpipe")
JPEG_QUALITY = 90


class Colour(StrEnum):
    """How colour images are stored."""

    raw = "raw"
    jpeg = "jpeg"


OutOption = Annotated[
    Path, typer.Option("--out", "-o", help="recording to write; - streams to standard output")
]
SourceOption = Annotated[str, typer.Option(help="source plugin, or a recording to copy")]
SetOption = Annotated[
    list[str] | None,
    typer.Option("--set", metavar="A.B=VALUE", help="change a setting: source.preset=short-range"),
]
FramesOption = Annotated[int | None, typer.Option(help="stop after N frames")]
DurationOption = Annotated[float | None, typer.Option(help="stop after so many seconds")]
ColourOption = Annotated[
    Colour, typer.Option("--colour", "--color", help="lossless, or JPEG of quality 90")
]
SplitOption = Annotated[
    str | None, typer.Option(metavar="SIZE", help="begin a new file at this size: 2GB, say")
]


def register(app: typer.Typer) -> None:
    """Add the verb to the program."""
    app.command("record")(record)


def record(
    out: OutOption,
    source: SourceOption = "realsense",
    set_: SetOption = None,
    frames: FramesOption = None,
    duration: DurationOption = None,
    colour: ColourOption = Colour.raw,
    split_size: SplitOption = None,
) -> None:
    """Record a source until it ends or Ctrl-C; what cannot be kept is counted and told."""
    from mushpipe.console import execute, set_up_logging

    set_up_logging(False)
    limits = source_overrides(frames=frames, duration=duration)
    if duration is not None and frames is None:  # a source's own number of frames would end it
        limits = [("source.max_frames=null", f"--duration {duration}"), *limits]
    # The sink looks once more: opening a camera takes time, in which another may have recorded it.
    settings = {"path": str(out), "timing": False, "overwrite": False}
    settings |= {"jpeg_quality": JPEG_QUALITY} if colour is Colour.jpeg else {}
    settings |= {"split_size": split_size} if split_size is not None else {}
    plan = _compile(settings, [*limits, *(set_ or [])], source)
    for text in plan.warnings:
        logger.warning(text)
    _refuse_to_overwrite(plan)
    size = None if out == STDIO else lambda: sum(path.stat().st_size for path in _files(plan))
    report = execute(plan, None, Path("failures"), size)
    _show_files(plan, report)
    raise typer.Exit(report.exit_code)


def _compile(settings: dict[str, Any], overrides: list[Any], source: str) -> Plan:
    from mushpipe.core.document import Document
    from mushpipe.core.graph import compile_document
    from mushpipe.core.plugins import load_registry

    sink = {"use": "mcap", **settings}
    # Of a recording every frame counts: one that cannot be written ends it.
    data = {"mushpipe": 1, "on_error": "fail", "sinks": {"recorder": sink}}
    document = Document("record", Path.cwd(), data)
    flags = {"path": "-o", "split_size": "--split-size"}
    for key, flag in flags.items():
        if key in settings:
            document.overrides["sinks", "recorder", key] = f"{flag} {settings[key]}"
    return compile_document(document, load_registry(), overrides, source)


def _files(plan: Plan) -> list[Path]:
    """Return the files of the recording that exist."""
    from mushpipe.core.files import files_of, recording_of
    from mushpipe.core.stage import RunInfo

    files = files_of(plan.sinks[0], RunInfo(recording_of(plan.source), {}))
    return [path for path in files if path.is_file()]


def _refuse_to_overwrite(plan: Plan) -> None:
    from mushpipe.core.recorder import EXISTS

    for path in _files(plan):
        raise UsageError(EXISTS.format(path))


def _show_files(plan: Plan, report: RunReport) -> None:
    from mushpipe.console import stderr

    stored = _files(plan)
    for path in stored:
        stderr.print(f"{path}: {path.stat().st_size / 1e6:.1f} MB")
    if report.dropped:
        cure = f"--colour jpeg or a faster {'disk' if stored else 'reader or network'} would help"
        slow = f"{report.dropped} frames were lost because writing was too slow; {cure}"
        stderr.print(slow, style="yellow")
