"""A judgement as plain data, for ``--format json``; what is not known is null there."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import asdict
from typing import Any

import orjson

from mushpipe.evaluate.command import Comparison, Judgement, Section
from mushpipe.evaluate.events import Verdict
from mushpipe.evaluate.judging import Summary
from mushpipe.evaluate.plane import PlaneRow
from mushpipe.evaluate.thresholds import Outcome

Json = dict[str, Any]


def judgement_json(judgement: Judgement) -> str:
    """Return a judgement as JSON."""
    rules = judgement.sections[0].evaluation.rules
    return _dump(
        {
            "rules": asdict(rules),
            "alternatives": [_section(section) for section in judgement.sections],
            "differences": [_with_metrics(item) for item in judgement.comparisons],
            "thresholds": [_outcome(label, item) for label, item in judgement.outcomes],
            "damage": judgement.damage,
            "exit_code": judgement.exit_code,
        }
    )


def planes_json(
    rows: Iterable[PlaneRow], outcomes: Iterable[tuple[str, Outcome]], exit_code: int
) -> str:
    """Return the depth accuracy on planes as JSON."""
    planes = [asdict(row) for row in rows]
    thresholds = [_outcome(name, item) for name, item in outcomes]
    return _dump({"planes": planes, "thresholds": thresholds, "exit_code": exit_code})


def _dump(content: Json) -> str:
    return orjson.dumps(content, option=orjson.OPT_SERIALIZE_NUMPY).decode()


def _section(section: Section) -> Json:
    parts = zip(section.evaluation.recordings, section.recordings, strict=True)
    return {
        "label": section.label,
        "overall": _with_metrics(section.overall),
        "recordings": [
            {
                **_with_metrics(summary),
                "results": str(judged.results.path),
                "topic": judged.results.topic,
                "truth": judged.truth.name,
                "notes": judged.notes,
            }
            for judged, summary in parts
        ],
        "speed": section.speed,
        "frames": [_frame(verdict) for verdict in section.evaluation.verdicts],
    }


def _with_metrics(item: Summary | Comparison) -> Json:
    content = asdict(item)
    content["metrics"] = content.pop("values")
    return content


def _frame(verdict: Verdict) -> Json:
    matching = verdict.matching
    return {
        "recording": verdict.recording,
        verdict.place[0]: verdict.place[1],
        "answered": verdict.header is not None,
        "found": len(matching.truth),
        "missed": len(matching.missed),
        "false": len(matching.false),
        "ignored": len(matching.ignored),
    }


def _outcome(label: str, item: Outcome) -> Json:
    return {
        "label": label,
        "threshold": item.threshold.text,
        "value": item.value,
        "kept": item.kept,
    }
