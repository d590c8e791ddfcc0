"""Types to messages and back: Foxglove protobuf for images and calibration, JSON for tables.

A table becomes one JSON object with a column per field (NaN is null, floats are exact), described
by a JSON Schema in the file, so that any MCAP tool can read it.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, fields
from functools import cache
from typing import Any, NamedTuple

import numpy as np
import orjson

from mushpipe.core.arrays import Bytes
from mushpipe.core.columns import Columns
from mushpipe.core.geometry import Camera
from mushpipe.core.truth import BUILT_IN, Instances, stands_for
from mushpipe.core.types import Header, Mask, RgbdFrame

COLOR_TOPIC = "/camera/color/image_raw"
DEPTH_TOPIC = "/camera/aligned_depth_to_color/image_raw"
CAMERA_TOPIC = "/camera/color/camera_info"
RESULT_PREFIX = "/mushpipe/"
TIMING_TOPIC = "/mushpipe/timing"
BASE_TOPIC = "/mushpipe/T_base_camera"
TOTAL = "total"  # how the time of all stages together is called
NO_DEPTH = {"depth": "none"}  # metadata of the colour of a stage's frame without depth
# for viewers, made of the tables beside them and of the graph
DRAWINGS = ("foxglove.ImageAnnotations", "foxglove.SceneUpdate", "foxglove.FrameTransform")
# name here -> name in ROS and Foxglove
DISTORTION_MODELS = {
    "none": "",
    "brown_conrady": "plumb_bob",
    "inverse_brown_conrady": "inverse_brown_conrady",
    "rational": "rational_polynomial",
}
# how the schema of a table calls what NumPy calls by these kinds, and fields by these annotations
JSON_KINDS = {
    "f": ["number", "null"],
    "b": "boolean",
    "i": "integer",
    "u": "integer",
    "U": "string",
}
_PLAIN = {"str": "string", "bool": "boolean", "int": "integer", "float": ["number", "null"]}
TABLES = {f"mushpipe.{cls.__name__}": cls for cls in BUILT_IN}


@dataclass(frozen=True)
class Schema:
    """A message schema as MCAP wants it."""

    name: str
    encoding: str
    data: bytes
    message_encoding: str


class Message(NamedTuple):
    """An encoded value; ``suffix`` extends the topic where a value needs several messages."""

    suffix: str
    schema: Schema
    data: bytes
    metadata: Mapping[str, str] = {}


Encoder = Callable[[Any, Header], Iterator[Message]]


def encoder_of(kind: type) -> Encoder | None:
    """Return the encoder of a port type, or None where it has no wire form."""
    for known, encoder in _ENCODERS.items():
        if issubclass(kind, known):
            return encoder
    return None


@cache
def foxglove_schema(name: str) -> Schema:
    """Return the schema of a message of Foxglove's."""
    import foxglove.messages

    schema = getattr(foxglove.messages, name).get_schema()
    return Schema(schema.name, schema.encoding, schema.data, "protobuf")


