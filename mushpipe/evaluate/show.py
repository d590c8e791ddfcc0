"""A judgement as tables for the terminal."""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Sequence

from rich.console import Console, ConsoleOptions, RenderResult
from rich.table import Table
from rich.text import Text

from mushpipe.evaluate.command import Comparison, Judgement, Section
from mushpipe.evaluate.judging import Summary
from mushpipe.evaluate.metrics import METRICS, Value
from mushpipe.evaluate.plane import PLANE_METRICS, PlaneRow
from mushpipe.evaluate.thresholds import Outcome

LABELS = ("bias", "mean", "std", "mae", "median", "p95")
HEADLINE = {
    "precision": "precision",
    "recall": "recall",
    "f": "F",
    "center_median_px": "centre px\nmedian",
    "apex_mean_mm": "apex mm\nmean",
    "diameter_bias_mm": "diameter mm\nbias",
    "axis_mean_deg": "axis deg\nmean",
    "upright_mean_deg": "upright deg\nmean",
}
RATIOS = ("precision", "recall", "f")
QUANTITIES = {
    "center": "centre, px",
    "center_u": "centre u, px",
    "center_v": "centre v, px",
    "radius": "radius, px",
    "surface": "surface point, mm",
    "surface_x": "surface dx, mm",
    "surface_y": "surface dy, mm",
    "surface_z": "surface dZ, mm",
    "apex": "apex, mm",
    "apex_x": "apex dx, mm",
    "apex_y": "apex dy, mm",
    "apex_z": "apex dZ, mm",
    "diameter": "diameter, mm",
    "axis": "axis, deg",
    "upright": "answer 'upright', deg",
    "tilt": "tilt, deg",
}
# for which sigmas are stated, each with what carries it
CARRIED = {"position": "position", "diameter": "diameter", "tilt": "axis"}
Named = tuple[str, Value]
"""A value with the name of its metric."""


def number(value: float, digits: int = 2) -> str:
    """Return a number for people; a dash where it is not known."""
    return f"{round(value, digits) + 0.0:.{digits}f}" if math.isfinite(value) else "-"


def interval(value: Value, digits: int = 2) -> str:
    """Return the interval of a value, empty where there is none."""
    if not math.isfinite(value.low):
        return ""
    return f"{number(value.low, digits)}..{number(value.high, digits)}"


def digits_of(name: str) -> int:
    """Return how many digits of a metric mean something: 3 of ratios, 2 of lengths and angles."""
    return 2 if METRICS[name].unit else 3


def error_rows(summary: Summary) -> Iterator[tuple[str, int, list[Named | None]]]:
    """Yield title, number of mushrooms and statistics, by `LABELS`, of each error that is known."""
    for quantity, title in QUANTITIES.items():
        metrics = {m.label: name for name, m in METRICS.items() if m.quantity == quantity}
        names = [metrics.get(label) for label in LABELS]
        if n := summary.values[next(iter(metrics.values()))].n:
            yield title, n, [(name, summary.values[name]) if name else None for name in names]


def stated_rows(summary: Summary) -> Iterator[tuple[str, list[Named]]]:
    """Yield what is given: how often it is, how often with a sigma, and how true sigmas are."""
    for name, carrier in CARRIED.items():
        keys = (f"coverage_{carrier}", f"coverage_sigma_{name}", f"calibration_{name}")
        yield carrier, [(key, summary.values[key]) for key in keys]


def cell(name: str, value: Value) -> Text:
    """Return a value above its interval."""
    digits = digits_of(name)
    text = Text(number(value.value, digits))
    below = interval(value, digits)
    return text.append(f"\n{below}", style="dim") if below else text


def judgement_tables(judgement: Judgement) -> Iterator[Titled | Text]:
    """Yield what to print, from top to bottom."""
    if len(judgement.sections) == 1:
        yield from _single(judgement.sections[0])
    else:
        rows = [(section.label, section.overall) for section in judgement.sections]
        yield headline_table("alternative", rows)
        for comparison in judgement.comparisons:
            yield comparison_table(comparison)
        for section in judgement.sections:
            yield from speed_table(section)
    if judgement.outcomes:
        yield threshold_table(judgement.outcomes)
    for text in notes_of(judgement):
        yield Text(f"note: {text}", style="yellow")


def _single(section: Section) -> Iterator[Titled | Text]:
    rows = [(summary.name, summary) for summary in section.recordings]
    if len(rows) > 1:
        rows.append(("overall", section.overall))
    yield headline_table("recording", rows)
    if section.overall.found:
        yield error_table(section.overall)
    yield stated_table(section.overall)
    yield from speed_table(section)


