"""How much later a frame arrives through `mushpipe record -o - | mushpipe run --source -`.

The same source, 640x480 colour and depth at 30 frames/s, feeds the same sink in one process and
through the pipe. A frame's age in the sink is the time since the source took it; both processes
share the clock.

    python benchmarks/pipe.py [frames]
"""

from __future__ import annotations

import subprocess
import sys
import tempfile
from pathlib import Path

import numpy as np

MAIN = [sys.executable, "-m", "mushpipe"]
PARTS = '''
import time
from collections.abc import Iterator
from typing import Any, ClassVar

import numpy as np
from pydantic import PrivateAttr

from mushpipe import Camera, Header, RgbdFrame, RunInfo, Sink, Source


class Camera30(Source):
    """Noise at 30 frames/s, live."""

    live: ClassVar[bool] = True

    def frames(self) -> Iterator[RgbdFrame]:
        rng = np.random.default_rng(1)
        color = rng.integers(0, 256, (480, 640, 3), np.uint8)
        depth = rng.integers(3000, 4000, (480, 640), np.uint16)
        camera = Camera(640, 480, 617.0, 617.0, 319.5, 239.5)
        due = time.monotonic()
        for i in range(10**9):
            due += 1 / 30
            time.sleep(max(0.0, due - time.monotonic()))
            now = time.time_ns()
            header = Header(now, i, "camera_color_optical_frame", now)
            yield RgbdFrame(header, color.copy(), depth.copy(), 0.000125, camera)


class Age(Sink):
    """Writes how old each frame is, in ns."""

    path: str = "ages"
    _file: Any = PrivateAttr(None)

    def open(self, run: RunInfo) -> None:
        self._file = open(self.path, "w")

    def consume(self, frame: RgbdFrame) -> None:
        self._file.write(f"{time.time_ns() - frame.header.arrival_ns}\\n")

    def close(self) -> None:
        self._file.close()
'''
GRAPH = """\
mushpipe: 1
source: {{use: "./parts.py:Camera30"}}
sinks: {{age: {{use: "./parts.py:Age", path: {path}}}}}
"""


def ages_ms(folder: Path, name: str, frames: int, piped: bool) -> np.ndarray:
    """Run once and return the age of each frame, without the first second."""
    (folder / f"{name}.yaml").write_text(GRAPH.format(path=folder / name))
    run = [*MAIN, "run", f"{name}.yaml", "--frames", str(frames)]
    if piped:
        record = [*MAIN, "record", "--source", "./parts.py:Camera30", "-o", "-"]
        quiet = subprocess.DEVNULL
        sender = subprocess.Popen(record, cwd=folder, stdout=subprocess.PIPE, stderr=quiet)
        subprocess.run([*run, "--source", "-"], cwd=folder, stdin=sender.stdout, check=True)
        assert sender.stdout is not None
        sender.stdout.close()
        sender.wait()
    else:
        subprocess.run(run, cwd=folder, check=True)
    return np.loadtxt(folder / name)[30:] / 1e6


def main() -> None:
    """Print both and their difference."""
    frames = int(sys.argv[1]) if len(sys.argv) > 1 else 300
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        (folder / "parts.py").write_text(PARTS)
        direct = ages_ms(folder, "direct", frames, piped=False)
        piped = ages_ms(folder, "piped", frames, piped=True)
    for label, ages in (("one process", direct), ("through a pipe", piped)):
        p50, p95 = np.quantile(ages, [0.5, 0.95])
        print(f"{label:15} age of a frame: p50 {p50:6.2f} ms, p95 {p95:6.2f} ms")
    print(f"the pipe adds {np.median(piped) - np.median(direct):.2f} ms at the median")


if __name__ == "__main__":
    main()
