"""A camera that is absent, unplugged, silent, or comes back."""

from __future__ import annotations

import logging
import platform
import threading
import time
from contextlib import suppress
from pathlib import Path
from types import SimpleNamespace

import pytest

from mushpipe.core.errors import EXIT_INTERRUPTED, EXIT_NO_DEVICE, DeviceError
from mushpipe.sources import realsense, realsense_device, realsense_frames
from mushpipe.sources.realsense import TIMES_LOST, RealsenseSource
from mushpipe.sources.realsense_device import cameras_on_usb, no_camera
from mushpipe.sources.realsense_frames import AWAY
from tests.core.lab import Lab, cli
from tests.live.rig import SDK, Context, Rig, acquire

SR300_HERE = """\
    an SR300 or SR305 needs pyrealsense2 2.54, as it is here: the last one with
    their driver, built for Python 3.11 and older
"""
SR300_NOT_HERE = """\
    it cannot see an SR300 or SR305: 2.55 dropped their driver; they need
    pyrealsense2 2.54, which is built for Python 3.11 and older
"""
GRAPH = """\
mushpipe: 1
source: {use: realsense}
sinks: {log: {use: mcap, path: out.mcap}}
"""


def started(rig: Rig, **settings):
    """Return the source and its frames, after the first one."""
    source = rig.source(**settings)
    source.open()
    frames = source.frames()
    rig.feed(0)
    assert next(frames).header.sequence == 0
    return source, frames


def test_an_unplugged_camera_is_taken_up_again(caplog, monkeypatch):
    arrivals_s = iter([1000.0, 1002.5])
    clock = SimpleNamespace(time_ns=lambda: round(next(arrivals_s) * 1e9), monotonic=time.monotonic)
    monkeypatch.setattr(realsense, "time", clock)
    rig = Rig()
    source, frames = started(rig)
    rig.context.plugged = False

    def plug() -> None:
        rig.context.plugged = len(rig.pauses) == 3

    rig.on_pause = plug
    rig.on_start = lambda: rig.feed(0)  # a camera counts from 0 again
    with caplog.at_level(logging.WARNING, "mushpipe"):
        frame = next(frames)
    assert frame.header.sequence == 1
    assert rig.pauses == [0.5, 1.0, 2.0]
    assert rig.starts == 2
    assert caplog.messages == [
        "the camera was lost: it was unplugged; waiting for it up to 60 s",
        "the camera is back",
    ]
    counts = source.counts()
    source.close()
    assert counts == {TIMES_LOST: 1, AWAY: 2500}


def test_settings_are_made_again_when_the_camera_is_back():
    rig = Rig(options={"laser_power": (0, 16, 16)})
    source, frames = started(rig, laser_power=3)
    sensor = rig.sensors["depth"][0]
    option = next(o for o in sensor.get_supported_options() if o.name == "laser_power")
    rig.context.plugged = False

    def plug() -> None:
        sensor.set_option(option, 16)
        rig.context.plugged = True

    rig.on_pause, rig.on_start = plug, lambda: rig.feed(9)
    next(frames)
    assert sensor.get_option(option) == 3
    source.close()


def test_a_camera_that_stays_away_ends_the_run():
    rig = Rig()
    source, frames = started(rig, reconnect_s=4.0)
    rig.context.plugged = False
    with pytest.raises(DeviceError) as caught:
        next(frames)
    source.close()
    assert str(caught.value) == (
        "the camera was lost (it was unplugged) and did not come back within 4 s"
    )
    assert rig.pauses == [0.5, 1.0, 2.0, 4.0]


def test_another_camera_in_its_place_is_not_taken():
    rig = Rig()
    source, frames = started(rig, reconnect_s=1.0)
    other = Rig(serial="42")
    rig.context = other.context
    source._link._context = other.context  # the cable now leads there
    with pytest.raises(DeviceError, match="did not come back within 1 s"):
        next(frames)
    source.close()


