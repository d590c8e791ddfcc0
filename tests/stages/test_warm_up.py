"""Kernels are compiled when stages open: a frame that waits for one is stale when it is done."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
OTHERS = """
mushpipe: 1
source: {use: mcap, path: %s}
stages:
  fuse: {use: fuse-depth}
  height: {use: height}
  kmeans: {use: kmeans}
  otsu: {use: otsu}
  pde: {use: chan-vese, solver: pde, iterations: 2}
  morph: {use: chan-vese, solver: morphological, iterations: 2}
  detect: {use: phase-hough, radius_px: null}
  locate: {use: surface-fit}
  pose: {use: registration, global: none}
  pick: {use: picks, min_score: 0.99}
"""
# in a process of its own, since other tests compile the same kernels
SCRIPT = """
import sys
from pathlib import Path
from numba.core.dispatcher import Dispatcher
from mushpipe.core.chain import Chain
from mushpipe.core.document import read_document
from mushpipe.core.graph import compile_document
from mushpipe.core.plugins import load_registry
from mushpipe.core.run import run

def compiled():
    return {
        (kernel.py_func.__module__, kernel.py_func.__name__, str(signature))
        for name, module in list(sys.modules.items()) if name.startswith("mushpipe.")
        for kernel in vars(module).values() if isinstance(kernel, Dispatcher)
        for signature in kernel.signatures
    }

opened, passed = [], Chain.passed

def first(chain, *arguments):
    opened.append(compiled())
    return passed(chain, *arguments)

Chain.passed = first
report = run(compile_document(read_document(Path(sys.argv[1])), load_registry()))
late = sorted(compiled() - opened[0])
sys.exit(str(report.error or late) if report.error or late else 0)
"""


@pytest.mark.parametrize(
    ("graph", "recording"),
    [("pick", "sparse"), ("pick", "gaps"), ("classic", "gaps"), ("others", "gaps")],
)
def test_no_frame_waits_for_a_compiler(graph: str, recording: str, tmp_path: Path) -> None:
    played = ROOT / "recordings" / f"{recording}.mcap"
    if graph == "others":
        text = OTHERS % played
    else:
        text = (ROOT / "graphs" / f"{graph}.yaml").read_text()
        text = text.replace("../recordings/first-bed.mcap", str(played))
        text = text.replace("../out", str(tmp_path))
    (tmp_path / "graph.yaml").write_text(text)
    # a warning of NumPy's while a stage opens would be in the face of every user
    command = [
        sys.executable,
        "-W",
        "error::RuntimeWarning",
        "-c",
        SCRIPT,
        str(tmp_path / "graph.yaml"),
    ]
    done = subprocess.run(command, capture_output=True, text=True, timeout=400)
    assert done.returncode == 0, done.stderr
