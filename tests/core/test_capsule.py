"""Failure capsules: written once per failing plugin, and run again to the same failure."""

import json
from pathlib import Path

import numpy as np
import pytest

from mushpipe import Camera, Circles, GraphPath, Mask, RgbdFrame, Sink, SinkPath, Stage
from mushpipe.core.capsule import capsule_document
from mushpipe.core.errors import InputError, UsageError
from mushpipe.core.graph import compile_document
from mushpipe.core.recorder import RecordingWriter
from mushpipe.core.run import run
from tests.core.lab import Frames, Lab, circles, cli, make_frame


class Rich(Frames):
    """Frames with depth and calibration."""

    def frames(self):
        for i in range(self.count):
            depth = np.full((6, 8), 1000 + i, np.uint16)
            camera = Camera(8, 6, 10.0, 11.0, 3.0, 2.0)
            yield make_frame(i, depth=depth, depth_scale=0.000125, camera=camera)


class Picky(Stage):
    """Fails where the chance of the frame and the depth say so: needs seed, number and depth."""

    def process(self, frame: RgbdFrame, rng: np.random.Generator) -> Circles:
        if frame.header.sequence == 2:
            metres = float(np.nanmean(frame.depth_m))
            raise RuntimeError(f"chance {rng.random()}, depth {metres}, fx {frame.camera.fx}")
        return circles(1)


@pytest.fixture
def graph(lab: Lab) -> str:
    lab.registry.source("rich", Rich)
    lab.registry.source("mcap", "mushpipe.sources.mcap:McapSource")
    return lab.chain("threshold", Picky, source="rich", extra="seed: 3")


def again(lab: Lab, path: str):
    """Run a capsule as the program does."""
    from pathlib import Path

    return run(compile_document(capsule_document(Path(path)), lab.registry))


def test_a_capsule_repeats_the_failure(lab: Lab, graph: str):
    first = lab.run(graph, "a.level=2", capsules=lab.folder / "failures")
    assert first.capsules == [str(lab.folder / "failures" / "failure-rich-b-2.mcap")]
    lab.seen.clear()
    second = again(lab, first.capsules[0])
    assert str(second.error) == str(first.error)
    assert "failed on frame 2: RuntimeError: chance 0." in str(first.error)
    assert (second.frames_in, second.failed, second.exit_code) == (1, 1, 1)
    assert lab.seen == []


def test_the_program_repeats_the_failure(lab: Lab, graph: str, monkeypatch, capsys):
    monkeypatch.chdir(lab.folder)
    monkeypatch.setattr("mushpipe.core.plugins.load_registry", lambda: lab.registry)
    (lab.folder / "graph.yaml").write_text(graph)
    assert cli(monkeypatch, "run", "graph.yaml") == 1
    first = capsys.readouterr().err
    assert (
        "mushpipe run failures/failure-rich-b-2.mcap runs it again, -v says where it fails" in first
    )
    assert cli(monkeypatch, "run", "failures/failure-rich-b-2.mcap") == 1
    error = first[first.index("error: ") :]
    assert capsys.readouterr().err.endswith(error)
    names = ["failure-rich-b-2.mcap", "failure-rich-b-2.mcap.run.json"]  # the capsule and its run
    assert sorted(path.name for path in (lab.folder / "failures").iterdir()) == names


def test_of_a_failure_that_does_not_come_again_the_program_says_so(
    lab: Lab, graph: str, monkeypatch, capsys
):
    class Once(Stage):
        _frames = 0

        def process(self, frame: RgbdFrame) -> Mask:
            self._frames += 1
            if self._frames == 2:
                raise RuntimeError("the second frame")
            return Mask(np.zeros(frame.color.shape[:2], bool))

    monkeypatch.chdir(lab.folder)
    monkeypatch.setattr("mushpipe.core.plugins.load_registry", lambda: lab.registry)
    Path("graph.yaml").write_text(lab.chain(Once))
    assert cli(monkeypatch, "run", "graph.yaml") == 1
    assert "does not fail again" not in capsys.readouterr().err
    (capsule,) = Path("failures").iterdir()
    assert cli(monkeypatch, "run", str(capsule)) == 0
    assert "this frame does not fail again" in capsys.readouterr().err


def test_a_capsule_keeps_the_resolved_graph_without_its_sinks(lab: Lab, graph: str):
    report = lab.run(graph, "a.level=2", capsules=lab.folder)
    document = capsule_document(lab.folder / "failure-rich-b-2.mcap")
    assert document.data["source"] == {"use": "mcap", "path": report.capsules[0]}
    assert document.data["stages"]["a"] == {"use": "threshold", "level": 2, "band": None}
    assert (document.data["seed"], document.data["sinks"]) == (3, {})


def test_a_capsule_reads_the_files_that_the_shell_named(lab: Lab, monkeypatch):
    class Reader(Stage):
        file: GraphPath

        def process(self, frame: RgbdFrame) -> Mask:
            raise RuntimeError(self.file.read_text())

    monkeypatch.chdir(lab.folder)
    Path("words.txt").write_text("so it says")
    lab.registry.source("mcap", "mushpipe.sources.mcap:McapSource")
    report = lab.run(lab.chain(Reader), "a.file=words.txt", capsules=lab.folder / "failures")
    monkeypatch.chdir("/")
    assert str(again(lab, report.capsules[0]).error).endswith("RuntimeError: so it says")


def test_a_capsule_of_a_skipping_run_does_not_skip(lab: Lab, graph: str):
    first = lab.run(graph + "\non_error: skip", capsules=lab.folder)
    assert (first.exit_code, first.failed) == (0, 1)
    assert again(lab, first.capsules[0]).exit_code == 1