def test_a_silent_camera_is_started_again(caplog):
    rig = Rig()
    source, frames = started(rig, patience_s=1.0)
    rig.on_start = lambda: rig.feed(1)
    with caplog.at_level(logging.WARNING, "mushpipe"):
        assert next(frames).header.sequence == 1
    source.close()
    assert caplog.messages[0] == (
        "the camera was lost: it is connected but sent no whole frame for 1 s; waiting for it "
        "up to 60 s"
    )


def live_lab(lab: Lab, rig: Rig) -> str:
    lab.registry.source("camera", rig.source_class())
    settings = rig.settings() | {"use": "camera"}
    return f"mushpipe: 1\nsource: {settings}\nsinks: {{out: {{use: collect}}}}\n"


@pytest.mark.parametrize("missing", ["color", "depth"])
def test_a_camera_of_which_one_sensor_sends_nothing_is_lost(missing):
    """Neither half-dead nor started in vain for ever: the time to come back goes on meanwhile."""
    rig = Rig()
    source, frames = started(rig, patience_s=1.0, reconnect_s=2.0)
    ended = threading.Event()

    def pump() -> None:
        number = 0
        while not ended.wait(0.03):
            number += 1
            images = rig.images(number)
            del images[missing]
            with suppress(RuntimeError):  # between two starts
                rig.feed(number, images)

    thread = threading.Thread(target=pump)
    thread.start()
    with pytest.raises(DeviceError, match=r"sent no whole frame for 1 s.* within 2 s"):
        next(frames)
    ended.set()
    thread.join()
    assert source.counts()[TIMES_LOST] == 1
    source.close()


def test_depth_from_before_a_loss_fills_no_holes():
    rig = Rig()
    source = rig.source(filters=["temporal"])
    source.open()
    frames = source.frames()
    for number in range(10):
        rig.feed(number)
        next(frames)
    rig.context.plugged = False
    holes = rig.images(0)
    holes["depth"][:] = 0

    def plug() -> None:
        rig.context.plugged = True

    rig.on_pause, rig.on_start = plug, lambda: rig.feed(0, holes)
    assert not next(frames).depth.any()
    source.close()


def test_a_camera_that_goes_while_it_is_asked_for_its_calibration_is_lost(monkeypatch):
    rig = Rig()
    source, frames = started(rig)
    calls, real = [], realsense_frames._along_color_axis

    def flaky(*arguments):
        calls.append(arguments)
        if len(calls) == 1:
            raise RuntimeError("hwmon command failed")
        return real(*arguments)

    monkeypatch.setattr(realsense_frames, "_along_color_axis", flaky)
    rig.context.plugged = False

    def plug() -> None:
        rig.context.plugged = True

    rig.on_pause, rig.on_start = plug, lambda: rig.feed(0)
    assert next(frames).header.sequence == 1
    assert len(calls) == 2
    source.close()


@pytest.mark.parametrize("away", [False, True])
def test_ctrl_c_ends_a_run_whose_camera_is_silent_or_away(lab: Lab, away):
    rig = Rig()
    stop, seen = threading.Event(), threading.Semaphore(0)

    def user() -> None:
        acquire(rig.started)
        rig.feed(0)
        acquire(seen)
        rig.context.plugged = not away
        stop.set()

    rig.on_pause = stop.set
    thread = threading.Thread(target=user)
    thread.start()
    report = lab.run(live_lab(lab, rig), stop=stop, progress=lambda _: seen.release())
    thread.join()
    assert (report.exit_code, report.processed, report.balanced()) == (EXIT_INTERRUPTED, 1, True)
    assert "mushpipe-source" not in [t.name for t in threading.enumerate()]


def test_the_balance_of_a_run_tells_that_the_camera_was_away(lab: Lab):
    rig = Rig()
    seen = threading.Semaphore(0)

    def user() -> None:
        acquire(rig.started)
        rig.feed(0)
        acquire(seen)
        rig.on_start = lambda: rig.feed(0)
        rig.context.plugged = False

    def plug() -> None:
        rig.context.plugged = True

    rig.on_pause = plug
    thread = threading.Thread(target=user)
    thread.start()
    report = lab.run(live_lab(lab, rig), "source.max_frames=2", progress=lambda _: seen.release())
    thread.join()
    assert report.exit_code == 0
    assert report.balanced()
    assert report.processed == 2
    assert report.source[TIMES_LOST] == 1
    assert report.summary()["device"]["serial_number"] == "617203001234"


