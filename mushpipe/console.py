"""What the command line shows: logs, progress, tables. All of it goes to stderr."""

from __future__ import annotations

import json
import logging
import os
import signal
import sys
import threading
import time
from collections import deque
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

from rich.console import Console
from rich.logging import RichHandler
from rich.progress import Progress, SpinnerColumn, TextColumn, TimeElapsedColumn
from rich.table import Table

from mushpipe.core.errors import EXIT_INTERRUPTED
from mushpipe.core.files import files_read
from mushpipe.core.overwriting import require_writable, spare, write_text
from mushpipe.core.plan import Plan
from mushpipe.core.report import RunReport
from mushpipe.core.run import run

# Names may hold brackets, which are no markup.
stderr = Console(stderr=True, highlight=False, markup=False, soft_wrap=True)
WINDOW_S = 2.0  # over which the rate is shown
NOT_AGAIN = (
    "this frame does not fail again: the plugin was changed since, or what failed depends on the "
    "frames before it, or on something outside of the graph"
)


def set_up_logging(verbose: bool) -> None:
    """Send the log of the package to stderr."""
    plain = logging.Formatter("%(levelname)s: %(message)s")
    handler: logging.Handler = logging.StreamHandler()
    if stderr.is_terminal:
        handler = RichHandler(console=stderr, show_time=False, show_path=False)
        plain = logging.Formatter("%(message)s")
    handler.setFormatter(plain)
    handler.addFilter(_once())
    logger = logging.getLogger("mushpipe")
    logger.handlers[:] = [handler]
    logger.setLevel(logging.DEBUG if verbose else logging.INFO)


def _once() -> Callable[[logging.LogRecord], bool]:
    """Return a filter that lets each notice pass once: a graph that runs again gives it again."""
    seen = set[str]()

    def is_new(record: logging.LogRecord) -> bool:
        if record.levelno != logging.INFO:
            return True
        try:
            text = record.getMessage()
        except Exception:  # of a plugin, whose arguments do not fit: the handler tells where
            return True
        new = text not in seen
        seen.add(text)
        return new

    return is_new


@contextmanager
def interruptible(stop: threading.Event) -> Iterator[None]:
    """Set ``stop`` on the first Ctrl-C or SIGTERM; leave at once on the second."""

    def handle(number: int, _: Any) -> None:
        if stop.is_set():
            os._exit(EXIT_INTERRUPTED)
        stop.set()
        name = signal.Signals(number).name
        with suppress(OSError, SystemExit):  # rich's, where Ctrl-C ended who reads it, too
            stderr.print(f"{name}: finishing this frame; once more leaves at once", style="yellow")

    old = {number: signal.signal(number, handle) for number in (signal.SIGINT, signal.SIGTERM)}
    try:
        yield
    finally:
        for number, handler in old.items():
            signal.signal(number, handler)


class Rate:
    """How many frames a second there are now: a mean of the whole run hides that a camera slows."""

    def __init__(self) -> None:
        self._counts: deque[tuple[float, int]] = deque()

    def at(self, now_s: float, count: int) -> float:
        """Take in how many there were at a moment; return the rate of the last `WINDOW_S`.

        It is 0 at the first, and goes back to the count before where that is older.
        """
        self._counts.append((now_s, count))
        while len(self._counts) > 2 and now_s - self._counts[1][0] >= WINDOW_S:
            self._counts.popleft()
        begin_s, before = self._counts[0]
        return (count - before) / (now_s - begin_s) if now_s > begin_s else 0.0


