"""The program in a process of its own, as a shell starts it, and a graph for it."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

ROOT = Path(__file__).parents[2]
MAIN = [sys.executable, "-c", "from mushpipe.cli import main; main()"]
GRAPH = f"""\
mushpipe: 1
source: {{use: mcap, path: {ROOT / "recordings" / "first-bed.mcap"}}}
stages:
  segment: {{use: otsu}}
  open:    {{use: opening}}
  detect:  {{use: hough}}
  locate:  {{use: nearest-depth}}
  pick:    {{use: picks}}
sinks:
  log: {{use: mcap, path: out.mcap}}
"""


def mushpipe(*arguments: object, cwd: Path) -> subprocess.CompletedProcess[str]:
    command = [*MAIN, *map(str, arguments)]
    return subprocess.run(command, cwd=cwd, capture_output=True, text=True, check=False)
