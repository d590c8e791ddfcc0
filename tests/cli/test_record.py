"""`mushpipe record`: what is on the disk after it was killed, filled the disk, or was split."""

from __future__ import annotations

import json
import os
import re
import resource
import signal
import struct
import subprocess
import time
from contextlib import suppress
from pathlib import Path

import numpy as np
import pytest
from mcap.exceptions import McapError
from mcap.records import Channel, Chunk, Message, Metadata
from mcap.stream_reader import StreamReader, breakup_chunk

from mushpipe import Camera, Header, RgbdFrame
from mushpipe.core.errors import EXIT_FAILED, EXIT_USAGE, InputError
from mushpipe.core.recorder import RecordingWriter
from mushpipe.sources.mcap import McapSource
from tests.cli.shell import MAIN, mushpipe
from tests.core.lab import PATIENCE_S

CAMERA = Camera(160, 120, 154.0, 154.5, 80.2, 59.7)
SCALE = 1e-5  # m: caps of a usual size are neither too small for such an image nor too large
IMAGES = 23
CHUNK = 2**20


def picture(i: int) -> tuple[np.ndarray, np.ndarray]:
    """Noise, and no image twice in a chunk: nothing can be compressed."""
    rng = np.random.default_rng(i % IMAGES)
    color = rng.integers(0, 256, (120, 160, 3), np.uint8)
    return color, rng.integers(0, 2**16, (120, 160), np.uint16)


