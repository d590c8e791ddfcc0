"""What the program writes: never over what it reads, and nothing emptied in vain."""

from __future__ import annotations

import os
import subprocess
from pathlib import Path

import pytest

from mushpipe import RunInfo
from mushpipe.core.errors import EXIT_FAILED, EXIT_USAGE
from mushpipe.sinks.mcap import McapSink
from mushpipe.sinks.rerun import RerunSink
from tests.cli.shell import MAIN, ROOT, mushpipe
from tests.io.values import make_frame, record, trace_of

ROBOT = "{use: robot-json, port: 0, replay: true, transcript: p}"


@pytest.fixture
def recorded(folder: Path) -> Path:
    """The folder, with a recording of one frame, a.mcap, too."""
    return record(folder / "a.mcap", [trace_of(make_frame())]).parent


def test_a_recording_is_never_written_over_by_its_own_run(recorded: Path) -> None:
    before = (recorded / "a.mcap").read_bytes()
    done = mushpipe(
        *("run", "graph.yaml", "--source", "a.mcap", "--set", "log.path=./a.mcap"), cwd=recorded
    )
    assert done.returncode == EXIT_USAGE
    assert "sink 'log' would write over what is read" in done.stderr
    assert (recorded / "a.mcap").read_bytes() == before


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="needs a full device")
def test_of_a_manifest_that_does_not_fit_it_is_told_which_file_it_is(recorded: Path) -> None:
    """The system's own error names no file then."""
    done = mushpipe(
        *("run", "graph.yaml", "--source", "a.mcap", "--set", "log.path=./out.mcap"),
        *("--manifest", "/dev/full"),
        cwd=recorded,
    )
    assert done.returncode == EXIT_FAILED
    told = "/dev/full: not written to its end: No space left on device; make room, or give another"
    assert f"error: {told} path\n" in done.stderr
    assert (recorded / "out.mcap").stat().st_size


def test_a_run_writes_over_neither_its_graph_nor_its_plugins(recorded: Path) -> None:
    (recorded / "mine.py").write_text(
        "from mushpipe import Mask, RgbdFrame, Stage\n"
        "class Everything(Stage):\n"
        "    def process(self, frame: RgbdFrame) -> Mask:\n"
        "        return Mask(frame.gray >= 0)\n"
    )
    (recorded / "own.yaml").write_text(
        "mushpipe: 1\nsource: {use: mcap, path: a.mcap}\n"
        "stages: {all: {use: ./mine.py:Everything}}\n"
        "sinks: {log: {use: mcap, path: out.mcap}}\n"
    )
    before = {path: path.read_bytes() for path in recorded.iterdir()}
    for name in ("own.yaml", "mine.py", "a.mcap"):
        for option in (("--set", f"log.path=./{name}"), ("--manifest", name)):
            done = mushpipe("run", "own.yaml", *option, cwd=recorded)
            assert done.returncode == EXIT_USAGE
            assert name in done.stderr
        done = mushpipe("bench", "own.yaml", "--frames", 10, "--json", name, cwd=recorded)
        assert done.returncode == EXIT_USAGE
    assert {path: path.read_bytes() for path in before} == before
    done = mushpipe("run", "own.yaml", "--manifest", "out.mcap", cwd=recorded)
    assert done.returncode == EXIT_USAGE
    assert (recorded / "out.mcap").read_bytes()[:5] == b"\x89MCAP"


def test_two_sinks_never_write_one_file(recorded: Path) -> None:
    text = (recorded / "graph.yaml").read_text()
    (recorded / "graph.yaml").write_text(text + "  again: {use: mcap, path: ./out.mcap}\n")
    done = mushpipe(
        *("run", "graph.yaml", "--source", "a.mcap", "--set", "log.path=./out.mcap"), cwd=recorded
    )
    assert done.returncode == EXIT_USAGE
    assert "sink 'again' would write over the file of sink 'log', " in done.stderr


