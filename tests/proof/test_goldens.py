"""Every recording still gives what it gave; `make goldens` renews what is meant to change."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest

from mushpipe.core.document import read_document
from mushpipe.core.graph import compile_document
from mushpipe.core.plugins import load_registry
from mushpipe.proof.compare import compare
from tests.evaluate.scenes import bed, picks_of, write_results
from tests.proof.goldens import (
    CASES,
    FOLDER,
    GRAPHS,
    LIMITS,
    RECORDINGS,
    ROOT,
    TOLERANCE,
    Case,
    renewed,
)

# Built-in plugins that no recording can show, each with the tests that stand in.
ELSEWHERE = {
    "realsense": "tests/live",  # needs librealsense's software device
    "onnx": "tests/stages/test_onnx_model.py",  # the model is the user's own
    "foxglove": "tests/io/test_foxglove.py",  # it keeps nothing
    "stream": "tests/cli/test_stream.py",  # it reads a pipe
    "images": "tests/io/test_image_files.py",  # it reads a folder
    "synthetic": "tests/sim",  # it is what the recordings were made with
}


@pytest.mark.parametrize("case", CASES, ids=str)
def test_a_recording_gives_what_it_gave(case: Case, tmp_path: Path) -> None:
    found = renewed(case, tmp_path / "new.mcap")
    assert found.differences == [], "see `make goldens`"
    assert found.messages >= 3 * case.frames


@pytest.mark.parametrize(
    ("name", "by", "differs"),
    [
        *((name, 5e-5, True) for name in ("position", "surface", "distance", "diameter")),
        ("sigma_position", 5e-5, True),
        ("diameter", 1e-6, False),
        *((name, 8e-3, True) for name in ("center", "radius")),
        ("center", 1e-3, False),
        ("score", 5e-3, True),
        ("score", 1e-4, False),
    ],
)
def test_a_golden_is_held_to_less_than_a_robot_could_notice(
    tmp_path: Path, name: str, by: float, differs: bool
) -> None:
    picks = picks_of(bed(0), sigma=0.01)
    changed = replace(picks, **{name: getattr(picks, name) + by})
    golden, new = (
        write_results(tmp_path / f"{label}.mcap", {0: value})
        for label, value in (("golden", picks), ("new", changed))
    )
    found = compare(golden, new, TOLERANCE, limits=LIMITS).differences
    assert [d.field for d in found] == [name] * differs


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
        used |= {node.use for node in plan.nodes}
    builtin = {
        entry.name for found in registry.entries.values() for entry in found
        if entry.distribution == "mushpipe"
    }  # fmt: skip
    assert builtin - used == set()