def notes_of(judgement: Judgement) -> list[str]:
    """Return what was noticed on the way, and what could not be read."""
    notes = [
        f"{judged.name}: {text}"
        for section in judgement.sections
        for judged in section.evaluation.recordings
        for text in judged.notes
    ]
    return list(dict.fromkeys([*notes, *judgement.damage]))


class Titled:
    """A table under a title that may be wider than it."""

    def __init__(self, title: str, first: str, columns: Iterable[str]) -> None:
        self.title = Text(title, style="bold")
        self.table = Table(box=None, pad_edge=False)
        self.table.add_column(first, no_wrap=True)
        for name in columns:
            self.table.add_column(name, justify="right", no_wrap=True)

    def add_row(self, *cells: str | Text, style: str = "") -> None:
        """Add a row."""
        self.table.add_row(*cells, style=style)

    def __rich_console__(self, console: Console, options: ConsoleOptions) -> RenderResult:
        """Yield title and table, as rich asks for them."""
        yield self.title
        yield self.table


def headline_table(first: str, rows: Sequence[tuple[str, Summary]]) -> Titled:
    """Counts and the figures that people ask for first, one row per recording.

    The intervals of its errors stand in `error_table`, for all recordings together.
    """
    counts = ("frames", "truths", "found", "false", "ignored")
    result = Titled("Detection", first, [*counts, *HEADLINE.values()])
    for name, summary in rows:
        numbers = [str(getattr(summary, count)) for count in counts]
        cells = [cell(n, summary.values[n]) for n in RATIOS]
        errors = [n for n in HEADLINE if n not in RATIOS]
        cells += [Text(number(summary.values[n].value)) for n in errors]
        result.add_row(name, *numbers, *cells)
    return result


def error_table(summary: Summary) -> Titled:
    """Every error of the mushrooms found, with its statistics."""
    result = Titled("Errors of the mushrooms found", "detected - true", ["n", *LABELS])
    for title, n, values in error_rows(summary):
        result.add_row(title, str(n), *(cell(*value) if value else "" for value in values))
    return result


def stated_table(summary: Summary) -> Titled:
    """How often a value is given at all, and whether the sigmas stated with it are true."""
    columns = ["given", "sigma given", "mean squared z"]
    result = Titled("Coverage and stated sigmas (1 is calibrated)", "value", columns)
    for name, values in stated_rows(summary):
        result.add_row(name, *(cell(*value) for value in values))
    return result


def speed_table(section: Section) -> Iterator[Titled]:
    """Time per stage, where the results hold it."""
    if section.speed:
        result = Titled(f"Time per frame {section.label}".strip(), "stage", ["p50 ms", "p95 ms"])
        for stage, row in section.speed.items():
            result.add_row(stage, number(row["p50_ms"]), number(row["p95_ms"]))
        yield result


def comparison_title(comparison: Comparison) -> str:
    """Return what is compared with what."""
    same = "the same frame" if comparison.frames == 1 else f"the same {comparison.frames} frames"
    return f"{comparison.label} minus {comparison.base}, on {same}"


def known_values(comparison: Comparison) -> list[tuple[str, Value]]:
    """Return the differences that are known, by the name of their metric."""
    return [item for item in comparison.values.items() if math.isfinite(item[1].value)]


def comparison_table(comparison: Comparison) -> Titled:
    """Paired differences on the same frames."""
    result = Titled(comparison_title(comparison), "metric", ["difference", "95 % interval"])
    for name, value in known_values(comparison):
        digits = digits_of(name) + 1
        sure = value.low > 0 or value.high < 0
        result.add_row(
            name, number(value.value, digits), interval(value, digits), style="" if sure else "dim"
        )
    return result


def threshold_table(outcomes: Sequence[tuple[str, Outcome]]) -> Titled:
    """What was asked for and what came out."""
    result = Titled("Thresholds", "threshold", ["value", ""])
    for label, outcome in outcomes:
        word = Text("kept", style="green") if outcome.kept else Text("missed", style="bold red")
        name = f"{outcome.threshold.text} {label}".strip()
        result.add_row(name, number(outcome.value, 4), word)
    return result


def plane_table(rows: Iterable[PlaneRow]) -> Titled:
    """The paper's Table I."""
    titles = ["mean mm", "std mm", "range mm", "offset mm", "flat std mm", "valid"]
    result = Titled("Depth on a plane", "recording", ["true mm", "frames", *titles])
    for row in rows:
        cells = [
            Text(number(value.value)).append(f"\n{interval(value)}".rstrip(), style="dim")
            for value in (row.values[name] for name in PLANE_METRICS)
        ]
        result.add_row(row.name, number(1e3 * row.distance_m, 1), str(row.frames), *cells)
    return result
