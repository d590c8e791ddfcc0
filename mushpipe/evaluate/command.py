"""What `mushpipe eval` does: run where asked to, judge, compare, hold against thresholds."""

from __future__ import annotations

import logging
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from itertools import combinations
from pathlib import Path

from mushpipe.core.errors import EXIT_DAMAGED, EXIT_DIFFERS, EXIT_OK, InputError, UsageError
from mushpipe.core.files import recording_of
from mushpipe.core.overwriting import spare
from mushpipe.core.paths import real
from mushpipe.core.plan import Plan
from mushpipe.core.report import RunReport
from mushpipe.evaluate.compare import differences
from mushpipe.evaluate.events import events_of
from mushpipe.evaluate.judging import (
    Evaluation,
    Judged,
    Rules,
    Summary,
    find_truth,
    foreign_truth,
    judge_results,
    summarise,
)
from mushpipe.evaluate.metrics import METRICS, Value
from mushpipe.evaluate.results import read_results
from mushpipe.evaluate.running import (
    Alternative,
    Override,
    alternatives,
    plans,
    recordings_in,
    require_results,
    result_path,
    unique_names,
)
from mushpipe.evaluate.speed import named, speed_of
from mushpipe.evaluate.thresholds import Outcome, check, parse_threshold, require_known
from mushpipe.evaluate.truth import TruthSet, has_truth, read_truth, truth_of_recording

logger = logging.getLogger("mushpipe")
GRAPHS = (".yaml", ".yml")
Runner = Callable[[Plan], RunReport]


@dataclass(frozen=True)
class Request:
    """The command line of `mushpipe eval`, apart from how the outcome is shown."""

    targets: list[Path]
    truth: list[Path]
    recordings: list[Path]
    overrides: list[Override]
    matrix: list[str]
    thresholds: list[str]
    topic: str | None
    rules: Rules

    def graph(self) -> Path | None:
        """Return the graph among the targets; None where all are results.

        Raises:
            UsageError: There are several, or options that need one.
        """
        graphs = [path for path in self.targets if path.suffix in GRAPHS]
        if len(graphs) > 1:
            raise UsageError("give one graph; --matrix compares alternatives of it")
        if not graphs and (self.recordings or self.matrix or self.overrides):
            raise UsageError("--recordings, --matrix, --set and --frames need a graph to run")
        return graphs[0] if graphs else None


@dataclass(frozen=True)
class Section:
    """One alternative with its figures."""

    evaluation: Evaluation
    overall: Summary
    recordings: list[Summary]
    speed: dict[str, dict[str, float]]

    @property
    def label(self) -> str:
        """Name of the alternative, "" where there is one only."""
        return self.evaluation.label

    def named(self) -> dict[str, float]:
        """Return every figure a threshold can be set on."""
        values = {name: value.value for name, value in self.overall.values.items()}
        return values | named(self.speed)


@dataclass(frozen=True)
class Comparison:
    """Paired differences of an alternative to the first one."""

    label: str
    base: str
    frames: int
    values: dict[str, Value]


@dataclass
class Judgement:
    """All that `mushpipe eval` has to say."""

    sections: list[Section]
    comparisons: list[Comparison]
    outcomes: list[tuple[str, Outcome]]
    run_exit_code: int = EXIT_OK

    @property
    def damage(self) -> list[str]:
        """What could not be read, in words."""
        texts = [text for section in self.sections for text in section.evaluation.damage]
        return list(dict.fromkeys(texts))

    @property
    def exit_code(self) -> int:
        """0, that of a failed run, 4 where a file is damaged, 3 where a threshold is missed."""
        if self.run_exit_code or self.damage:
            return self.run_exit_code or EXIT_DAMAGED
        return EXIT_OK if all(outcome.kept for _, outcome in self.outcomes) else EXIT_DIFFERS


def perform(request: Request, folder: Path, runner: Runner) -> Judgement:
    """Do what is asked.

    Args:
        request: The command line.
        folder: Where the results of a graph go.
        runner: Runs a plan.

    Raises:
        MushpipeError: Nothing can be judged.
    """
    thresholds = [parse_threshold(text) for text in request.thresholds]
    early = [t for t in thresholds if not t.name.startswith("speed_")]
    require_known(early, METRICS)
    graph = request.graph()
    code = EXIT_OK
    if graph is None:
        evaluations = _judge_files(request)
    else:
        evaluations, code = _judge_graph(request, graph, folder, runner)
    for evaluation in evaluations:
        _require_judged(evaluation)
    sections = [_section(evaluation) for evaluation in evaluations]
    for section in sections:
        require_known(thresholds, section.named())
    return Judgement(
        sections,
        [_compare(evaluations[0], other) for other in evaluations[1:]],
        [(s.label, outcome) for s in sections for outcome in check(thresholds, s.named())],
        code,
    )


def _judge_files(request: Request) -> list[Evaluation]:
    files = recordings_in(request.targets)
    truths = _given_truth(request, len(files))
    parts = [
        _judge(request, file, truth, None, name)
        for file, truth, name in zip(files, truths, unique_names(files), strict=True)
    ]
    if _same_frames(parts):
        return [Evaluation(request.rules, [part], label=part.name) for part in parts]
    return [Evaluation(request.rules, parts)]


