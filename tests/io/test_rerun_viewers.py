"""Where the sink `rerun` sends: files, viewers, servers; and the layout that goes with it."""

from __future__ import annotations

import os
import signal
import socket
import subprocess
import sys
import time
from contextlib import suppress
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from pydantic import ValidationError
from rerun.chunk import RrdReader

from mushpipe import Camera, Mask, RunInfo, Trace
from mushpipe.core.errors import DependencyError, UsageError
from mushpipe.sinks import rerun
from mushpipe.sinks.rerun import RerunSink
from tests.io.rerun_file import feed, show
from tests.io.values import make_frame, make_picks, trace_of


def test_the_file_has_one_layout_and_is_whole(tmp_path: Path) -> None:
    mask = Mask(np.zeros((24, 32), bool))
    show(tmp_path, [trace_of(make_frame(), segment=mask, pick=make_picks())])
    reader = RrdReader(tmp_path / "out.rrd")
    assert len(reader.recordings()) == 1
    assert len(reader.blueprints()) == 1
    command = [sys.executable, "-m", "rerun", "rrd", "verify", str(tmp_path / "out.rrd")]
    verified = subprocess.run(command, capture_output=True, text=True, check=False)
    assert verified.returncode == 0, verified.stderr


def test_the_layout_grows_when_depth_or_results_come_late(tmp_path: Path) -> None:
    sent = []
    sink = RerunSink(save=tmp_path / "out.rrd")
    sink.open(RunInfo("bed", {}))
    sink._recording.send_blueprint = lambda blueprint: sent.append(blueprint)
    bare = Trace(make_frame(0, depth=None), {}, {})
    full = trace_of(make_frame(2), a=make_picks())
    for trace in (bare, bare, trace_of(make_frame(1)), full, full):
        sink.consume(trace)
    sink.close()
    views = [{v.name for v in walk(b.root_container)} for b in sent]
    assert views[0] == {"Image", "Log"}  # no plot without anything in it
    assert views[1] == views[0] | {"Bed", "Depth, holes red", "Depth valid, %"}
    assert views[2] == views[1] | {"Mushrooms", "Time per stage, ms"}


def walk(part: Any) -> list[Any]:
    """Return the views in a container of a blueprint."""
    inside = getattr(part, "contents", [])
    return [part] if not hasattr(part, "kind") else [v for p in inside for v in walk(p)]


def first_look(spread: float) -> tuple[np.ndarray, np.ndarray]:
    """Return where the eye and what it looks at are, for a camera that sees so wide a bed."""
    sent: list[Any] = []
    sink = RerunSink(connect="rerun+http://127.0.0.1:1/proxy")
    sink._recording = SimpleNamespace(send_blueprint=sent.append, log=lambda *_, **__: None)
    camera = Camera(32, 24, 16 / spread, 16 / spread, 15.5, 11.5)
    sink._lay_out(trace_of(make_frame(camera=camera), pick=make_picks()))
    (bed,) = (view for view in walk(sent[0].root_container) if view.name == "Bed")
    eye = bed.properties["EyeControls3D"]
    position, target = (
        batch.as_arrow_array().to_pylist() for batch in (eye.position, eye.look_target)
    )
    return np.array(position[0]), np.array(target[0])


@pytest.mark.parametrize("spread", [0.3, 0.53, 0.98, 2.0])
def test_a_wide_bed_is_looked_at_from_as_far_as_it_is_seen_whole(spread: float) -> None:
    eye, middle = first_look(spread)
    near, same = first_look(0.5)
    np.testing.assert_allclose(middle, same)
    away, usual = eye - middle, near - same
    times = max(1.0, spread / 0.55)  # half the usual width is just seen from the usual place
    np.testing.assert_allclose(away, times * usual, rtol=1e-5)


def free_port() -> int:
    with socket.socket() as s:
        s.bind(("127.0.0.1", 0))
        return int(s.getsockname()[1])


def test_a_run_is_served_to_viewers_on_this_machine_only(tmp_path: Path) -> None:
    port = free_port()
    sink = RerunSink(serve=port, save=tmp_path / "out.rrd")
    sink.open(RunInfo("bed", {}))
    listening = Path("/proc/net/tcp").read_text()
    sink.consume(trace_of(make_frame(), pick=make_picks()))
    sink.close()
    assert f"0100007F:{port:04X} 00000000:0000 0A" in listening
    assert f"00000000:{port:04X}" not in listening
    assert (tmp_path / "out.rrd").stat().st_size > 0
    wait_for(port, False)


def test_a_run_is_served_by_ipv6(tmp_path: Path) -> None:
    if not Path("/proc/net/if_inet6").exists():
        pytest.skip("this machine has no IPv6")
    sink = RerunSink(serve=free_port(), host="::1", save=tmp_path / "out.rrd")
    feed(sink, [trace_of(make_frame(), pick=make_picks())])
    assert (tmp_path / "out.rrd").stat().st_size > 0


