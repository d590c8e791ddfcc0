"""`mushpipe record -o - | mushpipe run graph.yaml --source -`, and how it ends."""

from __future__ import annotations

import re
import signal
import subprocess
from collections import defaultdict
from pathlib import Path
from typing import IO

import pytest

from mushpipe.core.errors import (
    EXIT_DAMAGED,
    EXIT_FAILED,
)
from mushpipe.core.recording import RecordingReader
from mushpipe.core.truth import INSTANCES_TOPIC, TRUTH_TOPIC
from mushpipe.core.wire import COLOR_TOPIC
from mushpipe.sources.mcap import McapSource
from tests.cli.shell import MAIN, ROOT, mushpipe
from tests.core.lab import PATIENCE_S

BED = ROOT / "recordings/first-bed.mcap"
GRAPH = """\
mushpipe: 1
source: {use: mcap, path: nothing.mcap}
stages:
  segment: {use: otsu}
  say: {use: "./say.py:Say"}
sinks:
  log: {use: mcap, path: out.mcap}
"""
# Prints, as a careless plugin or a library may; nothing of it may get into a stream.
SAY = """\
import os
from mushpipe import RgbdFrame, Stage
print("imported", flush=True)

class Say(Stage):
    def open(self) -> None:
        print("opened", flush=True)

    def process(self, frame: RgbdFrame) -> RgbdFrame:
        os.write(1, b"frame\\n")
        print("frame", flush=True)
        return frame
"""


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    (tmp_path / "graph.yaml").write_text(GRAPH)
    (tmp_path / "say.py").write_text(SAY)
    return tmp_path


def sender(folder: Path, *options: str) -> subprocess.Popen[bytes]:
    command = [*MAIN, "record", "--source", str(BED), "-o", "-", *options]
    pipe = subprocess.PIPE
    return subprocess.Popen(command, cwd=folder, stdout=pipe, stderr=pipe)


def reader(folder: Path, stream: IO[bytes] | None, *options: str) -> subprocess.Popen[bytes]:
    command = [*MAIN, "run", "graph.yaml", "--source", "-", *options]
    pipe = subprocess.PIPE
    return subprocess.Popen(command, cwd=folder, stdin=stream, stdout=pipe, stderr=pipe)


def piped(folder: Path, *options: str) -> tuple[subprocess.Popen[bytes], subprocess.Popen[bytes]]:
    first = sender(folder, *options)
    second = reader(folder, first.stdout)
    assert first.stdout is not None
    first.stdout.close()  # so that the sender notices when the reader is gone
    return first, second


def end(process: subprocess.Popen[bytes]) -> tuple[int, str]:
    _, stderr = process.communicate(timeout=2 * PATIENCE_S)
    text = stderr.decode()
    assert "Traceback" not in text
    balance = re.search(r"(\d+) frames in = (\d+) processed \+ (\d+) dropped \+ (\d+) fail", text)
    assert balance is not None, text
    assert int(balance[1]) == sum(int(balance[i]) for i in (2, 3, 4))
    return process.returncode, text


def results(path: Path) -> dict[str, list[tuple[int, int, bytes]]]:
    found = defaultdict(list)
    for raw in RecordingReader(path).messages():
        if raw.channel.topic != "/mushpipe/timing":
            message = raw.message
            row = (message.publish_time, message.log_time, message.data)
            found[raw.channel.topic].append(row)
    return found


def test_through_a_pipe_the_results_are_the_same(folder: Path) -> None:
    direct = mushpipe(
        *("run", "graph.yaml", "--source", BED, "--set", "log.path=direct.mcap"), cwd=folder
    )
    assert direct.returncode == 0, direct.stderr
    first, second = piped(folder)
    assert end(second)[0] == 0
    code, told = end(first)
    assert (code, "Traceback" in told) == (0, False)
    through = results(folder / "out.mcap")
    assert through == results(folder / "direct.mcap")
    assert {TRUTH_TOPIC, INSTANCES_TOPIC} < set(through)


def test_a_copy_of_a_recording_carries_the_truth_on(folder: Path) -> None:
    done = mushpipe("record", "--source", BED, "-o", "copy.mcap", cwd=folder)
    assert done.returncode == 0, done.stderr
    copy, original = results(folder / "copy.mcap"), results(BED)
    for messages in (copy, original):
        assert len(messages.pop(COLOR_TOPIC)) == 3  # JPEG there, lossless here
    assert copy == original
    assert TRUTH_TOPIC in original


def test_of_a_killed_sender_what_came_is_processed_and_told(folder: Path) -> None:
    first, second = piped(folder, "--set", "source.loop=0")
    assert second.stdout is not None
    for _ in range(6):
        assert second.stdout.readline() == b"frame\n"
    first.send_signal(signal.SIGKILL)
    first.wait()
    code, told = end(second)
    assert code == EXIT_DAMAGED
    came = re.search(r"the stream broke off: its sender did not end it .*; (\d+) frames came", told)
    assert came is not None, told
    assert f"{came[1]} frames in = {came[1]} processed" in told
    assert len(results(folder / "out.mcap")["/mushpipe/segment"]) == int(came[1])


@pytest.mark.parametrize("killed", [True, False])
def test_a_sender_whose_reader_is_gone_ends_and_says_so(folder: Path, killed: bool) -> None:
    first = sender(folder, "--set", "source.loop=0")
    second = reader(folder, first.stdout, *(() if killed else ("--frames", "2")))
    assert first.stdout is not None
    first.stdout.close()
    if killed:
        assert second.stdout is not None
        second.stdout.readline()
        second.send_signal(signal.SIGKILL)
        second.wait()
    else:
        assert end(second)[0] == 0
    code, told = end(first)
    assert code == EXIT_FAILED
    assert "the program that reads the stream has ended" in told


# A camera that is none; the reader tells what it takes it for.
CAMERA_PY = """\
from collections.abc import Iterator
from pathlib import Path
from typing import ClassVar
import numpy as np
from mushpipe import Header, RgbdFrame, RunInfo, Sink, Source

class Cam(Source):
    live: ClassVar[bool] = True

    def frames(self) -> Iterator[RgbdFrame]:
        yield RgbdFrame(Header(10**18, 0, "camera"), np.zeros((6, 8, 3), np.uint8))

class Tell(Sink):
    def open(self, run: RunInfo) -> None:
        Path("live").write_text(str(run.live))

    def consume(self, frame: RgbdFrame) -> None:
        pass
"""


def test_the_reader_is_told_that_the_sender_has_a_camera(folder: Path) -> None:
    (folder / "cam.py").write_text(CAMERA_PY)
    (folder / "graph.yaml").write_text(
        'mushpipe: 1\nsource: {use: stream}\nsinks: {tell: {use: "./cam.py:Tell"}}\n'
    )
    first, second = piped(folder, "--source", "./cam.py:Cam")
    assert end(second)[0] == 0
    assert end(first)[0] == 0
    assert (folder / "live").read_text() == "True"


def test_what_others_print_does_not_get_into_a_stream(folder: Path) -> None:
    (folder / "graph.yaml").write_text(GRAPH.replace("out.mcap", '"-"'))
    done = subprocess.run(
        [*MAIN, "run", "graph.yaml", "--source", str(BED)],
        cwd=folder,
        capture_output=True,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    assert b"frame\nframe\n" in done.stderr
    (folder / "stream.mcap").write_bytes(done.stdout)
    frames = list(McapSource(path=folder / "stream.mcap").frames())
    assert len(frames) == 3
