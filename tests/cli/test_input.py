"""What a run says about recordings that lack something."""

from __future__ import annotations

import os
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

from mushpipe import Camera, Header, InputError, RgbdFrame
from mushpipe.cli import app
from mushpipe.core import wire
from mushpipe.core.errors import EXIT_DAMAGED, EXIT_OK
from mushpipe.core.recorder import RecordingWriter
from tests.cli.shell import mushpipe
from tests.stages.scenes import discs

CAMERA = Camera(160, 120, 200.0, 200.0, 79.5, 59.5)


def record(path: Path, shapes: list[tuple[int, int]], depth: bool, camera: Camera | None) -> None:
    writer = RecordingWriter(path, {})
    gray = np.rint(255 * discs([(60.0, 60.0, 20.0)], 0.8, 0.2)).astype(np.uint8)
    for i, (height, width) in enumerate(shapes):
        color = np.repeat(gray[:height, :width, None], 3, axis=2)
        native = np.full((height, width), 500, np.uint16) if depth else None
        header = Header(10**9 + i * 33_000_000, i, "camera_color_optical_frame")
        fits = camera if (height, width) == (120, 160) else None
        frame = RgbdFrame(header, color, native, 0.001, fits)
        if fits == camera:
            writer.frame(frame)
        else:  # a recorder that says nothing of another size
            writer.write(wire.COLOR_TOPIC, wire.encode_color(frame), header)
    writer.close()


def test_depth_without_calibration_ends_the_run(folder: Path) -> None:
    record(folder / "a.mcap", [(120, 160)], True, None)
    done = mushpipe("run", "graph.yaml", "--source", "a.mcap", cwd=folder)
    assert done.returncode == EXIT_DAMAGED
    assert "WARNING: a.mcap has no calibration: nothing can be measured in metres" in done.stderr
    assert (
        "error: stage 'locate' (nearest-depth) failed on frame 0: depth cannot be turned into "
        "metres without the camera's calibration: record camera_info, or set "
        "source.camera: {fx: , fy: , cx: , cy: }"
    ) in done.stderr


def test_the_calibration_can_be_given(folder: Path) -> None:
    record(folder / "a.mcap", [(120, 160)], True, None)
    camera = "source.camera={fx: 200, fy: 200, cx: 79.5, cy: 59.5}"
    done = mushpipe("run", "graph.yaml", "--source", "a.mcap", "--set", camera, cwd=folder)
    assert done.returncode == EXIT_OK, done.stderr


def test_colour_alone_runs_and_says_what_is_missing(folder: Path) -> None:
    record(folder / "a.mcap", [(120, 160), (100, 160)], False, None)
    done = mushpipe("run", "graph.yaml", "--source", "a.mcap", cwd=folder)
    assert done.returncode == EXIT_OK, done.stderr
    assert "a.mcap has no depth: positions, distances and diameters will be missing" in done.stderr
    assert "the frame size changes from 160x120 to 160x100 at frame 1" in done.stderr
    assert "2 of 2 mushrooms have no position: there is no depth at them" in done.stderr


def test_a_size_that_does_not_fit_the_calibration_ends_the_run(folder: Path) -> None:
    record(folder / "a.mcap", [(120, 160), (100, 160)], True, CAMERA)
    done = mushpipe("run", "graph.yaml", "--source", "a.mcap", cwd=folder)
    assert done.returncode == EXIT_DAMAGED
    assert "frame 1: the image (/camera/color/image_raw) is 160x100, its calibration" in done.stderr
    assert "1 frames in = 1 processed" in done.stderr


def test_an_empty_recording_is_incomplete(folder: Path) -> None:
    RecordingWriter(folder / "a.mcap", {}).close()
    done = mushpipe("run", "graph.yaml", "--source", "a.mcap", cwd=folder)
    assert done.returncode == EXIT_DAMAGED
    assert "it holds no colour images (it holds no topics at all)" in done.stderr


@pytest.mark.parametrize(
    "arguments",
    [
        ["run", "graph.yaml", "--source"],
        ["record", "-o", "copy.mcap", "--source"],
        ["bench", "graph.yaml"],
        ["info"],
    ],
)
@pytest.mark.parametrize(
    ("leads_to", "why"),
    [("/proc/self/mem", "Input/output error"), ("a.mcap", "Too many levels of symbolic links")],
)
def test_a_recording_that_cannot_be_read_is_the_inputs_fault(
    folder: Path, arguments: list[str], leads_to: str, why: str
) -> None:
    """It was told as a failure of the source, and a link to itself as a traceback."""
    (folder / "a.mcap").symlink_to(leads_to)
    done = mushpipe(*arguments, "a.mcap", cwd=folder)
    last = done.stderr.splitlines()[-1].replace(f"{folder}/", "")
    assert last == f"error: a.mcap: cannot be read: {why}"
    assert done.returncode == EXIT_DAMAGED


@pytest.mark.parametrize(
    "arguments",
    [
        ["run", "a.mcap"],
        ["info", "a.mcap"],
        ["export", "a.mcap"],
        ["figure", "a.mcap", "-o", "a.png"],
        ["view", "a.mcap", "--save", "a.rrd"],
        ["compare", "a.mcap", "a.mcap"],
        ["eval", "a.mcap"],
        ["eval", "a.mcap", "--truth", "a.mcap"],
        ["calibrate", "depth", "a.mcap", "--plane", "1"],
        ["robot", "replay", "a.mcap", "--listen", "0"],
    ],
)
def test_every_verb_itself_says_that_a_file_cannot_be_read(
    folder: Path, monkeypatch: pytest.MonkeyPatch, arguments: list[str]
) -> None:
    """Typer looked first, and ended some verbs with 2 where others end with 4."""
    (folder / "a.mcap").touch()
    monkeypatch.chdir(folder)
    with monkeypatch.context() as nothing_readable:
        nothing_readable.setattr("os.access", lambda _, mode: mode != os.R_OK)
        done = CliRunner().invoke(app, arguments)
    assert isinstance(done.exception, InputError), done.output
    assert "a.mcap: the file is empty" in str(done.exception)


def test_a_name_that_no_file_can_have_is_told_as_a_recording_that_cannot_be_read(
    folder: Path,
) -> None:
    name = 300 * "a" + ".mcap"
    done = mushpipe("info", name, cwd=folder)
    assert done.stderr == f"error: {name}: cannot be read: File name too long\n"
    assert done.returncode == EXIT_DAMAGED
