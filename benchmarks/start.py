"""How long the program takes to start: `mushpipe --help`, and the demo graph to its first frame.

    python benchmarks/start.py

The least of several runs with warm caches of files and kernels; the first frame is that which
`mushpipe run graphs/demo.yaml --frames 1` has recorded, shown and reported when it ends.
"""

from __future__ import annotations

import subprocess
import sys
import tempfile
import time
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
MUSHPIPE = (sys.executable, "-c", "from mushpipe.cli import main; main()")
RUNS = 5


def seconds(*arguments: str) -> float:
    """Return how long a command takes, the least of several runs after one that warms up, s."""
    times = []
    for _ in range(RUNS + 1):
        begin = time.perf_counter()
        subprocess.run([*MUSHPIPE, *arguments], cwd=ROOT, check=True, capture_output=True)
        times.append(time.perf_counter() - begin)
    return min(times[1:])


def main() -> None:
    """Measure and print."""
    with tempfile.TemporaryDirectory() as folder:
        paths = [f"log.path={folder}/log.mcap", f"view.save={folder}/view.rrd"]
        settings = [word for path in paths for word in ("--set", path)]
        print(f"mushpipe --help: {seconds('--help'):.2f} s")
        demo = seconds("run", "graphs/demo.yaml", "--frames", "1", *settings)
        print(f"mushpipe run graphs/demo.yaml, one frame: {demo:.2f} s")


if __name__ == "__main__":
    main()