@contextmanager
def progress_bar(size: Callable[[], int] | None = None) -> Iterator[Any]:
    """Yield a function that shows a `RunReport`; it shows nothing where stderr is no terminal.

    Args:
        size: Returns the bytes written so far, where they are to be shown.
    """
    if not stderr.is_terminal:
        jit = sys.modules.get("mushpipe.core.jit")  # of a graph that has kernels
        if jit is not None and jit.cold():
            logging.getLogger("mushpipe").info("the first run of all compiles: a minute or two")
        yield None
        return
    columns = (SpinnerColumn(), TextColumn("{task.description}"), TimeElapsedColumn())
    with Progress(*columns, console=stderr, transient=True) as bar:
        task = bar.add_task("preparing; the first run of all compiles", total=None)
        rate = Rate()

        def show(report: RunReport) -> None:
            fps = rate.at(time.monotonic(), report.processed)
            text = f"{report.processed} frames  {fps:.1f} fps  {report.dropped} dropped"
            text += f"  {size() / 1e6:.1f} MB" if size else ""
            bar.update(task, description=text)

        yield show


def execute(
    plan: Plan, manifest: Path | None, capsules: Path | None, size: Callable[[], int] | None = None
) -> RunReport:
    """Run a plan in front of a user; None writes no manifest, no capsules; see `progress_bar`."""
    spare(manifest, *files_read(plan))
    require_writable(manifest, with_folder=True)
    stop = threading.Event()
    with interruptible(stop), progress_bar(size) as show:
        report = run(plan, stop, show, capsules)
    show_report(report)
    try:
        if manifest is not None and report.opened:  # else it is still that of the run before
            spare(manifest, *report.files)
            manifest.parent.mkdir(parents=True, exist_ok=True)
            content = {**report.manifest, "result": report.summary()}
            write_text(manifest, json.dumps(content, indent=2) + "\n")
            stderr.print(f"manifest: {manifest}", style="dim")
    finally:  # a full disk takes no manifest either, and is not what went wrong first
        if report.error is not None:
            stderr.print(f"error: {report.error}", style="bold red")
    return report


def durations_table(
    times: Mapping[str, Mapping[str, float]], ratios: Mapping[str, float] | None = None
) -> Table:
    """Return a table of what each node takes for a frame, as `Durations.summary` gives it.

    Args:
        times: By node.
        ratios: By node, how many times those of a baseline they are, where there is one.
    """
    columns = ("p50 ms", "p95 ms", "p99 ms", "max ms", *(["x baseline"] if ratios else []))
    table = Table("", *columns, box=None, pad_edge=False)
    for column in table.columns[1:]:
        column.justify = "right"
    for name, values in times.items():
        ratio = [f"{ratios[name]:.2f}" if name in ratios else ""] if ratios else []
        table.add_row(name, *(f"{value:.2f}" for value in values.values()), *ratio)
    return table


def show_report(report: RunReport) -> None:
    """Print the time per stage, the balance, and what was lost."""
    if report.frame.count:
        summary = report.summary()
        beside = {"all stages": summary["frame"], "latency": summary["latency"]}
        stderr.print(durations_table({**summary["durations"], **beside}))
    rate = report.processed / report.elapsed_s if report.elapsed_s else 0.0
    stderr.print(
        f"{report.frames_in} frames in = {report.processed} processed + {report.dropped} dropped "
        f"+ {report.failed} failed, in {report.elapsed_s:.1f} s ({rate:.1f} frames/s)"
    )
    if frames := (found := report.found).frames:
        number = f"{found.rows} in {frames} frames, {found.rows / frames:.1f} a frame"
        empty = f", none in {found.empty}" if found.empty else ""
        stderr.print(
            f"mushrooms: {number}{empty}" if found.rows else f"mushrooms: none in {frames} frames",
            style=None if found.rows else "yellow",
        )
    for name, count in report.source.items():
        stderr.print(f"{count} {name}", style="yellow")
    for name, sink in report.sinks.items():
        if sink.dropped or sink.failed:
            stderr.print(f"{name}: {sink.dropped} dropped, {sink.failed} failed", style="yellow")
    if not report.balanced():
        stderr.print("the balance does not close: frames were lost unaccounted", style="bold red")
    for path in report.capsules:
        stderr.print(
            f"the failing frame is saved: mushpipe run {path} runs it again, -v says where it fails"
        )
