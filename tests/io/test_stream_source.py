"""The source `stream`, with a file or a pipe of the test's in place of standard input."""

from __future__ import annotations

import os
import pty
import subprocess
import sys
import tempfile
import threading
import time
from collections import Counter
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from mushpipe import Header, RgbdFrame
from mushpipe.core.errors import (
    EXIT_INTERRUPTED,
    InputError,
    UsageError,
)
from mushpipe.core.paths import STDIO
from mushpipe.core.recorder import RecordingWriter
from mushpipe.core.recording import MANIFEST, Raw, RecordingReader
from mushpipe.core.wire import CAMERA_TOPIC, COLOR_TOPIC, DEPTH_TOPIC, Message, Schema
from mushpipe.sources import stream as module
from mushpipe.sources.mcap import McapSource
from mushpipe.sources.playing import Player
from mushpipe.sources.realsense_frames import CLOCK_TOPIC, Clock, Domain, clock_of
from mushpipe.sources.stream import StreamSource
from mushpipe.sources.topics import Topics
from tests.cli.test_record import CAMERA, picture
from tests.core.lab import Lab, held, soon
from tests.io.bags import ALIGNED, COLOR, COLOR_INFO, rgbd, write_bag


def stream(path: Path, frames: int, live: bool = False, depth: int = 0) -> Path:
    """Write what a sender sends into a file, which then stands in for standard input.

    There is depth from a frame on.
    """
    manifest = {"json": '{"device": {"serial_number": "42"}}'} | ({"live": "true"} if live else {})
    writer = RecordingWriter(path, {MANIFEST: manifest})
    for i in range(frames):
        color, native = picture(i)
        header = Header(10**18 + i * 33_000_000, i + 7, "camera_color_optical_frame")
        seen = native if depth <= i else None
        writer.frame(RgbdFrame(header, color, seen, 0.000125, CAMERA))
    writer.close()
    return path


def source_of(path: Path, piped: bool = False) -> type[StreamSource]:
    def feed(end: int) -> None:
        with suppress(BrokenPipeError), os.fdopen(end, "wb") as pipe:
            pipe.write(path.read_bytes())

    class FromFile(StreamSource):
        def open(self) -> None:
            self._number = os.open(path, os.O_RDONLY)
            if piped:
                self._number, end = os.pipe()
                threading.Thread(target=feed, args=(end,), daemon=True).start()
            super().open()

        def close(self) -> None:
            os.close(self._number)

    return FromFile


def opened(path: Path, **settings: object) -> StreamSource:
    source = source_of(path).model_validate(settings)
    source.open()
    return source


@pytest.mark.parametrize("piped", [True, False])
def test_what_a_camera_sent_is_live_until_it_is_saved(tmp_path: Path, piped: bool) -> None:
    source = source_of(stream(tmp_path / "s.mcap", 1, live=True), piped)()
    source.open()
    assert source.live == piped
    source.close()


@pytest.mark.parametrize("live", [True, False])
def test_of_a_camera_the_newest_frame_is_taken_of_a_recording_every_one(
    lab: Lab, tmp_path: Path, live: bool
) -> None:
    entered, release = threading.Event(), threading.Event()

    class Sender(source_of(stream(tmp_path / "s.mcap", 9, live), piped=True)):  # type: ignore[misc]
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
    frames = list(opened(stream(tmp_path / "s.mcap", 3, depth=3)).frames())
    assert [frame.depth for frame in frames] == [None] * 3
    assert "the stream has no depth" in caplog.text


@pytest.mark.parametrize("depth", [1, 5, 31])
def test_a_recording_that_is_sent_is_played_as_the_file_is(tmp_path: Path, depth: int) -> None:
    """Also where depth begins later than colour."""
    path = stream(tmp_path / "s.mcap", 40, depth=depth)
    seen = [frame.depth is not None for frame in opened(path).frames()]
    assert seen == [frame.depth is not None for frame in McapSource(path=path).frames()]
    assert seen == [False] * depth + [True] * (40 - depth)


def test_depth_of_a_camera_that_begins_late_counts_from_there_on(tmp_path: Path) -> None:
    source = source_of(stream(tmp_path / "s.mcap", 9, live=True, depth=4), piped=True)()
    source.open()
    assert [frame.depth is not None for frame in source.frames()] == [False] * 5 + [True] * 4
    assert source.counts() == {"depth images without colour": 1}


