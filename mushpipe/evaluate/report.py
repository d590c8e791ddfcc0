"""One self-contained HTML page about a judgement: no script, no file beside it, no network."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from html import escape
from pathlib import Path

import numpy as np

from mushpipe.core.overwriting import write_text
from mushpipe.core.types import RgbdFrame
from mushpipe.evaluate.command import Comparison, Judgement, Section
from mushpipe.evaluate.events import Verdict
from mushpipe.evaluate.judging import Summary
from mushpipe.evaluate.metrics import Value
from mushpipe.evaluate.overlay import images_of, overlay, worst
from mushpipe.evaluate.plots import plots_of
from mushpipe.evaluate.show import (
    LABELS,
    comparison_title,
    digits_of,
    error_rows,
    interval,
    known_values,
    notes_of,
    number,
    stated_rows,
)

WORST = 6
CARDS = {
    "precision": ("precision", ""),
    "recall": ("recall", ""),
    "f": ("F", ""),
    "center_median_px": ("centre, median", " px"),
    "surface_z_std_mm": ("surface dZ, std", " mm"),
    "apex_mean_mm": ("apex, mean", " mm"),
    "diameter_bias_mm": ("diameter, bias", " mm"),
    "axis_mean_deg": ("axis, mean", "°"),
    "upright_mean_deg": ("“upright”, mean", "°"),
}
LEGEND = {
    "t": "true, found",
    "m": "true, missed",
    "d": "detected",
    "x": "false",
    "g": "ignored or may be found",
    "i": "detected, counts neither way",
}


def write_report(judgement: Judgement, folder: Path) -> Path:
    """Write ``index.html`` into a folder and return its path."""
    folder.mkdir(parents=True, exist_ok=True)
    path = folder / "index.html"
    write_text(path, page(judgement))
    return path


def page(judgement: Judgement) -> str:
    """Return the page."""
    style = Path(__file__).with_name("page.css").read_text(encoding="utf-8")
    body = [_heading(judgement), _thresholds(judgement)]
    body += [f'<p class="note">{escape(text)}</p>' for text in notes_of(judgement)]
    if len(judgement.sections) > 1:
        body.append(_alternatives(judgement))
    for i, section in enumerate(judgement.sections):
        body.append(_section(section, i))
    return (
        '<!doctype html>\n<html lang="en"><head><meta charset="utf-8">'
        '<meta name="viewport" content="width=device-width, initial-scale=1">'
        f"<title>mushpipe evaluation</title><style>{style}</style></head>"
        f"<body><main>{''.join(body)}</main></body></html>\n"
    )


def _heading(judgement: Judgement) -> str:
    first = judgement.sections[0]
    rules = first.evaluation.rules
    names = ", ".join(judged.name for judged in first.evaluation.recordings)
    bootstrap = f"95 % intervals from {rules.resamples} bootstrap samples of the frames"
    if first.overall.frames == 1:
        bootstrap += " (here of the mushrooms of the one frame)"
    return (
        f"<h1>Evaluation</h1><p>{escape(names)}</p>"
        f'<p class="soft">Frames: {first.overall.frames}; mushrooms that count: '
        f"{first.overall.truths}; a match is a circle IoU of at least "
        f"{rules.iou:g}; {bootstrap}.</p>"
    )


def _thresholds(judgement: Judgement) -> str:
    if not judgement.outcomes:
        return ""
    rows = []
    for label, outcome in judgement.outcomes:
        word = "kept" if outcome.kept else "missed"
        name = f"{outcome.threshold.text} {label}".strip()
        rows.append([escape(name), number(outcome.value, 4), f'<span class="{word}">{word}</span>'])
    return "<h3>Thresholds</h3>" + table(["threshold", "value", ""], rows)


def table(heads: Sequence[str], rows: Iterable[Sequence[str]], total: bool = False) -> str:
    """Return a table of cells that are HTML already; ``total`` sets off the last row."""
    head = "".join(f"<th>{escape(text)}</th>" for text in heads)
    lines = [f"<tr>{''.join(f'<td>{cell}</td>' for cell in row)}</tr>" for row in rows]
    if total and lines:
        lines[-1] = lines[-1].replace("<tr>", '<tr class="total">', 1)
    body = "".join(lines)
    return (
        f'<div class="scroll"><table><thead><tr>{head}</tr></thead>'
        f"<tbody>{body}</tbody></table></div>"
    )


def _interval(value: Value, digits: int) -> str:
    return interval(value, digits).replace("..", " … ")


def _cell(name: str, value: Value) -> str:
    digits = digits_of(name)
    below = _interval(value, digits)
    text = number(value.value, digits)
    return f'{text}<span class="interval">{below}</span>' if below else text


def _alternatives(judgement: Judgement) -> str:
    rows = [(section.label, section.overall) for section in judgement.sections]
    parts = ["<h2>Alternatives</h2>", _headline("alternative", rows, total=False)]
    parts += [_comparison(comparison) for comparison in judgement.comparisons]
    return "".join(parts)


def _comparison(comparison: Comparison) -> str:
    rows = []
    for name, value in known_values(comparison):
        digits = digits_of(name) + 1
        below = _interval(value, digits)
        sure = value.low > 0 or value.high < 0
        text = number(value.value, digits)
        rows.append([escape(name), f"<b>{text}</b>" if sure else text, below])
    title = escape(comparison_title(comparison))
    return f"<h3>{title}</h3>" + table(["metric", "difference", "95 % interval"], rows)


def _headline(first: str, rows: Sequence[tuple[str, Summary]], total: bool) -> str:
    counts = ("frames", "truths", "found", "missed", "false", "ignored")
    metrics = [n for n in CARDS if any(np.isfinite(s.values[n].value) for _, s in rows)]
    lines = [
        [
            escape(name),
            *(str(getattr(summary, count)) for count in counts),
            *(_cell(metric, summary.values[metric]) for metric in metrics),
        ]
        for name, summary in rows
    ]
    return table([first, *counts, *("".join(CARDS[n]) for n in metrics)], lines, total)


def _section(section: Section, place: int) -> str:
    overall = section.overall
    title = f"<h2>{escape(section.label)}</h2>" if section.label else ""
    rows = [(summary.name, summary) for summary in section.recordings]
    parts = [title, _cards(overall)]
    if len(rows) > 1:
        parts += ["<h3>Recordings</h3>", _headline("", [*rows, ("overall", overall)], total=True)]
    figures = "".join(
        f'<figure class="panel{" wide" if plot.wide else ""}">{plot.svg}'
        f"<figcaption><b>{escape(plot.title)}.</b> {escape(plot.caption)}</figcaption></figure>"
        for plot in plots_of(section.evaluation.events(), f"s{place}p")
    )
    parts += ["<h3>Plots</h3>", f'<div class="plots">{figures}</div>' if figures else ""]
    parts += [_errors(overall), _stated(overall), _speed(section), _worst(section)]
    return f"<section>{''.join(parts)}</section>"


def _cards(summary: Summary) -> str:
    cards = []
    for name, (title, unit) in CARDS.items():
        value = summary.values[name]
        if np.isfinite(value.value):
            digits = digits_of(name)
            below = _interval(value, digits) or "&nbsp;"
            text = f"{number(value.value, digits)}<small>{unit}</small>"
            cards.append(
                f'<div class="card"><span>{title}</span><b>{text}</b><span>{below}</span></div>'
            )
    return f'<div class="cards">{"".join(cards)}</div>'


def _errors(summary: Summary) -> str:
    rows = [
        [escape(title), str(n), *(_cell(*value) if value else "" for value in values)]
        for title, n, values in error_rows(summary)
    ]
    if not rows:
        return ""
    heading = "<h3>Errors of the mushrooms found, detected minus true</h3>"
    return heading + table(["", "n", *LABELS], rows)


def _stated(summary: Summary) -> str:
    rows = [[name, *(_cell(*value) for value in values)] for name, values in stated_rows(summary)]
    heads = ["", "given", "sigma given", "mean squared z"]
    return "<h3>Coverage, and calibration of the stated sigmas</h3>" + table(heads, rows)


def _speed(section: Section) -> str:
    rows = [
        [escape(stage), number(row["p50_ms"]), number(row["p95_ms"])]
        for stage, row in section.speed.items()
    ]
    return "<h3>Time per frame, ms</h3>" + table(["stage", "p50", "p95"], rows) if rows else ""


def _worst(section: Section) -> str:
    chosen = worst(section.evaluation.verdicts, WORST)
    if not chosen:
        return ""
    images: dict[int, RgbdFrame] = {}  # by verdict: recordings may share names and stamps
    for part in section.evaluation.recordings:
        own = {v.place: id(v) for v in chosen if v in part.verdicts}
        images |= {own[place]: frame for place, frame in images_of(part, own).items()}
    figures = [_frame(verdict, images.get(id(verdict))) for verdict in chosen]
    legend = "".join(
        f'<span><svg class="frame" viewBox="0 0 22 10"><line class="{style}" x1="0" y1="5" '
        f'x2="22" y2="5"/></svg>{text}</span>'
        for style, text in LEGEND.items()
    )
    return (
        f'<h3>Worst frames</h3><p class="legend">{legend}</p>'
        f'<div class="plots">{"".join(figures)}</div>'
    )


def _frame(verdict: Verdict, frame: RgbdFrame | None) -> str:
    m = verdict.matching
    at = f"{verdict.recording}, {verdict.place[0]} {verdict.place[1]}"
    text = f"F {number(verdict.f, 3)}: {len(m.missed)} missed, {len(m.false)} false"
    if verdict.header is None:
        text += ", no answer"
    return (
        f'<figure class="panel frame">{overlay(verdict, frame)}'
        f"<figcaption><b>{text}.</b> {escape(at)}</figcaption></figure>"
    )
