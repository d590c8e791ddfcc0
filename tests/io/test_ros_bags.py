"""ROS 2 bags as realsense2_camera writes them: order, time, range, loop and pace."""

from __future__ import annotations

import threading
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from foxglove.mcap import MCAPCompression
from pydantic import ValidationError

from mushpipe.core import edges
from mushpipe.core.errors import InputError, UsageError
from mushpipe.core.types import RgbdFrame
from mushpipe.sources.mcap import McapSource
from tests.io.bags import (
    COLOR,
    OPTICAL,
    PERIOD,
    T0,
    color_at,
    color_pixels,
    depth_pixels,
    play,
    raw_image,
    rgbd,
    write_bag,
    write_foxglove,
)

FRAMES = 6


@pytest.fixture(scope="module", params=["ros", "foxglove", "foxglove in one chunk"])
def path(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("bags")
    if request.param == "ros":
        return write_bag(folder, rgbd(range(FRAMES)))
    chunk_size = None if "one chunk" in request.param else 1
    return write_foxglove(folder / "bag.mcap", FRAMES, chunk_size)


def numbers(frames: list[RgbdFrame]) -> list[int]:
    return [round((frame.header.stamp_ns - T0) / PERIOD) for frame in frames]


def seconds(frames: float) -> float:
    return frames * PERIOD / 1e9


def test_every_frame_is_delivered_in_order_and_exact(path: Path) -> None:
    source = McapSource(path=path)
    frames = list(source.frames())
    assert len(frames) == FRAMES
    for i, frame in enumerate(frames):
        np.testing.assert_array_equal(frame.color, color_pixels(i))
        np.testing.assert_array_equal(frame.depth, depth_pixels(i))
        assert frame.header.stamp_ns == T0 + i * PERIOD
        assert frame.header.sequence == i
        assert frame.header.frame_id == OPTICAL
        assert frame.depth_scale == 0.001
    assert source.counts() == {}
    assert (source.name(), source.files(), source.live) == ("bag", (path,), False)


@pytest.mark.parametrize("compression", [None, MCAPCompression.Lz4, MCAPCompression.Zstd], ids=str)
@pytest.mark.parametrize("chunk_size", [1, 500, None])
def test_any_compression_and_size_of_chunks_is_read(
    compression: MCAPCompression | None, chunk_size: int | None, tmp_path: Path
) -> None:
    frames = play(write_foxglove(tmp_path / "x.mcap", 3, chunk_size, compression))
    assert numbers(frames) == [0, 1, 2]
    assert all(frame.depth is not None for frame in frames)


def test_images_are_read_only(path: Path) -> None:
    frame = play(path)[0]
    assert not frame.color.flags.writeable
    assert frame.depth is not None
    assert not frame.depth.flags.writeable


def test_a_recording_can_be_played_again(path: Path) -> None:
    source = McapSource(path=path)
    assert numbers(list(source.frames())) == numbers(list(source.frames()))


@pytest.mark.parametrize(
    ("settings", "expected"),
    [
        ({}, [0, 1, 2, 3, 4, 5]),
        ({"start": seconds(2)}, [2, 3, 4, 5]),
        ({"start": seconds(2.5)}, [3, 4, 5]),
        ({"end": seconds(2)}, [0, 1]),
        ({"end": seconds(1.5)}, [0, 1]),
        ({"start": seconds(1), "end": seconds(4)}, [1, 2, 3]),
        ({"end": 3600}, [0, 1, 2, 3, 4, 5]),
    ],
)
def test_start_and_end_choose_a_range(
    settings: dict[str, float], expected: list[int], path: Path
) -> None:
    frames = play(path, **settings)
    assert numbers(frames) == expected
    assert [frame.header.sequence for frame in frames] == list(range(len(expected)))
    for i, frame in zip(expected, frames, strict=True):
        np.testing.assert_array_equal(frame.color, color_pixels(i))
        np.testing.assert_array_equal(frame.depth, depth_pixels(i))
        assert frame.camera is not None


def test_the_range_counts_from_the_first_image_whatever_was_logged_before(tmp_path: Path) -> None:
    (topic, _, info), *images = rgbd(range(5))
    path = write_bag(tmp_path, [(topic, 0, info), *images])
    assert len(play(path, start=seconds(2))) == 3
    assert len(play(path, end=seconds(2))) == 2
    source = McapSource(path=path, start=60)
    with pytest.raises(UsageError, match=r"it ends after 0\.132 s, before start, 60 s"):
        source.open()


@pytest.mark.parametrize("settings", [{"start": 60.0}, {"start": 0.09, "end": 0.01}])
def test_an_empty_range_is_an_error(settings: dict[str, float], path: Path) -> None:
    with pytest.raises(InputError, match="there is no frame in the chosen range") as error:
        play(path, **settings)
    assert error.value.exit_code == 4


@pytest.mark.parametrize(
    "settings",
    [{"start": -1}, {"end": 0}, {"loop": -1}, {"speed": -1}, {"max_frames": 0}, {"depth_scale": 0}],
)
def test_impossible_settings_are_refused(settings: dict[str, Any], path: Path) -> None:
    with pytest.raises(ValidationError):
        McapSource(path=path, **settings)


def test_in_a_loop_time_and_sequence_go_on(path: Path) -> None:
    frames = play(path, loop=3)
    assert len(frames) == 3 * FRAMES
    assert [frame.header.sequence for frame in frames] == list(range(3 * FRAMES))
    steps = [b.header.stamp_ns - a.header.stamp_ns for a, b in pairwise(frames)]
    assert steps == [PERIOD] * (3 * FRAMES - 1)
    arrivals = [frame.header.arrival_ns for frame in frames]
    assert arrivals == sorted(set(arrivals))
    for i, frame in enumerate(frames):
        np.testing.assert_array_equal(frame.color, color_pixels(i % FRAMES))
        np.testing.assert_array_equal(frame.depth, depth_pixels(i % FRAMES))


def test_a_loop_repeats_the_chosen_range(path: Path) -> None:
    frames = play(path, start=seconds(1), end=seconds(3), loop=2)
    assert [i for i in range(4) if np.array_equal(frames[i].color, color_pixels(1 + i % 2))] == [
        *range(4)
    ]


def test_a_loop_for_ever_goes_on(path: Path) -> None:
    frames = McapSource(path=path, loop=0).frames()
    taken = [next(frames) for _ in range(10 * FRAMES)]
    assert numbers(taken) == list(range(10 * FRAMES))


def test_in_a_loop_of_one_frame_time_goes_on(tmp_path: Path) -> None:
    frames = play(write_bag(tmp_path, rgbd([0])), loop=3)
    stamps = [frame.header.stamp_ns for frame in frames]
    assert stamps == sorted(set(stamps))


def test_a_stamp_that_was_never_set_gives_way_to_the_time_of_recording(tmp_path: Path) -> None:
    entries = [(t, at, m) for i in range(3) for t, at, m in (color_at(i, stamp_ns=0),)]
    frames = play(write_bag(tmp_path, entries))
    assert [frame.header.stamp_ns for frame in frames] == [T0 + i * PERIOD for i in range(3)]


def test_sensor_time_is_told_from_the_time_of_recording(tmp_path: Path) -> None:
    late = 5_000_000
    entries = [
        (COLOR, T0 + i * PERIOD + late, raw_image(color_pixels(i), "rgb8", T0 + i * PERIOD))
        for i in range(3)
    ]
    headers = [frame.header for frame in play(write_bag(tmp_path, entries))]
    assert [header.stamp_ns for header in headers] == [T0 + i * PERIOD for i in range(3)]
    assert [header.arrival_ns - header.stamp_ns for header in headers] == [late] * 3


def test_color_alone_is_played_and_it_is_said(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    frames = play(write_bag(tmp_path, [color_at(i) for i in range(3)]))
    assert [frame.depth for frame in frames] == [None] * 3
    assert np.isnan(frames[0].depth_m).all()
    text = "bag.mcap has no depth: positions, distances and diameters will be missing"
    assert caplog.messages.count(text) == 1


class Clock(threading.Event):
    """An event that never waits, and the clock its waits move on."""

    def __init__(self) -> None:
        super().__init__()
        self.now = 100.0

    def wait(self, timeout: float | None = None) -> bool:
        self.now += timeout or 0.0
        return self.is_set()


@pytest.mark.parametrize(("speed", "factor"), [(1.0, 1.0), (2.0, 0.5), (0.1, 10.0), (0.0, 0.0)])
def test_speed_sets_the_pace_and_loses_nothing(
    speed: float, factor: float, path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    clock = Clock()
    monkeypatch.setattr(edges.time, "monotonic", lambda: clock.now)
    source = McapSource(path=path, speed=speed)
    times = [
        (numbers([frame])[0], clock.now - 100)
        for frame in edges.paced(source.frames(), source.speed, clock)
    ]
    expected = [(i, i * PERIOD / 1e9 * factor) for i in range(FRAMES)]
    np.testing.assert_allclose(times, expected, atol=1e-9)


def test_a_stop_ends_the_wait(path: Path) -> None:
    stop = Clock()
    frames = edges.paced(McapSource(path=path).frames(), 1.0, stop)
    assert numbers([next(frames)]) == [0]
    stop.set()
    assert list(frames) == []
