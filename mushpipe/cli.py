"""The command line: `mushpipe run graph.yaml` and its siblings."""

from __future__ import annotations

import faulthandler
import json
import logging
import sys
from collections.abc import Iterator
from dataclasses import asdict
from enum import StrEnum
from importlib.metadata import version
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from mushpipe.core.closed import open_closed
from mushpipe.core.errors import EXIT_DAMAGED, EXIT_INTERRUPTED, GraphError, MushpipeError
from mushpipe.core.interrupt import watch
from mushpipe.core.overwriting import require_writable, write_text
from mushpipe.doctor import register as register_doctor
from mushpipe.evaluate.cli import register as register_eval
from mushpipe.options import file_argument, source_overrides
from mushpipe.output import Output, OutputOption
from mushpipe.proof.cli import register as register_proof
from mushpipe.record import register as register_record
from mushpipe.robot.commands import app as robot_app
from mushpipe.viewing import register as register_viewing

if TYPE_CHECKING:
    from mushpipe.core.plan import Plan

logger = logging.getLogger("mushpipe")
app = typer.Typer(
    help="RGB-D camera above a mushroom bed in, pick targets for a robot out.\n\n"
    "mushpipe run graphs/demo.yaml\n\n"
    "mushpipe run graphs/pick.yaml --source field.mcap --set sinks.log.path=out.mcap\n\n"
    "mushpipe export out.mcap --format csv",
    no_args_is_help=True,
    pretty_exceptions_enable=False,
    rich_markup_mode="rich",
)
plugins_app = typer.Typer(help="What is installed.", no_args_is_help=True)
app.add_typer(plugins_app, name="plugins")
app.add_typer(robot_app, name="robot")

GraphArgument = Annotated[Path, file_argument("graph file, or a failure capsule")]
SetOption = Annotated[
    list[str] | None,
    typer.Option("--set", metavar="A.B=VALUE", help="change a setting: segment.use=otsu"),
]
SourceOption = Annotated[
    str | None,
    typer.Option(
        "--source",
        help="recording, image or folder of images, source plugin, or - for a stream",
    ),
]
FramesOption = Annotated[int | None, typer.Option("--frames", help="stop after N frames")]


class Drawing(StrEnum):
    """Formats of `mushpipe graph`."""

    mermaid = "mermaid"
    dot = "dot"


class Export(StrEnum):
    """Formats of `mushpipe export`."""

    ndjson = "ndjson"
    csv = "csv"


def _out(text: str) -> None:
    sys.stdout.write(text + "\n")


def _version(asked: bool) -> None:
    if asked:
        _out(f"mushpipe {version('mushpipe')}")
        raise typer.Exit()


@app.callback()
def _program(
    asked: Annotated[
        bool,
        typer.Option("--version", callback=_version, is_eager=True, help="show it and end"),
    ] = False,
) -> None:
    del asked  # `_version` has looked at it


def _compile(graph: Path, overrides: list[Any], source: str | None, foxglove: bool = False) -> Plan:
    from mushpipe.core.capsule import capsule_document
    from mushpipe.core.document import read_document
    from mushpipe.core.graph import compile_document
    from mushpipe.core.plugins import load_registry

    document = capsule_document(graph) if graph.suffix.lower() == ".mcap" else read_document(graph)
    sinks = document.data.get("sinks") or {}
    if foxglove and isinstance(sinks, dict):
        document.data["sinks"] = {"foxglove": {"use": "foxglove"}, **sinks}
    plan = compile_document(document, load_registry(), overrides, source)
    for warning in plan.warnings:
        logger.warning(warning)
    return plan


@app.command()
def run(
    graph: GraphArgument,
    source: SourceOption = None,
    set_: SetOption = None,
    frames: FramesOption = None,
    start: Annotated[float | None, typer.Option(help="skip so many seconds")] = None,
    end: Annotated[float | None, typer.Option(help="stop at this second")] = None,
    speed: Annotated[
        float | None, typer.Option(help="pace: 1 is real time, 0 as fast as possible")
    ] = None,
    loop: Annotated[int | None, typer.Option(help="times to play; 0 is for ever")] = None,
    foxglove: Annotated[bool, typer.Option(help="serve it live to the Foxglove app")] = False,
    manifest: Annotated[Path | None, typer.Option(help="where to write run.json")] = None,
    capsules: Annotated[Path, typer.Option(help="folder for failing frames")] = Path("failures"),
    verbose: Annotated[bool, typer.Option("--verbose", "-v", help="log more")] = False,
) -> None:
    """Run a graph on its source, or on another one given by --source."""
    from mushpipe.console import NOT_AGAIN, execute, set_up_logging, stderr
    from mushpipe.core.manifest import manifest_of, manifest_path

    set_up_logging(verbose)
    flags = source_overrides(frames=frames, start=start, end=end, speed=speed, loop=loop)
    plan = _compile(graph, [*flags, *(set_ or [])], source, foxglove)
    repeated = graph.suffix.lower() == ".mcap" and source is None  # its frame is saved already
    beside = manifest_of(graph) if repeated else manifest_path(plan)
    report = execute(plan, manifest or beside, None if repeated else capsules)
    if repeated and report.processed and report.exit_code == 0:
        stderr.print(NOT_AGAIN, style="yellow")
    raise typer.Exit(report.exit_code)


