"""Damaged files: what can be read is delivered, then InputError (exit code 4), never another."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from mcap.writer import Writer
from rosbags.rosbag2 import CompressionFormat, CompressionMode, StoragePlugin
from rosbags.rosbag2 import Writer as BagWriter

from mushpipe.core.errors import InputError, UsageError
from mushpipe.core.types import RgbdFrame
from mushpipe.sources.folder import ImagesSource
from mushpipe.sources.mcap import McapSource
from mushpipe.sources.realsense import RealsenseSource
from tests.io.bags import (
    ALIGNED,
    COLOR,
    PERIOD,
    STORE,
    T0,
    color_at,
    color_pixels,
    compressed,
    depth_at,
    depth_pixels,
    drain,
    play,
    raw_image,
    rgbd,
    ros,
    write_bag,
    write_foxglove,
    write_ros1_bag,
)

FRAMES = 4
MAGIC = 8


def borders(data: bytes) -> list[tuple[int, int]]:
    """Return (opcode, end) of every record; the format is opcode, uint64 length, content."""
    at, found = MAGIC, []
    while at < len(data) - MAGIC:
        end = at + 9 + int.from_bytes(data[at + 1 : at + 9], "little")
        found.append((data[at], end))
        at = end
    return found


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A recording in which every message stands in a chunk of its own."""
    return write_foxglove(tmp_path_factory.mktemp("whole") / "whole.mcap", FRAMES)


def same_as_written(frame: RgbdFrame) -> bool:
    i = round((frame.header.stamp_ns - T0) / PERIOD)
    color = np.array_equal(frame.color, color_pixels(i))
    return color and (frame.depth is None or np.array_equal(frame.depth, depth_pixels(i)))


def read_damaged(path: Path, data: bytes) -> tuple[list[RgbdFrame], InputError | None]:
    path.write_bytes(data)
    frames, error = drain(McapSource(path=path))
    assert all(map(same_as_written, frames))
    stamps = [frame.header.stamp_ns for frame in frames]
    assert stamps == sorted(set(stamps))
    return frames, error


def colors_before(data: bytes, cut: int) -> int:
    """Count the colour images before a cut: chunks are schemas, calibration, colour, depth, ..."""
    chunks = [end for opcode, end in borders(data) if opcode == 6]
    assert len(chunks) == 2 + 2 * FRAMES
    return sum(end <= cut for end in chunks[2::2])


def check_cut(whole: Path, path: Path, cut: int) -> None:
    data = whole.read_bytes()
    frames, error = read_damaged(path, data[:cut])
    assert len(frames) == colors_before(data, cut)
    assert error is not None
    assert error.exit_code == 4
    assert str(path) in str(error)


def test_a_file_cut_at_any_border_of_its_records_is_played_up_to_there(
    whole: Path, tmp_path: Path
) -> None:
    data = whole.read_bytes()
    for _, cut in borders(data):
        if cut < len(data) - MAGIC:
            check_cut(whole, tmp_path / "cut.mcap", cut)


@settings(max_examples=80, deadline=None)
@given(share=st.floats(0, 1, exclude_max=True))
def test_a_file_cut_anywhere_is_played_up_to_there(
    share: float, whole: Path, tmp_path_factory: pytest.TempPathFactory
) -> None:
    path = tmp_path_factory.getbasetemp() / "cut.mcap"
    check_cut(whole, path, int(share * whole.stat().st_size))


@settings(max_examples=300, deadline=None)
@given(share=st.floats(0, 1, exclude_max=True), flip=st.integers(1, 255))
def test_flipped_bits_never_pass_for_images(
    share: float, flip: int, whole: Path, tmp_path_factory: pytest.TempPathFactory
) -> None:
    data = bytearray(whole.read_bytes())
    data[int(share * len(data))] ^= flip
    path = tmp_path_factory.getbasetemp() / "flipped.mcap"
    frames, error = read_damaged(path, bytes(data))
    assert len(frames) == FRAMES or error is not None