def no_cameras(monkeypatch, tmp_path: Path) -> None:
    """Whatever is plugged into this machine, the test sees none of it."""
    context = Context()
    context.plugged = False
    monkeypatch.setattr(RealsenseSource, "_context", lambda self: context)
    monkeypatch.setattr(realsense_device, "USB", tmp_path / "nothing")


def test_without_a_camera_the_program_says_so_and_ends_with_5(tmp_path, monkeypatch, capsys):
    no_cameras(monkeypatch, tmp_path)
    monkeypatch.chdir(tmp_path)
    Path("graph.yaml").write_text(GRAPH)
    assert cli(monkeypatch, "run", "graph.yaml") == EXIT_NO_DEVICE
    out, error = capsys.readouterr()
    assert out == ""
    assert error.partition("error: ")[2] == (
        "no RealSense camera is connected; plug it into a USB 3 port\n"
        f"    this is librealsense {SDK}, Python {platform.python_version()}\n"
        + (SR300_HERE if SDK.startswith("2.54") else SR300_NOT_HERE)
    )
    assert not Path("out.mcap").exists()


def test_recording_without_a_camera_leaves_no_file(tmp_path, monkeypatch, capsys):
    no_cameras(monkeypatch, tmp_path)
    monkeypatch.chdir(tmp_path)
    code = cli(monkeypatch, "record", "--source", "realsense", "-o", "field.mcap")
    assert code == EXIT_NO_DEVICE
    assert "no RealSense camera is connected" in capsys.readouterr().err
    assert not Path("field.mcap").exists()


def test_a_newer_librealsense_says_that_it_cannot_see_an_sr300(tmp_path, monkeypatch):
    monkeypatch.setattr(realsense_device, "version", lambda _: "2.59.1.10000")
    assert str(no_camera(tmp_path)) == (
        "no RealSense camera is connected; plug it into a USB 3 port\n"
        f"    this is librealsense 2.59.1.10000, Python {platform.python_version()}\n"
        + SR300_NOT_HERE.rstrip("\n")
    )


def usb(folder: Path, **files: str) -> None:
    folder.mkdir()
    for name, text in files.items():
        (folder / name).write_text(text + "\n")


def test_a_camera_on_usb_that_may_not_be_opened_is_named_with_the_rule(tmp_path):
    usb(tmp_path / "1-1", idVendor="046d", idProduct="0aa5", product="a mouse")
    usb(tmp_path / "1-2", idVendor="8086", idProduct="8087", product="Bluetooth")
    at = {"busnum": "2", "devnum": "14"}
    usb(tmp_path / "2-1", idVendor="8086", idProduct="0aa5", **at)
    named = "Intel(R) RealSense(TM) 435"
    usb(tmp_path / "2-2", idVendor="8086", idProduct="0b07", product=named, **at)
    usb(tmp_path / "usb1")
    assert list(cameras_on_usb(tmp_path)) == [
        ("0aa5", "SR300", Path("/dev/bus/usb/002/014")),
        ("0b07", "Intel(R) RealSense(TM) 435", Path("/dev/bus/usb/002/014")),
    ]
    assert str(no_camera(tmp_path)).splitlines()[:4] == [
        "a camera SR300 is on USB (8086:0aa5), but librealsense cannot open it",
        "    if it is not permitted to, put this line into /etc/udev/rules.d/99-realsense.rules,",
        "    run 'sudo udevadm control --reload-rules && sudo udevadm trigger', plug it in again:",
        '    SUBSYSTEMS=="usb", ATTRS{idVendor}=="8086", ATTRS{idProduct}=="0aa5", '
        'MODE:="0666", GROUP:="plugdev"',
    ]
