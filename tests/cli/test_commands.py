"""The commands as a user types them: exit codes, stdout, stderr."""

from __future__ import annotations

import json
import subprocess
import sys
from importlib.metadata import version
from pathlib import Path

import pytest
from mcap.reader import make_reader
from typer.testing import CliRunner

from mushpipe.cli import app
from mushpipe.core.errors import EXIT_DAMAGED, EXIT_FAILED, EXIT_USAGE
from mushpipe.core.recording import RecordingReader
from tests.cli.shell import GRAPH, ROOT, mushpipe
from tests.io.values import make_frame, make_picks, record, trace_of

PICK_KEYS = [
    "id",
    "u",
    "v",
    "radius_px",
    "position_m",
    "distance_m",
    "diameter_m",
    "quaternion_xyzw",
    "axis",
    "score",
    "sigma_position_m",
    "sigma_diameter_m",
    "sigma_tilt_rad",
    "depth_source",
    "flags",
]
# In Python's own words.
NUL = "embedded null byte"
if sys.version_info >= (3, 13):
    NUL = "lstat: embedded null character in path"


def test_run_writes_results_and_manifest_and_prints_the_balance(folder: Path) -> None:
    done = mushpipe("run", "graph.yaml", cwd=folder)
    assert done.returncode == 0, done.stderr
    assert done.stdout == ""
    assert "3 frames in = 3 processed + 0 dropped + 0 failed" in done.stderr
    assert "p95 ms" in done.stderr
    manifest = json.loads((folder / "out.mcap.run.json").read_text())
    assert manifest["graph"]["stages"]["open"] == {"use": "opening", "size": 10}
    assert manifest["result"]["frames"] == {
        "in": 3,
        "processed": 3,
        "dropped": 0,
        "failed": 0,
        "balanced": True,
    }


def test_run_says_how_many_mushrooms_it_found(folder: Path) -> None:
    done = mushpipe("run", "graph.yaml", cwd=folder)
    exported = mushpipe("export", "out.mcap", cwd=folder).stdout.splitlines()
    number = sum(len(json.loads(line)["picks"]) for line in exported)
    assert number > 10
    assert f"mushrooms: {number} in 3 frames, {number / 3:.1f} a frame" in done.stderr
    result = json.loads((folder / "out.mcap.run.json").read_text())["result"]
    assert result["found"] == {"rows": number, "frames": 3, "empty": 0}
    none = ("--set", "detect.radius_px=[200,210]")
    done = mushpipe("run", "graph.yaml", *none, cwd=folder)
    assert "mushrooms: none in 3 frames" in done.stderr


def test_a_run_that_never_began_leaves_the_manifest_of_the_one_before(folder: Path) -> None:
    mushpipe("run", "graph.yaml", cwd=folder)
    before = (folder / "out.mcap.run.json").read_bytes()
    (folder / "recordings").mkdir()
    done = mushpipe("run", "graph.yaml", "--source", "recordings", cwd=folder)
    assert done.returncode == EXIT_DAMAGED
    assert (folder / "out.mcap.run.json").read_bytes() == before
    assert "manifest:" not in done.stderr


def test_results_of_one_stem_have_a_manifest_each(folder: Path) -> None:
    (folder / "graph.yaml").write_text(GRAPH.replace("path: out.mcap", "path: a.mcap"))
    mushpipe("run", "graph.yaml", cwd=folder)
    look = GRAPH.replace("log: {use: mcap, path: out.mcap}", "look: {use: rerun, save: a.rrd}")
    (folder / "graph.yaml").write_text(look)
    mushpipe("run", "graph.yaml", cwd=folder)
    sinks = [
        [*json.loads((folder / f"{name}.run.json").read_text())["graph"]["sinks"]]
        for name in ("a.mcap", "a.rrd")
    ]
    assert sinks == [["log"], ["look"]]


def test_export_prints_one_json_line_per_frame(folder: Path) -> None:
    mushpipe("run", "graph.yaml", cwd=folder)
    done = mushpipe("export", "out.mcap", cwd=folder)
    lines = [json.loads(line) for line in done.stdout.splitlines()]
    assert [line["sequence"] for line in lines] == [0, 1, 2]
    assert set(lines[0]) == {"stamp_ns", "sequence", "frame_id", "picks"}
    pick = lines[0]["picks"][0]
    assert list(pick) == PICK_KEYS
    assert pick["quaternion_xyzw"] is None
    assert pick["flags"][0] == "pose_unknown"
    table = mushpipe("export", "out.mcap", "--format", "csv", cwd=folder).stdout.splitlines()
    assert table[0].startswith("stamp_ns,sequence,frame_id,id,u,v,radius_px,x_m,y_m,z_m")
    assert len(table) == 1 + sum(len(line["picks"]) for line in lines)


