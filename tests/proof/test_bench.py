"""Figures of a run: that they are of the right frames and add up; never how fast it was."""

from __future__ import annotations

import json
import math
import mmap
import resource
import subprocess
import sys
import threading
import tracemalloc
from contextlib import suppress
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
import pytest

from mushpipe import Circles, RgbdFrame, Stage
from mushpipe.core.errors import InputError, UsageError
from mushpipe.core.report import RunReport
from mushpipe.proof.bench import _Watch, bench, changes, conditions, peak_mb, read_baseline, slower
from tests.core.lab import Frames, Lab, circles, cli

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
    busy = result["cpu_ms_per_frame"] * result["frames_per_s"] / 1e3
    assert result["cores_busy"] == pytest.approx(busy, rel=0.1, abs=0.02)  # both are rounded
    json.dumps(result)


def test_a_frame_whose_memory_is_traced_is_alone(lab: Lab) -> None:
    meeting, met = threading.Barrier(2), []

    class Meets(Allocates):
        reentrant: ClassVar[bool] = True

        def process(self, frame: RgbdFrame) -> Circles:
            with suppress(threading.BrokenBarrierError):
                meeting.wait(0.05)
                met.append(tracemalloc.is_tracing())
            meeting.reset()
            return super().process(frame)

    text = lab.chain(Meets)
    result = bench(lambda count: lab.compile(text, f"source.count={count}"), 10)
    assert met
    assert not any(met)
    assert result["allocated_mb_per_frame"] == pytest.approx(8, abs=0.2)


def test_the_peak_is_that_of_the_run_without_what_tracing_needs(lab: Lab) -> None:
    before: list[float] = []

    class Traced(Allocates):
        def process(self, frame: RgbdFrame) -> Circles:
            if tracemalloc.is_tracing():
                before.append(peak_mb())
            return circles(1 + np.ones(10_000_000 if before else 1)[0])

    text = lab.chain(Traced)
    result = bench(lambda count: lab.compile(text, f"source.count={count}"), 10)
    assert result["peak_memory_mb"] <= round(before[0], 1)


def test_the_peak_is_of_this_process_and_not_of_who_started_it() -> None:
    pages = int(Path("/proc/self/statm").read_text().split()[1])
    held = np.ones(20_000_000)  # 160 MB
    assert peak_mb() >= (held.nbytes + 0.9 * pages * resource.getpagesize()) / 1e6
    code = "from mushpipe.proof.bench import peak_mb; print(peak_mb())"
    alone = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert 10 < float(alone.stdout) < held.nbytes / 1e6


def test_cpu_time_and_growth_are_those_between_frames() -> None:
    watch = _Watch()
    watch.seen_s = [7.0, 7.5, 8.0, 8.5]  # the first frame's own began before it was seen
    assert watch.cpu_s() == pytest.approx(2.0)
    watch.seen_mb = [0.0, 50.0, 100.0, 102.0, 0.0, 0.0, 0.0, 0.0, 110.0, 114.0]
    assert watch.growth_mb() == pytest.approx(112 - 101)
    watch.seen_mb = [0.0, 100.0, 103.0]
    assert watch.growth_mb() == pytest.approx(3)


def test_resident_memory_and_cpu_time_are_seen_at_each_frame() -> None:
    watch = _Watch()
    watch(RunReport())
    held = mmap.mmap(-1, 80_000_000)  # malloc may have as much left from another test
    np.frombuffer(held, np.uint8)[:] = 1
    watch(RunReport())
    assert watch.seen_mb[1] - watch.seen_mb[0] == pytest.approx(80, abs=8)
    assert watch.seen_s[0] < watch.seen_s[1]


def test_what_is_measured_was_warmed_up_before_and_is_traced_after(lab: Lab) -> None:
    seen: list[Any] = []

    class Notes(Allocates):
        def open(self) -> None:
            seen.append("open")

        def process(self, frame: RgbdFrame) -> Circles:
            seen.append(frame.header.sequence)
            first = np.zeros(5_000_000 if frame.header.sequence == 0 else 1)  # 40 MB, once
            return circles(1 + first.sum())

        def close(self) -> None:
            seen.append("close")

    text = lab.chain(Notes)
    result = bench(lambda count: lab.compile(text, f"source.count={count}"), 10)
    runs = [["open", *range(frames), "close"] for frames in (3, 10, 5)]
    assert seen == [step for run in runs for step in run]
    assert result["allocated_mb_per_frame"] < 1


def test_a_recording_is_the_same_wherever_it_lies(lab: Lab, tmp_path: Path) -> None:
    class Recorded(Frames):
        path: Path = Path("none")

        def files(self) -> tuple[Path, ...]:
            return (self.path,)

    lab.registry.source("recorded", Recorded)
    here, there = tmp_path / "here/bed.mcap", tmp_path / "there/bed.mcap"
    found = []
    for path in (here, there):
        path.parent.mkdir()
        path.write_bytes(b"mushrooms")
        plan = lab.compile(lab.chain("threshold", source="recorded"), f"source.path={path}")
        found.append(conditions(plan))
    assert found[0]["recordings"][0]["file"] == "bed.mcap"
    assert found[0] == found[1]


def test_two_frames_are_enough_and_one_is_too_few(lab: Lab) -> None:
    text = lab.chain("threshold")
    result = bench(lambda count: lab.compile(text, f"source.count={min(count, 2)}"), 10)
    assert result["frames"] == 2
    with pytest.raises(InputError, match="one frame is too few"):
        bench(lambda _: lab.compile(lab.chain("threshold"), "source.count=1"), 10)


def test_a_source_without_frames_has_no_figures(lab: Lab) -> None:
    with pytest.raises(InputError, match="no frame"):
        bench(lambda _: lab.compile(lab.chain("threshold"), "source.count=0"), 10)


