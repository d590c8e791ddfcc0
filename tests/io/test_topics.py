"""Which topics are colour, depth and calibration."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from mcap.writer import Writer as McapWriter

from mushpipe.core.errors import InputError
from mushpipe.core.types import RgbdFrame
from mushpipe.sources.mcap import McapSource
from tests.io.bags import (
    ALIGNED,
    CAMERA,
    COLOR,
    COLOR_INFO,
    RECT,
    T0,
    Entry,
    camera_info,
    color_at,
    color_pixels,
    compressed,
    depth_at,
    depth_pixels,
    depth_png,
    encoded,
    play,
    raw_image,
    rgbd,
    write_bag,
)

OTHER_INFO = camera_info(k=(99, 0, 1, 0, 99, 1, 0, 0, 1))
MM_OFF = depth_pixels(7)
LEFT = "/left/color/image_raw"
RIGHT = "/right/color/image_raw"
LEFT_DEPTH = "/left/aligned_depth_to_color/image_raw"
RIGHT_DEPTH = "/right/aligned_depth_to_color/image_raw"


def first(tmp_path: Path, entries: list[Entry], **settings: object) -> RgbdFrame:
    return play(write_bag(tmp_path, entries), **settings)[0]


def refusal(tmp_path: Path, entries: list[Entry], **settings: object) -> str:
    """Return what is said about a recording, without the path that it begins with."""
    path = write_bag(tmp_path, entries)
    with pytest.raises(InputError) as error:
        play(path, **settings)
    assert error.value.exit_code == 4
    return str(error.value).removeprefix(f"{path}: ")


@pytest.mark.parametrize(
    "namespace", ["/camera/camera", "/camera", "", "/robot1/D405", "/depth_camera", "/rgbd/infra"]
)
def test_names_of_old_and_new_nodes_are_known(namespace: str, tmp_path: Path) -> None:
    entries = [(t.replace("/camera/camera", namespace), at, m) for t, at, m in rgbd([0])]
    frame = first(tmp_path, entries)
    np.testing.assert_array_equal(frame.color, color_pixels(0))
    np.testing.assert_array_equal(frame.depth, depth_pixels(0))
    assert frame.camera is not None


def test_infrared_and_unaligned_depth_beside_the_right_topics_do_no_harm(tmp_path: Path) -> None:
    infra = raw_image(color_pixels(5)[..., :1], "mono8")
    rect = raw_image(depth_pixels(5), "16UC1", frame_id="camera_depth_optical_frame")
    entries = [
        *rgbd([0]),
        (CAMERA + "infra1/image_rect_raw", T0, infra),
        (CAMERA + "infra1/camera_info", T0, OTHER_INFO),
        (RECT, T0, rect),
        (CAMERA + "depth/camera_info", T0, OTHER_INFO),
        (CAMERA + "aligned_depth_to_color/camera_info", T0, OTHER_INFO),
    ]
    frame = first(tmp_path, entries)
    np.testing.assert_array_equal(frame.color, color_pixels(0))
    np.testing.assert_array_equal(frame.depth, depth_pixels(0))
    assert frame.camera is not None
    assert frame.camera.fx == 617.5


def test_of_a_raw_topic_and_its_compressed_twin_the_raw_one_is_played(tmp_path: Path) -> None:
    jpeg = encoded(color_pixels(9), ".jpg")
    entries = [
        *rgbd([0]),
        (COLOR + "/compressed", T0, compressed(jpeg, "rgb8; jpeg compressed bgr8")),
        (
            ALIGNED + "/compressedDepth",
            T0,
            compressed(depth_png(depth_pixels(9)), "16UC1; compressedDepth png"),
        ),
    ]
    frame = first(tmp_path, entries)
    np.testing.assert_array_equal(frame.color, color_pixels(0))
    np.testing.assert_array_equal(frame.depth, depth_pixels(0))


def test_of_the_compressed_twins_of_depth_the_one_made_for_it_is_played(tmp_path: Path) -> None:
    jpeg = encoded(np.zeros((6, 8), np.uint8), ".jpg")
    entries = [
        (COLOR_INFO, T0, camera_info()),
        color_at(0),
        (ALIGNED + "/compressed", T0 + 1, compressed(jpeg, "16UC1; jpeg compressed ")),
        (
            ALIGNED + "/compressedDepth",
            T0 + 1,
            compressed(depth_png(depth_pixels(0)), "16UC1; compressedDepth png"),
        ),
    ]
    np.testing.assert_array_equal(first(tmp_path, entries).depth, depth_pixels(0))


def test_a_topic_that_is_named_as_depth_is_not_asked_for_as_colour(tmp_path: Path) -> None:
    entries = [color_at(0, topic="/cam/image"), depth_at(0, topic="/cam/range")]
    frame = first(tmp_path, entries, depth_topic="/cam/range")
    np.testing.assert_array_equal(frame.color, color_pixels(0))
    np.testing.assert_array_equal(frame.depth, depth_pixels(0))


def test_compressed_topics_find_the_calibration_beside_them(tmp_path: Path) -> None:
    png = compressed(encoded(color_pixels(0)[..., ::-1], ".png"), "rgb8; png compressed bgr8")
    entries = [
        (CAMERA + "depth/camera_info", T0, OTHER_INFO),
        (COLOR_INFO, T0, camera_info()),
        (COLOR + "/compressed", T0, png),
    ]
    frame = first(tmp_path, entries)
    np.testing.assert_array_equal(frame.color, color_pixels(0))
    assert frame.camera is not None
    assert frame.camera.fx == 617.5


def two_cameras() -> list[Entry]:
    return [
        color_at(1, topic=LEFT),
        depth_at(1, topic=LEFT_DEPTH),
        ("/left/color/camera_info", T0, camera_info()),
        color_at(2, topic=RIGHT),
        depth_at(2, topic=RIGHT_DEPTH),
        ("/right/color/camera_info", T0, OTHER_INFO),
    ]


def test_of_several_cameras_one_must_be_chosen(tmp_path: Path) -> None:
    text = refusal(tmp_path, two_cameras())
    assert text == (
        "several topics could be color; choose with "
        f"--set source.color_topic={LEFT} or --set source.color_topic={RIGHT}"
    )


def test_with_its_colour_the_depth_of_a_camera_is_chosen(tmp_path: Path) -> None:
    frame = first(tmp_path, two_cameras(), color_topic=RIGHT)
    np.testing.assert_array_equal(frame.color, color_pixels(2))
    np.testing.assert_array_equal(frame.depth, depth_pixels(2))


def test_of_several_depths_of_one_camera_one_must_be_chosen(tmp_path: Path) -> None:
    filtered = RIGHT_DEPTH.replace("/aligned", "/filtered/aligned")
    entries = [*two_cameras(), depth_at(3, topic=filtered)]
    text = refusal(tmp_path, entries, color_topic=RIGHT)
    assert f"--set source.depth_topic={RIGHT_DEPTH} or --set source.depth_topic={filtered}" in text


def test_named_topics_are_taken_as_they_are(tmp_path: Path) -> None:
    frame = first(tmp_path, two_cameras(), color_topic=RIGHT, depth_topic=RIGHT_DEPTH)
    np.testing.assert_array_equal(frame.color, color_pixels(2))
    np.testing.assert_array_equal(frame.depth, depth_pixels(2))
    assert frame.camera is not None
    assert frame.camera.fx == 99


def test_a_named_calibration_is_taken(tmp_path: Path) -> None:
    entries = [*rgbd([0]), ("/elsewhere/calibration", T0, OTHER_INFO)]
    frame = first(tmp_path, entries, camera_topic="/elsewhere/calibration")
    assert frame.camera is not None
    assert frame.camera.fx == 99


@pytest.mark.parametrize("role", ["color", "depth", "camera"])
def test_a_named_topic_that_is_not_there_gets_a_suggestion(role: str, tmp_path: Path) -> None:
    text = refusal(tmp_path, rgbd([0]), **{f"{role}_topic": COLOR + "x"})
    assert text == f"there is no topic '{COLOR}x'; did you mean '{COLOR}'?"


@pytest.mark.parametrize(
    ("role", "topic", "expected"),
    [
        ("color", COLOR_INFO, "foxglove.CompressedImage or foxglove.RawImage or sensor_msgs/msg/C"),
        ("depth", COLOR_INFO, "foxglove.CompressedImage or foxglove.RawImage or sensor_msgs/msg/C"),
        ("camera", COLOR, "foxglove.CameraCalibration or sensor_msgs/msg/CameraInfo"),
    ],
)
def test_a_named_topic_of_another_type_is_refused(
    role: str, topic: str, expected: str, tmp_path: Path
) -> None:
    text = refusal(tmp_path, rgbd([0]), **{f"{role}_topic": topic})
    kind = "Image" if topic == COLOR else "CameraInfo"
    assert text.startswith(f"topic '{topic}' holds sensor_msgs/msg/{kind}, expected {expected}")


@pytest.mark.parametrize(
    ("role", "topic", "said"),
    [
        ("depth", COLOR, f"holds colour, expected depth; --set source.depth_topic={ALIGNED}"),
        ("color", ALIGNED, f"holds depth, expected colour; --set source.color_topic={COLOR}"),
    ],
)
def test_of_a_topic_that_holds_the_other_kind_the_right_one_is_told(
    role: str, topic: str, said: str, tmp_path: Path
) -> None:
    text = refusal(tmp_path / "raw", rgbd([0]), **{f"{role}_topic": topic})
    assert text == f"topic '{topic}' {said}"
    jpeg = compressed(encoded(color_pixels(), ".jpg"), "rgb8; jpeg compressed bgr8")
    png = compressed(depth_png(depth_pixels()), "16UC1; compressedDepth png")
    entries = [(COLOR, T0, jpeg), (ALIGNED, T0 + 1, png)]
    assert refusal(tmp_path / "small", entries, **{f"{role}_topic": topic}) == text
    with pytest.raises(InputError, match=f"topic '{topic}' {said}"):  # before any sink opens
        McapSource.model_validate(
            {"path": tmp_path / "raw/bag/bag.mcap", f"{role}_topic": topic}
        ).open()


def test_where_no_topic_holds_depth_it_is_said(tmp_path: Path) -> None:
    text = refusal(tmp_path, [color_at(0)], depth_topic=COLOR)
    assert text == f"topic '{COLOR}' holds colour, expected depth; no topic is known to hold depth"


def test_unaligned_depth_is_refused_with_a_way_out(tmp_path: Path) -> None:
    rect = raw_image(depth_pixels(0), "16UC1", frame_id="camera_depth_optical_frame")
    text = refusal(tmp_path, [color_at(0), (RECT, T0 + 1, rect)])
    assert text == (
        f"depth ({RECT}) is in frame 'camera_depth_optical_frame', colour in "
        "'camera_color_optical_frame': depth must be aligned to colour; record "
        "aligned_depth_to_color, or play without depth: --set source.use_depth=false"
    )


@pytest.mark.parametrize(
    "topic",
    [
        CAMERA + "aligned_depth_to_infra1/image_raw",
        CAMERA + "depth_unaligned/image_raw",
        RIGHT_DEPTH,
    ],
)
def test_depth_aligned_to_something_else_is_no_depth_of_these_images(
    topic: str, tmp_path: Path
) -> None:
    other = raw_image(depth_pixels(0), "16UC1", frame_id="another_optical_frame")
    text = refusal(tmp_path, [color_at(0), (topic, T0 + 1, other)], depth_topic=topic)
    assert text.startswith(f"depth ({topic}) is in frame 'another_optical_frame', colour in")


def test_depth_aligned_to_colour_comes_before_depth_aligned_to_infrared(tmp_path: Path) -> None:
    infra = (CAMERA + "aligned_depth_to_infra1/image_raw", T0 + 1, raw_image(MM_OFF, "16UC1"))
    frame = first(tmp_path, [infra, *rgbd([0])])
    np.testing.assert_array_equal(frame.depth, depth_pixels(0))


@pytest.mark.parametrize("topic", ["/cam2/camera_info", "/cam2/color/camera_info"])
def test_the_calibration_of_another_camera_is_refused_unless_it_is_named(
    topic: str, tmp_path: Path
) -> None:
    entries = [(topic, T0, camera_info(frame_id="cam2")), color_at(0)]
    text = refusal(tmp_path / "a", entries)
    assert f"the only calibration ({topic}) is of frame 'cam2', colour is in" in text
    assert first(tmp_path / "b", entries, camera_topic=topic).camera is not None


@pytest.mark.parametrize("frame_id", ["camera_color_optical_frame", ""])
def test_where_only_names_say_that_a_calibration_is_another_cameras_it_is_told(
    frame_id: str, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    topic = "/right/color/camera_info"
    entries = [(topic, T0, camera_info(frame_id=frame_id)), color_at(0, topic=LEFT)]
    assert first(tmp_path / "a", entries).camera is not None
    told = f"by its name, the only calibration ({topic}) is of another camera than colour ({LEFT})"
    assert sum(told in message for message in caplog.messages) == 1
    caplog.clear()
    first(tmp_path / "b", entries, camera_topic=topic)
    own = [("/left/camera_info", T0, camera_info(frame_id=frame_id)), color_at(0, topic=LEFT)]
    first(tmp_path / "c", own)
    assert "another camera" not in caplog.text


@pytest.mark.parametrize(
    ("color", "info"),
    [("/cam/rgb", "/cam/depth_info"), ("/color_image", "/depth_camera_info")],
)
def test_the_calibration_of_depth_in_the_folder_of_colour_is_not_that_of_colour(
    color: str, info: str, tmp_path: Path
) -> None:
    entries = [(info, T0, OTHER_INFO), color_at(0, topic=color)]
    assert first(tmp_path, entries).camera is None


def test_depth_aligned_to_colour_is_not_aligned_to_infrared(tmp_path: Path) -> None:
    topic = CAMERA + "infra1/image_rect_raw"
    gray = raw_image(color_pixels(0)[..., :1], "mono8", frame_id="camera_infra1_optical_frame")
    text = refusal(tmp_path, [(topic, T0, gray), depth_at(0)], color_topic=topic)
    assert text.startswith(f"depth ({ALIGNED}) is in frame 'camera_color_optical_frame', colour in")


def test_infrared_images_that_are_named_have_the_calibration_beside_them(tmp_path: Path) -> None:
    topic = CAMERA + "infra1/image_rect_raw"
    gray = raw_image(color_pixels(0)[..., :1], "mono8")
    entries = [(topic, T0, gray), (CAMERA + "infra1/camera_info", T0, camera_info())]
    frame = first(tmp_path, entries, color_topic=topic)
    assert frame.camera is not None


def test_the_calibration_of_an_infrared_camera_is_not_that_of_colour(tmp_path: Path) -> None:
    entries = [(CAMERA + "infra1/camera_info", T0, OTHER_INFO), color_at(0)]
    assert first(tmp_path, entries).camera is None


def test_unaligned_depth_may_be_left_out(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    rect = raw_image(depth_pixels(0), "16UC1", frame_id="camera_depth_optical_frame")
    entries = [(COLOR_INFO, T0, camera_info()), color_at(0), (RECT, T0 + 1, rect)]
    assert first(tmp_path, entries, use_depth=False).depth is None
    assert caplog.messages == [
        "bag.mcap has no depth: positions, distances and diameters will be missing"
    ]


@pytest.mark.parametrize("kind", ["sensor_msgs/Image", "foxglove.CompressedVideo"])
def test_colour_of_a_kind_that_is_not_read_is_told_of(kind: str, tmp_path: Path) -> None:
    """Of a bag of ROS 1 that `mcap convert` made MCAP of, and of video."""
    path = tmp_path / "a.mcap"
    writer = McapWriter(str(path))
    writer.start()
    schema = writer.register_schema(kind, "ros1msg", b"")
    channel = writer.register_channel("/camera/color/image_raw", "ros1", schema)
    writer.add_message(channel, 1, b"", 1)
    writer.finish()
    with pytest.raises(InputError, match=rf"color/image_raw holds {kind}, expected foxglove\.C"):
        play(path)


def test_depth_whose_topic_does_not_say_so_is_asked_for(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    """As depthai_ros_driver calls the depth of an OAK-D."""
    colors = [color_at(i, topic="/oak/rgb/image_raw") for i in range(3)]
    depths = [depth_at(i, topic="/oak/stereo/image_raw") for i in range(3)]
    path = write_bag(tmp_path, [*colors, *depths])
    assert [frame.depth for frame in play(path)] == [None] * 3
    setting = "--set source.depth_topic=/oak/stereo/image_raw"
    assert f"is depth, aligned to colour, name it: {setting}" in caplog.messages[1]
    caplog.clear()
    play(path, use_depth=False)
    assert "name it" not in caplog.text
    assert all(frame.depth is not None for frame in play(path, depth_topic="/oak/stereo/image_raw"))


def test_rectified_depth_in_the_frame_of_the_colour_is_taken(tmp_path: Path) -> None:
    # A D405 has one optical frame for both.
    frame = first(tmp_path, [color_at(0), depth_at(0, topic=RECT)])
    np.testing.assert_array_equal(frame.depth, depth_pixels(0))


def test_aligned_depth_of_another_size_is_refused(tmp_path: Path) -> None:
    small = raw_image(depth_pixels(0, (4, 3)), "16UC1")
    text = refusal(tmp_path, [color_at(0), (ALIGNED, T0 + 1, small)])
    assert f"frame 0: depth ({ALIGNED}) is 4x3, colour 8x6: depth must be aligned" in text
    assert "--set source.use_depth=false" in text


@pytest.mark.parametrize(
    ("color", "depth", "same"),
    [
        ("/left/color/image_raw", "/right/depth/image_raw", False),
        ("/cam0/image_color", "/cam1/image_depth", False),
        ("/robot1/camera/rgb/image_raw", "/robot2/camera/depth/image_raw", False),
        ("/camera/color/image_raw", "/camera/depth/image_rect_raw", True),
        ("/rgb/image_raw", "/depth_to_rgb/image_raw", True),
        ("/camera/rgb/image_rect_color", "/camera/depth_registered/image_raw", True),
        ("/zed/zed_node/rgb/image_rect_color", "/zed/zed_node/depth/depth_registered", True),
        ("/color", "/depth", True),
    ],
)
def test_depth_of_another_camera_is_taken_only_where_it_is_named(
    color: str, depth: str, same: bool, tmp_path: Path
) -> None:
    """Though it claims to be in the same frame."""
    names = {COLOR: color, ALIGNED: depth}
    path = write_bag(tmp_path, [(names.get(topic, topic), at, m) for topic, at, m in rgbd([0])])
    if same:
        assert play(path)[0].depth is not None
        return
    said = rf"by its name, depth \({depth}\) is of another camera than colour \({color}\)"
    with pytest.raises(InputError, match=said):
        play(path)
    assert play(path, depth_topic=depth)[0].depth is not None
    assert play(path, use_depth=False)[0].depth is None


def test_topics_without_a_message_are_told_apart(tmp_path: Path) -> None:
    path = tmp_path / "a.mcap"
    with path.open("wb") as file:
        writer = McapWriter(file)
        writer.start()
        schema = writer.register_schema("sensor_msgs/msg/Image", "ros2msg", b"uint32 height\n")
        writer.register_channel(COLOR, "cdr", schema)
        writer.finish()
    with pytest.raises(InputError, match=rf"no colour images \(it holds {COLOR} without a message"):
        play(path)


def test_images_whose_name_says_depth_may_be_named_as_colour(tmp_path: Path) -> None:
    topic = "/depth_camera/image_raw"
    entries = [color_at(0, topic=topic), depth_at(0, topic="/depth_camera/depth/image_raw")]
    other = "/depth_camera/depth/image_raw"
    options = f"--set source.color_topic={other} or --set source.color_topic={topic}"
    text = refusal(tmp_path / "a", entries)
    assert text.endswith(f"; where one of these is colour, name it: {options}")
    frame = first(tmp_path / "b", entries, color_topic=topic)
    np.testing.assert_array_equal(frame.color, color_pixels(0))
    np.testing.assert_array_equal(frame.depth, depth_pixels(0))
