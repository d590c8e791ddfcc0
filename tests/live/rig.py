"""A RealSense camera without hardware: librealsense's own software device.

All that is simulated are the photons. Pipeline, synchronisation, alignment, recorder and player are
librealsense's; the code under test is the product's. Tests that need one are skipped beside
newer ones, which do not list it.
"""

from __future__ import annotations

import ctypes
import threading
from collections.abc import Callable, Iterator
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from mushpipe import Camera, RgbdFrame
from mushpipe.core.libraries import import_realsense
from mushpipe.sources.realsense import RealsenseSource
from tests.core.lab import PATIENCE_S

rs, SDK = import_realsense(), version("pyrealsense2")
UNITS = 0.000125
SERIAL = "617203001234"
COLOR = Camera(160, 120, 154.0, 154.5, 80.2, 59.7)
# The lens of an SR300's depth camera: one unit's values, scaled.
DEPTH = Camera(
    *(160, 120, 118.2, 118.4, 77.5, 61.3),
    "inverse_brown_conrady",
    (0.098, 0.203, 0.003, 0.003, -0.112),
)
HARDWARE, SYSTEM = rs.timestamp_domain.hardware_clock, rs.timestamp_domain.system_time


class Context(rs.context):
    """Real librealsense, with a cable that can be pulled."""

    plugged = True

    def query_devices(self, *mask: Any) -> Any:
        return super().query_devices(*mask) if self.plugged else []


class Rig:
    """A software device with a depth and a colour sensor, fed frame by frame.

    Args:
        color: Intrinsics of the colour camera; depth has those given by ``depth``.
        color_format: Name of the colour images' pixel format.
        options: Settable options of the depth sensor, name -> (lowest, highest, default).
        shift: Translation depth -> colour in metres.
        turn: Rotation vector depth -> colour in radians.
    """

    def __init__(
        self,
        color: Camera = COLOR,
        depth: Camera | None = DEPTH,
        color_format: str = "rgb8",
        options: dict[str, tuple[float, float, float]] | None = None,
        shift: tuple[float, float, float] = (0.025, 0.0, 0.0),
        turn: tuple[float, float, float] = (0.0, 0.0, 0.0),
        serial: str = SERIAL,
    ) -> None:
        if not SDK.startswith("2.54"):  # realsenseai/librealsense issue 13819
            pytest.skip("librealsense 2.55 and later do not list software devices")
        self.color, self.depth = color, depth
        self.bytes_per_pixel = {"rgb8": 3, "bgr8": 3, "rgba8": 4, "yuyv": 2, "y8": 1}[color_format]
        self.device = rs.software_device()
        self.device.register_info(rs.camera_info.name, "Simulated SR300")
        self.device.register_info(rs.camera_info.serial_number, serial)
        self.sensors: dict[str, tuple[Any, Any]] = {}
        if depth:
            self._add("depth", depth, 2, rs.format.z16)
            sensor, profile = self.sensors["depth"]
            sensor.add_read_only_option(rs.option.depth_units, UNITS)
            for name, limits in (options or {}).items():
                sensor.add_option(getattr(rs.option, name), _range(*limits), True)
        self._add("color", color, self.bytes_per_pixel, getattr(rs.format, color_format))
        if depth:
            profile.register_extrinsics_to(self.sensors["color"][1], _pose(shift, turn))
        self.device.create_matcher(rs.matchers.dlr_c)
        self.context = Context()
        self.device.add_to(self.context)
        self.starts = 0
        self.started, self.taken = threading.Semaphore(0), threading.Semaphore(0)
        self.pauses: list[float] = []
        self.on_start: Callable[[], object] = lambda: None
        self.on_pause: Callable[[], object] = lambda: None

    def _add(self, kind: str, camera: Camera, size: int, pixel_format: Any) -> None:
        stream = rs.video_stream()
        stream.type, stream.index, stream.uid = getattr(rs.stream, kind), 0, len(self.sensors)
        stream.width, stream.height, stream.fps = camera.width, camera.height, 30
        stream.bpp, stream.fmt, stream.intrinsics = size, pixel_format, _intrinsics(camera)
        sensor = self.device.add_sensor(kind.capitalize())
        self.sensors[kind] = (sensor, sensor.add_video_stream(stream).as_video_stream_profile())

    def images(self, number: int) -> dict[str, Any]:
        """Return colour and depth whose every pixel tells the number of the frame."""
        shape = (self.color.height, self.color.width, self.bytes_per_pixel)
        images = {"color": np.full(shape, number % 251, np.uint8)}
        if self.depth:
            shape = (self.depth.height, self.depth.width)
            images["depth"] = np.full(shape, 4000 + number, np.uint16)
        return images

    def feed(
        self,
        number: int,
        images: dict[str, Any] | None = None,
        time_ms: float | None = None,
        domain: Any = HARDWARE,
    ) -> None:
        """Let the camera take a picture; what ``images`` lacks, it did not see."""
        for kind, image in (self.images(number) if images is None else images).items():
            sensor, profile = self.sensors[kind]
            frame = rs.software_video_frame()
            frame.pixels = np.ascontiguousarray(image)
            frame.bpp = image[0].nbytes // image.shape[1]
            frame.stride = image[0].nbytes
            frame.timestamp = 5000 + number * 1000 / 30 if time_ms is None else time_ms
            frame.domain, frame.frame_number, frame.profile = domain, number, profile
            if kind == "depth":
                _set_units(frame)
            sensor.on_video_frame(frame)

    def source(self, **settings: Any) -> RealsenseSource:
        """Return the product's source, looking at this camera."""
        return self.source_class().model_validate(self.settings() | settings)

    def settings(self) -> dict[str, Any]:
        return {
            "color": f"{self.color.width}x{self.color.height}",
            "depth": self.depth and f"{self.depth.width}x{self.depth.height}",
            "warm_up": 0,
        }

    def source_class(self) -> type[RealsenseSource]:
        rig = self

        class RigSource(RealsenseSource):
            """The product's source; it only waits without waiting, and tells how far it is."""

            def _context(self) -> Any:
                return rig.context

            def _pause(self, seconds: float) -> bool:
                rig.pauses.append(seconds)
                rig.on_pause()
                return self._interrupted.is_set()

            def _connect(self) -> Any:
                link = super()._connect()
                rig.starts += 1
                rig.started.release()
                rig.on_start()
                return link

            def frames(self) -> Iterator[RgbdFrame]:
                for frame in super().frames():
                    try:
                        yield frame
                    finally:
                        rig.taken.release()

        return RigSource

    def record(self, path: Path, frames: list[dict[str, Any]], domain: Any = SYSTEM) -> None:
        """Write a `.bag` with librealsense's own recorder."""
        config = rs.config()
        for kind in self.sensors:
            config.enable_stream(getattr(rs.stream, kind))
        config.enable_record_to_file(str(path))
        pipeline, queue = rs.pipeline(self.context), rs.frame_queue(4)
        pipeline.start(config, queue)
        for number, images in enumerate(frames):
            time_ms = 1.7e12 + number * 1000 / 30
            self.feed(number, images, time_ms, domain)
            queue.wait_for_frame(PATIENCE_S * 1000)
        pipeline.stop()


