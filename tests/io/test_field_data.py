"""Real recordings, where the environment variable MUSHPIPE_FIELD_DATA names their folder."""

from __future__ import annotations

import os
from pathlib import Path

import numpy as np
import pytest
from mcap.reader import make_reader

from mushpipe.core.types import RgbdFrame
from mushpipe.info import describe
from mushpipe.sources.mcap import McapSource
from tests.io.bags import ALIGNED, COLOR, STORE
from tests.io.values import record, trace_of

FOLDER = os.environ.get("MUSHPIPE_FIELD_DATA")
pytestmark = pytest.mark.skipif(
    FOLDER is None, reason="MUSHPIPE_FIELD_DATA does not name a folder of real recordings"
)

# frames, their sizes, dtype of depth or None, focal length in px or None
RECORDINGS = {
    "white-bed-0": (1, [(640, 480)], np.uint16, 600),
    "desk-june": (2, [(1280, 720)] * 2, np.float32, 650),
    "desk-july": (1, [(1280, 720)], np.uint16, 650),
    "beds-colour-only": (3, None, None, None),
}
WITH_DEPTH = ["white-bed-0", "desk-june", "desk-july"]


def path_of(name: str) -> Path:
    path = Path(FOLDER or "") / f"{name}.mcap"
    if not path.is_file():
        pytest.skip(f"there is no {path}")
    return path


def load(name: str) -> list[RgbdFrame]:
    source = McapSource(path=path_of(name))
    frames = list(source.frames())
    assert source.counts() == {}
    return frames


@pytest.mark.parametrize("name", RECORDINGS)
def test_every_frame_is_played_with_what_was_recorded(name: str) -> None:
    count, sizes, dtype, focal = RECORDINGS[name]
    frames = load(name)
    assert len(frames) == count
    assert [frame.header.sequence for frame in frames] == list(range(count))
    stamps = [frame.header.stamp_ns for frame in frames]
    assert stamps == sorted(set(stamps))
    for i, frame in enumerate(frames):
        assert frame.color.max() > 150 > 50 > frame.color.min()
        if sizes is not None:
            assert frame.color.shape == (sizes[i][1], sizes[i][0], 3)
        assert (None if frame.depth is None else frame.depth.dtype.type) is dtype
        assert (None if frame.camera is None else round(frame.camera.fx)) == focal
    content = describe(path_of(name))
    assert (content["damage"], content["unchecked"]) == ([], True)  # `rosbags` writes no CRCs


def test_two_image_sizes_without_calibration_are_played_with_a_warning(
    caplog: pytest.LogCaptureFixture,
) -> None:
    frames = load("beds-colour-only")
    assert len({frame.color.shape for frame in frames}) == 2
    text = " ".join(caplog.messages)
    for part in ("the frame size changes", "has no calibration", "has no depth"):
        assert part in text


@pytest.mark.parametrize("name", WITH_DEPTH)
def test_depth_is_in_metres(name: str) -> None:
    for frame in load(name):
        known = frame.depth_m[np.isfinite(frame.depth_m)]
        assert known.size > 0.3 * frame.depth_m.size
        low, middle, high = np.percentile(known, [5, 50, 95])
        # A camera on a stand above a bed or a desk.
        assert 0.05 < low <= middle < 1.5
        assert high < 3


@pytest.mark.parametrize("name", WITH_DEPTH)
def test_pixels_are_those_that_another_reader_finds(name: str) -> None:
    images: dict[str, list[np.ndarray]] = {COLOR: [], ALIGNED: []}
    with path_of(name).open("rb") as file:
        for _, channel, message in make_reader(file).iter_messages(list(images)):
            image = STORE.deserialize_cdr(message.data, "sensor_msgs/msg/Image")
            kinds = {"rgb8": np.uint8, "16UC1": np.uint16, "32FC1": np.float32}
            pixels = image.data.view(kinds[image.encoding]).reshape(image.height, image.width, -1)
            images[channel.topic].append(pixels)
    for frame, color, depth in zip(load(name), images[COLOR], images[ALIGNED], strict=True):
        np.testing.assert_array_equal(frame.color, color)
        np.testing.assert_array_equal(frame.depth, depth[..., 0])


def test_large_gaps_in_the_depth_of_the_white_bed_are_nan() -> None:
    (frame,) = load("white-bed-0")
    assert frame.depth is not None
    assert 0.3 < np.isnan(frame.depth_m).mean() < 0.7
    np.testing.assert_array_equal(np.isnan(frame.depth_m), frame.depth == 0)


@pytest.mark.parametrize("name", WITH_DEPTH)
def test_a_real_recording_is_recorded_again_without_loss(name: str, tmp_path: Path) -> None:
    frames = load(name)
    copy = record(tmp_path / "copy.mcap", [trace_of(frame) for frame in frames])
    for found, wanted in zip(McapSource(path=copy).frames(), frames, strict=True):
        assert found.header == wanted.header
        assert found.camera == wanted.camera
        assert found.depth_scale == wanted.depth_scale
        np.testing.assert_array_equal(found.color, wanted.color)
        np.testing.assert_array_equal(found.depth, wanted.depth)