def test_what_is_sent_to_a_viewer_arrives(tmp_path: Path) -> None:
    port = free_port()
    stored = tmp_path / "arrived.rrd"
    # Rerun's own command line plays the viewer that receives.
    command = [sys.executable, "-m", "rerun", "--bind", "127.0.0.1", "--port", str(port)]
    quiet = {"stdout": subprocess.DEVNULL, "stderr": subprocess.DEVNULL}
    viewer = subprocess.Popen([*command, "--save", str(stored)], **quiet)
    try:
        wait_for(port)
        feed(
            RerunSink(connect=f"rerun+http://127.0.0.1:{port}/proxy"),
            [trace_of(make_frame(), pick=make_picks())],
        )
        wait_for_picks(stored, runs=1)
        viewer.send_signal(signal.SIGINT)
        viewer.wait(20)
    finally:
        viewer.kill()
    assert "/camera/image/picks" in {c.entity_path for c in RrdReader(stored).stream()}


def test_a_viewer_is_opened_for_this_machine_only(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    started, stored, start = [], tmp_path / "shown.rrd", rerun.start

    def instead(host: str, port: int, *arguments: str) -> subprocess.Popen[bytes]:
        started.append((host, arguments, start(host, port, "--save", str(stored))))
        return started[0][2]

    monkeypatch.setenv("DISPLAY", ":99")
    monkeypatch.setattr(rerun, "PORT", free_port())
    monkeypatch.setattr(rerun, "start", instead)
    try:
        for _ in range(2):  # the viewer of the first run takes the second one too
            feed(RerunSink(spawn=True, memory="300MB"), [trace_of(make_frame(), pick=make_picks())])
        ((host, arguments, viewer),) = started
        assert (host, arguments) == ("127.0.0.1", ("--memory-limit", "300MB"))
        assert viewer.poll() is None  # it stays open when the run is over
        wait_for_picks(stored, runs=2)
    finally:
        for _, _, viewer in started:
            os.killpg(viewer.pid, signal.SIGINT)
            viewer.wait(20)
    assert runs_with_picks(stored) == len(RrdReader(stored).recordings()) == 2


def runs_with_picks(stored: Path) -> int:
    reader = RrdReader(stored)
    shown = [{c.entity_path for c in reader.stream(store=run)} for run in reader.recordings()]
    return sum("/camera/image/picks" in entities for entities in shown)


def wait_for_picks(stored: Path, runs: int) -> None:
    """Wait until a viewer has stored them: its end cuts off what is still on the way."""
    for _ in range(200):
        with suppress(ValueError, RuntimeError):  # there is no file yet, or half a message
            if runs_with_picks(stored) == runs:
                return
        time.sleep(0.1)
    raise TimeoutError(stored)


def wait_for(port: int, listening: bool = True) -> None:
    for _ in range(200):
        with socket.socket() as probe:
            if (probe.connect_ex(("127.0.0.1", port)) == 0) == listening:
                return
        time.sleep(0.1)
    raise TimeoutError(port)


def test_what_cannot_be_opened_is_refused_with_a_reason(monkeypatch: pytest.MonkeyPatch) -> None:
    with pytest.raises(ValidationError, match="set 'save', 'spawn', 'connect' or 'serve'"):
        RerunSink()
    with pytest.raises(UsageError, match="no viewer answers at 127"):
        feed(RerunSink(connect=f"rerun+http://127.0.0.1:{free_port()}/proxy"), [])
    with pytest.raises(UsageError, match="is not like"):
        feed(RerunSink(connect="localhost"), [])
    monkeypatch.delenv("DISPLAY", raising=False)
    monkeypatch.delenv("WAYLAND_DISPLAY", raising=False)
    with pytest.raises(DependencyError, match="no display"):
        feed(RerunSink(spawn=True), [])
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        taken.listen()
        sink = RerunSink(serve=taken.getsockname()[1])
        with pytest.raises(UsageError, match="is taken"):
            feed(sink, [])


@pytest.mark.parametrize(
    ("setting", "value", "message"),
    [
        ("memory", "lots", r"expected an amount \(300MB, 2GB\), or a share"),
        ("memory", "1gb", "expected an amount"),
        ("memory", "150%", "expected an amount"),
        ("host", "localhost", "expected an IP address of this machine"),
    ],
)
def test_what_rerun_would_not_start_with_is_a_fault_of_its_setting(
    setting: str, value: str, message: str
) -> None:
    with pytest.raises(ValidationError, match=rf"{setting}\n.*{message}"):
        RerunSink.model_validate({"serve": 9876, setting: value})


@pytest.mark.parametrize("memory", ["1GB", "1.5 GiB", "300MB", "50%", "0kB"])
def test_rerun_starts_with_any_amount_of_memory_that_is_accepted(memory: str) -> None:
    feed(RerunSink(serve=free_port(), memory=memory), [])


def test_it_takes_only_the_newest_frame_when_live_and_can_be_closed_twice(tmp_path: Path) -> None:
    sink = RerunSink(save=tmp_path / "{recording}.rrd")
    assert sink.delivery == "latest"
    feed(sink, [trace_of(make_frame())])
    sink.close()
    assert (tmp_path / "bed.rrd").stat().st_size > 0
