"""The verbs `eval` and `calibrate`; everything heavy is imported when they run."""

from __future__ import annotations

import math
import sys
import tempfile
import threading
from collections.abc import Iterable
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from mushpipe.options import file_argument, file_option, finite, source_overrides
from mushpipe.output import Output, OutputOption

if TYPE_CHECKING:
    from mushpipe.core.plan import Plan
    from mushpipe.core.report import RunReport
    from mushpipe.evaluate.command import Request
    from mushpipe.evaluate.judging import Rules


TargetsArgument = Annotated[
    list[Path], file_argument("results to judge; or a graph to run, then recordings")
]
TruthOption = Annotated[
    list[Path] | None,
    file_option("labels (JSON) or a recording with truth; one for all, or one each"),
]
RecordingsOption = Annotated[
    list[Path] | None, file_option("what the graph runs on; a folder is all in it")
]
SetOption = Annotated[
    list[str] | None,
    typer.Option("--set", metavar="A.B=VALUE", help="change a setting of the graph"),
]
FramesOption = Annotated[int | None, typer.Option(help="stop each recording after N frames")]
MatrixOption = Annotated[
    list[str] | None, typer.Option(metavar="A.B=X,Y", help="compare alternatives with the first")
]
ThresholdOption = Annotated[
    list[str] | None, typer.Option(metavar="METRIC>=X", help="exit with 3 where missed: 'f>=0.98'")
]
PlaneOption = Annotated[
    str | None,
    typer.Option(metavar="METRES", help="judge the depth of a plane so far away; one, or one each"),
]
IouOption = Annotated[
    float, typer.Option(min=0.01, max=1, callback=finite, help="circle IoU of a match")
]
GravityOption = Annotated[
    str, typer.Option(metavar="X,Y,Z", help="direction of gravity in the camera's frame")
]
TopicOption = Annotated[str | None, typer.Option(help="what to judge, where there is a choice")]
ResamplesOption = Annotated[
    int, typer.Option(min=0, max=100_000, help="bootstrap samples; 0 is none")
]
SeedOption = Annotated[int, typer.Option(min=0, help="seed of the bootstrap")]
OutOption = Annotated[Path | None, typer.Option(help="folder to keep the graph's results in")]
ReportOption = Annotated[Path | None, typer.Option(help="folder for a page with plots")]


calibrate_app = typer.Typer(
    help="Measure a camera: the errors of its depth, and which way is up.", no_args_is_help=True
)


def register(app: typer.Typer) -> None:
    """Add the verbs to the program."""
    app.command("eval")(evaluate)
    app.add_typer(calibrate_app, name="calibrate")


@calibrate_app.command("depth")
def calibrate_depth(
    recordings: Annotated[list[Path], file_argument("planes square to the camera")],
    plane: Annotated[
        str, typer.Option(metavar="METRES", help="true distances; one for all, or one each")
    ],
    order: Annotated[
        int, typer.Option(min=0, max=2, help="0: an offset; 1, 2: with a slope, a curve")
    ] = 0,
    out: Annotated[
        Path | None, typer.Option("--out", "-o", help="file for depth-correct's `calibration`")
    ] = None,
    resamples: ResamplesOption = 1000,
    seed: SeedOption = 0,
) -> None:
    """Find what `depth-correct` must take off, from planes at known distances."""
    from mushpipe.core.overwriting import require_writable, spare, write_text
    from mushpipe.evaluate.calibrate import fit_correction
    from mushpipe.evaluate.plane import judge_planes
    from mushpipe.evaluate.show import plane_table

    spare(out, *recordings)
    require_writable(out)
    rows, _, _ = judge_planes(recordings, plane, [], resamples, seed)
    correction = fit_correction(rows, order)
    _print([plane_table(rows)])
    _write(correction.fragment())
    if out is not None:
        write_text(out, correction.fragment())


@calibrate_app.command("up")
def calibrate_up(
    recording: Annotated[Path, file_argument("of a camera at rest, with its IMU")],
    topic: Annotated[str | None, typer.Option(help="of the readings, where there are more")] = None,
) -> None:
    """Find which way is up, for the setting `up`, from an accelerometer's readings."""
    from mushpipe.console import set_up_logging
    from mushpipe.evaluate.gravity import measure_up

    set_up_logging(False)
    _write(measure_up(recording, topic).fragment().rstrip())