def test_no_command_writes_over_what_it_reads(recorded: Path) -> None:
    (recorded / "b.mcap").hardlink_to(recorded / "a.mcap")
    before = (recorded / "a.mcap").read_bytes()
    for arguments in (
        ("view", "a.mcap", "--save", "b.mcap"),
        ("calibrate", "depth", "a.mcap", "--plane", "0.5", "-o", "b.mcap"),
        ("run", "graph.yaml", "--source", "a.mcap", "--manifest", "b.mcap"),
    ):
        done = mushpipe(*arguments, cwd=recorded)
        assert done.returncode == EXIT_USAGE, done.stderr
        assert "b.mcap is what is read, and would be written over" in done.stderr
        assert (recorded / "a.mcap").read_bytes() == before


def test_a_saved_stream_is_not_written_over_by_what_plays_it(folder: Path) -> None:
    saved = folder / "s.mcap"
    record(saved, [trace_of(make_frame())])
    before = saved.read_bytes()
    options = ("--source", "-", "--set", "log.path=./s.mcap")
    with saved.open("rb") as stream:
        command = [*MAIN, "run", "graph.yaml", *options]
        done = subprocess.run(command, cwd=folder, stdin=stream, capture_output=True, text=True)
    assert done.returncode == EXIT_USAGE
    assert "sink 'log' would write over what" in done.stderr
    assert saved.read_bytes() == before


def test_the_pose_of_the_camera_is_not_written_over(recorded: Path) -> None:
    mount = "{frame: base, translation: [0, 0, 1], quaternion: [1, 0, 0, 0]}"
    (recorded / "camera.yaml").write_text(mount)
    (recorded / "own.yaml").write_text(
        "mushpipe: 1\nsource: {use: mcap, path: a.mcap}\n"
        "stages:\n  segment: {use: otsu}\n  detect: {use: hough}\n"
        "  locate: {use: nearest-depth}\n  pick: {use: picks, T_base_camera: camera.yaml}\n"
        "sinks: {log: {use: mcap, path: camera.yaml}}\n"
    )
    done = mushpipe("run", "own.yaml", cwd=recorded)
    assert done.returncode == EXIT_USAGE
    assert "sink 'log' would write over what is read, " in done.stderr
    assert (recorded / "camera.yaml").read_text() == mount


def test_an_evaluation_does_not_write_over_the_truth(recorded: Path) -> None:
    (recorded / "truth").mkdir()
    truth = recorded / "truth" / "lab.mcap"
    lab = "recordings/lab.mcap"
    truth.write_bytes((ROOT / lab).read_bytes())
    before = truth.read_bytes()
    done = mushpipe(
        *("eval", "graph.yaml", "--recordings", ROOT / lab, "--truth", truth, "--out", "truth"),
        cwd=recorded,
    )
    assert done.returncode == EXIT_USAGE
    assert "lab.mcap is what is read, and would be written over" in done.stderr
    assert truth.read_bytes() == before


def test_standard_output_is_for_one_sink(recorded: Path) -> None:
    text = (recorded / "graph.yaml").read_text()
    (recorded / "graph.yaml").write_text(text + '  again: {use: mcap, path: "-"}\n')
    done = mushpipe("validate", "graph.yaml", "--set", "log.path=-", cwd=recorded)
    assert done.returncode == EXIT_USAGE
    assert "sink 'again' would write to standard output beside sink 'log'" in done.stderr


@pytest.mark.parametrize("closed", [">&-", "2>&-", "<&- >&- 2>&-"])
def test_what_is_printed_gets_into_no_file_where_a_shell_closed_the_stream(
    recorded: Path, closed: str
) -> None:
    shell = ["sh", "-c", f'exec "$@" {closed}', "sh"]
    run = ("run", "graph.yaml", "--source", "a.mcap", "--set", "log.path=./b.mcap")
    for arguments in (run, ("export", "b.mcap")):
        done = subprocess.run([*shell, *MAIN, *arguments], cwd=recorded, capture_output=True)
        assert (done.returncode, b"Traceback" in done.stderr) == (0, False)
    assert mushpipe("info", "b.mcap", cwd=recorded).returncode == 0


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (("--set", "log.path=."), "it names no file"),
        (("--set", "log.path=$OUT/x.mcap"), "$OUT is not filled in here"),
        (("--set", "log.path=graph.yaml/x.mcap"), "graph.yaml is no folder"),
        (("--source", ""), "--source is empty"),
    ],
)
def test_paths_that_cannot_be_meant_are_refused(
    recorded: Path, options: tuple[str, ...], message: str
) -> None:
    before = {*recorded.iterdir()}
    done = mushpipe("run", "graph.yaml", "--source", "a.mcap", *options, cwd=recorded)
    assert done.returncode == EXIT_USAGE
    assert message in done.stderr
    assert {*recorded.iterdir()} == before