def acquire(semaphore: threading.Semaphore) -> None:
    """Wait for another thread, but not for ever."""
    if not semaphore.acquire(timeout=PATIENCE_S):
        raise TimeoutError("another thread of the test never came so far")


def _range(lowest: float, highest: float, default: float) -> Any:
    limits = rs.option_range()
    limits.min, limits.max, limits.step, limits.default = lowest, highest, 1, default
    return limits


def _intrinsics(camera: Camera) -> Any:
    result = rs.intrinsics()
    result.width, result.height = camera.width, camera.height
    result.fx, result.fy, result.ppx, result.ppy = camera.fx, camera.fy, camera.cx, camera.cy
    result.model = getattr(rs.distortion, camera.model)
    result.coeffs = list(camera.coefficients or (0.0,) * 5)
    return result


def _pose(shift: tuple[float, ...], turn: tuple[float, ...]) -> Any:
    result = rs.extrinsics()
    rotation = Rotation.from_rotvec(turn).as_matrix()
    result.rotation, result.translation = rotation.T.ravel().tolist(), list(shift)
    return result


def _set_units(frame: Any) -> None:
    """Give a software frame its depth unit, for which 2.54 has no Python name.

    A real camera sets it in its driver; without it librealsense aligns to an empty image.
    """
    struct = ctypes.c_void_p.from_address(id(frame) + 16).value
    assert struct is not None
    ctypes.c_float.from_address(struct + 48).value = UNITS