def timestamp(stamp_ns: int) -> Any:
    """Return a foxglove.Timestamp."""
    from foxglove.messages import Timestamp

    return Timestamp(sec=stamp_ns // 10**9, nsec=stamp_ns % 10**9)


def encode_image(image: np.ndarray[Any, Any], encoding: str, header: Header) -> Message:
    """Encode an (H, W) or (H, W, C) array as foxglove.RawImage."""
    from foxglove.messages import RawImage

    message = RawImage(
        timestamp=timestamp(header.stamp_ns),
        frame_id=header.frame_id,
        width=image.shape[1],
        height=image.shape[0],
        encoding=encoding,
        step=image[0].nbytes,
        data=image.tobytes(),
    )
    return Message("", foxglove_schema("RawImage"), message.encode())


def encode_color(frame: RgbdFrame, jpeg_quality: int | None = None) -> Message:
    """Encode the colour image, lossless or as JPEG."""
    if jpeg_quality is None:
        return encode_image(frame.color, "rgb8", frame.header)
    from foxglove.messages import CompressedImage

    image = CompressedImage(
        timestamp=timestamp(frame.header.stamp_ns),
        frame_id=frame.header.frame_id,
        data=jpeg(frame.color, jpeg_quality),
        format="jpeg",
    )
    return Message("", foxglove_schema("CompressedImage"), image.encode())


def jpeg(color: Bytes, quality: int) -> bytes:
    """Return an (H, W, 3) RGB image as JPEG of a quality from 1 to 100."""
    import cv2

    bgr = cv2.cvtColor(color, cv2.COLOR_RGB2BGR)
    return cv2.imencode(".jpg", bgr, [cv2.IMWRITE_JPEG_QUALITY, quality])[1].tobytes()


def encode_depth(frame: RgbdFrame) -> Message:
    """Encode the depth image as the sensor gave it; its scale stands in the channel's metadata.

    ``16UC1`` means millimetres to every viewer, so other 16-bit scales are called ``mono16``.
    """
    if frame.depth is None:
        raise ValueError("the frame has no depth")
    if frame.depth.dtype == np.float32:
        encoding = "32FC1"
    else:  # RealSense states its scale in single precision
        millimetres = np.float32(frame.depth_scale) == np.float32(0.001)
        encoding = "16UC1" if millimetres else "mono16"
    metadata = {"depth_scale": repr(float(frame.depth_scale))}
    return encode_image(frame.depth, encoding, frame.header)._replace(metadata=metadata)


def encode_camera(camera: Camera | None, size: tuple[int, ...], header: Header) -> Message:
    """Encode the intrinsics as foxglove.CameraCalibration.

    Without any the matrices are zero, as in ROS, and so read as none again.

    Args:
        camera: The intrinsics.
        size: Height and width of the image, px.
        header: Of the frame.
    """
    from foxglove.messages import CameraCalibration

    k = [0.0] * 9
    if camera is not None:
        k = [camera.fx, 0.0, camera.cx, 0.0, camera.fy, camera.cy, 0.0, 0.0, 1.0]
    message = CameraCalibration(
        timestamp=timestamp(header.stamp_ns),
        frame_id=header.frame_id,
        width=size[1],
        height=size[0],
        distortion_model=DISTORTION_MODELS[camera.model] if camera else "",
        D=list(camera.coefficients) if camera else [],
        K=k,
        R=[k[8], 0.0, 0.0, 0.0, k[8], 0.0, 0.0, 0.0, k[8]],
        P=[*k[:3], 0.0, *k[3:6], 0.0, *k[6:], 0.0],
    )
    return Message("", foxglove_schema("CameraCalibration"), message.encode())


def _encode_frame(frame: RgbdFrame, _: Header) -> Iterator[Message]:
    yield encode_color(frame)._replace(suffix="/color")
    if frame.depth is not None:
        yield encode_depth(frame)._replace(suffix="/depth")


def _encode_mask(mask: Mask, header: Header) -> Iterator[Message]:
    for suffix, image in (("", mask.foreground), ("/initial", mask.initial)):
        if image is not None:
            pixels = image.view(np.uint8) * np.uint8(255)
            yield encode_image(pixels, "mono8", header)._replace(suffix=suffix)


def _encode_instances(instances: Instances, header: Header) -> Iterator[Message]:
    yield encode_image(instances.labels, "mono16", header)


def _encode_table(table: Columns, header: Header) -> Iterator[Message]:
    columns = {f.name: getattr(table, f.name) for f in fields(table)}  # type: ignore[arg-type]
    for name, value in columns.items():
        if isinstance(value, np.ndarray) and value.dtype.kind == "U":  # orjson knows numbers alone
            columns[name] = value.tolist()
    message = json_message(table_schema(type(table)), header, columns)
    yield message._replace(metadata=stands_for(type(table)))


_ENCODERS: dict[type, Encoder] = {
    Message: lambda message, _: iter((message,)),  # of a recording, passed on as it is
    RgbdFrame: _encode_frame,
    Mask: _encode_mask,
    Instances: _encode_instances,
    Columns: _encode_table,
}


def json_message(schema: Schema, header: Header, content: Mapping[str, Any]) -> Message:
    """Encode a JSON object with the frame's stamp, sequence and frame beside its content."""
    body = {
        "timestamp": {"sec": header.stamp_ns // 10**9, "nsec": header.stamp_ns % 10**9},
        "sequence": header.sequence,
        "frame_id": header.frame_id,
        **content,
    }
    return Message("", schema, orjson.dumps(body, option=orjson.OPT_SERIALIZE_NUMPY))


def json_schema(name: str, properties: Mapping[str, Any], title: str = "") -> Schema:
    """Describe a message made by `json_message`."""
    whole = {"type": "integer"}
    document = {
        "title": title or name,
        "type": "object",
        "properties": {
            "timestamp": {"type": "object", "properties": {"sec": whole, "nsec": whole}},
            "sequence": whole,
            "frame_id": {"type": "string"},
            **properties,
        },
    }
    return Schema(name, "jsonschema", orjson.dumps(document), "json")


def table_schema(table: type[Columns]) -> Schema:
    """Return the schema of a table type, derived from its fields."""
    properties: dict[str, Any] = {}
    for item in fields(table):  # type: ignore[arg-type]
        if "shape" not in item.metadata:
            plain = _PLAIN.get(str(getattr(item.type, "__name__", item.type)))
            properties[item.name] = {"type": plain} if plain else {}  # else anything
            continue
        entry: dict[str, Any] = {"type": JSON_KINDS[np.dtype(item.metadata["dtype"]).kind]}
        for length in reversed(item.metadata["shape"]):
            entry = {"type": "array", "items": entry, "minItems": length, "maxItems": length}
        properties[item.name] = {"type": "array", "items": entry}
    return json_schema(f"mushpipe.{table.__name__}", properties)


TIMING = json_schema(
    "mushpipe.Timing",
    {"stages_ns": {"type": "object", "additionalProperties": {"type": "integer"}}},
    "wall time of each stage; differs from run to run",
)


@dataclass(frozen=True, eq=False)
class Decoded:
    """A table read back, with the header of its frame."""

    header: Header
    table: Columns


def decode_table(schema_name: str, data: bytes, log_time: int = 0) -> Decoded | None:
    """Read a table back; None where the schema is not one of ours.

    Raises:
        ValueError, KeyError, TypeError: The message does not fit its type.
    """
    cls = TABLES.get(schema_name)
    if cls is None:
        return None
    body = orjson.loads(data)
    stamp = body["timestamp"]["sec"] * 10**9 + body["timestamp"]["nsec"]
    header = Header(stamp, body["sequence"], body["frame_id"], log_time)
    values: dict[str, Any] = {}
    for item in fields(cls):
        value = body[item.name]
        if "shape" in item.metadata:
            try:
                value = np.array(value, dtype=item.metadata["dtype"])
            except OverflowError as error:
                raise ValueError(f"{item.name}: {error}") from error
            value = value.reshape(-1, *item.metadata["shape"])
        values[item.name] = value
    return Decoded(header, cls(**values))