def test_a_sink_of_ones_own_is_kept_from_its_source_by_the_type_of_its_path(recorded: Path) -> None:
    (recorded / "mine.py").write_text(
        "from mushpipe import Circles, RunInfo, Sink, SinkPath\n\n"
        "class Lines(Sink):\n"
        "    path: SinkPath | None = None\n"
        "    def open(self, run: RunInfo) -> None:\n"
        "        run.path(self.path).write_text('')\n"
        "    def consume(self, circles: Circles) -> None:\n"
        "        pass\n"
    )
    text = (recorded / "graph.yaml").read_text()
    own = "  mine: {use: ./mine.py:Lines, path: ./a.mcap}\n"
    (recorded / "graph.yaml").write_text(text + own)
    before = (recorded / "a.mcap").read_bytes()
    done = mushpipe("run", "graph.yaml", "--source", "a.mcap", cwd=recorded)
    assert done.returncode == EXIT_USAGE
    assert "sink 'mine' would write over what is read" in done.stderr
    assert (recorded / "a.mcap").read_bytes() == before


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (("--start", 60), "a.mcap: it ends after 0.000 s, before start, 60 s"),
        (("--start", 2, "--end", 1), "a.mcap: end, 1 s, is not after start"),
        (("--set", "source.color_topic=/camera/colour"), "there is no topic '/camera/colour'; did"),
    ],
)
def test_nothing_is_emptied_where_there_is_nothing_to_play(
    recorded: Path, options: tuple[object, ...], message: str
) -> None:
    (recorded / "out").mkdir()
    (recorded / "out/a.mcap").write_bytes(b"of a run before")
    done = mushpipe("run", "graph.yaml", "--source", "a.mcap", *options, cwd=recorded)
    assert done.returncode != 0
    assert message in done.stderr
    assert (recorded / "out/a.mcap").read_bytes() == b"of a run before"


@pytest.mark.parametrize("held", ["out.mcap", "out.rrd"])
def test_nothing_is_emptied_where_another_run_writes_one_of_the_files(
    folder: Path, held: str
) -> None:
    text = (folder / "graph.yaml").read_text()
    (folder / "graph.yaml").write_text(text + "  look: {use: rerun, save: ./out.rrd}\n")
    run = RunInfo("synthetic", {})
    sink = RerunSink(save=folder / held) if held == "out.rrd" else McapSink(path=folder / held)
    sink.open(run)
    other = folder / ({"out.mcap", "out.rrd"} - {held}).pop()
    other.write_bytes(b"of the first run")
    before = (folder / held).read_bytes()
    options = ("--frames", 1, "--set", "log.path=./out.mcap")
    done = mushpipe("run", "graph.yaml", *options, cwd=folder)
    assert done.returncode == EXIT_USAGE
    assert f"{held} cannot be written: another run is writing it" in done.stderr
    assert other.read_bytes() == b"of the first run"
    assert (folder / held).read_bytes().startswith(before)
    sink.close()
    assert mushpipe("run", "graph.yaml", *options, cwd=folder).returncode == 0


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ("{use: robot-json, port: 5005}", "set 'replay: true' to serve it"),
        ("{use: mcap, path: .}", "sink 'other': {folder} cannot be written: it is a folder"),
    ],
)
def test_results_are_kept_where_another_sink_cannot_open(
    folder: Path, settings: str, message: str
) -> None:
    text = (folder / "graph.yaml").read_text()
    (folder / "graph.yaml").write_text(text + f"  other: {settings}\n")
    (folder / "out.mcap").write_text("of yesterday")
    done = mushpipe("run", "graph.yaml", cwd=folder)
    assert done.returncode == EXIT_USAGE
    assert message.format(folder=folder) in done.stderr
    assert (folder / "out.mcap").read_text() == "of yesterday"


