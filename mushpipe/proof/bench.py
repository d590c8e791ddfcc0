"""What a graph costs on a recording: time of each node, frames/s, CPU, memory, allocation."""

from __future__ import annotations

import json
import os
import platform
import resource
import time
import tracemalloc
from collections.abc import Callable, Iterator, Mapping
from contextlib import ExitStack
from importlib.metadata import version
from itertools import islice
from pathlib import Path
from typing import Any

from mushpipe.core.chain import Chain
from mushpipe.core.edges import opened
from mushpipe.core.errors import InputError, UsageError
from mushpipe.core.manifest import build_manifest
from mushpipe.core.plan import Plan
from mushpipe.core.report import RunReport
from mushpipe.core.run import Progress, run
from mushpipe.core.stage import Source

WARM_UP_FRAMES = 3
TRACED_FRAMES = 5
LEAST_FRAMES = 2  # between which CPU time is taken
_LIBRARIES = ("mushpipe", "numpy", "numba", "opencv-python-headless")


def bench(plan_of: Callable[[int], Plan], frames: int) -> dict[str, Any]:
    """Run a graph three times: to warm up, to trace allocations, and to measure.

    Args:
        plan_of: Returns the plan that ends after so many frames.
        frames: How many frames are measured.

    Returns:
        Plain data, `conditions` among it; times in ms, memory in MB (1e6 bytes).

    Raises:
        MushpipeError: The run failed, or had less than two frames.
    """
    _run(plan_of(WARM_UP_FRAMES))
    watch = _Watch()
    report = _run(plan_of(frames), watch)
    if report.processed < LEAST_FRAMES:
        raise InputError(f"{plan_of(frames).file}: one frame is too few to measure CPU time with")
    cpu, elapsed = watch.cpu_s(), report.elapsed_s
    summary, peak = report.summary(), peak_mb()
    return {
        **conditions(plan_of(frames)),
        "frames": report.processed,
        "failed": report.failed,
        "frames_per_s": round(report.processed / elapsed, 2),
        "cpu_ms_per_frame": round(1e3 * cpu / report.processed, 2),
        "cores_busy": round(cpu / elapsed, 2),
        "allocated_mb_per_frame": _allocated_mb(plan_of(TRACED_FRAMES)),
        "peak_memory_mb": round(peak, 1),
        "memory_growth_mb": round(watch.growth_mb(), 2),
        "nodes": summary["durations"],
        "frame": summary["frame"],
        "latency": summary["latency"],
    }


def conditions(plan: Plan) -> dict[str, Any]:
    """Describe what is measured, and where."""
    manifest = build_manifest(plan)
    settings = manifest["graph"]
    settings["source"].pop("path", None)  # the same recording may lie elsewhere
    return {
        "graph": manifest["graph_file"],
        "recordings": manifest["recordings"],
        "settings": {name: settings[name] for name in ("source", "stages", "sinks")},
        "machine": machine(),
    }


def machine() -> dict[str, Any]:
    """Describe where figures were measured."""
    return {
        "processor": _processor(),
        "cores": len(os.sched_getaffinity(0)),
        "python": platform.python_version(),
        **{name: version(name) for name in _LIBRARIES},
    }


def _processor() -> str:
    lines = Path("/proc/cpuinfo").read_text().splitlines()
    return next(
        (line.partition(":")[2].strip() for line in lines if line.startswith("model name")),
        platform.processor(),
    )


def _run(plan: Plan, progress: Progress | None = None) -> RunReport:
    report = run(plan, progress=progress)
    if report.error is not None:
        raise report.error
    if not report.processed:
        raise InputError(f"{plan.file}: the source delivered no frame")
    return report


