"""Recordings for tests, made by writers that are not ours: rosbags (ROS 2) and foxglove-sdk."""

from __future__ import annotations

import struct
from collections.abc import Iterable
from dataclasses import fields
from pathlib import Path
from typing import Any

import cv2
import foxglove
import numpy as np
from foxglove.mcap import MCAPCompression, MCAPWriteOptions
from foxglove.messages import CameraCalibration, RawImage, Timestamp
from rosbags.convert import convert
from rosbags.rosbag1 import Writer as Ros1Writer
from rosbags.rosbag2 import StoragePlugin, Writer
from rosbags.typesys import Stores, get_typestore

from mushpipe.core.errors import InputError
from mushpipe.core.types import RgbdFrame
from mushpipe.sources.mcap import McapSource

T0 = 1_700_000_000_000_000_000
PERIOD = 33_000_000
WIDTH, HEIGHT = 8, 6
OPTICAL = "camera_color_optical_frame"
CAMERA = "/camera/camera/"
COLOR = CAMERA + "color/image_raw"
COLOR_INFO = CAMERA + "color/camera_info"
ALIGNED = CAMERA + "aligned_depth_to_color/image_raw"
RECT = CAMERA + "depth/image_rect_raw"
# fx fy cx cy of the calibration that `camera_info` writes
FX, FY, CX, CY = 617.5, 618.25, 3.5, 2.25

STORE = get_typestore(Stores.ROS2_HUMBLE)
ROS1 = get_typestore(Stores.ROS1_NOETIC)
Entry = tuple[str, int, Any]


def ros(name: str, **fields: Any) -> Any:
    return STORE.types[name](**fields)


