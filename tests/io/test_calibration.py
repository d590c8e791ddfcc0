"""Calibration of a recording: once, per frame, late, absent, wrong; and frames of other sizes."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import cv2
import foxglove
import numpy as np
import pytest
from foxglove.channels import CameraCalibrationChannel, RawImageChannel
from foxglove.messages import CameraCalibration

from mushpipe.core.errors import InputError
from mushpipe.core.geometry import Camera
from mushpipe.sources.mcap import McapSource
from tests.io.bags import (
    ALIGNED,
    COLOR,
    COLOR_INFO,
    CX,
    CY,
    FX,
    FY,
    HEIGHT,
    PERIOD,
    T0,
    WIDTH,
    Entry,
    camera_info,
    color_at,
    color_pixels,
    compressed,
    converted,
    depth_at,
    depth_pixels,
    drain,
    encoded,
    foxglove_entries,
    play,
    raw_image,
    write_bag,
    write_foxglove,
    write_ros1_bag,
)

CALIBRATED = Camera(WIDTH, HEIGHT, FX, FY, CX, CY)
COLORS = [color_at(i) for i in range(3)]
SMALL = (4, 3)


def info_at(i: int, **fields: Any) -> Entry:
    at = T0 + i * PERIOD
    return COLOR_INFO, at, camera_info(at, **fields)


def cameras(tmp_path: Path, entries: list[Entry], **settings: Any) -> list[Camera | None]:
    return [frame.camera for frame in play(write_bag(tmp_path, entries), **settings)]


@pytest.mark.parametrize(
    "entries",
    [
        [info_at(0), *COLORS],
        [e for i in range(3) for e in (info_at(i), color_at(i))],
        [*COLORS, info_at(3)],
    ],
    ids=["once", "per frame", "late"],
)
def test_every_frame_gets_the_calibration(entries: list[Entry], tmp_path: Path) -> None:
    assert cameras(tmp_path, entries) == [CALIBRATED] * 3


@pytest.mark.parametrize(
    "entries",
    [COLORS, [info_at(0, k=(0,) * 9), *COLORS]],
    ids=["absent", "all zero, which means uncalibrated"],
)
def test_without_calibration_frames_are_played_and_it_is_said(
    entries: list[Entry], tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    assert cameras(tmp_path, entries) == [None] * 3
    text = "bag.mcap has no calibration: nothing can be measured in metres"
    assert caplog.messages.count(text) == 1


def test_intrinsics_may_be_given(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    given = {"fx": 600.0, "fy": 601.0, "cx": 4.0, "cy": 3.0}
    expected = Camera(WIDTH, HEIGHT, 600.0, 601.0, 4.0, 3.0)
    assert cameras(tmp_path / "a", COLORS, camera=given) == [expected] * 3
    assert cameras(tmp_path / "b", [info_at(0), *COLORS], camera=given) == [expected] * 3
    assert not any("no calibration" in text for text in caplog.messages)


@pytest.mark.parametrize(
    ("wire", "model", "count"),
    [
        ("plumb_bob", "brown_conrady", 5),
        ("inverse_brown_conrady", "inverse_brown_conrady", 5),
        ("rational_polynomial", "rational", 8),
    ],
)
def test_distortion_is_kept(
    tmp_path: Path, wire: str, model: str, count: int, caplog: pytest.LogCaptureFixture
) -> None:
    d = (0.1, -0.2, 0.001, 0.002, 0.05, 0.03, 0.02, 0.01)[:count]
    expected = Camera(WIDTH, HEIGHT, FX, FY, CX, CY, model, d)
    assert cameras(tmp_path, [info_at(0, d=d, model=wire), *COLORS]) == [expected] * 3
    assert "is not applied" not in caplog.text


@pytest.mark.parametrize("length", [4, 5, 8, 12, 14])
@pytest.mark.parametrize(("model", "known"), [("plumb_bob", 5), ("rational_polynomial", 8)])
def test_coefficients_left_out_or_of_zero_are_as_opencv_has_them(
    tmp_path: Path, model: str, known: int, length: int
) -> None:
    values = np.array([0.1, -0.2, 0.01, 0.02, 0.05, 0.03, 0.02, 0.01, *[0.0] * 6])
    values[known:] = 0
    (camera, *_) = cameras(tmp_path, [info_at(0, d=tuple(values[:length]), model=model), *COLORS])
    points = np.random.default_rng(1).uniform((-0.2, -0.2, 0.9), (0.2, 0.2, 1.1), (20, 3))
    matrix = np.array([[FX, 0, CX], [0, FY, CY], [0, 0, 1]])
    expected, _ = cv2.projectPoints(points, np.zeros(3), np.zeros(3), matrix, values[:length])
    assert camera is not None
    assert camera.project(points) == pytest.approx(expected[:, 0], abs=1e-9)


@pytest.mark.parametrize("model", ["plumb_bob", "rational_polynomial", ""])
def test_distortion_of_zeros_is_none(model: str, tmp_path: Path) -> None:
    assert cameras(tmp_path, [info_at(0, model=model), *COLORS]) == [CALIBRATED] * 3


@pytest.mark.parametrize(
    ("model", "d"),
    [
        ("equidistant", (0.1, 0.2, 0.3, 0.4)),
        ("equidistant", (0.0,) * 4),  # r = f theta, not f tan(theta): no pinhole
        ("kannala_brandt", ()),
        ("rational_polynomial", (0.1,) * 14),
        ("plumb_bob", (0.1,) * 8),
        ("plumb_bob", (0.1, 0.2)),
    ],
)
def test_an_unsupported_lens_model_is_reported_after_the_frames(
    model: str, d: tuple[float, ...], tmp_path: Path
) -> None:
    source = McapSource(path=write_bag(tmp_path, [info_at(0, d=d, model=model), *COLORS]))
    frames, error = drain(source)
    assert [frame.camera for frame in frames] == [None] * 3
    assert f"distortion model '{model}' with {len(d)} coefficients is not supported" in str(error)
    assert error is not None
    assert error.exit_code == 4
    assert source.counts() == {"calibrations that could not be decoded": 1}


def test_a_calibration_without_a_size_of_image_is_refused(tmp_path: Path) -> None:
    source = McapSource(path=write_bag(tmp_path, [info_at(0, size=(0, 0)), *COLORS]))
    with pytest.raises(
        InputError, match=r"info.*: a calibration for images of 0x0 px: give source"
    ):
        list(source.frames())


@pytest.mark.parametrize(
    "k", [(FX, 0, 0, 0, FY, 0, CX, CY, 1), (FX, 5, CX, 0, FY, CY, 0, 0, 1)], ids=["turned", "skew"]
)
def test_a_matrix_that_is_no_pinholes_is_refused(k: tuple[float, ...], tmp_path: Path) -> None:
    """Read as if it were, the first puts the principal point into the corner of the image."""
    frames, error = drain(McapSource(path=write_bag(tmp_path, [info_at(0, k=k), *COLORS])))
    assert [frame.camera for frame in frames] == [None] * 3
    assert "its matrix is no fx 0 cx, 0 fy cy, 0 0 1, but [617.5" in str(error)


def test_a_principal_point_outside_of_the_image_is_told_of_once(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    """As where images were made smaller and their calibration was not."""
    for i, cx in enumerate((CX, WIDTH + 0.5)):
        infos = [info_at(n, k=(FX, 0, cx, 0, FY, CY, 0, 0, 1)) for n in range(3)]
        found = cameras(tmp_path / str(i), [*infos, *COLORS])
        assert [camera and camera.cx for camera in found] == [cx] * 3
        said = [r.getMessage() for r in caplog.records if "principal point" in r.getMessage()]
        assert len(said) == i
    assert "(8.5, 2.25), lies outside of the image, which is 8x6" in said[0]


def test_a_calibration_that_changes_is_followed(tmp_path: Path) -> None:
    entries = [info_at(0), color_at(0), info_at(1, k=(99, 0, 1, 0, 99, 1, 0, 0, 1)), color_at(1)]
    found = cameras(tmp_path, entries)
    assert [camera.fx for camera in found if camera] == [FX, 99]


def test_from_a_calibration_that_says_there_is_none_there_is_none(tmp_path: Path) -> None:
    entries = [
        info_at(0),
        color_at(0),
        info_at(1, k=(0,) * 9),
        color_at(1),
        info_at(2),
        color_at(2),
    ]
    assert cameras(tmp_path, entries) == [CALIBRATED, None, CALIBRATED]


@pytest.mark.parametrize("start", [1.5 * PERIOD, 2 * PERIOD])
def test_a_start_after_the_change_uses_the_later_calibration(start: float, tmp_path: Path) -> None:
    changed = info_at(1, k=(99, 0, 1, 0, 99, 1, 0, 0, 1))
    entries = [info_at(0), color_at(0), changed, color_at(1), color_at(2)]
    found = cameras(tmp_path, entries, start=start / 1e9)
    assert [camera.fx for camera in found if camera] == [99]


def test_every_turn_of_a_loop_begins_with_the_calibration_of_the_first(tmp_path: Path) -> None:
    changed = info_at(1, k=(99, 0, 1, 0, 99, 1, 0, 0, 1))
    # The calibration stands after the first image, as late ones do.
    entries = [color_at(0), (COLOR_INFO, T0 + 1, camera_info()), changed, color_at(1)]
    found = cameras(tmp_path, entries, loop=2)
    assert [camera.fx for camera in found if camera] == [FX, 99, FX, 99]


def test_calibration_of_another_size_is_refused(tmp_path: Path) -> None:
    path = write_bag(tmp_path, [info_at(0, size=(640, 480)), *COLORS])
    with pytest.raises(InputError) as error:
        play(path)
    assert str(error.value) == (
        f"{path}, frame 0: the image ({COLOR}) is 8x6, its calibration ({COLOR_INFO}) for 640x480: "
        "name that of these images (--set source.camera_topic=), or set source.camera: "
        "{fx: , fy: , cx: , cy: }"
    )
    assert error.value.exit_code == 4


@pytest.mark.parametrize("binning", [(0, 0), (1, 1), (2, 2), (3, 1)])
@pytest.mark.parametrize("part", [(0, 0, 0, 0), (0, 0, 24, 18), (5, 2, 16, 12)])
def test_a_part_of_the_sensor_and_binning_are_as_image_geometry_has_them(
    binning: tuple[int, int], part: tuple[int, int, int, int], tmp_path: Path
) -> None:
    """A point of space is seen where its pixel of the whole image went."""
    k = (50.0, 0, 11.0, 0, 55.0, 8.0, 0, 0, 1)
    left, top, wide, high = part
    across, down = max(1, binning[0]), max(1, binning[1])
    size = ((wide or 24) // across, (high or 18) // down)
    info = camera_info(size=(24, 18), k=k, binning=binning, roi=part)
    image = raw_image(np.zeros((size[1], size[0], 3), np.uint8), "rgb8")
    frame = play(write_bag(tmp_path, [(COLOR_INFO, T0, info), (COLOR, T0, image)]))[0]
    assert frame.camera is not None
    u, v = 50 * 0.03 / 0.4 + 11, 55 * 0.02 / 0.4 + 8
    seen = frame.camera.project(np.array([[0.03, 0.02, 0.4]]))[0]
    np.testing.assert_allclose(seen, [(u - left) / across, (v - top) / down])


@pytest.mark.parametrize(("left", "top"), [(3, 0), (0, 2)])
def test_a_part_beyond_its_image_is_refused(
    left: int, top: int, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    """A driver that gives the size of the part, and perhaps its matrix: nobody can tell."""
    info = camera_info(roi=(left, top, 8, 6))
    source = McapSource(path=write_bag(tmp_path, [(COLOR_INFO, T0, info), *COLORS]))
    with pytest.raises(InputError, match=rf"roi, 8x6 from \({left}, {top}\) on, lies beyond"):
        list(source.frames())
    assert "has no calibration" in caplog.text


def shrinking() -> list[Entry]:
    small = raw_image(color_pixels(1, SMALL), "rgb8", T0 + PERIOD)
    return [color_at(0), (COLOR, T0 + PERIOD, small)]


def test_a_change_of_size_without_calibration_is_a_warning(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    frames = play(write_bag(tmp_path, shrinking()))
    assert [frame.color.shape[:2] for frame in frames] == [(6, 8), (3, 4)]
    assert "the frame size changes from 8x6 to 4x3 at frame 1" in caplog.messages


def test_a_change_of_size_that_the_calibration_does_not_follow_ends_the_playback(
    tmp_path: Path,
) -> None:
    source = McapSource(path=write_bag(tmp_path, [info_at(0), *shrinking()]))
    frames, error = drain(source)
    assert len(frames) == 1
    sizes = f"the image ({COLOR}) is 4x3, its calibration ({COLOR_INFO}) for 8x6"
    assert f"frame 1: {sizes}" in str(error)


def test_a_change_of_size_that_the_calibration_follows_is_played(tmp_path: Path) -> None:
    first, second = shrinking()
    frames = play(write_bag(tmp_path, [info_at(0), first, info_at(1, size=SMALL), second]))
    assert [frame.color.shape[:2] for frame in frames] == [(6, 8), (3, 4)]


@pytest.mark.parametrize("depth_first", [False, True])
@pytest.mark.parametrize("with_depth", [False, True])
def test_a_calibration_may_follow_its_image_as_drivers_of_ros_send_it(
    depth_first: bool, with_depth: bool, tmp_path: Path
) -> None:
    k, entries = (500.0, 0, 1.5, 0, 500.0, 1.0, 0, 0, 1), []
    for i in range(4):
        size = SMALL if i >= 2 else (WIDTH, HEIGHT)
        at = T0 + i * PERIOD
        color = (COLOR, at, raw_image(color_pixels(i, size), "rgb8", at))
        depth = [(ALIGNED, at, raw_image(depth_pixels(i, size), "16UC1", at))] * with_depth
        info = (COLOR_INFO, at, camera_info(at, size, k) if i >= 2 else camera_info(at))
        entries += [*depth, color, info] if depth_first else [color, info, *depth]
    found = [camera.fx for camera in cameras(tmp_path, entries) if camera]
    assert found == [FX, FX, 500.0, 500.0]


def test_foxglove_calibration(tmp_path: Path) -> None:
    frames = play(write_foxglove(tmp_path / "f.mcap", 2))
    assert [frame.camera for frame in frames] == [CALIBRATED] * 2


def test_a_new_calibration_does_not_reach_back_to_an_image_that_waits_for_its_depth(
    tmp_path: Path,
) -> None:
    k = (500.0, 0, CX, 0, 500.0, CY, 0, 0, 1)
    late = [depth_at(i, T0 + i * PERIOD + 5_000_000) for i in range(4)]
    entries = [info_at(0)]
    for i in range(4):
        entries += [info_at(2, k=k)] if i == 2 else []
        entries += [color_at(i), late[i]]
    found = [camera.fx for camera in cameras(tmp_path, entries) if camera]
    assert found == [FX, FX, 500.0, 500.0]


@pytest.mark.parametrize(
    "name",
    [
        "image_rect",
        "image_rect_color/compressed",
        "image_color_rect",
        "image_rectified",
        "rect/image",
    ],
)
def test_rectified_images_have_the_projection_matrix_and_no_distortion(
    name: str, tmp_path: Path
) -> None:
    """Names of image_proc, of kinect2_bridge, of others, of the ZED wrapper."""
    p = (500.0, 0, 3, 0, 0, 510.0, 2, 0, 0, 0, 1, 0)
    info = camera_info(d=(0.1, 0, 0, 0, 0), p=p)
    topic = f"/camera/color/{name}"
    message = color_at(0)[2]
    if "compressed" in name:
        message = compressed(encoded(color_pixels(0), ".png"), "rgb8; png compressed bgr8")
    entries = [(f"{topic.partition('/image')[0]}/camera_info", T0, info), (topic, T0, message)]
    assert cameras(tmp_path, entries) == [Camera(WIDTH, HEIGHT, 500.0, 510.0, 3.0, 2.0)]


def test_rectified_images_of_a_foxglove_recording_have_the_projection_matrix(
    tmp_path: Path,
) -> None:
    path, context = tmp_path / "f.mcap", foxglove.Context()
    _, (_, _, image), *_ = foxglove_entries(1)
    info = CameraCalibration(
        width=WIDTH,
        height=HEIGHT,
        distortion_model="plumb_bob",
        D=[0.1, 0, 0, 0, 0],
        K=[FX, 0, CX, 0, FY, CY, 0, 0, 1],
        P=[500.0, 0, 3, 0, 0, 510.0, 2, 0, 0, 0, 1, 0],
    )
    with foxglove.open_mcap(path, context=context):
        CameraCalibrationChannel("/rect/camera_info", context=context).log(info, log_time=T0)
        RawImageChannel("/rect/image", context=context).log(image, log_time=T0)
    assert [frame.camera for frame in play(path)] == [Camera(WIDTH, HEIGHT, 500.0, 510.0, 3.0, 2.0)]


def test_a_given_camera_takes_the_place_of_one_that_cannot_be_decoded(tmp_path: Path) -> None:
    given = {"fx": 600.0, "fy": 600.0, "cx": 3.0, "cy": 2.0}
    entries = [info_at(0, d=(0.1, 0, 0, 0), model="equidistant"), *COLORS]
    expected = Camera(WIDTH, HEIGHT, 600.0, 600.0, 3.0, 2.0)
    assert cameras(tmp_path, entries, camera=given) == [expected] * 3


def test_a_given_camera_holds_for_images_of_one_size(tmp_path: Path) -> None:
    given = {"fx": 600.0, "fy": 600.0, "cx": 2.0, "cy": 1.0}
    frames, error = drain(McapSource(path=write_bag(tmp_path, shrinking()), camera=given))
    assert [frame.camera for frame in frames] == [Camera(WIDTH, HEIGHT, 600.0, 600.0, 2.0, 1.0)]
    message = "frame 1: the image is 4x3, the first one 8x6: source.camera holds for images of one"
    assert message in str(error)


def test_a_given_camera_of_larger_images_is_refused(tmp_path: Path) -> None:
    given = {"fx": 600.0, "fy": 600.0, "cx": 8.0, "cy": 3.0}
    with pytest.raises(
        InputError, match=r"principal point of source.camera, \(8, 3\), lies outside"
    ):
        cameras(tmp_path, [color_at(0)], camera=given)


@pytest.mark.parametrize("value", [float("inf"), float("nan")])
def test_a_camera_has_finite_numbers(value: float) -> None:
    with pytest.raises(ValueError, match="finite"):
        McapSource(path="a.mcap", camera={"fx": value, "fy": 600, "cx": 3, "cy": 2})
    with pytest.raises(ValueError, match="finite"):
        Camera(WIDTH, HEIGHT, FX, FY, value, CY)


@pytest.mark.parametrize("fx", [float("nan"), -600.0])
def test_a_focal_length_that_is_none_is_told_of_and_not_taken_for_no_calibration(
    fx: float, tmp_path: Path
) -> None:
    path = write_bag(tmp_path, [info_at(0, k=(fx, 0, CX, 0, FY, CY, 0, 0, 1)), *COLORS])
    frames, error = drain(McapSource(path=path))
    assert [frame.camera for frame in frames] == [None] * 3
    assert f"{COLOR_INFO}: its focal lengths are {fx:g} and {FY:g} px, expected" in str(error)


def test_after_a_calibration_that_cannot_be_decoded_none_is_known(tmp_path: Path) -> None:
    later = info_at(1, model="equidistant", d=(0.1, 0.2, 0.3, 0.4))
    path = write_bag(tmp_path, [info_at(0), COLORS[0], later, *COLORS[1:]])
    frames, error = drain(McapSource(path=path))
    assert "equidistant" in str(error)
    assert [frame.camera for frame in frames] == [CALIBRATED, None, None]


def test_a_lens_that_is_left_out_for_the_name_of_its_images_is_told_of(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    """As realsense2_camera calls the colour images of a D405."""
    topic = "/camera/camera/color/image_rect_raw"
    colors = [(topic, at, message) for _, at, message in COLORS]
    info = info_at(0, d=(0.1, 0.0, 0.0, 0.0, 0.0))
    found = play(write_bag(tmp_path, [info, *colors]))
    assert [frame.camera.model for frame in found if frame.camera] == ["none"] * 3
    assert caplog.text.count("the distortion that its calibration states is not applied") == 1


def test_a_bag_that_was_converted_from_ros_1_has_its_calibration(tmp_path: Path) -> None:
    """ROS 1 calls the matrices D, K, R and P, and `rosbags-convert` leaves these names."""
    lens = {"d": (0.1, 0.2, 0.3, 0.4, 0.5)}
    bag = write_ros1_bag(tmp_path / "a.bag", [info_at(0, **lens), *COLORS])
    (camera,) = {frame.camera for frame in play(converted(bag, tmp_path / "b"))}
    assert camera == Camera(WIDTH, HEIGHT, FX, FY, CX, CY, "brown_conrady", lens["d"])


def test_rectified_images_of_a_calibration_without_distortion(tmp_path: Path) -> None:
    topic = "/camera/camera/color/image_rect_raw"
    colors = [(topic, at, message) for _, at, message in COLORS]
    found = play(write_bag(tmp_path, [info_at(0, d=()), *colors]))
    assert [frame.camera for frame in found] == [CALIBRATED] * 3
