"""Framesets of librealsense to frames of mushpipe: aligned, copied, numbered and stamped."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass
from enum import IntEnum
from types import SimpleNamespace
from typing import Any

import numpy as np
import orjson
from numpy.typing import NDArray

from mushpipe.core.arrays import Bytes, Floats, Ints, Singles
from mushpipe.core.columns import Columns, column
from mushpipe.core.errors import InputError
from mushpipe.core.geometry import Camera
from mushpipe.core.libraries import import_realsense
from mushpipe.core.types import COLOR_FRAME, Header, RgbdFrame, end_of_scale
from mushpipe.core.wire import Message
from mushpipe.sources.images import decode_color
from mushpipe.sources.realsense_device import camera_of
from mushpipe.sources.realsense_link import Link

CLOCK_TOPIC = "/camera/clock"
LOST = "frames lost between the sensor and this program"
UNPAIRED = "colour or depth images without a partner"
AWAY = "ms without the camera"
# librealsense's formats, as ROS calls them
_ENCODINGS = {
    **{name: name for name in ("rgb8", "bgr8", "rgba8", "bgra8", "uyvy")},
    "yuyv": "yuv422_yuy2",
    "y8": "mono8",
}


class Domain(IntEnum):
    """Which clock a sensor's time stamp is from."""

    HARDWARE = 0
    SYSTEM = 1
    GLOBAL = 2


@dataclass(frozen=True, eq=False)
class Clock(Columns):
    """What the sensor itself says of a frame: row 0 is colour, row 1 depth where there is depth.

    Attributes:
        number: (N,) the sensor's own frame number.
        time_ms: (N,) its time stamp as it gave it, ms on the clock `domain`.
        domain: (N,) `Domain`: the camera's own clock (its zero is arbitrary), the host's clock,
            or the camera's clock translated to the host's by librealsense.
    """

    number: Ints = column(dtype=np.int64)
    time_ms: Floats = column()
    domain: Bytes = column(dtype=np.uint8)


def clock_of(frame: RgbdFrame) -> Clock | None:
    """Return what the sensor said of a frame, of a camera here or at the other end of a stream."""
    clock = frame.attached.get(CLOCK_TOPIC)
    if isinstance(clock, Message) and clock.schema.name == f"mushpipe.{Clock.__name__}":
        with suppress(ValueError, KeyError, TypeError):  # whatever was sent
            columns = orjson.loads(clock.data)
            clock = Clock(columns["number"], columns["time_ms"], columns["domain"])
    known = isinstance(clock, Clock) and len(clock) > 0 and np.isfinite(clock.time_ms).all()
    return clock if known else None


class FrameMaker:
    """Makes frames out of framesets; numbers go on where a lost camera comes back."""

    def __init__(self, filters: Sequence[str], warm_up: int, counts: Counter[str]) -> None:
        rs = import_realsense()
        makers = {
            "spatial": rs.spatial_filter,
            "temporal": rs.temporal_filter,
            "hole-filling": rs.hole_filling_filter,
        }
        self._makers = [makers[name] for name in filters]
        self._align = rs.align(rs.stream.color)
        self._warm_up = warm_up
        self._counts = counts
        self._sequence = -1
        self._last_arrival_ns = 0
        self.whole = 0  # framesets so far that had all of their images

    def begin(self, link: Link) -> None:
        """Take scale and calibration from a link that was just started.

        Raises:
            InputError: It has no colour images.
            DeviceError: Its lens model is not supported.
        """
        streams = {stream.stream_type().name: stream for stream in link.profile.get_streams()}
        if "color" not in streams:
            raise InputError("the recording has no colour images")
        intrinsics = streams["color"].as_video_stream_profile().get_intrinsics()
        self._camera = camera_of(intrinsics)
        self._has_depth = "depth" in streams
        self._scale = 0.001
        if self._has_depth:
            self._scale = link.profile.get_device().first_depth_sensor().get_depth_scale()
            self._gain, self._shift = _along_color_axis(streams, self._camera, self._scale)
            self._place = _without_lens(self._camera)
        self._filters = [make() for make in self._makers]  # they remember what was there before
        self._live = link.live
        self._to_skip = self._warm_up if link.live else 0
        self._numbers: dict[str, int] = {}
        self._base: int | None = None
        self._offset_ns: int | None = None
        self._resumed = self._last_arrival_ns > 0

    def make(self, frames: Any, arrival_ns: int) -> RgbdFrame | None:
        """Turn a frameset into a frame; None where a partner is missing, and in the warm-up.

        Args:
            frames: Colour and depth of one moment; nothing of it is kept.
            arrival_ns: When it arrived at the host, ns since the epoch; not used of a recording.
        """
        images = {"color": frames.get_color_frame()}
        if self._has_depth:
            images["depth"] = frames.get_depth_frame()
        arrived = {kind: image for kind, image in images.items() if image}
        fresh = self._note(arrived)
        # librealsense pairs an image without a partner with the last one of the other sensor.
        if len(arrived) < len(images) or not fresh:
            self._counts[UNPAIRED] += 1
            return None
        self.whole += 1
        if self._to_skip:
            self._to_skip -= 1
            return None
        native = self._aligned_depth(frames) if self._has_depth else None
        header = self._header(images["color"], arrival_ns)
        attached = {CLOCK_TOPIC: _clock(list(images.values()))}
        color = _color(images["color"])
        return RgbdFrame(header, color, native, self._scale, self._camera, attached)

    def _note(self, images: dict[str, Any]) -> bool:
        """Remember frame numbers and count gaps; return whether every image is a new one."""
        fresh = True
        for kind, image in images.items():
            number, last = image.get_frame_number(), self._numbers.get(kind)
            if kind == "color" and last is not None:
                self._counts[LOST] += max(0, number - last - 1)
            fresh &= number != last
            self._numbers[kind] = number
        return fresh

    def _aligned_depth(self, frames: Any) -> NDArray[np.uint16]:
        for block in self._filters:
            frames = block.process(frames).as_frameset()
        # A copy: librealsense stops delivering when its buffers are held.
        depth = np.array(self._align.process(frames).get_depth_frame().get_data(), np.uint16)
        if self._place is not None:
            depth = np.append(depth, np.uint16(0))[self._place]
        if self._gain is None:
            return depth
        end = end_of_scale(depth)
        moved = np.clip(np.rint((depth + self._shift) * self._gain), 0, end)
        return np.where((depth > 0) & (depth < end), moved, 0).astype(np.uint16)

    def _header(self, color: Any, arrival_ns: int) -> Header:
        whole_ms, rest_ms = divmod(color.get_timestamp(), 1)
        stamp_ns = int(whole_ms) * 10**6 + round(rest_ms * 1e6)
        if not self._live:
            arrival_ns = _recorded_arrival_ns(color) or stamp_ns
        if _domain(color) is Domain.HARDWARE:
            # The zero of this clock is arbitrary: its first time is put where it arrived, and
            # from there on the sensor's own intervals count.
            if self._offset_ns is None:
                self._offset_ns = arrival_ns - stamp_ns
            stamp_ns += self._offset_ns
        if self._resumed:
            self._counts[AWAY] += max(0, arrival_ns - self._last_arrival_ns) // 10**6
            self._resumed = False
        self._last_arrival_ns = arrival_ns
        return Header(stamp_ns, self._number(color), COLOR_FRAME, arrival_ns)

    def _number(self, color: Any) -> int:
        """Return the frame's number: the sensor's own, but from 0 and never going back."""
        number = color.get_frame_number()
        if self._base is None or number - self._base <= self._sequence:
            self._base = number - self._sequence - 1
        self._sequence = number - self._base
        return self._sequence


