"""Image messages to arrays: sensor_msgs and Foxglove, raw and compressed.

Both families name the fields alike (``encoding``, ``width``, ``height``, ``step``, ``data``), so
one decoder serves both.
"""

from __future__ import annotations

import re
import struct
from dataclasses import replace
from typing import Any

import numpy as np
from mcap.records import Schema
from numpy.typing import NDArray

from mushpipe.core.arrays import Bytes
from mushpipe.core.geometry import COEFFICIENTS, Camera
from mushpipe.core.wire import DISTORTION_MODELS

# encoding -> (bytes per pixel, order of its channels that gives RGB)
_COLOR: dict[str, tuple[int, tuple[int, ...]]] = {
    "rgb8": (3, (0, 1, 2)),
    "8UC3": (3, (2, 1, 0)),
    "bgr8": (3, (2, 1, 0)),
    "rgba8": (4, (0, 1, 2)),
    "bgra8": (4, (2, 1, 0)),
    "8UC4": (4, (2, 1, 0)),
    "mono8": (1, (0, 0, 0)),
    "8UC1": (1, (0, 0, 0)),
}
_YUV = {"yuv422": "COLOR_YUV2RGB_UYVY", "uyvy": "COLOR_YUV2RGB_UYVY"} | dict.fromkeys(
    ("yuv422_yuy2", "yuyv"), "COLOR_YUV2RGB_YUY2"
)
# encoding -> (dtype, metres per unit; None where the message cannot tell)
_DEPTH: dict[str, tuple[str, float | None]] = {
    "16UC1": ("u2", 0.001),
    "mono16": ("u2", None),
    "32FC1": ("f4", 1.0),
}
# models in which an angle is a distance from the centre: no pinhole even with coefficients of zero
_FISHEYE = ("equidistant", "kannala_brandt", "fisheye")
_COMPRESSED_DEPTH = "compressedDepth"
_PNG = b"\x89PNG"
_CAMERA_INFO = "sensor_msgs/msg/CameraInfo"
_ROS1_NAME = re.compile(rb"^(float64\[\d*\] +)([DKRP])\b", re.MULTILINE)


def kind_of(message: Any) -> str:
    """Return whether an image is ``color`` or ``depth``; "" of what does not say it."""
    stated = getattr(message, "format", "")  # of a compressed one: "rgb8; jpeg compressed bgr8"
    encoding = getattr(message, "encoding", "") or stated.partition(";")[0]
    if encoding in _DEPTH or _COMPRESSED_DEPTH in stated:
        return "depth"
    return "color" if encoding in (*_COLOR, *_YUV, "jpeg", "jpg") else ""


def _pixels(message: Any, item: int) -> Bytes:
    """Return the image's bytes as (H, W * item), without the padding at the end of its rows."""
    height, width, step = message.height, message.width, message.step or message.width * item
    data = np.frombuffer(message.data, np.uint8)
    if not height or not width or step < width * item or len(data) < step * height:
        raise ValueError(
            f"{width}x{height} image with step {step} in {len(data)} bytes, "
            f"{message.encoding} needs {item} bytes a pixel"
        )
    return data[: step * height].reshape(height, step)[:, : width * item]


def decode_color(message: Any) -> Bytes:
    """Decode a raw or compressed colour image to (H, W, 3) uint8 RGB.

    Raises:
        ValueError: Unknown encoding, or the data do not fit the stated size.
    """
    if not hasattr(message, "encoding"):
        return _decode_compressed_color(message)
    if message.encoding in _YUV:
        import cv2

        if message.width % 2:
            raise ValueError(f"{message.encoding} image of odd width {message.width}")
        rows = _pixels(message, 2).reshape(message.height, message.width, 2)
        return np.asarray(cv2.cvtColor(rows, getattr(cv2, _YUV[message.encoding])), np.uint8)
    if message.encoding not in _COLOR:
        known = ", ".join([*_COLOR, *_YUV])
        raise ValueError(f"colour encoding '{message.encoding}' is not known (known: {known})")
    item, order = _COLOR[message.encoding]
    image = _pixels(message, item).reshape(message.height, message.width, item)
    return np.ascontiguousarray(
        image if order == (0, 1, 2) == tuple(range(item)) else image[..., order]
    )


def _decode_compressed_color(message: Any) -> Bytes:
    import cv2

    # Depth is not turned as a camera's EXIF may ask for colour.
    flags = cv2.IMREAD_COLOR | cv2.IMREAD_IGNORE_ORIENTATION
    data = np.frombuffer(message.data, np.uint8)
    image = cv2.imdecode(data, flags) if len(data) else None
    if image is None:
        what = f"{message.format or 'no format'}, {len(data)} bytes"
        raise ValueError(f"compressed image ({what}) cannot be decoded")
    return np.asarray(cv2.cvtColor(image, cv2.COLOR_BGR2RGB), np.uint8)


def decode_depth(message: Any, scale: float | None) -> tuple[NDArray[Any], float]:
    """Decode a depth image to its native array and its scale in metres per unit.

    Args:
        message: Raw, or compressed as ROS compressedDepth or PNG.
        scale: Metres per unit where the recording states it.

    Raises:
        ValueError: Unknown encoding, bad data, or a 16-bit image whose unit nobody states.
    """
    if not hasattr(message, "encoding"):
        return _decode_compressed_depth(message, scale)
    if message.encoding not in _DEPTH:
        raise ValueError(
            f"depth encoding '{message.encoding}' is not known (known: {', '.join(_DEPTH)})"
        )
    dtype, default = _DEPTH[message.encoding]
    order = ">" if getattr(message, "is_bigendian", 0) else "<"
    native = np.dtype(dtype)
    image = np.ascontiguousarray(_pixels(message, native.itemsize)).view(order + dtype)
    return image.astype(native, copy=False), _known_scale(scale, default, message.encoding)