def test_record_then_replay_by_source_with_paths_relative_to_the_shell(folder: Path) -> None:
    recorded = mushpipe(
        "record", "--source", "synthetic", "--frames", 1, "-o", "a.mcap", cwd=folder
    )
    assert recorded.returncode == 0, recorded.stderr
    (folder / "elsewhere").mkdir()
    done = mushpipe(
        *("run", "../graph.yaml", "--source", "../a.mcap", "--set", "log.path=here.mcap"),
        cwd=folder / "elsewhere",
    )
    assert done.returncode == 0, done.stderr
    assert (folder / "elsewhere/here.mcap").exists()
    assert not (folder / "out.mcap").exists()
    graph = json.loads((folder / "elsewhere/here.mcap.run.json").read_text())["graph"]
    (folder / "again.yaml").write_text(json.dumps(graph))
    done = mushpipe("run", "again.yaml", cwd=folder)
    assert done.returncode == 0, done.stderr


def test_faults_of_a_graph_are_printed_together_with_places(folder: Path) -> None:
    (folder / "bad.yaml").write_text(
        GRAPH.replace("otsu", "osu").replace("opening}", "opening, sise: 3}")
    )
    done = mushpipe("validate", "bad.yaml", cwd=folder)
    assert done.returncode == EXIT_USAGE
    assert done.stderr == (
        "error: bad.yaml:4:18: unknown stage 'osu'; did you mean 'otsu'?\n"
        "      segment: {use: osu}\n"
        "                     ^\n"
        "bad.yaml:5:27: unknown setting 'sise' of 'opening'\n"
        "      open:    {use: opening, sise: 3}\n"
        "                              ^\n"
        "    did you mean 'size'?\n"
    )
    listed = json.loads(mushpipe("validate", "bad.yaml", "--format", "json", cwd=folder).stdout)
    assert [(p["line"], p["column"]) for p in listed["problems"]] == [(4, 18), (5, 27)]


@pytest.mark.parametrize(
    ("arguments", "code", "message"),
    [
        (["run", "nope.yaml"], EXIT_USAGE, "error: nope.yaml: there is no such file\n"),
        (
            ["run", "graph.yaml", "--source", "nope.mcap"],
            EXIT_USAGE,
            "error: nope.mcap: there is no such recording\n",
        ),
        (
            ["run", "graph.yaml", "--source", "empty.mcap"],
            EXIT_DAMAGED,
            "error: empty.mcap: the file is empty\n",
        ),
        (
            ["run", "graph.yaml", "--source", "synthetic", "--start", "3"],
            EXIT_USAGE,
            "error: --start 3.0: unknown setting 'start' of 'synthetic'\n",
        ),
        (
            ["run", "graph.yaml", "--set", "segmnt.x=1"],
            EXIT_USAGE,
            "error: --set segmnt.x=1: unknown path 'segmnt.x'; did you mean 'segment'?\n",
        ),
        (
            ["info", "graph.yaml"],
            EXIT_DAMAGED,
            "error: graph.yaml: not an MCAP file (it begins with b'mushpipe')\n",
        ),
        (
            ["plugins", "describe", "otsi"],
            EXIT_USAGE,
            "error: there is no plugin 'otsi'; did you mean 'otsu'?\n",
        ),
        (
            ["plugins", "describe", "broken.py:Mine"],
            EXIT_USAGE,
            "broken.py cannot be imported: TypeError: 'int' object is not a mapping "
            "(broken.py, line 1)\n",
        ),
        (
            ["export", "results.mcap", "--topic", "/picks"],
            EXIT_USAGE,
            "error: results.mcap: no picks on /picks; they are on /mushpipe/pick\n",
        ),
        (
            ["eval", "results.mcap", "--truth", "nope.json"],
            EXIT_USAGE,
            "error: nope.json: there are no such labels\n",
        ),
        (
            ["eval", "graph.yaml", "--out", "empty.mcap"],
            EXIT_USAGE,
            "error: empty.mcap cannot be a folder: File exists\n",
        ),
        (
            ["eval", "graph.yaml", "--report", "-"],
            EXIT_USAGE,
            "error: --report - is no folder: its files cannot go to standard output\n",
        ),
        (
            ["bench", "graph.yaml", "--set", "source.max_frames=50"],
            EXIT_USAGE,
            "error: --set source.max_frames=50 has no effect here: say --frames\n",
        ),
        (
            ["run", "graph.yaml", "--frames", "3", "--set", "source.max_frames=5"],
            EXIT_USAGE,
            "--set source.max_frames=5: --frames 3 sets this to 3: give one of them\n",
        ),
        (
            ["view", "results.mcap", "--save", "a{b}.rrd"],
            EXIT_USAGE,
            "error: --save a{b}.rrd: {b} is not known: only {recording} is\n",
        ),
    ],
)
def test_errors_name_what_is_wrong(
    folder: Path, arguments: list[str], code: int, message: str
) -> None:
    (folder / "empty.mcap").touch()
    (folder / "broken.py").write_text("{**5}\n")
    record(folder / "results.mcap", [trace_of(make_frame(), pick=make_picks())])
    done = mushpipe(*arguments, cwd=folder)
    assert message in done.stderr
    assert done.returncode == code
    assert not (folder / "out.mcap").exists()