def header(stamp_ns: int, frame_id: str) -> Any:
    time = ros("builtin_interfaces/msg/Time", sec=stamp_ns // 10**9, nanosec=stamp_ns % 10**9)
    return ros("std_msgs/msg/Header", stamp=time, frame_id=frame_id)


def raw_image(
    pixels: np.ndarray[Any, Any],
    encoding: str,
    stamp_ns: int = T0,
    frame_id: str = OPTICAL,
    padding: int = 0,
    bigendian: bool = False,
    data: bytes | None = None,
) -> Any:
    """Make a sensor_msgs/Image whose rows end in ``padding`` bytes that are no pixels."""
    stored = pixels.astype(pixels.dtype.newbyteorder(">")) if bigendian else pixels
    rows = np.frombuffer(stored.tobytes(), np.uint8).reshape(len(pixels), -1)
    rows = np.pad(rows, ((0, 0), (0, padding)), constant_values=0xAA)
    content = rows.reshape(-1) if data is None else np.frombuffer(data, np.uint8)
    return ros(
        "sensor_msgs/msg/Image",
        header=header(stamp_ns, frame_id),
        height=pixels.shape[0],
        width=pixels.shape[1],
        encoding=encoding,
        is_bigendian=int(bigendian),
        step=rows.shape[1],
        data=content,
    )


def compressed(data: bytes, kind: str, stamp_ns: int = T0, frame_id: str = OPTICAL) -> Any:
    return ros(
        "sensor_msgs/msg/CompressedImage",
        header=header(stamp_ns, frame_id),
        format=kind,
        data=np.frombuffer(data, np.uint8),
    )


def encoded(image: np.ndarray[Any, Any], suffix: str, *options: int) -> bytes:
    return cv2.imencode(suffix, image, options)[1].tobytes()


def depth_png(values: np.ndarray[Any, Any], a: float = 0.0, b: float = 0.0) -> bytes:
    """Make the payload of compressedDepth: enum, quantisation a and b, then a 16-bit PNG."""
    return struct.pack("<iff", 0, a, b) + encoded(values, ".png")


def camera_info(
    stamp_ns: int = T0,
    size: tuple[int, int] = (WIDTH, HEIGHT),
    k: tuple[float, ...] = (FX, 0, CX, 0, FY, CY, 0, 0, 1),
    d: tuple[float, ...] = (0, 0, 0, 0, 0),
    model: str = "plumb_bob",
    p: tuple[float, ...] = (0,) * 12,
    frame_id: str = OPTICAL,
    binning: tuple[int, int] = (0, 0),
    roi: tuple[int, int, int, int] = (0, 0, 0, 0),
) -> Any:
    region = dict(zip(("x_offset", "y_offset", "width", "height"), roi, strict=True))
    return ros(
        "sensor_msgs/msg/CameraInfo",
        header=header(stamp_ns, frame_id),
        height=size[1],
        width=size[0],
        distortion_model=model,
        d=np.array(d, float),
        k=np.array(k, float),
        r=np.eye(3).ravel(),
        p=np.array(p, float),
        binning_x=binning[0],
        binning_y=binning[1],
        roi=ros("sensor_msgs/msg/RegionOfInterest", **region, do_rectify=False),
    )


def color_pixels(i: int = 0, size: tuple[int, int] = (WIDTH, HEIGHT)) -> np.ndarray[Any, Any]:
    """Return (H, W, 3) uint8 RGB that differs in every channel and frame."""
    return np.random.default_rng([1, i]).integers(0, 256, (size[1], size[0], 3), np.uint8)


def depth_pixels(i: int = 0, size: tuple[int, int] = (WIDTH, HEIGHT)) -> np.ndarray[Any, Any]:
    """Return (H, W) uint16 in mm with one pixel missing."""
    depth = np.random.default_rng([2, i]).integers(200, 2000, (size[1], size[0]), np.uint16)
    depth[0, 0] = 0
    return depth


def color_at(i: int, stamp_ns: int | None = None, topic: str = COLOR) -> Entry:
    stamp = T0 + i * PERIOD if stamp_ns is None else stamp_ns
    return topic, T0 + i * PERIOD, raw_image(color_pixels(i), "rgb8", stamp)


def depth_at(i: int, stamp_ns: int | None = None, topic: str = ALIGNED) -> Entry:
    stamp = T0 + i * PERIOD if stamp_ns is None else stamp_ns
    return topic, T0 + i * PERIOD + 1, raw_image(depth_pixels(i), "16UC1", stamp)


def rgbd(frames: Iterable[int]) -> list[Entry]:
    """Return colour and aligned depth of some frames, with a calibration before them."""
    entries: list[Entry] = [(COLOR_INFO, T0, camera_info())]
    for i in frames:
        entries += [color_at(i), depth_at(i)]
    return entries


def write_bag(folder: Path, entries: Iterable[Entry], name: str = "bag") -> Path:
    """Write (topic, log time, message) as a ROS 2 bag and return its MCAP file."""
    folder.mkdir(parents=True, exist_ok=True)
    writer = Writer(folder / name, version=9, storage_plugin=StoragePlugin.MCAP)
    connections: dict[str, Any] = {}
    with writer:
        for topic, log_time, message in entries:
            kind = message.__msgtype__
            if topic not in connections:
                connections[topic] = writer.add_connection(topic, kind, typestore=STORE)
            writer.write(connections[topic], log_time, STORE.serialize_cdr(message, kind))
    return folder / name / f"{name}.mcap"


def write_ros1_bag(path: Path, entries: Iterable[Entry]) -> Path:
    """Write (topic, log time, message of ROS 2) as a bag of ROS 1."""
    connections: dict[str, Any] = {}
    with Ros1Writer(path) as writer:
        for topic, log_time, message in entries:
            kind = message.__msgtype__
            if topic not in connections:
                connections[topic] = writer.add_connection(topic, kind, typestore=ROS1)
            content = ROS1.serialize_ros1(_of_ros1(message), kind)
            writer.write(connections[topic], log_time, content)
    return path


def _of_ros1(message: Any) -> Any:
    """Return a message of ROS 2 as ROS 1 has it: headers are numbered, matrices have capitals."""
    if not hasattr(message, "__msgtype__") or message.__msgtype__.startswith("builtin"):
        return message
    of_camera = message.__msgtype__.endswith("CameraInfo")
    values = {f.name: _of_ros1(getattr(message, f.name)) for f in fields(message)}
    values.pop("__msgtype__", None)
    values |= {"seq": 0} if message.__msgtype__.endswith("Header") else {}
    named = {k.upper() if of_camera and len(k) == 1 else k: v for k, v in values.items()}
    return ROS1.types[message.__msgtype__](**named)


def converted(bag: Path, folder: Path) -> Path:
    """Make a ROS 2 bag of one of ROS 1 by `rosbags-convert`, and return its MCAP file."""
    convert([bag], folder, "mcap", 9, None, "none", None, None, (), (), (), ())
    return folder / f"{folder.name}.mcap"


def write_foxglove(
    path: Path,
    frames: int,
    chunk_size: int | None = 1,
    compression: MCAPCompression | None = MCAPCompression.Zstd,
    use_chunks: bool = True,
) -> Path:
    """Write the frames of `rgbd` as Foxglove messages; chunk_size 1 puts each in its own chunk."""
    context = foxglove.Context()
    options = MCAPWriteOptions(
        compression=compression, chunk_size=chunk_size, use_chunks=use_chunks
    )
    with foxglove.open_mcap(path, context=context, writer_options=options):
        for topic, log_time, message in foxglove_entries(frames):
            channel = getattr(foxglove.channels, f"{type(message).__name__}Channel")
            channel(topic, context=context).log(message, log_time=log_time)
    return path


def foxglove_entries(frames: int) -> Iterable[Entry]:
    stamp = Timestamp(sec=T0 // 10**9, nsec=0)
    k = [FX, 0.0, CX, 0.0, FY, CY, 0.0, 0.0, 1.0]
    yield (
        COLOR_INFO,
        T0,
        CameraCalibration(timestamp=stamp, frame_id=OPTICAL, width=WIDTH, height=HEIGHT, K=k),
    )
    for i in range(frames):
        at = T0 + i * PERIOD
        images = ((COLOR, "rgb8", color_pixels(i)), (ALIGNED, "16UC1", depth_pixels(i)))
        for topic, encoding, pixels in images:
            image = RawImage(
                timestamp=Timestamp(sec=at // 10**9, nsec=at % 10**9),
                frame_id=OPTICAL,
                width=WIDTH,
                height=HEIGHT,
                encoding=encoding,
                step=pixels[0].nbytes,
                data=pixels.tobytes(),
            )
            yield topic, at, image


def play(path: Path, **settings: Any) -> list[RgbdFrame]:
    return list(McapSource(path=path, **settings).frames())


def drain(source: McapSource) -> tuple[list[RgbdFrame], InputError | None]:
    """Return all frames a source delivers, and the error it ends with."""
    frames: list[RgbdFrame] = []
    try:
        frames.extend(source.frames())
    except InputError as error:
        return frames, error
    return frames, None
