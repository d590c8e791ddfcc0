"""Every recording still gives what it gave; `make goldens` renews what is meant to change."""

from __future__ import annotations

from pathlib import Path

import pytest

from mushpipe.core.document import read_document
from mushpipe.core.graph import compile_document
from mushpipe.core.plugins import load_registry
from tests.proof.goldens import CASES, FOLDER, GRAPHS, RECORDINGS, ROOT, Case, renewed

# Built-in plugins that no recording can show, each with the tests that stand in.
ELSEWHERE = {
    "realsense": "tests/live",  # needs librealsense's software device
    "onnx": "tests/stages/test_onnx_model.py",  # the model is the user's own
    "foxglove": "tests/io/test_foxglove.py",  # it keeps nothing
    "stream": "tests/cli/test_stream.py",  # it reads a pipe
    "synthetic": "tests/sim",  # it is what the recordings were made with
}


@pytest.mark.parametrize("case", CASES, ids=str)
def test_a_recording_gives_what_it_gave(case: Case, tmp_path: Path) -> None:
    found = renewed(case, tmp_path / "new.mcap")
    assert found.differences == [], "see `make goldens`"
    assert found.messages >= 3 * case.frames


def test_every_recording_and_golden_has_its_counterpart() -> None:
    assert {case.recording for case in CASES} == set(RECORDINGS)
    assert {path for path in FOLDER.iterdir() if path.suffix == ".mcap"} == {
        case.golden for case in CASES
    }


def test_every_builtin_plugin_appears_in_a_replay() -> None:
    registry = load_registry()
    graphs = [*GRAPHS.values(), *(ROOT / "graphs").glob("*.yaml")]
    used = set(ELSEWHERE)
    for graph in graphs:
        plan = compile_document(read_document(graph), registry)
        used |= {node.use for node in (plan.source, *plan.stages, *plan.sinks)}
    builtin = {
        entry.name for found in registry.entries.values() for entry in found
        if entry.distribution == "mushpipe"
    }  # fmt: skip
    assert builtin - used == set()