@pytest.mark.parametrize("chunk", range(2 + 2 * FRAMES))
def test_a_corrupt_chunk_costs_only_its_own_message(
    chunk: int, whole: Path, tmp_path: Path
) -> None:
    data = bytearray(whole.read_bytes())
    end = [end for opcode, end in borders(bytes(data)) if opcode == 6][chunk]
    data[end - 5] ^= 0xFF
    frames, error = read_damaged(tmp_path / "flipped.mcap", bytes(data))
    lost_color = chunk >= 2 and chunk % 2 == 0
    lost_depth = chunk >= 2 and chunk % 2 == 1
    assert len(frames) == FRAMES - lost_color
    assert sum(frame.depth is None for frame in frames) == lost_depth
    assert "a chunk is corrupt" in str(error)
    assert f"{len(frames)} frames could be read" in str(error)


def test_flipped_bits_of_messages_without_chunks_are_reported(tmp_path: Path) -> None:
    """They have no CRC but that of all data, which is known to be wrong only at its end."""
    path = write_foxglove(tmp_path / "a.mcap", FRAMES, use_chunks=False)
    data = bytearray(path.read_bytes())
    assert drain(McapSource(path=path))[1] is None
    for i in range(FRAMES):
        data[data.index(color_pixels(i).tobytes()) + 7] ^= 1
    path.write_bytes(data)
    frames, error = drain(McapSource(path=path))
    assert not any(map(same_as_written, frames))
    assert error is not None
    assert "its CRC does not match" in str(error)


def test_a_damaged_index_costs_nothing_but_is_reported(whole: Path, tmp_path: Path) -> None:
    data = bytearray(whole.read_bytes())
    # The topics are named twice: in a compressed chunk, and in the clear in the index.
    at = data.rfind(COLOR.encode())
    data[at + 3] ^= 1
    frames, error = read_damaged(tmp_path / "index.mcap", bytes(data))
    assert len(frames) == FRAMES
    assert all(frame.depth is not None and frame.camera is not None for frame in frames)
    assert "its index is corrupt" in str(error)


@pytest.mark.parametrize("behind", [lambda data: b"\n", lambda data: data, lambda data: data[:-99]])
def test_what_follows_the_end_of_a_recording_is_reported(
    behind: Callable[[bytes], bytes], whole: Path, tmp_path: Path
) -> None:
    data = whole.read_bytes()
    more = behind(data)
    frames, error = read_damaged(tmp_path / "two.mcap", data + more)
    assert len(frames) == FRAMES
    assert error is not None
    assert f"{len(more)} bytes behind its end were not read: another recording?" in str(error)


def test_a_bag_that_stands_twice_in_a_file_is_reported_without_checksums(tmp_path: Path) -> None:
    """Chunks that overlap in time are played by the index, and the second one's fits the first."""
    stamps, large = [T0 + i * PERIOD for i in range(3)], (640, 480)  # a chunk each
    color = [raw_image(color_pixels(0, large), "rgb8", at) for at in stamps]
    depth = [raw_image(depth_pixels(0, large), "16UC1", at) for at in stamps]
    entries = [(COLOR, at, image) for at, image in zip(stamps, color, strict=True)]
    entries += [(ALIGNED, at, image) for at, image in zip(stamps, depth, strict=True)]
    bag = write_bag(tmp_path, entries)
    assert drain(McapSource(path=bag))[1] is None
    data = bag.read_bytes()
    bag.write_bytes(data + data)
    frames, error = drain(McapSource(path=bag))
    assert [frame.header.stamp_ns for frame in frames] == stamps
    assert f"{len(data)} bytes behind its end were not read" in str(error)


