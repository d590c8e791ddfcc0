"""The verbs `mushpipe figure` and `mushpipe view`; everything heavy is imported when they run."""

from __future__ import annotations

import threading
from enum import StrEnum
from itertools import chain
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer
from pydantic import ValidationError

from mushpipe.core.errors import EXIT_INTERRUPTED, DependencyError, MushpipeError, UsageError
from mushpipe.core.overwriting import require_writable, spare
from mushpipe.core.stage import RunInfo
from mushpipe.options import file_argument

if TYPE_CHECKING:
    from mushpipe.core.types import Trace
    from mushpipe.sinks.rerun import RerunSink
    from mushpipe.stages.registration import Alignment


class FigureKind(StrEnum):
    """The figures of the paper."""

    stages = "stages"
    localization = "localization"
    diameter = "diameter"
    pose = "pose"


def register(app: typer.Typer) -> None:
    """Add the verbs to the program."""
    app.command()(figure)
    app.command()(view)


def figure(
    results: Annotated[Path, file_argument("recording written by a sink mcap")],
    out: Annotated[
        Path,
        typer.Option("--out", "-o", help="image to write: .png .jpg .pdf .svg; .rrd of a pose"),
    ],
    kind: Annotated[FigureKind, typer.Option(help="which figure")] = FigureKind.stages,
    frame: Annotated[int, typer.Option(help="number of the frame")] = 0,
    id_: Annotated[
        int | None,
        typer.Option("--id", help="mushroom of a pose: its pick's id; without picks its row"),
    ] = None,
) -> None:
    """Draw a figure of the paper from a frame of a result recording."""
    from mushpipe.console import set_up_logging
    from mushpipe.figure import KINDS
    from mushpipe.figure_pose import draw_pose
    from mushpipe.sinks.rerun_clouds import write_clouds
    from mushpipe.traces import read_trace

    set_up_logging(False)
    if not out.suffix:  # matplotlib would write another file, out.png
        raise UsageError(f"{out}: expected the kind of image in its name: {out}.png, say")
    if id_ is not None and kind is not FigureKind.pose:
        raise UsageError(f"--id {id_}: only --kind pose draws one mushroom, {kind} draws all")
    rerun = out.suffix.lower() == ".rrd"
    if rerun and kind is not FigureKind.pose:
        text = f"{out}: only --kind pose is drawn in space; mushpipe view {results} --save {out} "
        raise UsageError(f"{text}writes all the rest")
    spare(out, results)
    require_writable(out)
    trace = read_trace(results, frame)
    poses = _aligned(results, trace, id_) if kind is FigureKind.pose else None
    if poses and rerun:
        write_clouds(out, poses)
        return
    drawn = draw_pose(poses) if poses else KINDS[kind](trace)
    try:
        drawn.savefig(out)
    except ValueError as error:  # a suffix that matplotlib does not know
        raise UsageError(f"{out}: {error}") from error
    except OSError as error:
        raise MushpipeError(f"{out}: cannot be written: {error.strerror}") from error


def _aligned(results: Path, trace: Trace, id_: int | None) -> list[tuple[str, Alignment]]:
    """Register mushrooms of a frame as the graph's `registration` did, if it has one."""
    from mushpipe.figure_pose import aligned
    from mushpipe.traces import read_manifest

    stages = read_manifest(results).get("graph", {}).get("stages", {}).values()
    stages = [s for s in stages if s["use"].rpartition(":")[2] == "registration"]
    settings = {k: v for s in stages[-1:] for k, v in s.items() if k not in ("use", "inputs")}
    return aligned(trace, settings, id_)


def view(
    file: Annotated[Path, file_argument("recording, or results written by a sink mcap")],
    save: Annotated[Path | None, typer.Option(help="write an .rrd file, open no window")] = None,
    serve: Annotated[
        int | None,
        typer.Option(metavar="PORT", min=1, max=65535, help="let viewers fetch it, until Ctrl-C"),
    ] = None,
    set_: Annotated[
        list[str] | None,
        typer.Option(
            "--set", metavar="A.B=VALUE", help="how it is played: source.color_topic=/camera/rgb"
        ),
    ] = None,
) -> None:
    """Open a recording or results in the Rerun viewer."""
    from mushpipe.console import interruptible, set_up_logging
    from mushpipe.core.recording import RecordingReader
    from mushpipe.sinks.rerun import RerunSink
    from mushpipe.sinks.rerun_server import has_display

    set_up_logging(False)
    spare(save, file)
    RecordingReader(file)  # that it is no recording is said before where it could be looked at
    spawn = save is None and serve is None
    if spawn and not has_display():
        raise DependencyError(
            f"there is no display. mushpipe view {file} --save out.rrd writes a file for the "
            f"command 'rerun' elsewhere; --serve 9876 lets viewers fetch it from this machine "
            "(through ssh -L 9876:localhost:9876, say: rerun rerun+http://127.0.0.1:9876/proxy)"
        )
    try:
        sink = RerunSink(save=save, spawn=spawn, serve=serve)
    except ValidationError as error:
        reason = error.errors()[0]["msg"].removeprefix("Value error, ")
        raise UsageError(f"--save {save}: {reason}") from error
    played = _source_settings(file, set_ or [])
    stop = threading.Event()
    with interruptible(stop):
        _play(file, played, sink, stop)
        if serve is not None:
            stop.wait()
        sink.close()


def _source_settings(file: Path, overrides: list[str]) -> dict[str, Any]:
    """Return the settings of the source that the command line gives."""
    from mushpipe.core.document import Document
    from mushpipe.core.graph import compile_document
    from mushpipe.core.plugins import load_registry

    source = {"use": "mcap", "path": str(file)}
    document = Document("view", Path.cwd(), {"mushpipe": 1, "source": source})
    node = compile_document(document, load_registry(), overrides).source
    if node.use != "mcap":
        raise UsageError(f"--set source.use={node.use}: view plays recordings, with 'mcap'")
    given = node.plugin.model_fields_set - {"path"}
    return {name: getattr(node.plugin, name) for name in given}


def _play(file: Path, played: dict[str, Any], sink: RerunSink, stop: threading.Event) -> None:
    from mushpipe.console import progress_bar
    from mushpipe.core.report import RunReport
    from mushpipe.traces import read_manifest, read_traces

    report, traces = RunReport(), read_traces(file, played)
    first = next(traces, None)  # what has none fails here, before an .rrd is emptied for it
    with progress_bar() as show:
        try:
            sink.open(RunInfo(file.stem, read_manifest(file)))
            for trace in chain([first] if first else [], traces):
                if stop.is_set():
                    raise typer.Exit(EXIT_INTERRUPTED)
                sink.consume(trace)
                report.processed += 1
                if show is not None:
                    show(report)
        except BaseException:  # what could be read is shown all the same, and no viewer stays
            sink.close()
            raise
