"""`mushpipe doctor`: what is wrong with a computer, and what to do."""

from __future__ import annotations

import json
import sys
from pathlib import Path
from types import SimpleNamespace

import pytest

from mushpipe import Registry
from mushpipe.core import libraries, plugins
from mushpipe.core.errors import EXIT_FAILED, EXIT_NO_DEVICE, EXIT_OK, DependencyError
from mushpipe.core.plugins import Broken
from mushpipe.sources import realsense_device
from tests.core.lab import cli
from tests.live.rig import SERIAL, Context, Rig
from tests.live.test_lost import usb


@pytest.fixture
def computer(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> SimpleNamespace:
    """A computer without any camera, whatever is plugged into this one."""
    context = Context()
    context.plugged = False
    monkeypatch.setattr(realsense_device, "USB", tmp_path / "usb")
    monkeypatch.setattr(realsense_device, "version", lambda _: "2.54.2.5684")
    monkeypatch.chdir(tmp_path)

    def plug(found: Context) -> None:
        library = SimpleNamespace(context=lambda: found, __version__="2.54.2")
        monkeypatch.setattr(libraries, "import_realsense", lambda: library)

    def doctor(*options: str) -> tuple[int, dict[str, dict[str, str]]]:
        code = cli(monkeypatch, "doctor", "--format", "json", *options)
        rows = json.loads(capsys.readouterr().out)
        return code, {row["name"]: row for row in rows}

    plug(context)
    return SimpleNamespace(plug=plug, doctor=doctor, usb=tmp_path / "usb")


@pytest.mark.parametrize(
    ("options", "code", "state"),
    [([], EXIT_OK, "note"), *[([o], EXIT_NO_DEVICE, "error") for o in ("--camera", "--device")]],
)
def test_a_camera_is_missed_only_where_it_is_asked_for(computer, options, code, state):
    ended, found = computer.doctor(*options)
    assert ended == code
    assert found["camera"]["state"] == state
    assert found["camera"]["text"].startswith("no RealSense camera is connected")
    assert "an SR300 or SR305 needs pyrealsense2 2.54" in found["camera"]["cure"]


def test_a_camera_is_shown_with_what_it_says_of_itself(computer):
    rig = Rig()
    computer.plug(rig.context)
    ended, found = computer.doctor("--camera")
    assert ended == EXIT_OK
    assert "Simulated SR300" in found["camera"]["text"]
    assert f"serial number {SERIAL}, firmware" in found["camera"]["text"]


def test_a_camera_on_usb_2_is_there_but_slow(computer, monkeypatch):
    rig = Rig()
    computer.plug(rig.context)
    told = {"name": "SR300", "firmware_version": "3.26.1.0", "usb_type_descriptor": "2.1"}
    monkeypatch.setattr(realsense_device, "info", lambda _: told)
    ended, found = computer.doctor("--camera")
    assert ended == EXIT_OK
    assert found["camera"]["state"] == "warning"
    assert found["camera"]["text"].endswith("firmware 3.26.1.0, USB 2.1")
    assert "USB 3 port" in found["camera"]["cure"]


def test_a_camera_without_permission_gets_its_udev_rule(computer):
    computer.usb.mkdir()
    usb(computer.usb / "2-1", idVendor="8086", idProduct="0aa5", busnum="99", devnum="7")
    ended, found = computer.doctor("--camera")
    assert ended == EXIT_NO_DEVICE
    assert found["USB"]["text"] == "SR300: no permission for /dev/bus/usb/099/007"
    assert found["USB"]["cure"].splitlines()[-1] == (
        'SUBSYSTEMS=="usb", ATTRS{idVendor}=="8086", ATTRS{idProduct}=="0aa5", '
        'MODE:="0666", GROUP:="plugdev"'
    )


def test_a_missing_system_library_is_named_with_its_package(computer, monkeypatch):
    def load() -> None:
        raise DependencyError(libraries.explain("open3d", "libgomp.so.1: cannot open"))

    monkeypatch.setattr(libraries, "import_open3d", load)
    ended, found = computer.doctor()
    assert ended == EXIT_FAILED
    assert found["open3d"] == {
        "name": "open3d",
        "state": "error",
        "text": "open3d needs the system library libgomp.so.1",
        "cure": "apt-get install libgomp1",
    }


def test_without_what_runs_networks_no_graph_with_one_starts(computer, monkeypatch):
    def load() -> None:
        raise DependencyError("onnxruntime is not installed: pip install onnxruntime")

    monkeypatch.setattr(libraries, "import_onnxruntime", load)
    ended, found = computer.doctor()
    assert ended == EXIT_FAILED
    assert found["onnxruntime"]["cure"] == "pip install onnxruntime"


def test_plugins_that_failed_are_listed(computer, monkeypatch):
    registry = Registry()
    registry.broken.append(Broken("glow", "mushpipe-glow", "0.1", "ImportError: no torch"))
    monkeypatch.setattr(plugins, "load_registry", lambda: registry)
    ended, found = computer.doctor()
    assert ended == EXIT_FAILED
    assert found["plugin glow"]["text"] == "ImportError: no torch"
    assert "mushpipe-glow" in found["plugin glow"]["cure"]


@pytest.mark.parametrize(
    ("speed", "free", "cure"),
    [
        (200.0, 10**12, ""),
        (12.0, 10**12, "too slow for 30 frames/s"),
        (200.0, 10**9, "soon full"),
    ],
)
def test_a_slow_or_full_disk_is_told(computer, monkeypatch, speed, free, cure):
    monkeypatch.setattr("mushpipe.doctor._write_speed", lambda _: speed)
    monkeypatch.setattr("mushpipe.doctor._free", lambda _: free)
    ended, found = computer.doctor()
    assert ended == EXIT_OK
    assert found["disk"]["state"] == ("warning" if cure else "ok")
    assert found["disk"]["cure"].startswith(cure)
    assert f"{speed:.0f} MB/s, {free / 1e9:.0f} GB free" in found["disk"]["text"]


def test_a_folder_that_cannot_be_written_is_an_error(computer):
    ended, found = computer.doctor("--folder", "/proc")
    assert ended == EXIT_FAILED
    assert found["disk"]["text"].startswith("/proc: ")


def test_a_kernel_cache_that_cannot_be_written_is_told(computer, monkeypatch):
    monkeypatch.setenv("NUMBA_CACHE_DIR", "/proc/kernels")
    ended, found = computer.doctor()
    assert ended == EXIT_OK
    assert found["kernel cache"]["state"] == "warning"
    assert "NUMBA_CACHE_DIR" in found["kernel cache"]["cure"]


def test_plain_lines_in_a_pipe(computer, monkeypatch, capsys):
    assert cli(monkeypatch, "doctor") == EXIT_OK
    lines = capsys.readouterr().out.splitlines()
    state = "OK" if sys.version_info < (3, 12) else "NOTE"
    assert lines[0].startswith(f"{state:8}Python: 3.")
    at = lines.index("NOTE    camera: no RealSense camera is connected; plug it into a USB 3 port")
    assert lines[at + 1].startswith("        -> this is librealsense ")