def test_a_record_whose_type_is_damaged_is_missed(whole: Path, tmp_path: Path) -> None:
    data = bytearray(whole.read_bytes())
    third = [end for opcode, end in borders(bytes(data)) if opcode == 6][2]
    data[third] ^= 0x80  # the index of chunk 3; a message index may be lost without harm
    assert read_damaged(tmp_path / "a.mcap", bytes(data))[1] is None
    start = max(end for _, end in borders(bytes(data)) if end < third)
    data[start] ^= 0x80  # chunk 3 itself: the first colour image
    frames, error = read_damaged(tmp_path / "b.mcap", bytes(data))
    assert len(frames) == FRAMES - 1
    assert "1 of its messages are missing" in str(error)


AN_IMAGE = "not an MCAP file (it is an image: 'mushpipe record"


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (b"", "the file is empty"),
        (b"MThd\0\0\0\6\0", "not an MCAP file (it begins with b'MThd\\x00\\x00\\x00\\x06')"),
        (b"\x89MC", "not an MCAP file"),
        (b"RRF2\0\x1d\0\0", "not an MCAP file (it is a Rerun file: open it with 'rerun FILE')"),
        (b"\xff\xd8\xff\xe0\0\x10JFIF", f"{AN_IMAGE} --source IMAGE -o FILE'"),
        (b"\x89PNG\r\n\x1a\n\0\0", f"{AN_IMAGE} --source IMAGE -o FILE'"),
    ],
)
def test_a_file_that_is_no_recording_is_refused(
    content: bytes, message: str, tmp_path: Path
) -> None:
    path = tmp_path / "x.mcap"
    path.write_bytes(content)
    with pytest.raises(InputError) as error:
        play(path)
    assert str(error.value).startswith(f"{path}: {message}")
    assert error.value.exit_code == 4


def bags(folder: Path, **how: Any) -> Path:
    """Write a ROS 2 bag with rosbags, compressed or in SQLite, and return its file."""
    writer = BagWriter(
        folder / "bag", version=9, storage_plugin=how.get("storage", StoragePlugin.MCAP)
    )
    if "mode" in how:
        writer.set_compression(how["mode"], CompressionFormat.ZSTD)
    with writer:
        for topic, time, message in rgbd([0]):
            at = writer.add_connection(topic, message.__msgtype__, typestore=STORE)
            writer.write(at, time, STORE.serialize_cdr(message, message.__msgtype__))
    return next(path for path in (folder / "bag").iterdir() if path.suffix != ".yaml")


@pytest.mark.parametrize(
    ("how", "message"),
    [
        (
            {"storage": StoragePlugin.SQLITE3},
            "a ROS 2 bag in SQLite: 'rosbags-convert --src ITS_F",
        ),
        (
            {"mode": CompressionMode.FILE},
            "(it is compressed as a whole: 'zstd -d FILE' unpac",
        ),
        ({"mode": CompressionMode.MESSAGE}, "each message is compressed (ros2 bag record --compr"),
    ],
)
def test_a_bag_that_must_be_converted_says_how(how: Any, message: str, tmp_path: Path) -> None:
    path = bags(tmp_path, **how)
    frames, error = drain(McapSource(path=path))
    assert not frames
    assert message in str(error)
    with pytest.raises(InputError, match=f"is played by its file: --source '{path}'$"):
        ImagesSource(path=path.parent).open()


def test_a_bag_of_ros_1_says_how_to_convert_it(tmp_path: Path) -> None:
    path = write_ros1_bag(tmp_path / "a.bag", rgbd([0]))
    for play_it in (play, lambda path: RealsenseSource(file=path).open()):
        with pytest.raises(InputError, match="a bag of ROS 1: 'rosbags-convert --src FILE"):
            play_it(path)


def test_a_file_of_nothing_but_magic_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "x.mcap"
    path.write_bytes(b"\x89MCAP0\r\n")
    with pytest.raises(InputError, match=r"it breaks off.*nothing could be read"):
        play(path)


def test_a_missing_file_is_a_mistake_of_the_user(tmp_path: Path) -> None:
    with pytest.raises(UsageError, match="there is no such recording"):
        play(tmp_path / "x.mcap")


def test_a_folder_is_refused(tmp_path: Path) -> None:
    with pytest.raises(UsageError, match="it is a folder, in which no recording is"):
        play(tmp_path)