def evaluate(
    targets: TargetsArgument,
    truth: TruthOption = None,
    recordings: RecordingsOption = None,
    set_: SetOption = None,
    frames: FramesOption = None,
    matrix: MatrixOption = None,
    threshold: ThresholdOption = None,
    plane: PlaneOption = None,
    iou: IouOption = 0.5,
    gravity: GravityOption = "0,0,1",
    topic: TopicOption = None,
    resamples: ResamplesOption = 1000,
    seed: SeedOption = 0,
    out: OutOption = None,
    report: ReportOption = None,
    output: OutputOption = Output.text,
) -> None:
    """Judge results against the truth, or run a graph and judge that."""
    from mushpipe.console import set_up_logging
    from mushpipe.evaluate.command import Request
    from mushpipe.evaluate.judging import Rules

    set_up_logging(False)
    rules = Rules(iou, _up(gravity), resamples, seed)
    if plane is not None:
        _require_none(
            truth=truth, recordings=recordings, set=set_, matrix=matrix,
            frames=frames, topic=topic, out=out, report=report,
        )  # fmt: skip
        raise typer.Exit(_planes(targets, plane, threshold or [], rules, output))
    request = Request(
        targets=targets,
        truth=truth or [],
        recordings=recordings or [],
        overrides=[*source_overrides(frames=frames), *(set_ or [])],
        matrix=matrix or [],
        thresholds=threshold or [],
        topic=topic,
        rules=rules,
    )
    raise typer.Exit(_judge(request, out, report, output))


def _require_none(**options: object) -> None:
    """Raise UsageError where options were given that `--plane` does not look at."""
    from mushpipe.core.errors import UsageError

    if given := [f"--{name}" for name, value in options.items() if value]:
        raise UsageError(f"--plane does not go with {', '.join(given)}")


def _judge(request: Request, out: Path | None, report: Path | None, output: Output) -> int:
    from mushpipe.core.errors import UsageError
    from mushpipe.core.overwriting import make_folder
    from mushpipe.core.paths import STDIO
    from mushpipe.evaluate.command import perform

    for option, folder in (("--out", out), ("--report", report)):
        if folder == STDIO:
            raise UsageError(f"{option} - is no folder: its files cannot go to standard output")
        if folder is not None:  # before the work that goes into them
            make_folder(folder)
    # Frames for the page may stand in the temporary results, so those live until it is written.
    with tempfile.TemporaryDirectory(prefix="mushpipe-eval-") as temporary:
        judgement = perform(request, out or Path(temporary), _run)
        if output is Output.json:
            from mushpipe.evaluate.plain import judgement_json

            _write(judgement_json(judgement))
        else:
            from mushpipe.evaluate.show import judgement_tables

            _print(judgement_tables(judgement))
        if report is not None:
            from mushpipe.console import stderr
            from mushpipe.evaluate.report import write_report

            stderr.print(f"report: {write_report(judgement, report)}", style="dim")
    return judgement.exit_code


def _planes(
    files: list[Path], plane: str, thresholds: list[str], rules: Rules, output: Output
) -> int:
    from mushpipe.evaluate.plane import judge_planes

    rows, outcomes, code = judge_planes(files, plane, thresholds, rules.resamples, rules.seed)
    if output is Output.json:
        from mushpipe.evaluate.plain import planes_json

        _write(planes_json(rows, outcomes, code))
    else:
        from mushpipe.evaluate.show import plane_table, threshold_table

        checked = [threshold_table(outcomes)] if outcomes else []
        _print([plane_table(rows), *checked])
    return code


def _up(gravity: str) -> tuple[float, ...]:
    """Return the direction against gravity."""
    from mushpipe.core.errors import UsageError

    try:
        up = tuple(-float(part) for part in gravity.split(","))
    except ValueError:
        up = ()
    if len(up) != 3 or not 0 < sum(x * x for x in up) < math.inf:
        raise UsageError(f"--gravity {gravity}: expected X,Y,Z, finite and not all 0")
    return up


def _run(plan: Plan) -> RunReport:
    from mushpipe.console import interruptible, progress_bar
    from mushpipe.core.plugins import prints_aside
    from mushpipe.core.run import run

    stop = threading.Event()
    with interruptible(stop), progress_bar() as show, prints_aside():
        report = run(plan, stop, show)
    if report.interrupted:
        raise typer.Exit(report.exit_code)
    return report


def _write(text: str) -> None:
    sys.stdout.write(text + "\n")


def _print(items: Iterable[Any]) -> None:
    from rich.console import Console

    console = Console(file=sys.stdout, highlight=False, markup=False)
    if not console.is_terminal:
        console.width = 200
    for item in items:
        console.print(item)
        console.print()
