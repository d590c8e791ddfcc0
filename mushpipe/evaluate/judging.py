"""From result recordings to an evaluation: find the truth, judge every frame, count the rest."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

from mushpipe.core.errors import InputError, UsageError
from mushpipe.core.manifest import sha256
from mushpipe.evaluate.events import UP, Events, Verdict, comparable, events_of, judge
from mushpipe.evaluate.metrics import Value, measure
from mushpipe.evaluate.results import Detections, Results
from mushpipe.evaluate.truth import Place, TruthSet, has_truth, truth_of_recording
from mushpipe.traces import source_recording

OPTICAL = "the camera's optical frame"  # of labels that name none


@dataclass(frozen=True)
class Rules:
    """How to judge.

    Attributes:
        iou: Smallest circle IoU of a match.
        up: Direction against gravity in the camera's frame.
        resamples: Number of bootstrap samples.
        seed: Seed of the bootstrap.
    """

    iou: float = 0.5
    up: Sequence[float] = UP
    resamples: int = 1000
    seed: int = 0


@dataclass
class Judged:
    """The judged frames of one recording, and what was noticed on the way."""

    name: str
    results: Results
    truth: TruthSet
    recording: Path | None = None
    verdicts: list[Verdict] = field(default_factory=list)
    notes: list[str] = field(default_factory=list)

    def places(self) -> str:
        """Name the truth, with the first frame in it and those that the run looked at."""
        for kind, value in self.truth.frames:
            if seen := self.results.span("sequence" if kind == "index" else kind):
                known = f"{seen[0]} to {seen[-1]}"
                return f"{self.truth.name}: there {kind} {value} comes first, results have {known}"
        return self.truth.name


@dataclass
class Evaluation:
    """Judged recordings under one label (the alternative of a matrix, or "")."""

    rules: Rules
    recordings: list[Judged] = field(default_factory=list)
    label: str = ""

    @property
    def verdicts(self) -> list[Verdict]:
        """All judged frames."""
        return [verdict for judged in self.recordings for verdict in judged.verdicts]

    @property
    def damage(self) -> list[str]:
        """What could not be read, in words."""
        return [
            f"{name}: {text}"
            for judged in self.recordings
            for name, texts in (
                (judged.results.path.name, judged.results.damage),
                (judged.truth.name, judged.truth.damage),
            )
            for text in texts
        ]

    def events(self) -> Events:
        """Return what happened in all frames."""
        return events_of(self.verdicts, self.rules.up)


@dataclass(frozen=True)
class Summary:
    """The figures of one recording, or of all: what was counted, and the metrics by name."""

    name: str
    frames: int
    truths: int
    found: int
    missed: int
    false: int
    ignored: int
    values: dict[str, Value]


def summarise(name: str, verdicts: Sequence[Verdict], rules: Rules) -> Summary:
    """Return the figures of judged frames."""
    events = events_of(verdicts, rules.up)
    matchings = [verdict.matching for verdict in verdicts]
    found, missed = (sum(len(getattr(m, k)) for m in matchings) for k in ("truth", "missed"))
    return Summary(
        name=name,
        frames=len(verdicts),
        truths=found + missed,
        found=found,
        missed=missed,
        false=sum(len(m.false) for m in matchings),
        ignored=sum(len(m.ignored) for m in matchings),
        values=measure(events, len(verdicts), rules.resamples, rules.seed),
    )


def judge_results(
    results: Results, truth: TruthSet, rules: Rules, recording: Path | None = None, name: str = ""
) -> Judged:
    """Judge every frame whose truth is known.

    A frame with truth that the results do not answer counts as one in which nothing was found,
    unless the run was asked for a part of the recording and the frame is outside of it.

    Args:
        results: What was found.
        truth: What is there.
        rules: How to judge.
        recording: What the results were made from, where it is at hand.
        name: How the recording is called; if not given, after its file.
    """
    judged = Judged(name or (recording or results.path).stem, results, truth, recording)
    start = results.manifest.get("graph", {}).get("source", {}).get("start")
    if start and truth.numbered and results.frames and results.frames[0][0].sequence == 0:
        raise UsageError(
            f"{truth.name} labels frames by their number, and the frames of {results.path} are "
            f"counted from {start} s on: label them by 'stamp_ns', or run the whole recording"
        )
    _require_exact(results, truth)
    _judge_frames(judged, rules)
    if not all(map(comparable, judged.verdicts)):
        judged.notes.append("truth and results are in different frames: 3D errors are unknown")
    if truth.recording is None and _nothing_fits(judged.verdicts):
        judged.notes.append(
            f"nothing was found where {truth.name} has a mushroom: is it of this recording?"
        )
    if results.failed:
        judged.notes.append(f"{results.failed} frames failed when the graph ran")
    if error := results.summary.get("error"):
        judged.notes.append(f"the run ended early: {error}")
    unanswered, elsewhere = _unanswered(judged)
    if elsewhere:
        judged.notes.append(
            f"{elsewhere} frames of {truth.name} lie before or after what was played and are not "
            "judged"
        )
    if unanswered:
        judged.notes.append(f"{len(unanswered)} frames have no answer: all in them is missed")
    for place in unanswered:
        known = truth.frames[place]
        judged.verdicts.append(
            judge(judged.name, place, known, None, Detections.unknown(0), rules.iou)
        )
    judged.verdicts.sort(key=lambda verdict: verdict.place)
    return judged


def _nothing_fits(verdicts: Sequence[Verdict]) -> bool:
    """Return whether there are mushrooms and detections, and none of the ones is of the others."""
    matchings = [verdict.matching for verdict in verdicts]
    some = any(len(m.missed) for m in matchings) and any(len(m.false) for m in matchings)
    return some and not any(len(m.truth) for m in matchings)


def _require_exact(results: Results, truth: TruthSet) -> None:
    """Raise InputError where a label has the stamp of a frame as another program rounded it."""
    stamps = {header.stamp_ns for header, _ in results.frames}
    rounded = {value: stamp for stamp in stamps for value in _rounded(stamp) - stamps}
    for kind, value in truth.frames if truth.recording is None else ():
        if kind == "stamp_ns" and value in rounded:
            raise InputError(
                f"{truth.name}: no frame has the stamp_ns {value}: it is {rounded[value]}, rounded "
                "as by programs that keep numbers as floating point or in milliseconds; write all "
                "digits, or label frames by 'index'"
            )


def _rounded(stamp_ns: int) -> set[int]:
    """Return what a stamp becomes as a float of 64 bits, or in whole micro- or milliseconds."""
    halves = {(stamp_ns + half) // unit * unit for unit, half in ((1000, 500), (10**6, 500_000))}
    return {int(float(stamp_ns)), stamp_ns // 1000 * 1000, stamp_ns // 10**6 * 10**6} | halves


def _judge_frames(judged: Judged, rules: Rules) -> None:
    """Judge every answered frame whose truth is known, and each truth once."""
    unknown, places, repeated = 0, set[Place](), 0
    for header, detections in judged.results.frames:
        place = judged.truth.place(header)
        if place is None:
            unknown += 1
        elif place in places:
            repeated += 1
        else:
            places.add(place)
            known = judged.truth.frames[place]
            if known.frame_id is None and detections.frame_id in judged.results.robot_frames:
                known = replace(known, frame_id=OPTICAL)
            judged.verdicts.append(judge(judged.name, place, known, header, detections, rules.iou))
    if unknown:
        judged.notes.append(f"{unknown} frames have no truth and are not judged")
    if repeated:
        judged.notes.append(f"{repeated} frames repeat the stamp of another and are not judged")


def foreign_truth(results: Results, truth: TruthSet) -> str:
    """Say that the truth is carried by another recording than the one that was played."""
    played = results.played
    if not played or truth.recording in (None, results.path):
        return ""
    if sha256(truth.recording) in played:
        return ""
    return f"the truth is that of {truth.name}; what was played is {', '.join(played.values())}"


def _unanswered(judged: Judged) -> tuple[list[Place], int]:
    """Return the frames with truth that were not answered and should have been.

    Labels may be those of several recordings: frames beyond the ends of what was played are of
    another one. Returns how many these are, too.
    """
    answered = {verdict.place for verdict in judged.verdicts}
    results, left = judged.results, [p for p in judged.truth.frames if p not in answered]
    spans = {"stamp_ns": results.span("stamp_ns"), "index": results.span("sequence")}
    within = [(kind, value) for kind, value in left if value in spans[kind]]
    # without any answer, these results and this truth may have nothing to do with each other
    if not answered or results.partial:
        return within, 0
    labels = judged.truth.recording is None
    return (within, len(left) - len(within)) if labels and results.complete else (left, 0)


def find_truth(results: Results) -> TruthSet:
    """Return the truth of the recording that results were made from, or what they hold of it.

    The results' own copy lacks the frames that failed, so it is the second choice.

    Raises:
        InputError: Neither is to be found; a recording counts only with the SHA-256 that the
            results state.
    """
    stated = results.manifest.get("recordings") or [{}]
    path = source_recording(results.path, results.manifest)
    if (path is None or not has_truth(path)) and has_truth(results.path):
        return truth_of_recording(results.path)
    if path is None:
        of = f" of {stated[0]['file']}" if stated[0].get("file") else ""
        raise InputError(f"{results.path}: the truth{of} is not to be found; give it with --truth")
    if not has_truth(path):
        raise InputError(f"{path}: it carries no truth; give labels with --truth")
    return truth_of_recording(path)