def test_one_capsule_per_plugin_is_enough(lab: Lab):
    text = lab.chain("fussy", extra="on_error: skip").replace("fussy", "fussy, on: [0, 1, 2]")
    assert lab.run(text, capsules=lab.folder).capsules == [
        str(lab.folder / "failure-frames-a-0.mcap")
    ]


def test_the_same_frame_of_two_recordings_makes_two_capsules(lab: Lab):
    class Other(Frames):
        def name(self) -> str:
            return "other"

    lab.registry.source("other", Other)
    for source in ("frames", "other"):
        text = lab.chain("fussy", source=source).replace("fussy", "fussy, on: [0]")
        lab.run(text, capsules=lab.folder)
    names = sorted(path.name for path in lab.folder.glob("failure-*"))
    assert names == ["failure-frames-a-0.mcap", "failure-other-a-0.mcap"]


def test_a_camera_begins_counting_again_so_its_capsules_carry_the_stamp(lab: Lab):
    lab.live(lambda: iter([make_frame(0)]))
    text = lab.chain("fussy", source="live", extra="on_error: fail")
    report = lab.run(text.replace("fussy", "fussy, on: [0]"), capsules=lab.folder)
    assert report.capsules[0].endswith(f"-a-{10**9}.mcap")


def test_a_name_that_begins_like_another_gets_its_own_capsule(lab: Lab):
    text = lab.chain("fussy", extra="on_error: skip").splitlines()
    stages = ["  a: {use: fussy, on: [1]}", "  a-2: {use: fussy, on: [0]}"]
    report = lab.run("\n".join([*text[:4], *stages]), capsules=lab.folder)
    names = [path.rpartition("/")[2] for path in report.capsules]
    assert names == ["failure-frames-a-2-0.mcap", "failure-frames-a-1.mcap"]


def test_no_folder_no_capsule(lab: Lab, graph: str):
    assert lab.run(graph).capsules == []


def test_a_failing_sink_stays_in_its_capsule(lab: Lab, graph: str):
    class Full(Sink):
        def consume(self, frame: RgbdFrame) -> None:
            raise OSError("disk full")

    lab.registry.sink("full", Full)
    text = graph.replace("own-b", "fussy") + "\n"
    text = text.replace("{out: {use: collect}}", "{out: {use: full}, other: {use: collect}}")
    first = lab.run(text, capsules=lab.folder)
    document = capsule_document(lab.folder / "failure-rich-out-0.mcap")
    assert document.data["sinks"] == {"out": {"use": "full"}}
    assert str(again(lab, first.capsules[0]).error) == str(first.error)


def test_of_a_sink_that_fails_again_the_program_does_not_say_that_it_does_not(
    lab: Lab, graph: str, monkeypatch, capsys
):
    class Full(Sink):
        def consume(self, frame: RgbdFrame) -> None:
            raise OSError("disk full")

    lab.registry.sink("full", Full)
    monkeypatch.chdir(lab.folder)
    monkeypatch.setattr("mushpipe.core.plugins.load_registry", lambda: lab.registry)
    Path("graph.yaml").write_text(graph.replace("own-b", "fussy").replace("collect", "full"))
    assert cli(monkeypatch, "run", "graph.yaml") == 1
    (capsule,) = Path("failures").iterdir()
    Path("run.json").unlink()
    capsys.readouterr()
    assert cli(monkeypatch, "run", str(capsule)) == 1
    error = capsys.readouterr().err
    assert "disk full" in error
    assert "does not fail again" not in error
    assert not Path("run.json").exists()


def test_the_sink_of_a_capsule_writes_beside_it(lab: Lab, graph: str):
    class Full(Sink):
        save: SinkPath

        def consume(self, frame: RgbdFrame) -> None:
            raise OSError("disk full")

    lab.registry.sink("full", Full)
    (lab.folder / "results").mkdir()
    text = graph.replace("own-b", "fussy") + "\n"
    text = text.replace("{out: {use: collect}}", "{out: {use: full, save: results/a.txt}}")
    first = lab.run(text, capsules=lab.folder)
    document = capsule_document(lab.folder / "failure-rich-out-0.mcap")
    save = Path(document.data["sinks"]["out"]["save"])
    assert save == lab.folder / "failure-rich-out-0.out" / "out" / "a.txt"
    assert str(again(lab, first.capsules[0]).error) == str(first.error)


@pytest.mark.parametrize("trouble", ["folder", "attached"])
def test_a_capsule_that_cannot_be_written_hides_no_failure(lab: Lab, caplog, trouble):
    class Odd(Frames):
        def frames(self):
            yield make_frame(0, attached={"/x": object()} if trouble == "attached" else {})

    lab.registry.source("odd", Odd)
    (lab.folder / "file").write_text("")
    folder = lab.folder / ("file" if trouble == "folder" else "fine")
    text = lab.chain("fussy", source="odd").replace("fussy", "fussy, on: [0]")
    report = lab.run(text, capsules=folder)
    assert str(report.error).endswith("RuntimeError: I do not like it")
    assert report.capsules == []
    assert caplog.messages[0].startswith("the failing frame could not be saved: ")


def test_a_recording_is_no_graph(tmp_path):
    path = tmp_path / "bed.mcap"
    RecordingWriter(path, {}).close()
    with pytest.raises(UsageError) as caught:
        capsule_document(path)
    assert str(caught.value) == (
        f"{path} is a recording, not a graph: write a graph file and play the recording with "
        f"mushpipe run GRAPH --source {path}"
    )
    assert caught.value.exit_code == 2


def test_a_file_that_is_no_recording(tmp_path):
    path = tmp_path / "bed.mcap"
    path.write_text(json.dumps({}))
    with pytest.raises(InputError, match="not an MCAP file"):
        capsule_document(path)
