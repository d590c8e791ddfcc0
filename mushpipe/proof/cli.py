"""The verbs `mushpipe compare` and `mushpipe bench`."""

from __future__ import annotations

import json
import logging
import sys
from collections.abc import Iterable, Iterator
from dataclasses import replace
from itertools import groupby
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING, Annotated, Any

import typer

from mushpipe.core.errors import EXIT_DIFFERS, UsageError
from mushpipe.core.overwriting import require_writable, spare, write_text
from mushpipe.options import file_argument, file_option, finite

if TYPE_CHECKING:
    from mushpipe.core.plan import Plan
    from mushpipe.proof.compare import Comparison, Difference

logger = logging.getLogger("mushpipe")
SpeedOption = Annotated[
    float,
    typer.Option(
        min=0, callback=finite, help="pace of the replay: 1 is real time, 0 as fast as it goes"
    ),
]
AllowOption = Annotated[
    float,
    typer.Option(
        min=1, callback=finite, help="exit with 3 where a median is more times the baseline's"
    ),
]
_FIGURES = (
    *("frames", "failed", "frames_per_s", "cpu_ms_per_frame", "cores_busy"),
    *("allocated_mb_per_frame", "peak_memory_mb", "memory_growth_mb"),
)


def compare(
    a: Annotated[Path, file_argument("recording written by a sink mcap")],
    b: Annotated[Path, file_argument("another, to be the same")],
    tol: Annotated[
        float,
        typer.Option(
            min=0,
            callback=finite,
            help="what measured numbers, and which share of pixels, may differ",
        ),
    ] = 0.0,
    topics: Annotated[str, typer.Option(help="compare only these, as '/mushpipe/*'")] = "*",
    long: Annotated[bool, typer.Option("--long", help="tell of every frame")] = False,
) -> None:
    """Compare two result recordings; exit with 3 where they differ."""
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


def bench(
    graph: Annotated[Path, file_argument("graph file")],
    recording: Annotated[
        str | None, typer.Argument(help="recording to play in place of the graph's source")
    ] = None,
    frames: Annotated[int, typer.Option(help="frames to measure", min=10, max=10**6)] = 300,
    speed: SpeedOption = 0.0,
    set_: Annotated[
        list[str] | None, typer.Option("--set", metavar="A.B=VALUE", help="change a setting")
    ] = None,
    out: Annotated[Path | None, typer.Option("--json", help="file for the figures")] = None,
    baseline: Annotated[
        Path | None, file_option("figures of an earlier run, to compare with")
    ] = None,
    allow: AllowOption = 1.5,
) -> None:
    """Measure a graph: time of every node, latency, frames/s, CPU, memory.

    What its sinks write goes to a temporary folder.
    """
    from mushpipe.console import set_up_logging
    from mushpipe.core.document import read_document
    from mushpipe.core.files import files_read
    from mushpipe.core.graph import compile_document
    from mushpipe.core.plugins import load_registry
    from mushpipe.proof.bench import bench as measure
    from mushpipe.proof.bench import changes, conditions, read_baseline, slower

    set_up_logging(False)
    require_writable(out)
    _refuse_overridden(set_ or [])
    plan = compile_document(read_document(graph), load_registry(), set_ or [], recording)
    spare(out, *files_read(plan))
    now = conditions(_endless(plan, frames, speed))
    before = read_baseline(baseline, now) if baseline else None
    for text in (*plan.warnings, *(changes(now, before) if before else ())):
        logger.warning(text)
    with TemporaryDirectory(prefix="mushpipe-bench-") as folder:
        plan = plan.into(Path(folder))  # results of a run stay as they are
        result = measure(lambda count: _endless(plan, count, speed), frames)
    if result["failed"]:
        logger.warning(
            f"{result['failed']} frames failed: times are also of what was done of these"
        )
    ratios = slower(result, before) if before else {}
    _show(result, ratios)
    if out is not None:
        write_text(out, json.dumps(result, indent=2) + "\n")
    too_slow = {name: ratio for name, ratio in ratios.items() if ratio > allow}
    for name, ratio in too_slow.items():
        logger.error(
            f"{name} takes {ratio:.2f} times as long as in {baseline}; --allow is {allow:g}"
        )
    raise typer.Exit(EXIT_DIFFERS if too_slow else 0)


def _refuse_overridden(overrides: list[str]) -> None:
    """Raise UsageError where a change would be lost, since `bench` sets the same."""
    instead = {
        "source.max_frames": "say --frames",
        "source.speed": "say --speed",
        "source.loop": "the recording plays over and over, up to --frames",
    }
    for text in overrides:
        if (why := instead.get(text.partition("=")[0].strip())) is not None:
            raise UsageError(f"--set {text} has no effect here: {why}")


def _endless(plan: Plan, frames: int, speed: float) -> Plan:
    """Return a plan that plays its recording over and over, up to so many frames."""
    wanted = {"loop": 0, "speed": speed, "max_frames": frames}
    plugin = plan.source.plugin
    known = {name: value for name, value in wanted.items() if name in type(plugin).model_fields}
    return replace(plan, source=replace(plan.source, plugin=plugin.model_copy(update=known)))


def _show(result: dict[str, Any], ratios: dict[str, float]) -> None:
    from rich.console import Console

    from mushpipe.console import durations_table

    console = Console(file=sys.stdout, highlight=False, markup=False, soft_wrap=True)
    beside = {"all stages": result["frame"], "latency": result["latency"]}
    console.print(durations_table({**result["nodes"], **beside}, ratios))
    machine = result["machine"]
    console.print(f"{machine['cores']} cores of {machine['processor']}, Python {machine['python']}")
    for name in _FIGURES:
        console.print(f"{name.replace('_', ' ')}: {result[name]}")


def register(app: typer.Typer) -> None:
    """Add the verbs to the program."""
    app.command()(compare)
    app.command()(bench)
