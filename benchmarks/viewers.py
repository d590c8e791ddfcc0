"""What the sinks for viewers cost their threads per frame, beside the sink that only records.

python benchmarks/viewers.py RESULTS.mcap
"""

import sys
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from mushpipe import Circles, RunInfo, Sink, Trace
from mushpipe.sinks.foxglove import FoxgloveSink
from mushpipe.sinks.mcap import McapSink
from mushpipe.sinks.rerun import RerunSink
from mushpipe.traces import read_manifest, read_traces

ROUNDS = 20


def sinks(folder: Path) -> Iterator[tuple[str, Sink]]:
    """Yield the sinks that are compared."""
    yield "mcap", McapSink(path=folder / "a.mcap")
    yield "mcap, drawings: false", McapSink(path=folder / "b.mcap", drawings=False)
    yield "rerun, save", RerunSink(save=folder / "c.rrd")
    yield "foxglove, nobody connected", FoxgloveSink(port=0)


def cost_ms(sink: Sink, traces: list[Trace], run: RunInfo) -> float:
    """Return the median CPU time of `consume` on the sink's thread."""
    sink.open(run)
    times = []
    for i in range(ROUNDS):
        begin = time.thread_time()
        sink.consume(traces[i % len(traces)])  # type: ignore[attr-defined]
        times.append(1e3 * (time.thread_time() - begin))
    sink.close()
    return float(np.median(times[2:]))


def main() -> None:
    """Print a line per sink."""
    path = Path(sys.argv[1])
    traces, run = list(read_traces(path)), RunInfo("bench", read_manifest(path))
    values = [v for t in traces for outputs in t.outputs.values() for v in outputs]
    circles = [len(value) for value in values if isinstance(value, Circles)]
    height, width = traces[0].frame.color.shape[:2]
    print(f"{width}x{height}, {np.mean(circles):.0f} circles, median of {ROUNDS - 2} frames")
    with tempfile.TemporaryDirectory() as folder:
        for name, sink in sinks(Path(folder)):
            print(f"{name:28} {cost_ms(sink, traces, run):6.1f} ms CPU per frame")


if __name__ == "__main__":
    main()
