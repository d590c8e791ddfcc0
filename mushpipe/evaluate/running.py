"""Running a graph for evaluation: on each recording, once per alternative of a matrix."""

from __future__ import annotations

import itertools
import re
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path

from mushpipe.core.document import read_document
from mushpipe.core.errors import UsageError
from mushpipe.core.files import files_of, recording_of
from mushpipe.core.graph import compile_document
from mushpipe.core.paths import require_listed
from mushpipe.core.plan import Plan
from mushpipe.core.plugins import Registry, load_registry
from mushpipe.core.report import RunReport
from mushpipe.core.stage import RunInfo

_NO_BRACES = str.maketrans("{}", "()")

SINK = "evaluation"
Override = str | tuple[str, str]
"""A text ``a.b=value``, alone or with the option of the command line that it comes from."""


@dataclass(frozen=True)
class Alternative:
    """A way to set the graph: its name in tables, and what it overrides."""

    label: str
    overrides: tuple[str, ...] = ()


def alternatives(matrix: Iterable[str]) -> list[Alternative]:
    """Return every combination of ``a.b=x,y`` texts; the first is what others are compared with.

    Commas within brackets belong to a value: ``detect.radius_px=[8,38],[8,45]``.

    Raises:
        UsageError: A text has no values, or the same twice.
    """
    axes = []
    for text in matrix:
        path, equals, values = text.partition("=")
        options = [value.strip() for value in _split(values)]
        if not equals or not all(options) or len(set(options)) < len(options):
            raise UsageError(f"--matrix {text}: expected a.b=value,other with different values")
        axes.append([f"{path.strip()}={value}" for value in options])
    return [Alternative(" ".join(chosen), chosen) for chosen in itertools.product(*axes)]


def _split(values: str) -> list[str]:
    """Split at the commas that stand outside of brackets."""
    parts, depth = [""], 0
    for letter in values:
        depth += (letter in "[{") - (letter in "]}")
        if letter == "," and depth == 0:
            parts.append("")
        else:
            parts[-1] += letter
    return parts


def recordings_in(paths: Sequence[Path]) -> list[Path]:
    """Return the recordings that paths name; a folder stands for all ``*.mcap`` in it, or ``MCAP``.

    Raises:
        UsageError: A folder holds none, or may not be read.
    """
    found: list[Path] = []
    for path in paths:
        require_listed(path)
        files = [path]
        if path.is_dir():
            files = sorted(file for file in path.iterdir() if file.suffix.lower() == ".mcap")
        if not files:
            raise UsageError(
                f"{path}: the folder holds no recordings (*.mcap); one of images is played by a "
                "graph whose source is 'images', or after mushpipe record --source FOLDER -o X.mcap"
            )
        found += files
    return found


def unique_names(files: Sequence[Path]) -> list[str]:
    """Return the names of files without folder and suffix, numbered where several have one."""
    return numbered([file.stem for file in files])


def numbered(names: Sequence[str]) -> list[str]:
    """Return names, with their number behind where several are the same."""
    result = list[str]()
    for number, own in enumerate(names):
        name = own if names.count(own) == 1 else f"{own}-{number}"
        while name in result or (name != own and name in names):
            name += "-"
        result.append(name)
    return result


def plan_for(
    graph: Path,
    recording: Path | None,
    overrides: Iterable[Override],
    out: Path,
    registry: Registry,
) -> Plan:
    """Compile a graph so that its results go to a file, and nowhere else.

    Its own sinks are left out: an evaluation must not reach a robot or write over results.
    The frames are recorded too where the source is not a recording that can be read again.

    Raises:
        GraphError: With every problem of the graph and the overrides.
    """
    document = read_document(graph)
    source = document.data.get("source")
    replayed = recording is not None or (isinstance(source, dict) and source.get("use") == "mcap")
    sink = {"use": "mcap", "path": str(out.absolute()), "frames": not replayed}
    document.data["sinks"] = {SINK: sink}
    return compile_document(
        document, registry, overrides, None if recording is None else str(recording)
    )


def result_path(plan: Plan) -> Path:
    """Return the file that a plan made by `plan_for` writes."""
    return files_of(plan.sinks[0], RunInfo(recording_of(plan.source), {}))[0]


def slug(alternative: Alternative) -> str:
    """Return an alternative's label as part of a file name."""
    return re.sub(r"[^A-Za-z0-9.=-]+", "_", alternative.label).strip("_")


def plans(
    graph: Path,
    recordings: Sequence[Path],
    overrides: Sequence[Override],
    options: Sequence[Alternative],
    out: Path,
) -> list[tuple[Alternative, int, Plan]]:
    """Compile every run before the first begins, so that a fault in the last shows at once.

    Returns:
        Per run its alternative, the number of its recording, and what to run.
    """
    given = [item if isinstance(item, str) else item[0] for item in overrides]
    changed = [o for text in options for o in (*given, *text.overrides)]
    if recordings and any(text.startswith(("source.path=", "source.use=")) for text in changed):
        raise UsageError(
            "source.path and source.use cannot be changed where recordings are given: they are "
            "what is played, and whose truth counts"
        )
    if set("{}") & set(str(out)):
        raise UsageError(f"--out {out}: a folder of results cannot have braces in its name")
    registry = load_registry()
    sources: Sequence[Path | None] = recordings or [None]
    # without braces, which a sink would take for what it fills in
    names = numbered([file.stem.translate(_NO_BRACES) for file in recordings]) or ["results"]
    result = []
    for option, label in zip(options, numbered([slug(each) for each in options]), strict=True):
        for number, (name, recording) in enumerate(zip(names, sources, strict=True)):
            file = out / ".".join(filter(None, [name, label, "mcap"]))
            varied = [(text, f"--matrix {text}") for text in option.overrides]
            plan = plan_for(graph, recording, [*overrides, *varied], file, registry)
            result.append((option, number, plan))
    return result


def require_results(report: RunReport) -> None:
    """Raise the error of a run that answered no frame at all."""
    if report.error is not None and not report.processed:
        raise report.error
