"""The example plugin with a network: installed as a package, run in a graph on a recording."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from onnx import helper

from tests.stages.networks import saved

ROOT = Path(__file__).parents[2]
GRAPH = """\
mushpipe: 1
source: {{use: mcap, path: {recordings}/gaps.mcap}}
stages:
  segment: {{use: yourmodel, model: near.onnx, limit: -0.49}}
  detect:  {{use: phase-hough, input: mask}}
sinks:
  log: {{use: mcap, path: found.mcap}}
"""


@pytest.fixture(scope="module")
def site(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder into which pip installed the example."""
    pytest.importorskip("hatchling")
    site = tmp_path_factory.mktemp("site")
    pip = [sys.executable, "-m", "pip", "install", "--quiet", "--no-deps", "--no-index"]
    pip += ["--no-build-isolation", "--target", str(site)]
    copied = tmp_path_factory.mktemp("source") / "mushpipe-yourmodel"
    copied.mkdir()
    for path in (ROOT / "examples/mushpipe-yourmodel").iterdir():
        if path.is_file():
            (copied / path.name).write_bytes(path.read_bytes())
    subprocess.run([*pip, str(copied)], check=True, capture_output=True)
    return site


def run(folder: Path, site: Path) -> subprocess.CompletedProcess[str]:
    graph = folder / "graph.yaml"
    graph.write_text(GRAPH.format(recordings=ROOT / "recordings"))
    code = "from mushpipe.cli import main; main()"
    return subprocess.run(
        [sys.executable, "-c", code, "run", str(graph), "--frames", "1"],
        env={**os.environ, "PYTHONPATH": f"{site}{os.pathsep}{ROOT}"},
        capture_output=True,
        text=True,
        check=False,
    )


def test_the_installed_package_runs_your_model(tmp_path: Path, site: Path) -> None:
    """The network's logit is minus the depth, so that the mask is what is nearer than 0.49 m."""
    weights = np.array([0.0, -1.0]).reshape(1, 2, 1, 1)
    node = helper.make_node("Conv", ["image", "weights"], ["found"])
    saved(tmp_path / "near.onnx", [node], {"weights": weights}, image=[1, 2, "h", "w"])
    done = run(tmp_path, site)
    assert done.returncode == 0, done.stderr
    assert "1 processed" in done.stderr
    assert (tmp_path / "found.mcap").stat().st_size > 0


def test_a_model_that_is_not_there_is_named(tmp_path: Path, site: Path) -> None:
    done = run(tmp_path, site)
    assert done.returncode == 2
    assert "near.onnx: there is no such file" in done.stderr