@pytest.mark.parametrize(
    "arguments",
    [
        ["run", "graph.yaml", "--source", "realsens"],
        ["record", "--source", "realsens", "-o", "x.mcap"],
        ["bench", "graph.yaml", "realsens"],
        ["eval", "graph.yaml", "--recordings", "realsens", "--truth", "labels.json"],
    ],
)
def test_every_verb_that_plays_tells_what_a_graph_is_warned_of(
    folder: Path, arguments: list[str]
) -> None:
    (folder / "labels.json").write_text('{"mushpipe_labels": 1, "frames": []}')
    done = mushpipe(*arguments, cwd=folder)
    warning = "'realsens' is neither a file nor a source; did you mean 'realsense'?\n"
    assert done.stderr.count(warning) == 1
    assert done.returncode == EXIT_USAGE


def test_a_failing_stage_leaves_a_capsule_that_fails_again(folder: Path) -> None:
    (folder / "mine.py").write_text(
        "from mushpipe import Mask, RgbdFrame, Stage\n\n"
        "class Picky(Stage):\n"
        "    def process(self, frame: RgbdFrame) -> Mask:\n"
        "        if frame.header.sequence == 1:\n"
        "            raise RuntimeError('no frame like this')\n"
        "        return Mask(frame.gray > 0.5)\n"
    )
    done = mushpipe("run", "graph.yaml", "--set", "segment.use=./mine.py:Picky", cwd=folder)
    assert done.returncode == EXIT_FAILED
    assert "failed on frame 1: RuntimeError: no frame like this" in done.stderr
    assert "1 failed" in done.stderr
    again = mushpipe("run", "failures/failure-first-bed-segment-1.mcap", cwd=folder)
    assert again.returncode == EXIT_FAILED
    assert "failed on frame 1: RuntimeError: no frame like this" in again.stderr


def test_a_recording_is_no_graph(folder: Path) -> None:
    mushpipe("run", "graph.yaml", cwd=folder)
    done = mushpipe("run", "out.mcap", cwd=folder)
    assert done.returncode == EXIT_USAGE
    assert "mushpipe run GRAPH --source out.mcap" in done.stderr


def test_pictures_and_listings(folder: Path) -> None:
    assert "n1 -->|Mask| n2" in mushpipe("graph", "graph.yaml", cwd=folder).stdout
    assert '"segment" -> "open" [label="Mask"]' in (
        mushpipe("graph", "graph.yaml", "--format", "dot", cwd=folder).stdout
    )
    rows = json.loads(mushpipe("plugins", "list", "--format", "json", cwd=folder).stdout)
    assert {"kind": "stage", "name": "otsu", "from": "mushpipe 0.1.0", "problem": ""} in rows
    described = mushpipe("plugins", "describe", "opening", cwd=folder).stdout
    assert "inputs   mask: Mask" in described
    assert "integer >= 1 <= 255" in described


def test_verbs_without_a_log_of_their_own_call_a_warning_one(folder: Path) -> None:
    graph = folder / "graph.yaml"
    graph.write_text(GRAPH.partition("sinks:")[0])
    done = mushpipe("graph", graph, cwd=folder)
    assert done.stderr == "WARNING: nobody takes what 'pick' produces\n"
    assert done.returncode == 0


def test_the_version_is_that_of_the_installed_package(tmp_path: Path) -> None:
    done = mushpipe("--version", cwd=tmp_path)
    assert (done.returncode, done.stdout) == (0, f"mushpipe {version('mushpipe')}\n")