def test_a_recording_without_images_names_what_it_holds(tmp_path: Path) -> None:
    text = ros("std_msgs/msg/String", data="hello")
    path = write_bag(tmp_path, [("/chatter", T0, text), ("/rosout", T0, text)])
    with pytest.raises(InputError) as error:
        play(path)
    assert str(error.value) == f"{path}: it holds no colour images (it holds /chatter, /rosout)"


def test_a_recording_without_anything_is_refused(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="no colour images \\(it holds no topics at all\\)"):
        play(write_foxglove_empty(tmp_path / "empty.mcap"))


def write_foxglove_empty(path: Path) -> Path:
    import foxglove

    foxglove.open_mcap(path, context=foxglove.Context()).close()
    return path


def test_images_that_cannot_be_decoded_are_counted_and_the_others_played(tmp_path: Path) -> None:
    short = raw_image(color_pixels(1), "rgb8", data=b"short")
    broken = (COLOR, T0 + PERIOD, short)
    entries = [*rgbd([0]), broken, depth_at(1), color_at(2), *rgbd([3])[1:]]
    source = McapSource(path=write_bag(tmp_path, entries))
    frames, error = drain(source)
    assert [round((f.header.stamp_ns - T0) / PERIOD) for f in frames] == [0, 2, 3]
    assert source.counts() == {
        "colour images without depth": 1,
        "depth images without colour": 1,
        "images that could not be decoded": 1,
    }
    assert error is not None
    assert f"{COLOR}: 8x6 image with step 24 in 5 bytes" in str(error)
    assert "3 frames could be read" in str(error)


@pytest.mark.parametrize("size", [50, 0])
def test_garbage_in_place_of_a_jpeg_is_counted(size: int, tmp_path: Path) -> None:
    topic = COLOR + "/compressed"
    entries = [
        (topic, T0 + i, compressed(bytes([i] * size), "rgb8; jpeg compressed bgr8", T0 + i))
        for i in range(3)
    ]
    source = McapSource(path=write_bag(tmp_path, entries))
    frames, error = drain(source)
    assert frames == []
    assert source.counts() == {"images that could not be decoded": 3}
    what = f"rgb8; jpeg compressed bgr8, {size} bytes"
    assert f"compressed image ({what}) cannot be decoded" in str(error)


@pytest.mark.parametrize(
    ("message", "schema", "definition", "text"),
    [
        ("ros1", "ros1msg", b"x", "message encoding 'ros1' with schema encoding 'ros1msg' is not"),
        ("cdr", "ros2idl", b"x", "message encoding 'cdr' with schema encoding 'ros2idl' is not"),
        ("cdr", "ros2msg", b"", "the file lacks the definition of sensor_msgs/msg/Image"),
    ],
)
def test_a_message_that_cannot_be_read_is_told_why(
    message: str, schema: str, definition: bytes, text: str, tmp_path: Path
) -> None:
    path = tmp_path / "odd.mcap"
    with path.open("wb") as file:
        writer = Writer(file)
        writer.start()
        number = writer.register_schema("sensor_msgs/msg/Image", schema, definition)
        channel = writer.register_channel(COLOR, message, number)
        writer.add_message(channel, T0, b"\0" * 50, T0)
        writer.finish()
    frames, error = drain(McapSource(path=path))
    assert frames == []
    assert f"{COLOR}: {text}" in str(error)


def test_messages_that_are_no_ros_messages_are_counted(tmp_path: Path) -> None:
    path = write_bag(tmp_path, [color_at(0), depth_at(0), color_at(1), depth_at(1)])
    data = path.read_bytes()
    # rosbags writes neither compression nor CRC, so a frame_id can be made something not UTF-8.
    at = data.find(b"camera_color_optical_frame")
    path.write_bytes(data[:at] + b"\xff" + data[at + 1 :])
    frames, error = drain(McapSource(path=path))
    assert len(frames) == 1
    assert "utf-8" in str(error)