@pytest.mark.parametrize(("every", "failed"), [(2, 20), (4, 10)])
def test_frames_that_failed_are_told(lab: Lab, every: int, failed: int) -> None:
    text, on = lab.chain("fussy", extra="on_error: skip"), [*range(0, 40, every)]
    result = bench(lambda count: lab.compile(text, f"source.count={count}", f"a.on={on}"), 40)
    assert (result["frames"], result["failed"]) == (40 - failed, failed)


def figures(**medians: float) -> dict[str, Any]:
    nodes = {name: {"p50_ms": median} for name, median in medians.items()}
    return {"nodes": nodes, "frame": {"p50_ms": sum(medians.values())}}


def test_a_node_is_compared_with_itself_in_the_baseline() -> None:
    now = figures(a=3.0, b=1.0, new=2.0, c=1.0)
    found = slower(now, figures(a=2.0, b=2.0, old=9.0, c=0.0))  # of c too little to be told
    assert found == pytest.approx({"a": 1.5, "b": 0.5, "all stages": 7 / 13})


def test_nodes_are_compared_in_the_order_of_the_graph() -> None:
    names = [f"stage-{k}" for k in (3, 7, 1, 9, 0, 8, 2, 6, 4, 5)]
    medians = figures(**dict.fromkeys(names, 1.0))
    assert list(slower(medians, medians)) == [*names, "all stages"]


def test_what_had_no_frame_hides_nothing_that_became_slower() -> None:
    """Of a graph without stages the time of all stages is NaN, which is below any limit."""
    now, before = figures(a=3.0, b=math.nan), figures(a=2.0, b=math.nan)
    assert slower(now, before) == {"a": 1.5}


@pytest.mark.parametrize(
    "content",
    [
        *("", "[]", '{"nodes": {}}', '{"nodes": {}, "frame": {}}'),
        '{"nodes": {"a": {"p50_ms": "1"}}, "frame": {"p50_ms": 1}}',
    ],
)
def test_a_file_without_figures_is_no_baseline(tmp_path: Path, content: str) -> None:
    path = tmp_path / "b.json"
    path.write_text(content)
    with pytest.raises(UsageError, match="no figures"):
        read_baseline(path, measured())


def measured(**other: Any) -> dict[str, Any]:
    """Return conditions of figures, with other values in place of some."""
    base = {
        "graph": "a/pick.yaml",
        "recordings": [{"file": "bed.mcap", "sha256": "123abc"}],
        "settings": {"source": {"use": "mcap", "speed": 0.0}, "stages": {"a": {"use": "b"}}},
        "machine": {"processor": "AMD", "cores": 2, "numpy": "2.4"},
    }
    return {**base, **other}


@pytest.mark.parametrize(
    ("other", "message"),
    [
        ({"graph": "b/pick.yaml"}, None),
        ({"graph": "classic.yaml"}, r"those of classic\.yaml, not of pick\.yaml"),
        ({"recordings": [{"file": "bed.mcap", "sha256": "99"}]}, r"bed\.mcap \(99\), not of bed"),
        ({"recordings": []}, r"those of the source 'mcap', not of bed\.mcap"),
        ({"settings": {"source": {"use": "mcap", "speed": 1.0}}}, r"speed 1\.0, not of speed 0"),
        ({"machine": {"processor": "AMD", "cores": 4}}, "of 4 cores of AMD, not of 2 cores of AMD"),
        ({"machine": {"processor": "Intel", "cores": 2}}, "2 cores of Intel, not of 2 cores of AM"),
    ],
)
def test_figures_of_something_else_are_no_baseline(
    tmp_path: Path, other: dict[str, Any], message: str | None
) -> None:
    path = tmp_path / "b.json"
    path.write_text(json.dumps({**figures(a=1.0), **measured(**other)}))
    if message is None:
        assert read_baseline(path, measured())["graph"] == other["graph"]
        return
    with pytest.raises(UsageError, match=message):
        read_baseline(path, measured())


def test_settings_and_versions_that_changed_are_named() -> None:
    before = measured(
        settings={"source": {"use": "mcap", "speed": 0.0}, "stages": {"a": {"use": "c", "x": 1}}},
        machine={"processor": "AMD", "cores": 2, "numpy": "2.3"},
    )
    assert changes(measured(), before) == [
        "machine.numpy is 2.4, in the baseline 2.3",
        "settings.stages.a.use is b, in the baseline c",
        "settings.stages.a.x is None, in the baseline 1",
    ]
    assert changes(measured(), measured()) == []


def test_the_verb_plays_a_short_recording_over_and_over(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    arguments = ["bench", ROOT / "graphs/demo.yaml", ROOT / "recordings/sparse.mcap"]
    arguments += ["--frames", "10", "--set", f"log.path={tmp_path / 'log.mcap'}"]
    arguments += ["--set", f"view.save={tmp_path / 'view.rrd'}"]
    assert cli(monkeypatch, *arguments, "--json", tmp_path / "b.json") == 0
    assert "frames: 10\n" in capsys.readouterr().out
    assert not (tmp_path / "log.mcap").exists()  # results of a run stay as they are
    result = json.loads((tmp_path / "b.json").read_text())
    for times in (*result["nodes"].values(), result["frame"]):
        times["p50_ms"] /= 1000
    (tmp_path / "faster.json").write_text(json.dumps(result))
    assert cli(monkeypatch, *arguments, "--baseline", tmp_path / "faster.json") == 3
    assert "x baseline" in capsys.readouterr().out
    arguments[2] = ROOT / "recordings/gaps.mcap"
    assert cli(monkeypatch, *arguments, "--baseline", tmp_path / "b.json") == 2
    assert "those of sparse.mcap" in capsys.readouterr().err
