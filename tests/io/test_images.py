"""Every encoding of images that a recording may hold, against pixels known beforehand."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from mushpipe.core.errors import InputError
from mushpipe.core.types import RgbdFrame
from mushpipe.sources.mcap import McapSource
from tests.io.bags import (
    ALIGNED,
    COLOR,
    T0,
    WIDTH,
    color_at,
    color_pixels,
    compressed,
    depth_pixels,
    depth_png,
    drain,
    encoded,
    play,
    raw_image,
    write_bag,
)

RGB = color_pixels()
MM = depth_pixels()
ALPHA = np.full((*RGB.shape[:2], 1), 7, np.uint8)
GRAY = RGB[..., :1]


def one_frame(tmp_path: Path, color: Any = None, depth: Any = None, **settings: Any) -> RgbdFrame:
    """Play a bag of one colour and perhaps one depth image; the type of the message tells how."""
    entries = [color_at(0)]
    if color is not None:
        packed = color.__msgtype__.endswith("CompressedImage")
        entries = [(COLOR + "/compressed" * packed, T0, color)]
    if depth is not None:
        packed = depth.__msgtype__.endswith("CompressedImage")
        entries.append((ALIGNED + "/compressedDepth" * packed, T0 + 1, depth))
    (frame,) = play(write_bag(tmp_path, entries), **settings)
    return frame


@pytest.mark.parametrize("padding", [0, 5])
@pytest.mark.parametrize(
    ("encoding", "stored", "expected"),
    [
        ("rgb8", RGB, RGB),
        ("bgr8", RGB[..., ::-1], RGB),
        ("8UC3", RGB[..., ::-1], RGB),
        ("rgba8", np.concatenate([RGB, ALPHA], 2), RGB),
        ("bgra8", np.concatenate([RGB[..., ::-1], ALPHA], 2), RGB),
        ("8UC4", np.concatenate([RGB[..., ::-1], ALPHA], 2), RGB),
        ("mono8", GRAY, GRAY.repeat(3, axis=2)),
        ("8UC1", GRAY, GRAY.repeat(3, axis=2)),
    ],
)
def test_raw_color(
    encoding: str, stored: np.ndarray, expected: np.ndarray, padding: int, tmp_path: Path
) -> None:
    frame = one_frame(tmp_path, raw_image(stored, encoding, padding=padding))
    np.testing.assert_array_equal(frame.color, expected)
    assert frame.color.dtype == np.uint8


# BT.601 in video range: luma is 16 + 65.738 R / 256 + 129.057 G / 256 + 25.064 B / 256, and so on.
@pytest.mark.parametrize(
    ("rgb", "yuv"),
    [
        ((255, 255, 255), (235, 128, 128)),
        ((0, 0, 0), (16, 128, 128)),
        ((255, 0, 0), (81, 90, 240)),
        ((0, 255, 0), (145, 54, 34)),
        ((0, 0, 255), (41, 240, 110)),
    ],
)
@pytest.mark.parametrize(
    ("encoding", "order"),
    [
        ("yuv422", "uyvy"),
        ("uyvy", "uyvy"),
        ("yuv422_yuy2", "yuyv"),
        ("yuyv", "yuyv"),
    ],
)
def test_yuv_color(
    encoding: str, order: str, rgb: tuple[int, ...], yuv: tuple[int, ...], tmp_path: Path
) -> None:
    value = dict(zip("yuv", yuv, strict=True))
    pair = [value[letter] for letter in order]
    stored = np.tile(np.array(pair, np.uint8).reshape(2, 2), (6, WIDTH // 2, 1))
    frame = one_frame(tmp_path, raw_image(stored, encoding, padding=4))
    assert np.abs(frame.color.astype(int) - rgb).max() <= 2


@pytest.mark.parametrize("kind", ["rgb8; png compressed bgr8", "png", "bgr8; png compressed bgr8"])
def test_png_color_is_exact(kind: str, tmp_path: Path) -> None:
    frame = one_frame(tmp_path, compressed(encoded(RGB[..., ::-1], ".png"), kind))
    np.testing.assert_array_equal(frame.color, RGB)


def test_colour_is_not_turned_as_exif_asks_since_depth_is_not(tmp_path: Path) -> None:
    jpeg = encoded(np.repeat(np.repeat(GRAY, 8, 0), 8, 1), ".jpg", cv2.IMWRITE_JPEG_QUALITY, 100)
    tag = b"II*\0\x08\0\0\0\x01\0\x12\x01\x03\0\x01\0\0\0\x03\0\0\0\0\0\0\0"  # turned by 180
    exif = b"\xff\xe1" + (len(tag) + 8).to_bytes(2, "big") + b"Exif\0\0" + tag
    plain = one_frame(tmp_path / "plain", compressed(jpeg, "jpeg"))
    turned = one_frame(tmp_path / "turned", compressed(jpeg[:2] + exif + jpeg[2:], "jpeg"))
    assert np.array_equal(turned.color, plain.color)


def test_jpeg_color_keeps_red_red(tmp_path: Path) -> None:
    red = np.zeros((48, 64, 3), np.uint8)
    red[..., 0] = 200
    data = encoded(red[..., ::-1], ".jpg", cv2.IMWRITE_JPEG_QUALITY, 95)
    frame = one_frame(tmp_path, compressed(data, "rgb8; jpeg compressed bgr8"))
    assert np.abs(frame.color.astype(int) - red).max() <= 4


@pytest.mark.parametrize("bigendian", [False, True])
@pytest.mark.parametrize("padding", [0, 6])
@pytest.mark.parametrize(("encoding", "dtype"), [("16UC1", np.uint16), ("32FC1", np.float32)])
def test_raw_depth(
    encoding: str, dtype: type, padding: int, bigendian: bool, tmp_path: Path
) -> None:
    stored = MM if dtype is np.uint16 else (MM / 1000).astype(np.float32)
    image = raw_image(stored, encoding, padding=padding, bigendian=bigendian)
    frame = one_frame(tmp_path, depth=image)
    assert frame.depth is not None
    assert frame.depth.dtype == dtype
    np.testing.assert_array_equal(frame.depth, stored)
    np.testing.assert_allclose(frame.depth_m[1:], MM[1:] / 1000, rtol=1e-6)
    assert np.isnan(frame.depth_m[0, 0])


def test_float_depth_may_be_nan_or_infinite_where_missing(tmp_path: Path) -> None:
    metres = np.full((6, 8), 0.5, np.float32)
    metres[0, :4] = np.nan, np.inf, -np.inf, -1
    frame = one_frame(tmp_path, depth=raw_image(metres, "32FC1"))
    assert np.isnan(frame.depth_m[0, :4]).all()
    assert (frame.depth_m[0, 4:] == np.float32(0.5)).all()


@pytest.mark.parametrize("packed", [False, True])
def test_a_stated_depth_scale_goes_before_the_usual_one(packed: bool, tmp_path: Path) -> None:
    kind = "16UC1; compressedDepth png"
    image = compressed(depth_png(MM), kind) if packed else raw_image(MM, "16UC1")
    frame = one_frame(tmp_path, depth=image, depth_scale=0.000125)
    assert frame.depth_scale == 0.000125
    np.testing.assert_array_equal(frame.depth, MM)


def test_compressed_depth_in_millimetres_is_exact(tmp_path: Path) -> None:
    image = compressed(depth_png(MM), "16UC1; compressedDepth png")
    frame = one_frame(tmp_path, depth=image)
    np.testing.assert_array_equal(frame.depth, MM)
    assert frame.depth_scale == 0.001


def test_compressed_depth_in_metres_undoes_its_quantisation(tmp_path: Path) -> None:
    # As compressed_depth_image_transport writes it: a = 100 * 101, b = 1 - a / depth_max.
    metres = np.linspace(0.2, 1.5, 48).reshape(6, 8)
    a = 100.0 * 101.0
    b = 1.0 - a / 10.0
    stored = np.rint(a / metres + b)
    stored[0, 0] = 0
    image = compressed(depth_png(stored.astype(np.uint16), a, b), "32FC1; compressedDepth png")
    frame = one_frame(tmp_path, depth=image)
    assert frame.depth is not None
    assert frame.depth.dtype == np.float32
    assert np.isnan(frame.depth_m[0, 0])
    # Half a step of 1 / depth is z^2 / (2 a).
    error = np.abs(frame.depth_m - metres)[1:]
    assert (error < 1.1 * metres[1:] ** 2 / (2 * a) + 1e-6).all()


BAD_DEPTH = [
    (
        compressed(b"\0" * 12 + b"\1\2\3\4" * 30, "16UC1; compressedDepth rvl"),
        "compressed depth '16UC1; compressedDepth rvl' holds no PNG in its 132 bytes",
    ),
    (
        compressed(b"\0\1\2", "16UC1; compressedDepth png"),
        "compressed depth '16UC1; compressedDepth png' holds no PNG in its 3 bytes",
    ),
    (
        compressed(depth_png(MM.astype(np.uint8)), "16UC1; compressedDepth png"),
        "compressed depth '16UC1; compressedDepth png' holds no 16-bit image",
    ),
    (
        compressed(depth_png(MM)[:60], "16UC1; compressedDepth png"),
        "compressed depth '16UC1; compressedDepth png' holds no 16-bit image",
    ),
    (raw_image(MM, "mono16"), "mono16 depth without a unit: set depth_scale (metres per unit)"),
    (
        compressed(depth_png(MM), "mono16; compressedDepth png"),
        "mono16 depth without a unit: set depth_scale (metres per unit)",
    ),
    (
        raw_image(MM, "64FC1"),
        "depth encoding '64FC1' is not known (known: 16UC1, mono16, 32FC1)",
    ),
    (
        raw_image(MM, "16UC1", data=b"\0" * 95),
        "8x6 image with step 16 in 95 bytes, 16UC1 needs 2 bytes a pixel",
    ),
]


@pytest.mark.parametrize(("image", "message"), BAD_DEPTH)
def test_depth_that_cannot_be_read_leaves_the_colour(
    image: Any, message: str, tmp_path: Path
) -> None:
    source = McapSource(path=write_bag(tmp_path, [color_at(0), (ALIGNED, T0 + 1, image)]))
    frames, error = drain(source)
    assert [frame.depth for frame in frames] == [None]
    assert f"{ALIGNED}: {message}" in str(error)
    assert isinstance(error, InputError)
    assert error.exit_code == 4
    assert source.counts()["images that could not be decoded"] == 1


def test_a_unit_from_the_user_makes_mono16_readable(tmp_path: Path) -> None:
    frame = one_frame(tmp_path, depth=raw_image(MM, "mono16"), depth_scale=0.002)
    np.testing.assert_allclose(frame.depth_m[1:], MM[1:] * 0.002, rtol=1e-6)


@pytest.mark.parametrize(
    ("image", "message"),
    [
        (raw_image(RGB, "bayer_rggb8"), "colour encoding 'bayer_rggb8' is not known (known: rgb8"),
        (raw_image(GRAY, "rgb8"), "8x6 image with step 8 in 48 bytes, rgb8 needs 3 bytes a pixel"),
        (raw_image(RGB, "rgb8", data=b""), "8x6 image with step 24 in 0 bytes"),
        (raw_image(RGB[:, :0], "rgb8"), "0x6 image with step 0 in 0 bytes"),
        (raw_image(np.zeros((6, 7, 2), np.uint8), "yuv422"), "yuv422 image of odd width 7"),
    ],
)
def test_color_that_cannot_be_read_is_named(image: Any, message: str, tmp_path: Path) -> None:
    source = McapSource(path=write_bag(tmp_path, [(COLOR, T0, image)]))
    frames, error = drain(source)
    assert frames == []
    assert f"not all can be decoded: {COLOR}: {message}" in str(error)
    assert "damaged" not in str(error)
    assert source.counts() == {"images that could not be decoded": 1}


def test_of_several_images_that_cannot_be_read_the_first_is_named(tmp_path: Path) -> None:
    first, second = (raw_image(RGB, encoding) for encoding in ("bayer_rggb8", "bayer_bggr8"))
    entries = [color_at(0), (COLOR, T0 + 1, first), (COLOR, T0 + 2, second)]
    source = McapSource(path=write_bag(tmp_path, entries))
    frames, error = drain(source)
    assert len(frames) == 1
    assert "'bayer_rggb8' is not known" in str(error)
    assert "bayer_bggr8" not in str(error)
    assert source.counts() == {"images that could not be decoded": 2}
