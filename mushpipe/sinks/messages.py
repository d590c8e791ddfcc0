"""A trace as messages: what the sinks `mcap` and `foxglove` write, topic by topic."""

from __future__ import annotations

import logging
from collections.abc import Iterator
from typing import Any

from mushpipe import Header, RgbdFrame, Trace
from mushpipe.core import wire
from mushpipe.core.scene import drawings
from mushpipe.core.transform import Transform

logger = logging.getLogger("mushpipe")
Published = tuple[str, wire.Message]


def result_messages(
    trace: Trace, unknown: set[type], drawn: bool, images: bool = True
) -> Iterator[Published]:
    """Yield topic and message of every stage's output, in graph order.

    Args:
        trace: The frame.
        unknown: Types without a wire form, filled here; each is warned of once.
        drawn: Whether circles and picks come with their drawings for viewers as well.
        images: Whether colour and depth that a stage made are among them.
    """
    last = trace.frame
    for stage in trace.durations_ns:
        values = trace.outputs[stage]
        for value in values:
            encoder = wire.encoder_of(type(value))
            if encoder is None:
                _warn(stage, value, unknown)
                continue
            # Several outputs of one stage need several topics; the first keeps the stage's own.
            own = "" if value is values[0] else f"/{type(value).__name__.lower()}"
            topic = f"{wire.RESULT_PREFIX}{stage}{own}"
            if isinstance(value, RgbdFrame):
                messages = _made(value, last) if images else iter(())
                last = value
            else:
                messages = encoder(value, trace.frame.header)
            for message in messages:
                yield topic + message.suffix, message
            for message in drawings(value, trace.frame.header) if drawn else ():
                yield topic + message.suffix, message


def _made(frame: RgbdFrame, last: RgbdFrame) -> Iterator[wire.Message]:
    """Yield the images of a frame that the one before it in the graph does not have.

    Who reads them carries the others on; colour says where there is no depth to carry on.
    """
    flat = frame.depth is None
    if frame.color is not last.color or (flat and last.depth is not None):
        metadata = wire.NO_DEPTH if flat else {}
        yield wire.encode_color(frame)._replace(suffix="/color", metadata=metadata)
    changed = frame.depth is not last.depth or frame.depth_scale != last.depth_scale
    if changed and not flat:
        yield wire.encode_depth(frame)._replace(suffix="/depth")


def base_message(T_base_camera: Transform, header: Header) -> Published:  # noqa: N803
    """Return where the camera is in the robot's frame, so that viewers can show both together."""
    from foxglove.messages import FrameTransform, Quaternion, Vector3

    (x, y, z), q = T_base_camera.translation, T_base_camera.quaternion
    data = FrameTransform(
        timestamp=wire.timestamp(header.stamp_ns),
        parent_frame_id=T_base_camera.frame,
        child_frame_id=header.frame_id,
        translation=Vector3(x=x, y=y, z=z),
        rotation=Quaternion(x=q[0], y=q[1], z=q[2], w=q[3]),
    ).encode()
    return wire.BASE_TOPIC, wire.Message("", wire.foxglove_schema("FrameTransform"), data)


def timing_message(trace: Trace) -> Published:
    """Return the message with the time each stage took."""
    content = {"stages_ns": dict(trace.durations_ns)}
    return wire.TIMING_TOPIC, wire.json_message(wire.TIMING, trace.frame.header, content)


def _warn(stage: str, value: Any, unknown: set[type]) -> None:
    if type(value) not in unknown:
        unknown.add(type(value))
        name = type(value).__name__
        logger.warning("%s is not recorded: %s is not a Columns type", stage, name)
