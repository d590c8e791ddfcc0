"""A long replay with recorder, viewer and robots attached: memory must stay flat.

    python benchmarks/soak.py --minutes 60

It plays `recordings/dense.mcap` over and over through `graphs/station.yaml`. The results are split
into files of 200 MB, of which the finished ones are deleted, and Rerun's go to /dev/null. The exit
code is 3 where memory grew by more than the bound after the first fifth of the time, or where
frames were lost.
"""

from __future__ import annotations

import argparse
import resource
import sys
import tempfile
import threading
import time
from itertools import pairwise
from pathlib import Path
from statistics import mean

from mushpipe.core.document import read_document
from mushpipe.core.errors import EXIT_DIFFERS
from mushpipe.core.graph import compile_document
from mushpipe.core.plugins import load_registry
from mushpipe.core.report import RunReport
from mushpipe.core.run import run

ROOT = Path(__file__).resolve().parents[1]
ROWS = 10


class Watch:
    """Resident memory (MB) and frames, second by second; ends the run when its time is over."""

    def __init__(self, results: Path, seconds: float) -> None:
        self.results = results
        self.stop = threading.Event()
        self.seen: list[tuple[float, int, float]] = []
        self._begin = time.monotonic()
        self._seconds = seconds

    def __call__(self, report: RunReport) -> None:
        """Look, at most once a second."""
        now = time.monotonic() - self._begin
        if self.seen and now < self.seen[-1][0] + 1:
            return
        pages = int(Path("/proc/self/statm").read_text().split()[1])
        self.seen.append((now, report.processed, pages * resource.getpagesize() / 1e6))
        for finished in sorted(self.results.glob("*.mcap"))[:-1]:
            finished.unlink()
        if now > self._seconds:
            self.stop.set()

    def growth_mb(self) -> float:
        """Return mean memory of the last fifth less that of the second fifth."""
        fifth = len(self.seen) // 5
        memory = [row[2] for row in self.seen]
        return mean(memory[-fifth:]) - mean(memory[fifth : 2 * fifth])

    def table(self) -> None:
        """Print frames/s and memory over time."""
        print("| minutes | frames | frames/s | memory MB |\n|---|---|---|---|")
        marks = [self.seen[round(i * (len(self.seen) - 1) / ROWS)] for i in range(ROWS + 1)]
        for (t0, n0, _), (t1, n1, memory) in pairwise(marks):
            print(f"| {t1 / 60:.1f} | {n1} | {(n1 - n0) / (t1 - t0):.1f} | {memory:.0f} |")


def main() -> int:
    """Play, print, judge."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--minutes", type=float, default=60)
    parser.add_argument("--bound-mb", type=float, default=25, help="most growth of memory")
    arguments = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        watch = Watch(Path(folder), 60 * arguments.minutes)
        settings = [
            *("source.loop=0", "robot.port=0", "view.save=/dev/null"),
            *(f"log.path={folder}/results.mcap", "log.split_size=200MB"),
        ]
        document = read_document(ROOT / "graphs/station.yaml")
        recording = str(ROOT / "recordings/dense.mcap")
        plan = compile_document(document, load_registry(), settings, recording)
        report = run(plan, watch.stop, watch)
    if report.error is not None:
        raise report.error
    watch.table()
    latency = report.summary()["latency"]
    print(f"latency p50 {latency['p50_ms']:.0f} ms, p99 {latency['p99_ms']:.0f} ms")
    print(
        f"memory grew by {watch.growth_mb():.1f} MB, at most {arguments.bound_mb:g}; "
        f"the balance of frames {'closes' if report.balanced() else 'does NOT close'}"
    )
    flat = watch.growth_mb() <= arguments.bound_mb
    return 0 if flat and report.balanced() else EXIT_DIFFERS


if __name__ == "__main__":
    sys.exit(main())