def _known_scale(scale: float | None, default: float | None, encoding: str) -> float:
    known = scale if scale is not None else default
    if known is None:
        raise ValueError(f"{encoding} depth without a unit: set depth_scale (metres per unit)")
    return known


def _decode_compressed_depth(message: Any, scale: float | None) -> tuple[NDArray[Any], float]:
    """Decode compressedDepth: a header of 12 bytes (enum, quantisation a and b) before a PNG."""
    import cv2

    data = bytes(message.data)
    at = data.find(_PNG, 0, 16)
    if at < 0:
        raise ValueError(
            f"compressed depth '{message.format}' holds no PNG in its {len(data)} bytes, and only "
            "PNG is supported"
        )
    image = cv2.imdecode(np.frombuffer(data[at:], np.uint8), cv2.IMREAD_UNCHANGED)
    if image is None or image.dtype != np.uint16 or image.ndim != 2:
        raise ValueError(f"compressed depth '{message.format}' holds no 16-bit image")
    if not message.format.startswith("32FC1"):
        encoding = "mono16" if message.format.startswith("mono16") else "16UC1"
        return image, _known_scale(scale, _DEPTH[encoding][1], encoding)
    _, a, b = struct.unpack_from("<iff", data)
    metres = np.zeros(image.shape, np.float32)
    np.divide(np.float32(a), image - np.float32(b), out=metres, where=image > 0)
    return metres, _known_scale(scale, 1.0, "32FC1")


GIVEN_CAMERA = "source.camera: {fx: , fy: , cx: , cy: }"
_LENGTHS = (4, 5, 8, 12, 14)  # of coefficients that OpenCV has


def distortion(message: Any) -> list[float]:
    """Return the distortion that a CameraInfo or CameraCalibration states."""
    return [float(v) for v in (message.d if hasattr(message, "d") else message.D)]


def decode_camera(message: Any, rectified: bool) -> Camera | None:
    """Decode CameraInfo or CameraCalibration; None where it says that it is not calibrated.

    Args:
        message: As recorded.
        rectified: Whether the images have no distortion any more: by the convention of ROS P holds
            for them then, not K and D.

    Raises:
        ValueError: The distortion model is one that is not implemented, a number is not finite, a
            focal length not above 0, the matrix has more in it than a pinhole camera, the
            calibration says not for which size of image it is, or its part lies beyond that.
    """
    k = list(message.k if hasattr(message, "k") else message.K)
    d = distortion(message)
    if rectified:
        p, d = list(message.p if hasattr(message, "p") else message.P), []
        k = [*p[:3], *p[4:7], *p[8:11]] if len(p) == 12 and p[0] > 0 else k
    if len(k) != 9 or not (k[0] or k[4]):
        return None
    if not (k[0] > 0 and k[4] > 0):
        raise ValueError(f"its focal lengths are {k[0]:g} and {k[4]:g} px, expected above 0")
    if any((k[1], k[3], k[6], k[7])):  # sheared, or written column by column
        raise ValueError(f"its matrix is no fx 0 cx, 0 fy cy, 0 0 1, but {[float(v) for v in k]}")
    if not (message.width and message.height):
        raise ValueError(
            f"a calibration for images of {message.width}x{message.height} px: give {GIVEN_CAMERA}"
        )
    model = "none"
    coefficients: tuple[float, ...] = ()
    if any(d) or (message.distortion_model in _FISHEYE and not rectified):
        names = {wire: own for own, wire in DISTORTION_MODELS.items()}
        model = names.get(message.distortion_model, "unknown")
        count = COEFFICIENTS.get(model, 0)
        # OpenCV's order: those left out at the end are 0, those beyond (thin prism, tilt) must be.
        if not count or len(d) not in _LENGTHS or any(d[count:]):
            raise ValueError(
                f"distortion model '{message.distortion_model}' with {len(d)} coefficients is not "
                "supported (supported: plumb_bob with 4 or 5, rational_polynomial with 8, and "
                "zeros behind); rectify the images"
            )
        coefficients = (*d[:count], *[0.0] * (count - len(d)))
    camera = Camera(message.width, message.height, k[0], k[4], k[2], k[5], model, coefficients)
    return _of_part(camera, message)


def _of_part(camera: Camera, message: Any) -> Camera:
    """Return the calibration of images that are a part of the sensor's, or were made smaller.

    A CameraInfo is of the whole image; the part (`roi`) is cut out first, then so many pixels a
    side (`binning`) become one. As by image_geometry.PinholeCameraModel of ROS.
    """
    if not hasattr(message, "roi"):  # Foxglove's has none
        return camera
    across, down = max(1, message.binning_x), max(1, message.binning_y)
    left, top = message.roi.x_offset, message.roi.y_offset
    width, height = message.roi.width, message.roi.height
    if left + width > camera.width or top + height > camera.height:
        raise ValueError(
            f"its roi, {width}x{height} from ({left}, {top}) on, lies beyond its image of "
            f"{camera.width}x{camera.height}: set {GIVEN_CAMERA}"
        )
    return replace(
        camera,
        width=(width or camera.width) // across,
        height=(height or camera.height) // down,
        fx=camera.fx / across,
        fy=camera.fy / down,
        cx=(camera.cx - left) / across,
        cy=(camera.cy - top) / down,
    )


def with_ros2_names(schema: Schema | None) -> Schema | None:
    """Return a schema that can be read: a bag converted from ROS 1 keeps its D, K, R and P."""
    if schema is None or schema.name != _CAMERA_INFO or schema.encoding != "ros2msg":
        return schema
    names = _ROS1_NAME.sub(lambda found: found[1] + found[2].lower(), schema.data)
    return replace(schema, data=names)