def _along_color_axis(
    streams: dict[str, Any], camera: Camera, scale: float
) -> tuple[Singles | None, np.float32]:
    """Return (H, W) gain and shift: (depth + shift) * gain is z of the colour camera, in units.

    No gain where the two cameras look the same way from the same distance.

    librealsense moves a depth value to the pixel it belongs to and leaves its value alone: the
    distance along the axis of the depth camera, which is turned and shifted against the colour
    camera. Of a point p = R q + t, the depth camera measures q_z = r3 . (p - t) with r3 the last
    column of R; on the ray (x, y, 1) of a pixel, p_z = (q_z + r3 . t) / (r3 . (x, y, 1)).
    """
    pose = streams["depth"].get_extrinsics_to(streams["color"])
    r3, t = np.array(pose.rotation[6:]), np.array(pose.translation)  # stored column by column
    if np.array_equal(r3, (0, 0, 1)) and t[2] == 0:
        return None, np.float32(0)
    pixels = np.stack(np.meshgrid(np.arange(camera.width), np.arange(camera.height)), axis=-1)
    rays = camera.deproject(pixels.astype(float), np.ones(pixels.shape[:2]))
    return (1 / (rays @ r3)).astype(np.float32), np.float32(r3 @ t / scale)


def _without_lens(camera: Camera) -> Ints | None:
    """Return (H, W) the places in aligned depth, counted row by row, whose rays pixels have.

    librealsense aligns depth as if the colour camera had no lens, whatever its coefficients. A
    pixel with a ray beyond that image has the place behind the last. None without a lens.
    """
    if camera.model == "none":
        return None
    pixels = np.stack(np.meshgrid(np.arange(camera.width), np.arange(camera.height)), axis=-1)
    rays = camera.deproject(pixels.astype(float), np.ones(pixels.shape[:2]))
    u = np.rint(rays[..., 0] * camera.fx + camera.cx)
    v = np.rint(rays[..., 1] * camera.fy + camera.cy)
    inside = (u >= 0) & (u < camera.width) & (v >= 0) & (v < camera.height)
    beyond = camera.width * camera.height
    return np.where(inside, v * camera.width + u, beyond).astype(np.int64)


def _recorded_arrival_ns(frame: Any) -> int:
    key = import_realsense().frame_metadata_value.time_of_arrival
    known = frame.supports_frame_metadata(key)
    return int(frame.get_frame_metadata(key)) * 10**6 if known else 0


def _domain(frame: Any) -> Domain:
    name = frame.get_frame_timestamp_domain().name
    return {"hardware_clock": Domain.HARDWARE, "system_time": Domain.SYSTEM}.get(
        name, Domain.GLOBAL
    )


def _clock(images: list[Any]) -> Clock:
    return Clock(
        np.array([image.get_frame_number() for image in images]),
        np.array([image.get_timestamp() for image in images]),
        np.array([_domain(image) for image in images]),
    )


def _color(frame: Any) -> Bytes:
    """Return a copy of a colour frame as (H, W, 3) RGB."""
    name = frame.get_profile().format().name
    encoding = _ENCODINGS.get(name)
    if encoding is None:
        raise InputError(f"colour images of format '{name}' are not supported")
    data = np.array(frame.get_data())
    return decode_color(
        SimpleNamespace(
            encoding=encoding,
            width=frame.get_width(),
            height=frame.get_height(),
            step=data[0].nbytes,
            data=data,
        )
    )
