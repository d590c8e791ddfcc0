"""Figures of a run: that they are of the right frames and add up; never how fast it was."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from mushpipe import Circles, RgbdFrame, Stage
from mushpipe.core.errors import InputError, UsageError
from mushpipe.proof.bench import bench, read_baseline, slower
from tests.core.lab import Lab, circles, cli

ROOT = Path(__file__).parents[2]


class Allocates(Stage):
    """Holds 8 MB while it works on a frame."""

    def process(self, frame: RgbdFrame) -> Circles:
        held = np.zeros(1_000_000)
        return circles(1 + held.sum())


def test_figures_of_a_small_graph(lab: Lab) -> None:
    text = lab.chain("threshold", Allocates)
    result = bench(lambda count: lab.compile(text, f"source.count={count}"), 40)
    assert result["frames"] == 40
    assert list(result["nodes"]) == ["source", "a", "b", "out"]
    for times in (*result["nodes"].values(), result["frame"], result["latency"]):
        assert 0 <= times["p50_ms"] <= times["p95_ms"] <= times["p99_ms"] <= times["max_ms"]
    assert (
        result["latency"]["p50_ms"] >= result["frame"]["p50_ms"]
    )  # it waits, and then is worked on
    assert result["allocated_mb_per_frame"] == pytest.approx(8, abs=0.2)
    assert result["peak_memory_mb"] > 8
    json.dumps(result)


def test_a_source_without_frames_has_no_figures(lab: Lab) -> None:
    with pytest.raises(InputError, match="no frame"):
        bench(lambda _: lab.compile(lab.chain("threshold"), "source.count=0"), 10)


def figures(**medians: float) -> dict[str, Any]:
    nodes = {name: {"p50_ms": median} for name, median in medians.items()}
    return {"nodes": nodes, "frame": {"p50_ms": sum(medians.values())}}


def test_a_node_is_compared_with_itself_in_the_baseline() -> None:
    found = slower(figures(a=3.0, b=1.0, new=2.0), figures(a=2.0, b=2.0, old=9.0, c=0.0))
    assert found == pytest.approx({"a": 1.5, "b": 0.5, "all stages": 6 / 13})


@pytest.mark.parametrize("content", ["", "[]", '{"nodes": {}}', '{"nodes": {}, "frame": {}}'])
def test_a_file_without_figures_is_no_baseline(tmp_path: Path, content: str) -> None:
    path = tmp_path / "b.json"
    path.write_text(content)
    with pytest.raises(UsageError, match="no figures"):
        read_baseline(path, Path("graph.yaml"))


def test_the_verb_plays_a_short_recording_over_and_over(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    arguments = ["bench", ROOT / "graphs/demo.yaml", ROOT / "recordings/sparse.mcap"]
    arguments += ["--frames", "10", "--set", f"log.path={tmp_path / 'log.mcap'}"]
    arguments += ["--set", f"view.save={tmp_path / 'view.rrd'}"]
    assert cli(monkeypatch, *arguments, "--json", tmp_path / "b.json") == 0
    assert "frames: 10\n" in capsys.readouterr().out
    assert not (tmp_path / "log.mcap").exists()  # results of a run stay as they are
    result = read_baseline(tmp_path / "b.json", Path("demo.yaml"))
    with pytest.raises(UsageError, match=r"those of demo\.yaml, not of pick\.yaml"):
        read_baseline(tmp_path / "b.json", Path("graphs/pick.yaml"))
    for times in (*result["nodes"].values(), result["frame"]):
        times["p50_ms"] /= 1000
    (tmp_path / "faster.json").write_text(json.dumps(result))
    assert cli(monkeypatch, *arguments, "--baseline", tmp_path / "faster.json") == 3
    assert "x baseline" in capsys.readouterr().out