@pytest.fixture(scope="module")
def scene(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("scene") / "scene.mcap"
    writer = RecordingWriter(path, {"mushpipe.manifest": {"json": "{}"}})
    for i in range(IMAGES):
        header = Header(10**18 + i * 33_000_000, i, "camera_color_optical_frame")
        writer.frame(RgbdFrame(header, *picture(i), SCALE, CAMERA))
    writer.close()
    return path


def played(path: Path) -> tuple[list[RgbdFrame], str]:
    """Return the frames of a recording, each checked, and what is wrong with the file."""
    frames: list[RgbdFrame] = []
    damage = ""
    try:
        frames.extend(McapSource(path=path).frames())
    except InputError as error:
        damage = str(error)
    for frame in frames:
        color, depth = picture(frame.header.sequence)
        assert np.array_equal(frame.color, color)
        assert frame.depth is not None
        assert np.array_equal(frame.depth, depth)
        assert (frame.depth_scale, frame.camera) == (SCALE, CAMERA)
    return frames, damage


def endless(scene: Path, *options: str) -> list[str]:
    return [*MAIN, "record", "--source", str(scene), "--set", "source.loop=0", *options]


def check_salvage(path: Path) -> int:
    """Check that all but an open chunk can be played, from the first frame on; return how many."""
    frames, damage = played(path)
    assert "it breaks off: the recorder did not close it" in damage
    assert [f.header.sequence for f in frames] == list(range(len(frames)))
    stored = sum(image.nbytes for image in picture(0))
    assert path.stat().st_size - len(frames) * stored < 1.2 * CHUNK
    return len(frames)


def test_a_killed_recorder_leaves_every_finished_chunk(scene: Path, tmp_path: Path) -> None:
    path = tmp_path / "out.mcap"
    process = subprocess.Popen(endless(scene, "-o", str(path)), stderr=subprocess.DEVNULL)
    deadline = time.monotonic() + PATIENCE_S
    while time.monotonic() < deadline and not (path.exists() and path.stat().st_size > 4 * CHUNK):
        time.sleep(0.01)
    process.send_signal(signal.SIGKILL)
    process.wait()
    whole = chunks(path)
    assert check_salvage(path) == sum(whole) // 2
    assert len(whole) >= 3


def chunks(path: Path) -> list[int]:
    """Return how many images each whole chunk holds, by mcap's own stream reader."""
    counts: list[int] = []
    with path.open("rb") as file, suppress(McapError, struct.error):
        for record in StreamReader(file, emit_chunks=True).records:
            if isinstance(record, Chunk):
                messages = [r for r in breakup_chunk(record, True) if isinstance(r, Message)]
                counts.append(sum(len(message.data) > 10_000 for message in messages))
    return counts


def test_calibration_and_manifest_stand_first_and_only_the_balance_is_printed(
    scene: Path, tmp_path: Path
) -> None:
    done = mushpipe("record", "--source", scene, "-o", "out.mcap", cwd=tmp_path)
    assert (done.returncode, done.stdout) == (0, "")
    balance, size = done.stderr.splitlines()
    total = f"{IMAGES} frames in = {IMAGES} processed + 0 dropped + 0 failed, in "
    assert balance.startswith(total)
    assert size.startswith("out.mcap: ")
    with (tmp_path / "out.mcap").open("rb") as file:
        records = list(StreamReader(file).records)
    kinds = [type(record) for record in records]
    assert kinds.index(Metadata) < kinds.index(Channel)
    topics = [record.topic for record in records if isinstance(record, Channel)]
    assert topics[0] == "/camera/color/camera_info"
    metadata = next(record for record in records if isinstance(record, Metadata))
    graph = json.loads(metadata.metadata["json"])["graph"]
    assert graph["sinks"]["recorder"]["path"] == "out.mcap"
    assert graph["source"]["path"] == str(scene)


def test_a_full_disk_ends_the_recording_with_what_fits(scene: Path, tmp_path: Path) -> None:
    """The limit of the file's size stands in for the disk: the same system call fails."""
    limit = 3 * CHUNK

    def disk() -> None:
        resource.setrlimit(resource.RLIMIT_FSIZE, (limit, limit))

    command = endless(scene, "-o", "out.mcap")
    done = subprocess.run(
        command, cwd=tmp_path, preexec_fn=disk, capture_output=True, text=True, check=False
    )
    assert done.returncode == EXIT_FAILED
    assert "out.mcap: File too large; it plays up to its last whole chunk" in done.stderr
    assert "Traceback" not in done.stderr
    balance = re.search(r"(\d+) frames in = (\d+) processed \+ 0 dropped \+ 0 failed", done.stderr)
    assert balance is not None
    assert "the balance does not close" not in done.stderr
    path = tmp_path / "out.mcap"
    assert path.stat().st_size == limit
    assert 0 < check_salvage(path) <= int(balance[2])
    assert not (tmp_path / "failures").exists()


def test_a_pipe_that_is_set_not_to_block_loses_nothing(scene: Path, tmp_path: Path) -> None:
    """As a parent that shares it may have set it."""
    reading, writing = os.pipe()
    os.set_blocking(writing, False)
    command = [*MAIN, "record", "--source", str(scene), "-o", "-"]
    with subprocess.Popen(command, stdout=writing, stderr=subprocess.PIPE, text=True) as sender:
        os.close(writing)
        with os.fdopen(reading, "rb") as pipe:
            (tmp_path / "sent.mcap").write_bytes(pipe.read())
        assert sender.stderr is not None
        assert "Traceback" not in sender.stderr.read()
    assert sender.returncode == 0
    frames, damage = played(tmp_path / "sent.mcap")
    assert ([frame.header.sequence for frame in frames], damage) == (list(range(IMAGES)), "")


# A camera that does not wait for anybody; it tells when it has shown all it has.
CAMERA_PY = """\
from collections.abc import Iterator
from pathlib import Path
from typing import ClassVar
from mushpipe import Header, RgbdFrame, Source
from tests.cli.test_record import CAMERA, SCALE, picture

class Fast(Source):
    live: ClassVar[bool] = True

    def frames(self) -> Iterator[RgbdFrame]:
        for i in range(100):
            yield RgbdFrame(Header(10**18 + i, i, "camera"), *picture(i), SCALE, CAMERA)
        Path("shown").touch()
"""


def test_what_a_disk_is_too_slow_for_is_told(tmp_path: Path) -> None:
    """The disk is a named pipe that nobody reads until the camera is through."""
    (tmp_path / "cam.py").write_text(CAMERA_PY)
    os.mkfifo(tmp_path / "disk.mcap")
    command = [*MAIN, "record", "--source", "./cam.py:Fast", "-o", "disk.mcap"]
    process = subprocess.Popen(command, cwd=tmp_path, stderr=subprocess.PIPE, text=True)
    with (tmp_path / "disk.mcap").open("rb") as disk:
        deadline = time.monotonic() + PATIENCE_S
        while time.monotonic() < deadline and not (tmp_path / "shown").exists():
            time.sleep(0.01)
        (tmp_path / "out.mcap").write_bytes(disk.read())
    _, told = process.communicate(timeout=PATIENCE_S)
    assert process.returncode == 0, told
    balance = re.search(r"100 frames in = (\d+) processed \+ (\d+) dropped \+ 0 failed", told)
    assert balance is not None, told
    kept, lost = int(balance[1]), int(balance[2])
    assert kept + lost == 100
    assert lost > 50
    assert f"{lost} frames were lost because writing was too slow" in told
    frames, damage = played(tmp_path / "out.mcap")
    assert (len(frames), damage) == (kept, "")
    numbers = [frame.header.sequence for frame in frames]
    assert numbers == sorted(set(numbers))
    assert numbers[-1] == 99


def test_what_a_reader_is_too_slow_for_is_told(tmp_path: Path) -> None:
    """Of a stream; no disk has a part in it."""
    (tmp_path / "cam.py").write_text(CAMERA_PY)
    command = [*MAIN, "record", "--source", "./cam.py:Fast", "-o", "-"]
    pipe = subprocess.PIPE
    with subprocess.Popen(command, cwd=tmp_path, stdout=pipe, stderr=pipe) as sender:
        deadline = time.monotonic() + PATIENCE_S
        while time.monotonic() < deadline and not (tmp_path / "shown").exists():
            time.sleep(0.01)
        told = sender.communicate(timeout=PATIENCE_S)[1].decode()
    assert "writing was too slow; --colour jpeg or a faster reader or network would help" in told


def test_a_stream_is_not_split(scene: Path, tmp_path: Path) -> None:
    done = mushpipe("record", "--source", scene, "-o", "-", "--split-size", "1MB", cwd=tmp_path)
    assert (done.returncode, done.stdout) == (EXIT_USAGE, "")
    assert "--split-size 1MB: " in done.stderr
    assert "standard output is one stream, which cannot be split" in done.stderr


def test_every_part_of_a_split_recording_is_complete(scene: Path, tmp_path: Path) -> None:
    done = subprocess.run(
        endless(scene, "-o", "row.mcap", "--frames", "30", "--split-size", "1MB"),
        cwd=tmp_path,
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    parts = sorted(tmp_path.glob("row*"))
    assert [part.name for part in parts] == [f"row_{i:03d}.mcap" for i in range(len(parts))]
    assert len(parts) == 3
    numbers = []
    for part in parts:
        frames, damage = played(part)
        assert damage == ""
        assert part.stat().st_size < 1e6 + 2 * CHUNK
        numbers += [frame.header.sequence for frame in frames]
        assert f"{part.name}: {part.stat().st_size / 1e6:.1f} MB" in done.stderr
    assert numbers == list(range(30))
    again = mushpipe("record", "--source", scene, "-o", "row_000.mcap", cwd=tmp_path)
    assert again.returncode == EXIT_USAGE
    assert "row_000.mcap exists already" in again.stderr


def test_the_duration_counts_the_time_of_the_frames(scene: Path, tmp_path: Path) -> None:
    done = mushpipe(
        *("record", "--source", scene, "--duration", 0.1, "--colour", "jpeg", "-o", "out.mcap"),
        cwd=tmp_path,
    )
    assert done.returncode == 0, done.stderr
    assert "4 frames in = 4 processed" in done.stderr
    frames = list(McapSource(path=tmp_path / "out.mcap").frames())
    assert [f.header.stamp_ns - 10**18 for f in frames] == [0, 33_000_000, 66_000_000, 99_000_000]
    assert not np.array_equal(frames[0].color, picture(0)[0])
    assert frames[0].depth is not None
    assert np.array_equal(frames[0].depth, picture(0)[1])


@pytest.mark.parametrize(
    ("options", "count"), [([], 15), (["--frames", 3], 3), (["--set", "source.max_frames=4"], 4)]
)
def test_a_duration_outlasts_the_frames_that_a_source_gives_by_itself(
    options: list[object], count: int, tmp_path: Path
) -> None:
    settings = {"width": 160, "height": 120, "count": 5, "pins": 0}
    small = [part for k, v in settings.items() for part in ("--set", f"source.{k}={v}")]
    command = ["record", "--source", "synthetic", "--duration", 0.5, "-o", "out.mcap"]
    done = mushpipe(*command, *small, *options, cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    assert f"{count} frames in = {count} processed" in done.stderr


def test_a_terminal_shows_rate_drops_and_size(scene: Path, tmp_path: Path) -> None:
    ours, theirs = os.openpty()
    command = endless(scene, "-o", str(tmp_path / "out.mcap"), "--frames", "300")
    process = subprocess.Popen(command, stderr=theirs, env=os.environ | {"TERM": "xterm"})
    os.close(theirs)
    text = b""
    while True:
        try:
            text += os.read(ours, 65536)
        except OSError:  # the other side is closed
            break
    os.close(ours)
    assert process.wait() == 0
    shown = re.search(rb"\d+ frames  [\d.]+ fps  0 dropped  [\d.]+ MB", text)
    assert shown is not None, text
