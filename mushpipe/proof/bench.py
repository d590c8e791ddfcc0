"""What a graph costs on a recording: time of each node, frames/s, CPU, memory, allocation."""

from __future__ import annotations

import json
import os
import platform
import resource
import time
import tracemalloc
from collections.abc import Callable, Mapping
from importlib.metadata import version
from pathlib import Path
from typing import Any

from mushpipe.core.errors import InputError, UsageError
from mushpipe.core.plan import Plan
from mushpipe.core.report import RunReport
from mushpipe.core.run import Progress, run

WARM_UP_FRAMES = 3
TRACED_FRAMES = 5
_LIBRARIES = ("mushpipe", "numpy", "numba", "opencv-python-headless")


def bench(plan_of: Callable[[int], Plan], frames: int) -> dict[str, Any]:
    """Run a graph three times: to warm up, to trace allocations, and to measure.

    Args:
        plan_of: Returns the plan that ends after so many frames.
        frames: How many frames are measured.

    Returns:
        Plain data; times in ms, memory in MB (1e6 bytes).

    Raises:
        MushpipeError: The run failed, or had no frames.
    """
    _run(plan_of(WARM_UP_FRAMES))
    allocated = _allocated_mb(plan_of(TRACED_FRAMES))
    watch = _Watch()
    report = _run(plan_of(frames), watch)
    cpu, elapsed = watch.cpu_s(), report.elapsed_s
    summary = report.summary()
    return {
        "graph": report.manifest["graph_file"],
        "recordings": report.manifest["recordings"],
        "machine": machine(),
        "frames": report.processed,
        "frames_per_s": round(report.processed / elapsed, 2),
        "cpu_ms_per_frame": round(1e3 * cpu / report.processed, 2),
        "cores_busy": round(cpu / elapsed, 2),
        "allocated_mb_per_frame": allocated,
        "peak_memory_mb": round(_peak_mb(), 1),
        "memory_growth_mb": round(watch.growth_mb(), 2),
        "nodes": summary["durations"],
        "frame": summary["frame"],
        "latency": summary["latency"],
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
    """CPU time and resident memory at each frame of a run."""

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
        return (self.seen_s[-1] - self.seen_s[0]) * count / max(count - 1, 1)

    def growth_mb(self) -> float:
        """Return mean of the last fifth less mean of the second fifth."""
        fifth = max(len(self.seen_mb) // 5, 1)
        early, late = self.seen_mb[fifth : 2 * fifth], self.seen_mb[-fifth:]
        return sum(late) / len(late) - sum(early) / len(early) if early else 0.0


def _peak_mb() -> float:
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024 / 1e6


def _allocated_mb(plan: Plan) -> float:
    """Return the median over frames of the memory that exists at once beyond what stays."""
    peaks: list[float] = []

    def note(report: RunReport) -> None:
        del report
        current, peak = tracemalloc.get_traced_memory()
        peaks.append((peak - current) / 1e6)
        tracemalloc.reset_peak()

    tracemalloc.start()
    try:
        _run(plan, note)
    finally:
        tracemalloc.stop()
    return round(sorted(peaks)[len(peaks) // 2], 2)


def slower(result: Mapping[str, Any], baseline: Mapping[str, Any]) -> dict[str, float]:
    """Return by node how many times the baseline's median its own is."""
    before = {**baseline["nodes"], "all stages": baseline["frame"]}
    now = {**result["nodes"], "all stages": result["frame"]}
    return {
        name: now[name]["p50_ms"] / before[name]["p50_ms"]
        for name in now.keys() & before.keys()
        if before[name]["p50_ms"]
    }


def read_baseline(path: Path, graph: Path) -> dict[str, Any]:
    """Read figures of a graph that `mushpipe bench --json` wrote.

    Raises:
        UsageError: The file cannot be read, or holds something else, or those of another graph.
    """
    try:
        content: dict[str, Any] = json.loads(path.read_text())
        content["nodes"], content["frame"]["p50_ms"]
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise UsageError(f"{path}: no figures of 'mushpipe bench --json': {error}") from error
    measured = Path(content.get("graph", graph)).name
    if measured != graph.name:
        raise UsageError(f"{path}: the figures are those of {measured}, not of {graph.name}")
    return content
