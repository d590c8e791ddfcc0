"""The report's arithmetic and the manifest."""

import hashlib
import json
import math
import platform
import re
from importlib.metadata import version
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from mushpipe import GraphPath, Header, RunInfo, Sink, Trace
from mushpipe.console import execute
from mushpipe.core.errors import InputError, PluginError, StageError
from mushpipe.core.manifest import build_manifest, manifest_path
from mushpipe.core.report import Durations, RunReport, SinkReport
from tests.core.lab import Frames, Lab, circles, cli


@given(
    st.lists(st.integers(1, 10**11), min_size=1, max_size=200),
    st.sampled_from([0.0, 0.25, 0.5, 0.95, 1.0]),
)
def test_quantiles_are_those_of_numpy_within_one_percent(values, q):
    durations = Durations()
    for value in values:
        durations.add(value)
    expected = np.quantile(values, q, method="inverted_cdf") / 1e6
    assert durations.quantile_ms(q) == pytest.approx(expected, rel=0.01)
    assert durations.summary()["max_ms"] == round(max(values) / 1e6, 3)
    assert durations.count == len(values)


def test_no_durations_have_no_quantile():
    assert math.isnan(Durations().quantile_ms(0.5))


def test_a_duration_of_nothing_counts():
    durations = Durations()
    durations.add(0)
    assert durations.summary() == {"p50_ms": 0, "p95_ms": 0, "p99_ms": 0, "max_ms": 0}


@pytest.mark.parametrize(
    ("report", "balanced", "exit_code"),
    [
        (RunReport(read=7, waiting=2, processed=3, dropped=1, failed=1), True, 0),
        (RunReport(read=7, waiting=2, processed=3, dropped=1), False, 1),
        (RunReport(interrupted=True), True, 130),
        (RunReport(interrupted=True, error=InputError("x")), True, 4),
        (RunReport(read=1), False, 1),
        (RunReport(sinks={"a": SinkReport(3, 1, 1, 1)}), True, 0),
        (RunReport(sinks={"a": SinkReport(3, 1, 1, 0)}), False, 1),
    ],
)
def test_the_balance_decides_the_exit_code(report, balanced, exit_code):
    assert (report.balanced(), report.exit_code) == (balanced, exit_code)


def test_the_summary_is_plain_data():
    report = RunReport(
        read=5,
        waiting=1,
        processed=2,
        dropped=1,
        failed=1,
        source={"lost": 1},
        sinks={"out": SinkReport(2, 2)},
        durations={"a": Durations()},
        elapsed_s=1.23456,
        error=InputError("bad"),
        capsules=["c.mcap"],
    )
    report.durations["a"].add(2_000_000)
    # Through JSON and back, as it is stored.
    assert json.loads(json.dumps(report.summary())) == {
        "exit_code": 4,
        "error": "bad",
        "frames": {"in": 4, "processed": 2, "dropped": 1, "failed": 1, "balanced": True},
        "source": {"lost": 1},
        "sinks": {"out": {"handed": 2, "consumed": 2, "dropped": 0, "failed": 0}},
        "durations": {"a": {"p50_ms": 2.0, "p95_ms": 2.0, "p99_ms": 2.0, "max_ms": 2.0}},
        "elapsed_s": 1.235,
        "capsules": ["c.mcap"],
    }


def test_the_span_is_of_all_frames_whatever_their_order():
    report = RunReport()
    for stamp_ns, sequence in ((5, 2), (3, 0), (9, 1)):
        report.widen_span(Header(stamp_ns, sequence, "camera"))
    assert report.summary()["span"] == {"stamp_ns": (3, 9), "sequence": (0, 2)}