@app.command()
def validate(
    graph: GraphArgument,
    source: SourceOption = None,
    set_: SetOption = None,
    output: OutputOption = Output.text,
) -> None:
    """Check a graph file without running it; report every fault at once."""
    from mushpipe.console import set_up_logging

    set_up_logging(False)
    try:
        plan = _compile(graph, set_ or [], source)
    except GraphError as error:
        if output is Output.json:
            _out(json.dumps({"problems": [asdict(problem) for problem in error.problems]}))
            raise typer.Exit(error.exit_code) from None
        raise
    missing = plan.missing_files()  # which another machine may have
    for text in missing:
        logger.warning(text)
    if output is Output.json:
        warnings = [*plan.warnings, *missing]
        _out(json.dumps({"problems": [], "warnings": warnings, "graph": plan.resolved()}))
    else:
        number = len(plan.warnings) + len(missing)
        parts = [_count(len(plan.stages), "stage"), _count(len(plan.sinks), "sink"), "no faults"]
        parts += [_count(number, "warning")] if number else []
        _out(f"{graph}: {', '.join(parts)}")


def _count(number: int, what: str) -> str:
    return f"{number} {what}{'' if number == 1 else 's'}"


@app.command()
def graph(
    graph: GraphArgument,
    output: Annotated[Drawing, typer.Option("--format")] = Drawing.mermaid,
    set_: SetOption = None,
) -> None:
    """Draw a graph as text: Mermaid or DOT."""
    from mushpipe.core import draw

    plan = _compile(graph, set_ or [], None)
    _out(draw.dot(plan) if output is Drawing.dot else draw.mermaid(plan))


@app.command()
def info(
    file: Annotated[Path, file_argument("recording or results")],
    output: OutputOption = Output.text,
) -> None:
    """Tell what a recording holds, and whether it is whole."""
    from mushpipe.info import describe, render

    content = describe(file)
    _out(json.dumps(content) if output is Output.json else render(content))
    raise typer.Exit(EXIT_DAMAGED if content["damage"] else 0)


@app.command()
def export(
    results: Annotated[Path, file_argument("recording written by a sink mcap")],
    output: Annotated[Export, typer.Option("--format")] = Export.ndjson,
    topic: Annotated[str | None, typer.Option(help="which picks, where there are several")] = None,
) -> None:
    """Print the picks of a result recording: one JSON line per frame, or one CSV line per pick."""
    from mushpipe.export import csv_lines, ndjson_lines

    lines: Iterator[str] = (csv_lines if output is Export.csv else ndjson_lines)(results, topic)
    for line in lines:
        _out(line)


@app.command()
def schema(
    out: Annotated[Path | None, typer.Option("--out", "-o", help="file to write")] = None,
) -> None:
    """Print the JSON Schema of graph files, for completion in an editor."""
    from mushpipe.core.plugins import load_registry
    from mushpipe.core.schema import graph_schema

    require_writable(out)
    text = json.dumps(graph_schema(load_registry()), indent=2)
    if out is None:
        _out(text)
    else:
        write_text(out, text + "\n")


@plugins_app.command("list")
def plugins_list(
    output: OutputOption = Output.text,
) -> None:
    """List stages, sources and sinks, and plugins that failed to load."""
    from mushpipe.core.plugins import load_registry
    from mushpipe.info import plugin_rows, render_plugins

    registry = load_registry()
    rows = plugin_rows(registry)
    _out(json.dumps(rows) if output is Output.json else render_plugins(rows))


@plugins_app.command("describe")
def plugins_describe(
    name: Annotated[str, typer.Argument(help="name of a plugin, or file.py:Class")],
) -> None:
    """Show what a plugin does, its inputs and outputs, and its settings."""
    from mushpipe.core.plugins import load_registry
    from mushpipe.info import describe_plugin

    _out(describe_plugin(load_registry(), name))


register_eval(app)
register_viewing(app)
register_record(app)
register_doctor(app)
register_proof(app)


def main() -> None:
    """Entry point: errors meant for the user become one message and an exit code."""
    open_closed()
    if logging.lastResort:  # of the verbs that set up no log: what they warn of is called a warning
        logging.lastResort.setFormatter(logging.Formatter("%(levelname)s: %(message)s"))
    faulthandler.enable(file=2)  # where native code of a plugin crashes, which one it was
    try:
        watch()
        app()
    except KeyboardInterrupt:
        sys.exit(EXIT_INTERRUPTED)
    except MushpipeError as error:
        sys.stderr.write(f"error: {error}\n")
        sys.exit(error.exit_code)
    except SystemExit as ended:
        # Who reads our output may have read enough (`| head`), which typer calls a failure.
        if not isinstance(ended.__context__, BrokenPipeError):
            raise
        sys.exit(0)
    except OSError as error:  # a full disk, a folder that may not be written to
        sys.stderr.write(f"error: {error.filename or 'output'}: {error.strerror or error}\n")
        sys.exit(1)