class _Watch:
    """CPU time and resident memory at each frame of a run, of two at least."""

    def __init__(self) -> None:
        self.seen_mb: list[float] = []
        self.seen_s: list[float] = []

    def __call__(self, report: RunReport) -> None:
        del report
        pages = int(Path("/proc/self/statm").read_text().split()[1])
        self.seen_mb.append(pages * resource.getpagesize() / 1e6)
        self.seen_s.append(time.process_time())

    def cpu_s(self) -> float:
        """Return the CPU time of all frames, from that between the first and the last."""
        count = len(self.seen_s)
        return (self.seen_s[-1] - self.seen_s[0]) * count / (count - 1)

    def growth_mb(self) -> float:
        """Return mean of the last fifth less mean of the second fifth."""
        fifth = max(len(self.seen_mb) // 5, 1)
        early, late = self.seen_mb[fifth : 2 * fifth], self.seen_mb[-fifth:]
        return sum(late) / len(late) - sum(early) / len(early)


def peak_mb() -> float:
    """Return the largest memory that this process had so far, MB."""
    # getrusage would give the peak of the program that started this one, where that is larger
    lines = Path("/proc/self/status").read_text().splitlines()
    (kib,) = (line.split()[1] for line in lines if line.startswith("VmHWM:"))
    return int(kib) * 1024 / 1e6


def _allocated_mb(plan: Plan) -> float:
    """Return the median over frames of the memory that the stages need at once for one.

    One frame after the other, on this thread: in a run it would depend on what else is on its way.
    """
    peaks: list[float] = []
    plan = plan.fresh()
    chain, source = Chain(plan), plan.source.plugin
    if not isinstance(source, Source):
        raise TypeError("the plan's source is not a Source")
    with ExitStack() as stack:
        for node in (plan.source, *plan.stages):
            stack.enter_context(opened(node))
        tracemalloc.start()
        stack.callback(tracemalloc.stop)
        for ticket, frame in enumerate(islice(source.frames(), TRACED_FRAMES)):
            tracemalloc.reset_peak()
            before, _ = tracemalloc.get_traced_memory()
            chain.passed(frame, ticket)
            peaks.append((tracemalloc.get_traced_memory()[1] - before) / 1e6)
    return round(sorted(peaks)[len(peaks) // 2], 2)


def slower(result: Mapping[str, Any], baseline: Mapping[str, Any]) -> dict[str, float]:
    """Return by node how many times the baseline's median its own is, where both are known."""
    before = {**baseline["nodes"], "all stages": baseline["frame"]}
    now = {**result["nodes"], "all stages": result["frame"]}
    return {
        name: now[name]["p50_ms"] / before[name]["p50_ms"]
        for name in now  # in the order of the graph
        if name in before
        and before[name]["p50_ms"] > 0
        and now[name]["p50_ms"] >= 0  # NaN of what had no frame
    }


def read_baseline(path: Path, now: Mapping[str, Any]) -> dict[str, Any]:
    """Read figures that `mushpipe bench --json` wrote, to be compared with those to be measured.

    Args:
        path: The file.
        now: The `conditions` of what is to be measured.

    Raises:
        UsageError: The file cannot be read, or holds something else, or figures that say nothing
            of whether this became slower: of another graph, recording, pace or machine.
    """
    try:
        content: dict[str, Any] = json.loads(path.read_text())
        slower(content, content)
        before, wanted = _identity(content), _identity(now)
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise UsageError(f"{path}: no figures of 'mushpipe bench --json': {error}") from error
    for name, value in wanted.items():
        if before[name] != value:
            raise UsageError(f"{path}: the figures are those of {before[name]}, not of {value}")
    return content


def _identity(content: Mapping[str, Any]) -> dict[str, str]:
    """Return, in words, what must be the same in figures that are compared."""
    machine, settings = content["machine"], content["settings"]
    files = [f"{each['file']} ({str(each['sha256'])[:12]})" for each in content["recordings"]]
    return {
        "graph": Path(content["graph"]).name,
        "recordings": ", ".join(files) or f"the source '{settings['source']['use']}'",
        "pace": f"speed {settings['source'].get('speed')}",
        "machine": f"{machine['cores']} cores of {machine['processor']}",
    }


def changes(now: Mapping[str, Any], before: Mapping[str, Any]) -> list[str]:
    """Say which settings and versions are not those of the baseline."""
    sides = [dict(_flat({n: c[n] for n in ("settings", "machine")})) for c in (now, before)]
    return [
        f"{name} is {sides[0].get(name)}, in the baseline {sides[1].get(name)}"
        for name in sorted(sides[0] | sides[1])
        if sides[0].get(name) != sides[1].get(name)
    ]


def _flat(values: Mapping[str, Any], at: str = "") -> Iterator[tuple[str, Any]]:
    for name, value in values.items():
        if isinstance(value, Mapping):
            yield from _flat(value, f"{at}{name}.")
        else:
            yield f"{at}{name}", value