def test_what_was_found_are_the_rows_of_the_last_table_of_each_frame():
    report = RunReport()
    report.found.add({"detect": (circles(1, 2, 3),), "pick": (circles(4, 5),), "other": (7,)})
    report.found.add({"detect": (circles(1),), "pick": (circles(),)})
    report.found.add({"detect": (), "other": (7,)})  # a frame without a table tells nothing
    assert report.summary()["found"] == {"rows": 2, "frames": 2, "empty": 1}


class Recorded(Frames):
    """Frames that come from files."""

    path: Path = Path("none")

    def name(self) -> str:
        return "bed"

    def files(self) -> tuple[Path, ...]:
        return (self.path, Path("/no/such.mcap"))


class Writes(Sink):
    path: Path = Path("{recording}.out")

    def consume(self, trace: Trace) -> None: ...

    def files(self, run: RunInfo) -> tuple[Path, ...]:
        return (run.path(self.path),)


class OnePath(Writes):
    def files(self, run: RunInfo) -> Path:  # a mistake easily made
        return run.path(self.path)


class NoPaths(Recorded):
    def files(self) -> tuple[Path, ...]:
        raise OSError("not mounted")


@pytest.fixture
def graph(lab: Lab) -> str:
    lab.registry.source("recorded", Recorded)
    lab.registry.sink("writes", Writes)
    return lab.chain("dice", source="recorded", extra="seed: 9")


def test_the_manifest_says_what_a_run_was_made_of(lab: Lab, graph: str):
    recording = lab.folder / "bed.mcap"
    recording.write_bytes(b"mushrooms")
    manifest = build_manifest(lab.compile(graph, f"source.path={recording}"))
    assert manifest["graph_file"] == "graph.yaml"
    assert manifest["seed"] == 9
    assert manifest["overrides"] == [f"--set source.path={recording}"]
    assert manifest["recordings"] == [
        {
            "file": "bed.mcap",
            "sha256": hashlib.sha256(b"mushrooms").hexdigest(),
            "bytes": 9,
        },
        {"file": "such.mcap", "sha256": None, "bytes": None},
    ]
    assert manifest["versions"]["python"] == platform.python_version()
    assert manifest["versions"]["numpy"] == version("numpy") == np.__version__
    assert manifest["graph"]["stages"] == {"a": {"use": "dice"}}
    assert manifest["graph"]["source"]["path"] == str(recording)
    assert json.loads(json.dumps(manifest)) == manifest


def test_the_resolved_graph_writes_out_inputs_and_delivery(lab: Lab):
    plan = lab.compile("""
        mushpipe: 1
        source: {use: frames}
        stages: {a: {use: threshold, inputs: {frame: source}}}
        sinks: {out: {use: collect, delivery: every}}
    """)
    graph = build_manifest(plan)["graph"]
    assert graph["stages"]["a"]["inputs"] == {"frame": "source"}
    assert graph["sinks"]["out"]["delivery"] == "every"
    limits = {"max_frames": None, "max_seconds": None}
    assert graph["source"] == {"use": "frames", **limits, "speed": 0.0, "count": 3}


def test_the_manifest_names_results_as_the_user_did_and_the_recording_by_its_place(lab: Lab):
    lab.registry.sink("mcap", "mushpipe.sinks.mcap:McapSink")
    plan = lab.compile(
        """
        mushpipe: 1
        source: {use: frames}
        sinks: {a: {use: mcap, path: "../out/a.mcap"}, b: {use: mcap, path: b.mcap}}
    """,
        "b.path=here/b.mcap",
    )
    sinks = build_manifest(plan)["graph"]["sinks"]
    assert (sinks["a"]["path"], sinks["b"]["path"]) == ("../out/a.mcap", "here/b.mcap")
    resolved = plan.resolved()["sinks"]  # of a capsule, which lies elsewhere
    assert resolved["a"]["path"] == str(lab.folder.parent / "out/a.mcap")


