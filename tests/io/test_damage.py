"""Damaged files: what can be read is delivered, then InputError (exit code 4), never another."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from mushpipe.core.errors import InputError, UsageError
from mushpipe.core.types import RgbdFrame
from mushpipe.sources.mcap import McapSource
from tests.io.bags import (
    ALIGNED,
    COLOR,
    PERIOD,
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