def _same_frames(parts: Sequence[Judged]) -> bool:
    """Return whether results answer the same frames of a recording, and so are alternatives.

    Raises:
        UsageError: Some do and others do not: together, the former would count twice.
    """
    frames = [{(*part.results.played, v.place) for v in part.verdicts} for part in parts]
    pairs = [
        (one, other)
        for one, other in combinations(range(len(parts)), 2)
        if parts[one].results.played and frames[one] & frames[other]
    ]
    if 0 < len(pairs) < len(parts) * (len(parts) - 1) // 2:
        one, other = (parts[number] for number in pairs[0])
        recordings = ", ".join(one.results.played.values())
        raise UsageError(
            f"{one.name} and {other.name} answer the same frames of {recordings}, others do not: "
            "judge alternatives of one recording, or results of different ones"
        )
    return bool(pairs)


def _given_truth(request: Request, files: int) -> Sequence[TruthSet | None]:
    """Return the truth given for each file: one file of truth serves them all."""
    given = [read_truth(path) for path in request.truth]
    if len(given) not in (0, 1, files):
        raise UsageError(f"{len(given)} times --truth for {files} recordings: give one, or as many")
    return given * files if len(given) == 1 else given or [None] * files


def _judge_graph(
    request: Request, graph: Path, folder: Path, runner: Runner
) -> tuple[list[Evaluation], int]:
    recordings = recordings_in([*request.recordings, *(p for p in request.targets if p != graph)])
    recordings = [*{real(path): path for path in recordings}.values()]  # each counts once
    truths: Sequence[TruthSet | None]
    if recordings and not request.truth:
        recordings = _with_truth(recordings)
        truths = [truth_of_recording(path) for path in recordings]
    else:
        truths = _given_truth(request, max(1, len(recordings)))
    options = alternatives(request.matrix) if request.matrix else [Alternative("")]
    evaluations = {each.label: Evaluation(request.rules, label=each.label) for each in options}
    worst = EXIT_OK
    files = zip(recordings, unique_names(recordings), strict=True)
    played: Sequence[tuple[Path | None, str]] = [*files] or [(None, "")]
    runs = plans(graph, recordings, request.overrides, options, folder)
    for *_, plan in runs:
        spare(result_path(plan), *request.truth)
    for text in dict.fromkeys(text for *_, plan in runs for text in plan.warnings):
        logger.warning(text)
    for option, number, plan in runs:
        report = runner(plan)
        require_results(report)
        if report.error is not None:
            again = f"; 'mushpipe run {graph}' with its recording and settings keeps the frame"
            failed = report.failed and not option.label
            logger.warning("%s: %s%s", option.label or graph, report.error, again * bool(failed))
        worst = worst or report.exit_code
        recording, name = played[number]
        called = name or recording_of(plan.source)
        judged = _judge(request, result_path(plan), truths[number], recording, called)
        evaluations[option.label].recordings.append(judged)
    return list(evaluations.values()), worst


def _judge(
    request: Request, results: Path, truth: TruthSet | None, recording: Path | None, name: str
) -> Judged:
    """Judge a file of results; notes where the truth that was given is another recording's."""
    found = read_results(results, request.topic)
    judged = judge_results(found, truth or find_truth(found), request.rules, recording, name)
    if request.truth and (note := foreign_truth(found, judged.truth)):
        judged.notes.append(note)
    return judged


def _with_truth(recordings: list[Path]) -> list[Path]:
    kept = [path for path in recordings if has_truth(path)]
    for path in recordings:
        if path not in kept:
            logger.warning("%s carries no truth and is left out", path)
    if not kept:
        raise InputError("none of the recordings carries truth; give labels with --truth")
    return kept


def _require_judged(evaluation: Evaluation) -> None:
    if not evaluation.verdicts:
        places = ", ".join(judged.places() for judged in evaluation.recordings)
        raise InputError(f"no frame of the results is labelled in {places}")


def _section(evaluation: Evaluation) -> Section:
    rules, parts = evaluation.rules, evaluation.recordings
    overall = summarise("overall", evaluation.verdicts, rules)
    each = [replace(overall, name=parts[0].name)]
    if len(parts) > 1:
        each = [summarise(part.name, part.verdicts, rules) for part in parts]
    return Section(evaluation, overall, each, speed_of(part.results for part in parts))


def _compare(base: Evaluation, other: Evaluation) -> Comparison:
    """Compare two alternatives on the frames that both were judged on."""
    sides = [
        {(number, v.place): v for number, part in enumerate(e.recordings) for v in part.verdicts}
        for e in (base, other)
    ]
    common = [key for key in sides[0] if key in sides[1]]
    first, second = ([side[key] for key in common] for side in sides)
    rules = base.rules
    values = differences(
        events_of(first, rules.up),
        events_of(second, rules.up),
        len(common),
        rules.resamples,
        rules.seed,
    )
    return Comparison(other.label, base.label, len(common), values)
