"""Recordings of librealsense (`.bag`), made by its own recorder in the test, and played."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from mushpipe import RgbdFrame
from mushpipe.core.errors import EXIT_DAMAGED, EXIT_OK, EXIT_USAGE, InputError
from mushpipe.sources import realsense
from mushpipe.sources.realsense import RealsenseSource
from mushpipe.sources.realsense_frames import CLOCK_TOPIC, Domain
from tests.core.lab import Lab, cli
from tests.live.rig import COLOR, HARDWARE, UNITS, Rig, acquire, rs

N = 60


@pytest.fixture(scope="module")
def bag(tmp_path_factory) -> Path:
    path = tmp_path_factory.mktemp("bags") / "field.bag"
    rig = Rig(depth=COLOR, shift=(0, 0, 0))
    rig.record(path, [rig.images(i) for i in range(N)])
    return path


def play(path: Path, **settings):
    source = RealsenseSource(file=path, **settings)
    source.open()
    try:
        return source, list(source.frames())
    finally:
        source.close()


def test_60_of_60_frames_of_a_recording_are_exact(bag):
    source, frames = play(bag)
    assert (source.live, source.name(), source.files()) == (False, "field", (bag,))
    assert [frame.header.sequence for frame in frames] == list(range(N))
    for i, frame in enumerate(frames):
        assert (frame.color == i).all()
        assert frame.depth is not None
        assert set(np.unique(frame.depth)) <= {0, 4000 + i}
        assert frame.depth_scale == pytest.approx(UNITS, rel=1e-6)
        assert frame.header.stamp_ns == pytest.approx(1.7e18 + i * 1e9 / 30, abs=300)
        assert frame.header.arrival_ns == frame.header.stamp_ns
        assert frame.attached[CLOCK_TOPIC].domain.tolist() == [Domain.SYSTEM] * 2
    assert frames[0].camera is not None
    assert frames[0].camera.fx == pytest.approx(COLOR.fx)
    assert source.counts() == {}


def test_the_arrival_that_was_recorded_is_told(tmp_path):
    rig = Rig()
    for sensor, _ in rig.sensors.values():
        sensor.set_metadata(rs.frame_metadata_value.time_of_arrival, 1_700_000_000_456)  # ms
    rig.record(tmp_path / "a.bag", [rig.images(i) for i in range(3)])
    headers = [frame.header for frame in play(tmp_path / "a.bag")[1]]
    assert headers[0].stamp_ns == pytest.approx(1.7e18, abs=300)
    assert [header.arrival_ns for header in headers] == [1_700_000_000_456_000_000] * 3


def test_playing_twice_gives_the_same(bag):
    first, second = (play(bag)[1] for _ in range(2))
    for a, b in zip(first, second, strict=True):
        assert a.header == b.header
        assert (a.color == b.color).all()
        assert (a.depth == b.depth).all()


def test_a_graph_that_is_too_slow_gets_every_frame(lab: Lab, bag):
    """The stage holds the first frame until the reader has run into its full queue."""
    rig = Rig()
    lab.registry.source("player", rig.source_class())
    held = []

    def progress(report) -> None:
        if not held:
            held.append(True)
            acquire(rig.taken)  # frame 0 is handed over ...
            acquire(rig.taken)  # ... and two more wait

    text = f"mushpipe: 1\nsource: {{use: player, file: {bag}}}\nsinks: {{out: {{use: collect}}}}"
    report = lab.run(text, progress=progress)
    assert [trace.frame.header.sequence for trace in lab.seen] == list(range(N))
    assert (report.processed, report.dropped, report.exit_code) == (N, 0, 0)


def test_a_recording_ignores_the_settings_of_a_camera_and_says_so(bag, caplog):
    _, frames = play(bag, preset="short-range", laser_power=3, warm_up=30)
    assert len(frames) == N
    assert caplog.messages == ["of no effect on a recording: preset, laser_power"]


def test_the_cameras_own_clock_starts_where_the_recording_does(tmp_path):
    rig = Rig()
    rig.record(tmp_path / "a.bag", [rig.images(i) for i in range(4)], HARDWARE)
    _, frames = play(tmp_path / "a.bag")
    intervals = np.diff([frame.header.stamp_ns for frame in frames])
    assert intervals == pytest.approx(1e9 / 30, abs=300)
    assert frames[0].attached[CLOCK_TOPIC].domain.tolist() == [Domain.HARDWARE] * 2


@pytest.mark.parametrize("name", ["bgr8", "rgba8", "yuyv", "y8"])
def test_other_colour_formats(tmp_path, name):
    rig = Rig(depth=COLOR, color_format=name)
    pixel = {
        "bgr8": [30, 20, 10],
        "rgba8": [10, 20, 30, 0],
        "yuyv": [128, 128],
        "y8": [99],
    }[name]
    expected = {"yuyv": [130, 130, 130], "y8": [99, 99, 99]}.get(name, [10, 20, 30])
    image = np.full((120, 160, len(pixel)), pixel, np.uint8)
    rig.record(tmp_path / "a.bag", [{"depth": rig.images(0)["depth"], "color": image}] * 3)
    _, frames = play(tmp_path / "a.bag")
    assert len(frames) == 3
    assert np.abs(frames[0].color.astype(int) - expected).max() <= 1


def damaged(bag: Path, kind: str) -> bytes:
    data = bag.read_bytes()
    # Within the images of a chunk in the middle; the records around it stay whole.
    at = data.index(b"op=\x05", len(data) // 2) + 200
    return {
        "empty": b"",
        "foreign": b"not a recording at all" * 100,
        "cut": data[: len(data) * 6 // 10],
        "overwritten": data[:at] + bytes(1000) + data[at + 1000 :],
    }[kind]


@pytest.mark.parametrize("kind", ["empty", "foreign", "cut"])
def test_a_file_that_is_no_recording(bag, tmp_path, kind):
    (tmp_path / "a.bag").write_bytes(damaged(bag, kind))
    with pytest.raises(InputError, match=r"a\.bag: not a readable RealSense recording: Error"):
        play(tmp_path / "a.bag")


def test_a_damaged_recording_is_played_as_far_as_it_goes(bag, tmp_path):
    """librealsense itself stops without a word."""
    (tmp_path / "a.bag").write_bytes(damaged(bag, "overwritten"))
    source = RealsenseSource(file=tmp_path / "a.bag")
    source.open()
    frames: list[RgbdFrame] = []
    with pytest.raises(InputError, match=r"a\.bag is damaged: .* could be read$") as caught:
        frames.extend(source.frames())
    source.close()
    assert f"{len(frames)} of its 60 colour images" in str(caught.value)
    assert 0 < len(frames) < N


GRAPH = """\
mushpipe: 1
source: {use: synthetic}
sinks: {log: {use: mcap, path: out.mcap}}
"""


def test_the_program_plays_a_bag(bag, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    Path("graph.yaml").write_text(GRAPH)
    assert cli(monkeypatch, "run", "graph.yaml", "--source", bag, "--frames", 5) == EXIT_OK
    assert "5 frames in = 5 processed" in capsys.readouterr().err
    assert cli(monkeypatch, "run", "graph.yaml", "--source", "no.bag") == EXIT_USAGE
    assert "error: no.bag: there is no such recording" in capsys.readouterr().err
    Path("b.bag").write_bytes(damaged(bag, "overwritten"))
    assert cli(monkeypatch, "run", "graph.yaml", "--source", "b.bag") == EXIT_DAMAGED


def test_a_recording_whose_depth_stops_is_played_to_its_end(monkeypatch):
    """Silence is for cameras: how long a file takes depends on the machine."""

    class File:
        live = False
        left = 50

        def wait(self):
            self.left -= 1
            return object() if self.left >= 0 else None

        def ended(self):
            return True

        def unplayed(self):
            return 0

        def check(self, quiet_s, patience_s):
            raise AssertionError("nobody asks whether it is silent")

    class Maker:
        whole = 0

        def make(self, frames, arrival_ns):
            return None

    ticks = iter(range(10**6))
    monkeypatch.setattr(realsense.time, "monotonic", lambda: next(ticks))
    assert list(RealsenseSource(file="a.bag")._played(File(), Maker())) == []