@pytest.mark.parametrize(
    "sink", ["{use: mcap, path: p}", "{use: rerun, save: p}", ROBOT], ids=lambda text: text[6:10]
)
def test_a_pipe_is_written_where_somebody_reads_it(recorded: Path, sink: str) -> None:
    text = (recorded / "graph.yaml").read_text()
    (recorded / "graph.yaml").write_text(text + f"  piped: {sink}\n")
    os.mkfifo(recorded / "p")
    run = ("run", "graph.yaml", "--source", "a.mcap")
    done = mushpipe(*run, cwd=recorded)
    assert done.returncode == EXIT_USAGE
    assert "p is a pipe that nobody reads: start first what does" in done.stderr
    with subprocess.Popen(["timeout", "60", "cp", "p", "read"], cwd=recorded):
        done = mushpipe(*run, cwd=recorded)
        assert done.returncode == 0, done.stderr
    assert (recorded / "read").stat().st_size > 100


@pytest.mark.parametrize(
    "options",
    [
        ("--source", "none.mcap"),
        ("--set", "detect.use=./fails.py:Fails"),
        ("--set", "other.port=5005"),
        ("--set", "again.path=deep/er/out.mcap"),
    ],
    ids=lambda options: options[1],
)
def test_no_folder_is_made_where_a_run_cannot_begin(folder: Path, options: tuple[str, ...]) -> None:
    text = (folder / "graph.yaml").read_text()
    others = "  other: {use: robot-json, port: 0, replay: false}\n"
    others += "  again: {use: mcap, path: other/out.mcap}\n"
    (folder / "graph.yaml").write_text(text + others)
    (folder / "fails.py").write_text(
        "from mushpipe import Circles, Mask, RgbdFrame, Stage\n\n"
        "class Fails(Stage):\n"
        "    def open(self) -> None:\n"
        "        raise OSError('no weights')\n"
        "    def process(self, frame: RgbdFrame, mask: Mask) -> Circles:\n"
        "        raise NotImplementedError\n"
    )
    before = {*folder.iterdir()}
    path = ("--set", "log.path=deep/er/out.mcap")
    done = mushpipe("run", "graph.yaml", *path, *options, cwd=folder)
    assert done.returncode != 0
    made = {*folder.iterdir()} - before
    assert made <= {folder / "__pycache__"}, done.stderr  # of the plugin, as Python keeps it


@pytest.mark.parametrize(
    "arguments",
    [
        ("bench", "graph.yaml", "--json", "none/a.json"),
        ("calibrate", "depth", "a.mcap", "--plane", "0.5", "-o", "none/a.json"),
        ("figure", "a.mcap", "-o", "none/a.json"),
        ("schema", "-o", "none/a.json"),
    ],
)
def test_where_nothing_can_be_written_no_work_begins(
    folder: Path, arguments: tuple[str, ...]
) -> None:
    done = mushpipe(*arguments, cwd=folder)
    assert done.returncode == EXIT_USAGE
    assert done.stdout == ""
    assert done.stderr == "error: none/a.json cannot be written: there is no folder none\n"


@pytest.mark.parametrize(
    "arguments",
    [
        ("bench", "graph.yaml", "--json", "-"),
        ("calibrate", "depth", "a.mcap", "--plane", "0.5", "-o", "-"),
        ("run", "graph.yaml", "--manifest", "-"),
        ("schema", "-o", "-"),
    ],
)
def test_what_is_no_stream_gets_into_no_file_of_the_name_of_one(
    folder: Path, arguments: tuple[str, ...]
) -> None:
    done = mushpipe(*arguments, cwd=folder)
    assert done.returncode == EXIT_USAGE
    expected = "- cannot be written: it would be standard output; name a file"
    assert done.stderr.splitlines()[-1] == f"error: {expected}"
    assert not (folder / "-").exists()


def test_a_file_that_cannot_be_written_is_named(folder: Path) -> None:
    done = mushpipe("schema", "-o", "/proc/nowhere/schema.json", cwd=folder)
    assert done.returncode == EXIT_USAGE
    assert done.stderr.startswith("error: /proc/nowhere")
    assert "Traceback" not in done.stderr