def test_the_manifest_stands_beside_the_first_result(lab: Lab, graph: str):
    assert manifest_path(lab.compile(graph)) == Path("run.json")
    wanted = lab.folder / "deep" / "{recording}.results.mcap"
    plan = lab.compile(graph.replace("collect", "writes"), f"out.path={wanted}")
    assert manifest_path(plan) == lab.folder / "deep" / "bed.results.mcap.run.json"
    assert not (lab.folder / "deep").exists()


def test_the_program_writes_manifest_and_result(lab: Lab, graph: str, monkeypatch):
    monkeypatch.chdir(lab.folder)
    monkeypatch.setattr("mushpipe.core.plugins.load_registry", lambda: lab.registry)
    (lab.folder / "graph.yaml").write_text(graph)
    assert cli(monkeypatch, "run", "graph.yaml", "--manifest", "sub/m.json", "--frames", "2") == 0
    content = json.loads((lab.folder / "sub" / "m.json").read_text())
    assert content["overrides"] == ["--frames 2"]
    assert content["result"]["frames"] == {
        "in": 2,
        "processed": 2,
        "dropped": 0,
        "failed": 0,
        "balanced": True,
    }


def test_a_source_has_a_name_and_no_files_unless_it_says_so():
    source = Frames()
    assert (source.name(), source.files(), source.counts()) == ("frames", (), {})


@pytest.mark.parametrize(
    ("given", "name"),
    [
        ({"path": "beds/row-7.npz"}, "row-7"),
        ({"path": "beds/row.7"}, "row.7"),
        ({"path": "beds/row-7", "mask": "mask.png"}, "two"),
        ({}, "two"),
    ],
)
def test_a_source_is_named_by_the_only_file_or_folder_that_it_reads(
    tmp_path: Path, given: dict[str, str], name: str
):
    class Two(Frames):
        path: GraphPath | None = None
        mask: Path | None = None

    (tmp_path / "beds" / "row.7").mkdir(parents=True)
    paths = {key: tmp_path / value for key, value in given.items()}
    assert Two.model_validate(paths).name() == name


def test_a_sink_that_names_no_tuple_of_files_is_told_of(lab: Lab, graph: str):
    lab.registry.sink("one", OnePath)
    with pytest.raises(PluginError) as caught:
        manifest_path(lab.compile(graph.replace("collect", "one")))
    assert str(caught.value) == (
        "sink 'out' (one): its files() gave PosixPath('bed.out'), expected a tuple of paths"
    )


def test_a_source_that_does_not_name_what_it_plays_is_told_of(lab: Lab, graph: str):
    """A sink that made a file name of it was blamed."""

    class Numbered(Frames):
        def name(self):
            return 7

    class Unmounted(Frames):
        def name(self):
            raise OSError("not mounted")

    lab.registry.source("numbered", Numbered)
    lab.registry.source("unmounted", Unmounted)
    lab.registry.sink("one", OnePath)
    text = "source 'source' (numbered): its name() gave 7, expected text"
    plan = lab.compile(graph.replace("recorded", "numbered").replace("collect", "one"))
    with pytest.raises(PluginError, match=re.escape(text)):
        manifest_path(plan)
    assert str(execute(plan, None, None).error) == text
    plan = lab.compile(graph.replace("recorded", "unmounted"))
    text = "source 'source' (unmounted) failed in name(): OSError: not mounted (run -v says where)"
    with pytest.raises(StageError, match=re.escape(text)):
        manifest_path(plan)
    assert str(execute(plan, None, None).error) == text


def test_a_source_that_cannot_name_its_files_is_told_of(lab: Lab, graph: str, caplog):
    caplog.set_level("DEBUG", "mushpipe")
    lab.registry.source("unmounted", NoPaths)
    with pytest.raises(StageError) as caught:
        execute(lab.compile(graph.replace("recorded", "unmounted")), None, None)
    assert (
        str(caught.value)
        == "source 'source' (unmounted) failed in files(): OSError: not mounted (run -v says where)"
    )
    assert "where source 'source' failed" in caplog.text
