"""`mushpipe record -o - | mushpipe run graph.yaml --source -`, and how it ends."""

from __future__ import annotations

import os
import pty
import re
import signal
import subprocess
import tempfile
import threading
from collections import defaultdict
from collections.abc import Iterator
from pathlib import Path
from typing import IO

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from mushpipe import Header, RgbdFrame
from mushpipe.core.errors import (
    EXIT_DAMAGED,
    EXIT_FAILED,
    EXIT_INTERRUPTED,
    InputError,
    UsageError,
)
from mushpipe.core.recorder import RecordingWriter
from mushpipe.core.recording import MANIFEST, RecordingReader
from mushpipe.core.truth import INSTANCES_TOPIC, TRUTH_TOPIC
from mushpipe.core.wire import COLOR_TOPIC
from mushpipe.sources.mcap import McapSource
from mushpipe.sources.stream import StreamSource
from tests.cli.test_commands import ROOT, mushpipe
from tests.cli.test_record import CAMERA, MAIN, PATIENCE_S, picture
from tests.core.lab import Lab, held, soon

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

class Say(Stage):
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


def stream(path: Path, frames: int, live: bool = False, depth: bool = True) -> Path:
    """Write what a sender sends into a file, which then stands in for standard input."""
    manifest = {"json": '{"device": {"serial_number": "42"}}'} | ({"live": "true"} if live else {})
    writer = RecordingWriter(path, {MANIFEST: manifest})
    for i in range(frames):
        color, native = picture(i)
        header = Header(10**18 + i * 33_000_000, i + 7, "camera_color_optical_frame")
        writer.frame(RgbdFrame(header, color, native if depth else None, 0.000125, CAMERA))
    writer.close()
    return path


def source_of(path: Path) -> type[StreamSource]:
    class FromFile(StreamSource):
        def open(self) -> None:
            self._number = os.open(path, os.O_RDONLY)
            super().open()

        def close(self) -> None:
            os.close(self._number)

    return FromFile


def opened(path: Path, **settings: object) -> StreamSource:
    source = source_of(path).model_validate(settings)
    source.open()
    return source


@pytest.mark.parametrize("live", [True, False])
def test_of_a_camera_the_newest_frame_is_taken_of_a_recording_every_one(
    lab: Lab, tmp_path: Path, live: bool
) -> None:
    entered, release = threading.Event(), threading.Event()

    class Sender(source_of(stream(tmp_path / "s.mcap", 9, live))):  # type: ignore[misc]
        def frames(self) -> Iterator[RgbdFrame]:
            for i, frame in enumerate(super().frames()):
                yield frame
                if i == 0:
                    soon(entered)
                if i == (8 if live else 1):
                    release.set()
            release.set()

    lab.registry.source("stream", Sender)
    report = lab.run(lab.chain(held(entered, release), source="stream"))
    assert report.error is None
    assert report.balanced()
    assert report.device == {"serial_number": "42"}
    numbers = [trace.frame.header.sequence for trace in lab.seen]
    assert numbers == ([7, 15] if live else list(range(7, 16)))
    assert report.dropped == (7 if live else 0)


def test_a_stream_of_colour_alone_does_not_wait_for_depth(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    frames = list(opened(stream(tmp_path / "s.mcap", 3, depth=False)).frames())
    assert [frame.depth for frame in frames] == [None] * 3
    assert "the stream has no depth" in caplog.text


def test_frames_come_as_they_were_sent(tmp_path: Path) -> None:
    frames = list(opened(stream(tmp_path / "s.mcap", 30)).frames())
    assert [frame.header.sequence for frame in frames] == list(range(7, 37))
    for i, frame in enumerate(frames):
        color, native = picture(i)
        assert frame.depth is not None
        assert np.array_equal(frame.color, color)
        assert np.array_equal(frame.depth, native)
        assert (frame.depth_scale, frame.camera) == (0.000125, CAMERA)


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (b"", "standard input is empty: see what its sender says"),
        (b"\x89MCAP0", "standard input is empty: see what its sender says"),
        (b"mushpipe: 1\nsource: synthetic\n", "standard input is not MCAP: send it with -o -"),
    ],
)
def test_what_is_no_stream_is_refused(tmp_path: Path, content: bytes, message: str) -> None:
    path = tmp_path / "s"
    path.write_bytes(content)
    with pytest.raises(InputError) as caught:
        opened(path)
    assert str(caught.value) == message


@settings(max_examples=25)
@given(share=st.floats(0.05, 0.999))
def test_a_stream_cut_anywhere_gives_whole_frames_and_an_error(share: float) -> None:
    with tempfile.TemporaryDirectory() as folder:
        path = stream(Path(folder) / "s.mcap", 12)
        data = path.read_bytes()
        path.write_bytes(data[: int(share * len(data))])
        received = []
        with pytest.raises(InputError, match=r"broke off|is empty"):
            received.extend(opened(path).frames())
        for i, frame in enumerate(received):
            assert np.array_equal(frame.color, picture(i)[0])


def test_a_stream_without_images_names_what_it_holds(tmp_path: Path) -> None:
    source = opened(stream(tmp_path / "s.mcap", 2), color_topic="/left")
    with pytest.raises(InputError, match=r"no colour images on /left, only /camera/"):
        list(source.frames())


def test_a_terminal_is_no_stream() -> None:
    ours, theirs = pty.openpty()
    source = StreamSource()
    source._number = theirs
    with pytest.raises(UsageError, match="nothing is piped into this program"):
        source.open()
    os.close(ours)
    os.close(theirs)


def test_a_run_that_waits_for_its_sender_can_be_ended(lab: Lab) -> None:
    read, write = os.pipe()
    stop = threading.Event()

    class Silent(StreamSource):
        def open(self) -> None:
            self._number = read
            stop.set()
            super().open()

    lab.registry.source("stream", Silent)
    report = lab.run(lab.chain("both", source="stream"), stop=stop)
    assert (report.exit_code, report.processed) == (EXIT_INTERRUPTED, 0)
    os.close(read)
    os.close(write)


def test_an_interrupted_source_stops_waiting(tmp_path: Path) -> None:
    read, write = os.pipe()
    data = stream(tmp_path / "s.mcap", 12).read_bytes()
    os.write(write, data[:60_000])  # the pipe stays open and silent
    source = StreamSource()
    source._number = read
    source.open()
    source.interrupt()
    assert list(source.frames()) == []
    os.close(read)
    os.close(write)