def test_results_in_a_stream_are_not_passed_on(tmp_path: Path) -> None:
    writer = RecordingWriter(tmp_path / "s.mcap", {MANIFEST: {"json": "{}"}})
    for i in range(3):
        color, native = picture(i)
        header = Header(i + 1, i, "c")
        writer.frame(RgbdFrame(header, color, native, 0.000125, CAMERA))
        for topic in ("/mushpipe/found", "/truth/caps"):
            writer.write(topic, Message("", Schema("text", "", b"", "json"), b"{}"), header)
    writer.close()
    for source in (opened(tmp_path / "s.mcap"), McapSource(path=tmp_path / "s.mcap")):
        found = {topic for frame in source.frames() for topic in frame.attached}
        assert "/mushpipe/found" not in found


def test_a_stream_without_calibration_says_so_once(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    writer = RecordingWriter(tmp_path / "s.mcap", {MANIFEST: {"json": "{}"}})
    for i in range(3):
        writer.frame(RgbdFrame(Header(i, i, "c"), *picture(i), 0.000125))
    writer.close()
    assert [frame.camera for frame in opened(tmp_path / "s.mcap").frames()] == [None] * 3
    assert caplog.messages == [
        "the stream has no calibration: nothing can be measured in metres",
    ]


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
        (b"\x89MCAP0", "standard input ends after 6 bytes: see what its sender says"),
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


@pytest.mark.parametrize("piped", [True, False])
def test_a_second_recording_in_a_stream_is_not_lost_without_a_word(
    tmp_path: Path, piped: bool
) -> None:
    one = stream(tmp_path / "one.mcap", 3).read_bytes()
    (tmp_path / "two.mcap").write_bytes(one + one)
    source = source_of(tmp_path / "two.mcap", piped)()
    source.open()
    frames = []
    with pytest.raises(InputError, match=r"goes on behind its end.*; 3 frames came"):
        frames.extend(source.frames())
    source.close()


def test_a_sender_that_keeps_its_pipe_open_ends_the_run_all_the_same(tmp_path: Path) -> None:
    number, end = os.pipe()
    threading.Thread(
        target=os.write, args=(end, stream(tmp_path / "s.mcap", 2).read_bytes()), daemon=True
    ).start()
    source = StreamSource()
    source._number = number
    source.open()
    assert len(list(source.frames())) == 2
    os.close(end)
    os.close(number)


def test_a_stream_without_images_names_what_it_holds(tmp_path: Path) -> None:
    source = opened(stream(tmp_path / "s.mcap", 2), color_topic="/left")
    with pytest.raises(InputError, match=r"no colour images on /left, only /camera/"):
        list(source.frames())


def test_topics_of_another_program_are_asked_for(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    """A ROS 2 bag that is piped in holds depth and a calibration, but not where they are sought."""
    bag = write_bag(tmp_path, rgbd(range(2)))
    with pytest.raises(InputError) as caught:
        list(opened(bag).frames())
    assert f"{ALIGNED}, {COLOR_INFO}, {COLOR}: where they are among these, name" in str(
        caught.value
    )
    caplog.clear()
    assert len(list(opened(bag, color_topic=COLOR).frames())) == 2
    assert caplog.messages == [
        f"the stream, on {DEPTH_TOPIC}, has no depth: positions, distances and diameters will be "
        "missing",
        f"the stream has no calibration on {CAMERA_TOPIC}: nothing can be measured in metres",
    ]
    caplog.clear()
    named = {"color_topic": COLOR, "depth_topic": ALIGNED, "camera_topic": COLOR_INFO}
    assert all(frame.depth is not None for frame in opened(bag, **named).frames())
    assert not caplog.messages


def test_a_sender_without_images_is_not_listened_to_for_ever(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(module, "_MOST_BEFORE", 1000)
    data = stream(tmp_path / "s.mcap", 3).read_bytes()
    source = StreamSource(color_topic="/left")
    source._number, end = os.pipe()  # which stays open: the sender goes on
    threading.Thread(target=os.write, args=(end, data), daemon=True).start()
    source.open()
    with pytest.raises(InputError, match="no colour images on /left"):
        list(source.frames())
    os.close(source._number)


def test_many_messages_before_the_first_image_are_looked_at_once(tmp_path: Path) -> None:
    path, header = tmp_path / "s.mcap", Header(10**18, 0, "imu")
    writer = RecordingWriter(path, {})
    small = Message("", Schema("Imu", "jsonschema", b"{}", "json"), b"{}")
    for _ in range(30_000):
        writer.write("/imu", small, header)
    writer.frame(RgbdFrame(header, *picture(0)))
    writer.close()
    source = opened(path)
    begin = time.monotonic()
    assert len(list(source.frames())) == 1
    assert time.monotonic() - begin < 5  # s; each looked at for each took half a minute


@pytest.mark.parametrize(
    ("named", "said"),
    [
        (
            {"color_topic": DEPTH_TOPIC, "depth_topic": "/none"},
            f"'{DEPTH_TOPIC}' holds depth, expected colour; --set source.color_topic={COLOR_TOPIC}",
        ),
        (
            {"color_topic": "/none", "depth_topic": COLOR_TOPIC},
            "no colour images on /none",
        ),
        (
            {"color_topic": COLOR_TOPIC, "depth_topic": COLOR_TOPIC},
            f"'{COLOR_TOPIC}' holds colour, expected depth; no topic is known to hold depth",
        ),
    ],
)
def test_a_topic_of_the_other_kind_is_refused_while_its_sender_goes_on(
    named: dict[str, str], said: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """As of a recording; else a camera would be listened to without a frame or a word."""
    data = stream(tmp_path / "s.mcap", 9).read_bytes()
    monkeypatch.setattr(module, "_MOST_BEFORE", len(data) // 4)
    source = StreamSource.model_validate(named)
    source._number, end = os.pipe()  # which stays open
    threading.Thread(target=os.write, args=(end, data), daemon=True).start()
    source.open()
    with pytest.raises(InputError, match=said):
        list(source.frames())
    os.close(source._number)


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


def test_a_stream_that_was_saved_is_a_recording(tmp_path: Path) -> None:
    """Streams have no index of their metadata: what they are can only be read."""
    path = tmp_path / "saved.mcap"
    code = "import sys; from tests.io.test_stream_source import send; send()"
    with path.open("wb") as file:
        subprocess.run([sys.executable, "-c", code], stdout=file, check=True)
    saved = list(McapSource(path=path).frames())
    sent = list(opened(path).frames())
    assert [f.header.sequence for f in saved] == [f.header.sequence for f in sent] == [0, 1, 5]
    assert [list(f.attached) for f in saved] == [list(f.attached) for f in sent] == [["/clock"]] * 3


def test_a_saved_stream_in_which_a_bit_is_flipped_is_reported(tmp_path: Path) -> None:
    path = tmp_path / "saved.mcap"
    code = "import sys; from tests.io.test_stream_source import send; send()"
    with path.open("wb") as file:
        subprocess.run([sys.executable, "-c", code], stdout=file, check=True)
    data = bytearray(path.read_bytes())
    data[data.index(picture(0)[0].tobytes()) + 7] ^= 1
    path.write_bytes(data)
    for source in (McapSource(path=path), opened(path)):
        with pytest.raises(InputError, match=r"its CRC does not match\)?; 3 frames"):
            list(source.frames())


def test_what_a_sensor_said_of_a_frame_is_known_at_the_other_end(tmp_path: Path) -> None:
    path = tmp_path / "s.mcap"
    writer = RecordingWriter(path, {MANIFEST: {"json": "{}"}})
    for number in (7, 9):
        header = Header(10**18 + number * 33_000_000, number, "c")
        clock = Clock(np.array([number]), np.array([1000.25 * number]), np.array([Domain.GLOBAL]))
        writer.frame(RgbdFrame(header, picture(0)[0], attached={CLOCK_TOPIC: clock}))
    writer.close()
    for source in (McapSource(path=path), opened(path)):
        clocks = [clock_of(frame) for frame in source.frames()]
        told = [(c.number.item(), c.time_ms.item(), c.domain.item()) for c in clocks if c]
        assert told == [(7, 7001.75, Domain.GLOBAL), (9, 9002.25, Domain.GLOBAL)]


def test_a_frame_of_a_stream_does_not_wait_for_the_next_one(tmp_path: Path) -> None:
    """Of a recording it does: what belongs to it may stand behind its images."""
    path, taken = stream(tmp_path / "s.mcap", 3), list[str]()

    def messages() -> Iterator[Raw]:
        for raw in RecordingReader(path).messages(set(vars(topics).values())):
            taken.append(raw.channel.topic)
            yield raw

    topics = Topics(COLOR_TOPIC, DEPTH_TOPIC, CAMERA_TOPIC)
    for hold in (False, True):
        taken.clear()
        player = Player(StreamSource(), "s", topics, set(), True, Counter())
        assert next(player.play(messages(), hold)).header.sequence == 7
        images = [topic for topic in taken if topic != CAMERA_TOPIC]
        assert images == [COLOR_TOPIC, DEPTH_TOPIC] + [COLOR_TOPIC] * hold


def send() -> None:
    writer = RecordingWriter(STDIO, {MANIFEST: {"json": "{}"}})
    for number in (0, 1, 5):
        header = Header(10**18 + number * 33_000_000, number, "c")
        beside = Clock(np.array([number]), np.array([1.0]), np.array([0]))
        writer.frame(RgbdFrame(header, picture(0)[0], attached={"/clock": beside}))
    writer.close()
