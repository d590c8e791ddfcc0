"""`mushpipe view`: what is opened, and what is said where nothing can be."""

from __future__ import annotations

from pathlib import Path

import pytest
from rerun.chunk import RrdReader
from typer.testing import CliRunner

from mushpipe import RunInfo, Trace
from mushpipe.cli import app
from mushpipe.core.errors import DependencyError, GraphError, InputError, UsageError
from mushpipe.sinks.rerun import RerunSink
from tests.cli.shell import mushpipe
from tests.io.bags import COLOR, color_at, rgbd, write_bag
from tests.io.values import make_circles, make_frame, make_picks, record, trace_of


def entities(path: Path) -> dict[str, int]:
    """Return the rows of each entity that are not static."""
    rows: dict[str, int] = {}
    for chunk in RrdReader(path).stream():
        if not chunk.is_static:
            rows[chunk.entity_path] = rows.get(chunk.entity_path, 0) + chunk.num_rows
    return rows


def test_results_are_shown_with_all_their_layers(tmp_path: Path) -> None:
    traces = [trace_of(make_frame(i), detect=make_circles(), pick=make_picks()) for i in range(3)]
    results, out = record(tmp_path / "out.mcap", traces), tmp_path / "out.rrd"
    assert CliRunner().invoke(app, ["view", str(results), "--save", str(out)]).exit_code == 0
    rows = entities(out)
    assert rows["/camera/image/picks"] == rows["/camera/image/color"] == 3
    assert rows["/plots/time"] == 3
    assert len(RrdReader(out).blueprints()) == 1


def test_a_recording_is_shown_as_it_is(tmp_path: Path) -> None:
    recording = record(tmp_path / "bed.mcap", [Trace(make_frame(i), {}, {}) for i in range(2)])
    out = tmp_path / "bed.rrd"
    assert CliRunner().invoke(app, ["view", str(recording), "--save", str(out)]).exit_code == 0
    rows = entities(out)
    assert rows["/camera/image/color"] == rows["/camera/cloud"] == 2
    assert "/camera/image/picks" not in rows


def test_a_file_without_an_index_is_no_warning_where_none_was_asked_for(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.delenv("RUST_LOG", raising=False)
    recording = record(tmp_path / "bed.mcap", [Trace(make_frame(0), {}, {})])
    graph = tmp_path / "view.yaml"
    for index, footer in (("true", True), ("false", False)):
        graph.write_text(
            f"mushpipe: 1\nsource: {{use: mcap, path: {recording}}}\nstages: {{}}\n"
            f"sinks: {{view: {{use: rerun, save: {index}.rrd, index: {index}}}}}\n"
        )
        run = mushpipe("run", graph, cwd=tmp_path)
        assert run.returncode == 0
        assert "WARN" not in run.stderr
        assert (b"RRF2FOOT" in (tmp_path / f"{index}.rrd").read_bytes()[-64:]) is footer


def test_a_damaged_file_is_shown_as_far_as_it_goes(tmp_path: Path) -> None:
    path, out = record(tmp_path / "a.mcap", [trace_of(make_frame())]), tmp_path / "a.rrd"
    path.write_bytes(path.read_bytes()[:-9])
    result = CliRunner().invoke(app, ["view", str(path), "--save", str(out)])
    assert isinstance(result.exception, InputError)
    assert entities(out)["/camera/image/color"] == 1


def test_what_shows_nothing_leaves_an_earlier_file_alone(tmp_path: Path) -> None:
    path, out = record(tmp_path / "a.mcap", [trace_of(make_frame())]), tmp_path / "a.rrd"
    path.write_bytes(path.read_bytes()[:200])
    out.write_text("an earlier one")
    result = CliRunner().invoke(app, ["view", str(path), "--save", str(out)])
    assert isinstance(result.exception, InputError)
    assert out.read_text() == "an earlier one"


def test_which_of_several_topics_is_shown_can_be_said(tmp_path: Path) -> None:
    other = "/other/color/image_raw"
    bag = write_bag(tmp_path, [*rgbd(range(2)), color_at(0, topic=other)])
    arguments = ["view", str(bag), "--save", str(tmp_path / "bed.rrd")]
    error = CliRunner().invoke(app, arguments).exception
    assert isinstance(error, InputError)
    assert f"--set source.color_topic={other}" in str(error)
    chosen = [*arguments, "--set", f"source.color_topic={COLOR}"]
    assert CliRunner().invoke(app, chosen).exit_code == 0
    assert entities(tmp_path / "bed.rrd")["/camera/image/color"] == 2
    assert CliRunner().invoke(app, [*chosen, "--set", "source.max_frames=1"]).exit_code == 0
    assert entities(tmp_path / "bed.rrd")["/camera/image/color"] == 1


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ("source.colour_topic=/a", "did you mean 'color_topic'"),
        ("source.speed=-1", "greater than or equal to 0"),
        ("source.use=synthetic", "view plays recordings"),
        ("log.path=x.mcap", "unknown path 'log.path'"),
    ],
)
def test_a_wrong_setting_of_what_is_shown_is_told_of(
    tmp_path: Path, change: str, message: str
) -> None:
    path = record(tmp_path / "a.mcap", [trace_of(make_frame())])
    arguments = ["view", str(path), "--save", str(tmp_path / "a.rrd"), "--set", change]
    error = CliRunner().invoke(app, arguments).exception
    assert isinstance(error, UsageError | GraphError)
    assert message in str(error)


def test_without_a_display_it_says_what_to_do(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.delenv("DISPLAY", raising=False)
    monkeypatch.delenv("WAYLAND_DISPLAY", raising=False)
    path = record(tmp_path / "a.mcap", [trace_of(make_frame())])
    error = CliRunner().invoke(app, ["view", str(path)]).exception
    assert isinstance(error, DependencyError)
    assert "--save out.rrd" in str(error)
    assert "--serve 9876" in str(error)
    error = CliRunner().invoke(app, ["view", str(tmp_path / "no.mcap")]).exception
    assert isinstance(error, UsageError)
    assert "there is no such recording" in str(error)


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="needs a full device")
def test_a_file_that_cannot_be_written_is_named(tmp_path: Path) -> None:
    recording = record(tmp_path / "bed.mcap", [Trace(make_frame(), {}, {})])
    result = CliRunner().invoke(app, ["view", str(recording), "--save", "/dev/full"])
    assert isinstance(result.exception, UsageError)
    assert "/dev/full cannot be written" in str(result.exception)
    folder = tmp_path / "out"
    folder.mkdir()
    result = CliRunner().invoke(app, ["view", str(recording), "--save", str(folder)])
    assert str(result.exception) == f"save: {folder} cannot be written: Is a directory"


def test_a_server_does_not_outlive_a_view_that_cannot_begin(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    recording = record(tmp_path / "bed.mcap", [Trace(make_frame(), {}, {})])
    events = list[str]()

    def refuse(sink: RerunSink, run: RunInfo) -> None:
        events.append("served")
        raise UsageError("it cannot be written")

    monkeypatch.setattr(RerunSink, "open", refuse)
    monkeypatch.setattr(RerunSink, "close", lambda sink: events.append("closed"))
    result = CliRunner().invoke(app, ["view", str(recording), "--save", "a.rrd", "--serve", "9871"])
    assert isinstance(result.exception, UsageError)
    assert events == ["served", "closed"]