@pytest.mark.parametrize("heavy", ["open3d", "rerun", "scipy", "cv2", "pyrealsense2"])
def test_help_imports_nothing_heavy(heavy: str) -> None:
    code = (
        "import sys; sys.argv = ['mushpipe', '--help']\n"
        "from mushpipe.cli import main\n"
        "try: main()\n"
        f"except SystemExit: sys.exit('{heavy}' in sys.modules)"
    )
    assert subprocess.run([sys.executable, "-c", code], capture_output=True).returncode == 0


GRAPHS = [path for path in sorted((ROOT / "graphs").glob("*.yaml")) if path.stem != "robot"]


@pytest.mark.parametrize("graph", GRAPHS, ids=lambda p: p.stem)
def test_the_graphs_of_the_project_run(graph: Path, tmp_path: Path) -> None:
    sinks = ["--set", f"log.path={tmp_path / 'log.mcap'}"]
    if "view:" in graph.read_text():
        sinks += ["--set", f"view.save={tmp_path / 'view.rrd'}"]
    if graph.stem == "live":  # on a recording: there need not be a camera
        sinks += ["--source", str(ROOT / "recordings/first-bed.mcap")]
    done = mushpipe("run", graph, "--frames", 1, *sinks, cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    last = "detect" if graph.stem == "colour" else "pick"
    (log,) = tmp_path.glob("log*.mcap")  # the station's results are in parts
    (found,) = RecordingReader(log).messages({f"/mushpipe/{last}"})
    assert len(json.loads(found.message.data)["score"]) > 10


def test_a_graph_without_faults_may_name_files_of_another_machine(folder: Path) -> None:
    text = "mushpipe: 1\nsource: {use: mcap, path: bed.mcap}\nstages:\n"
    text += "  correct: {use: depth-correct, calibration: cal.yaml}\n"
    (folder / "graph.yaml").write_text(text)
    missing = [
        f"source: there is no file {folder}/bed.mcap (path)",
        f"correct: there is no file {folder}/cal.yaml (calibration)",
    ]
    done = mushpipe("validate", "graph.yaml", cwd=folder)
    assert done.returncode == 0
    assert all(line in done.stderr for line in missing)
    listed = json.loads(mushpipe("validate", "graph.yaml", "--format", "json", cwd=folder).stdout)
    assert listed["warnings"][-2:] == missing
    (folder / "cal.yaml").write_text("")
    (folder / "bed.mcap").write_text("")
    assert "no file" not in mushpipe("validate", "graph.yaml", cwd=folder).stderr


def test_names_with_brackets_are_printed_as_they_are(folder: Path) -> None:
    (folder / "mine.py").write_text(
        "from mushpipe import Mask, RgbdFrame, Stage\n\n"
        "class Picky(Stage):\n"
        "    def process(self, frame: RgbdFrame) -> Mask:\n"
        "        raise RuntimeError('never')\n"
    )
    options = ["--set", "segment.use=./mine.py:Picky", "--manifest", "m[red].json"]
    done = mushpipe("run", "graph.yaml", *options, "--capsules", "c[b]", cwd=folder)
    assert "manifest: m[red].json\n" in done.stderr
    assert "mushpipe run c[b]/" in done.stderr


def test_the_results_of_a_failed_run_say_how_it_ended(folder: Path) -> None:
    (folder / "mine.py").write_text(
        "from mushpipe import Mask, RgbdFrame, Stage\n\n"
        "class Picky(Stage):\n"
        "    def process(self, frame: RgbdFrame) -> Mask:\n"
        "        raise RuntimeError('never')\n"
    )
    mushpipe("run", "graph.yaml", "--set", "segment.use=./mine.py:Picky", cwd=folder)
    with (folder / "out.mcap").open("rb") as file:
        metadata = {m.name: m.metadata for m in make_reader(file).iter_metadata()}
    summary = json.loads(metadata["mushpipe.summary"]["json"])
    assert summary["exit_code"] == EXIT_FAILED
    assert summary["frames"]["failed"] == 1


def test_the_module_is_the_command() -> None:
    done = subprocess.run(
        [sys.executable, "-m", "mushpipe", "plugins", "list"], capture_output=True, text=True
    )
    assert done.returncode == 0
    assert "phase-hough" in done.stdout


@pytest.mark.parametrize(
    "arguments", [["eval", "a.mcap"], ["calibrate", "depth", "a.mcap", "--plane", "0.5"]]
)
def test_no_bootstrap_takes_all_memory(arguments: list[str]) -> None:
    done = CliRunner().invoke(app, [*arguments, "--resamples", "1000000000"])
    assert done.exit_code == EXIT_USAGE
    assert "--resamples" in done.output


@pytest.mark.parametrize("number", ["nan", "inf"])
@pytest.mark.parametrize(
    "arguments",
    [
        ["compare", "a.mcap", "a.mcap", "--tol"],
        ["bench", "graph.yaml", "--allow"],
        ["bench", "graph.yaml", "--speed"],
        ["eval", "a.mcap", "--iou"],
        ["robot", "client", "--every"],
        ["run", "graph.yaml", "--speed"],
        ["record", "--source", "synthetic", "-o", "b.mcap", "--duration"],
        ["eval", "graph.yaml", "--threshold", "f>=0.1", "--threshold", "|radius_bias_px|<="],
        ["eval", "a.mcap", "--plane"],
    ],
)
def test_no_option_that_decides_something_takes_what_is_no_number(
    folder: Path, monkeypatch: pytest.MonkeyPatch, arguments: list[str], number: str
) -> None:
    """Of NaN every comparison is false: no difference was above such a tolerance."""
    monkeypatch.chdir(folder)
    last = arguments[-1]
    given = [*arguments[:-1], last + number] if last.endswith("=") else [*arguments, number]
    done = CliRunner().invoke(app, given)
    assert getattr(done.exception, "exit_code", done.exit_code) == EXIT_USAGE
    option = next(text for text in reversed(given) if text.startswith("--"))
    assert option in f"{done.output} {done.exception}"


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["record", "--source", "synthetic", "-o", "\udcff.mcap"], "a text in it is not UTF-8"),
        (["view", "\udcff.mcap", "--save", "a.rrd"], "there is no such recording"),
        (["plugins", "describe", "\udcff.py:A"], "cannot be the name of a file"),
        (["validate", "nul.yaml"], f"cannot be the name of a file: {NUL}"),
        (["validate", "half.yaml"], "half.yaml:1:1: the graph: a text in it is not UTF-8"),
    ],
)
def test_names_that_cannot_be_are_told_in_words(
    folder: Path, arguments: list[str], message: str
) -> None:
    (folder / "nul.yaml").write_text(GRAPH.replace("otsu", r'"a\0.py:A"'))
    (folder / "half.yaml").write_text(GRAPH.replace("out.mcap", r'"\ud800.mcap"'))
    done = mushpipe(*arguments, cwd=folder)
    assert message in done.stderr
    assert done.returncode == EXIT_USAGE
    assert "Traceback" not in done.stderr


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["run", "graph.yaml", "--frames", str(2**63)], "max_frames of 'mcap'"),
        (["run", "graph.yaml", "--source", "a.mcap", "--end", "1e300"], "end of 'mcap'"),
        (["run", "graph.yaml", "--set", "pick.memory_s=1e300"], "memory_s of 'picks'"),
        (["run", "graph.yaml", "--set", "source.max_seconds=1e300"], "max_seconds of 'mcap'"),
        (["run", "graph.yaml", "--set", "source.pair_tolerance_ms=1e308"], "pair_tolerance_ms of"),
        (["run", "look.yaml", "--set", "look.image_hz=1e-300"], "image_hz of 'rerun'"),
        (["run", "look.yaml", "--set", "look.result_hz=1e-300"], "result_hz of 'rerun'"),
        (["run", "images.yaml", "--set", "source.fps=1e-300"], "fps of 'images'"),
        (["run", "made.yaml", "--set", "source.fps=1e-300"], "fps of 'synthetic'"),
        (["run", "made.yaml", "--set", "source.gap_s=1e300"], "gap_s of 'synthetic'"),
        (["bench", "graph.yaml", "--frames", str(2**63)], "Invalid value for '--frames'"),
    ],
)
def test_a_number_that_is_too_large_or_too_small_is_the_command_lines_fault(
    folder: Path, arguments: list[str], message: str
) -> None:
    """It was an OverflowError, told as a failure of the source, the stage or the sink."""
    played = {"images": "{use: images, path: .}", "made": "{use: synthetic}"}
    for name, source in played.items():
        (folder / f"{name}.yaml").write_text(f"mushpipe: 1\nsource: {source}\n")
    (folder / "look.yaml").write_text(GRAPH + "  look: {use: rerun, save: out.rrd}\n")
    done = mushpipe(*arguments, cwd=folder)
    assert message in done.stderr
    assert done.returncode == EXIT_USAGE
