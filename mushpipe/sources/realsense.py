"""Source `realsense`: a live Intel RealSense camera, or a recording of its viewer (`.bag`)."""

from __future__ import annotations

import logging
import threading
import time
from collections import Counter
from collections.abc import Iterator
from pathlib import Path
from typing import Any, Literal

from pydantic import Field, PrivateAttr

from mushpipe.core.errors import DeviceError, UsageError
from mushpipe.core.libraries import import_realsense
from mushpipe.core.paths import GraphPath
from mushpipe.core.stage import ReplaySource
from mushpipe.core.types import RgbdFrame
from mushpipe.sources import realsense_device as device
from mushpipe.sources.realsense_frames import FrameMaker
from mushpipe.sources.realsense_link import (
    POLL_MS,
    CameraLink,
    CameraLostError,
    FileLink,
    Link,
    Request,
)

logger = logging.getLogger("mushpipe")
UNPLAYED = "colour images of the recording that were not played"
TIMES_LOST = "times the camera was lost"
_SIZE = r"^[1-9]\d{1,3}x[1-9]\d{1,3}$"
# The names of librealsense's options for the depth sensor of an SR300.
_OPTIONS = ("laser_power", "accuracy", "motion_range", "filter_option", "confidence_threshold")


class RealsenseSource(ReplaySource):
    """Frames of a RealSense SR300, SR305 or D400 camera, with depth aligned to colour.

    Scale and calibration are read from the camera. Live, only the newest frame waits: what the
    graph is too slow for is dropped and counted. A camera that is unplugged is reported at once
    and taken up again when it comes back. With `file` it plays a RealSense `.bag` instead,
    without losing a frame.
    """

    file: GraphPath | None = Field(None, description="a `.bag` recording to play; none is live")
    serial: str | int | None = Field(None, description="serial number, where several are connected")
    color: str = Field("640x480", pattern=_SIZE, description="size of the colour images, px")
    depth: str | None = Field(
        "640x480", pattern=_SIZE, description="size of the depth images, px; null is without depth"
    )
    fps: int = Field(30, ge=1, le=300, description="frames per second")
    preset: str | int | None = Field(
        None, description="visual preset by the camera's name for it, short-range say, or number"
    )
    laser_power: float | None = Field(
        None, ge=0, description="SR300: power of its projector, 0 (off) to 16"
    )
    accuracy: int | None = Field(
        None, ge=0, description="SR300: 0 to 3; more patterns per image are finer and slower"
    )
    motion_range: int | None = Field(
        None, ge=0, description="SR300: 0 to 220; low for motion, high for range (slower)"
    )
    filter_option: int | None = Field(
        None, ge=0, description="SR300: 0 to 7, the filter inside of the camera"
    )
    confidence_threshold: int | None = Field(
        None, ge=0, description="SR300: 0 to 15; less sure depth becomes missing"
    )
    depth_options: dict[str, float] = Field(
        default_factory=dict, description="other options of the depth sensor, by librealsense name"
    )
    color_options: dict[str, float] = Field(
        default_factory=dict, description="options of the colour sensor, {exposure: 300} say"
    )
    filters: tuple[Literal["spatial", "temporal", "hole-filling"], ...] = Field(
        (), description="librealsense's filters for depth, in this order, before alignment"
    )
    warm_up: int = Field(
        30, ge=0, le=3000, description="live frames thrown away at first, while exposure settles"
    )
    patience_s: float = Field(
        5.0, ge=1, le=600, description="a camera that is silent for longer counts as lost, s"
    )
    reconnect_s: float = Field(
        60.0, ge=0, le=1e9, description="how long to wait for a lost camera to come back, s"
    )

    _link: Link | None = PrivateAttr(None)
    _serial: str | None = PrivateAttr(None)
    _counts: Counter[str] = PrivateAttr(default_factory=Counter)
    _interrupted: threading.Event = PrivateAttr(default_factory=threading.Event)
    _waited_s: float | None = PrivateAttr(None)  # for a lost camera, until it sends a frame
    _quiet_s: float = PrivateAttr(0.0)

    @property
    def live(self) -> bool:
        """Whether it is a camera; a recording waits for the graph."""
        return self.file is None

    def name(self) -> str:
        """Return the recording's file name without its suffix, or ``realsense``."""
        return self.file.stem if self.file else "realsense"

    def files(self) -> tuple[Path, ...]:
        """Return the recording, if there is one."""
        return (self.file,) if self.file else ()

    def open(self) -> None:
        """Find the camera, set it up and start it; or open the recording.

        Raises:
            DeviceError: No camera, or it does not do what is asked of it.
            UsageError: No such file, or a setting this camera does not have.
            InputError: The file is no RealSense recording.
        """
        self._serial = None if self.serial is None else str(self.serial)
        if self.live and self.speed:
            raise UsageError("source.speed is for recordings; a camera has its own pace")
        self._link = self._connect()
        identity = device.info(self._link.profile.get_device())
        if identity.get("usb_type_descriptor", "").startswith("2"):
            logger.warning("the camera is on USB 2: use a USB 3 port and cable")
        if "hole-filling" in self.filters:
            logger.warning(
                "source.filters: hole-filling invents depth, which counts as measured; with robots "
                "leave it out"
            )

    def describe(self) -> dict[str, Any]:
        """Return identity, streams, calibration and options, as the camera tells them."""
        return device.describe(self._link.profile) if self._link else {}

    def counts(self) -> dict[str, int]:
        """Return what was lost before it came here, and how often the camera was away."""
        return {name: count for name, count in sorted(self._counts.items()) if count}

    def interrupt(self) -> None:
        """Stop waiting for the camera."""
        self._interrupted.set()

    def close(self) -> None:
        """Stop the camera."""
        self.interrupt()
        if self._link is not None:
            self._link.stop()
            self._link = None

    def frames(self) -> Iterator[RgbdFrame]:
        """Yield frames until the recording ends, or for ever.

        Raises:
            DeviceError: The camera was lost and did not come back in time.
            InputError: The recording has no colour images, or is damaged.
        """
        if self._link is None:
            self.open()
        link = self._link
        maker = FrameMaker(self.filters, self.warm_up, self._counts)
        while link is not None:
            self._quiet_s = 0.0
            try:
                _begin(maker, link)
                yield from self._played(link, maker)
                return
            except CameraLostError as lost:
                why = str(lost)
            finally:
                link.stop()
            link = self._link = self._reconnect(why)

    def _played(self, link: Link, maker: FrameMaker) -> Iterator[RgbdFrame]:
        """Yield frames until the link ends; a camera that sends no whole frameset is silent."""
        whole = maker.whole
        while not self._interrupted.is_set():
            begin = time.monotonic()
            frames = link.wait()
            if frames is None and link.ended():
                self._counts[UNPLAYED] += link.unplayed()
                return
            frame = maker.make(frames, time.time_ns()) if frames is not None else None
            if maker.whole > whole or not (frames is None or link.live):
                self._quiet_s, whole = 0.0, maker.whole
                self._is_back()
            else:
                self._quiet_s += POLL_MS / 1000 if frames is None else time.monotonic() - begin
                if frames is None or self._quiet_s >= self.patience_s:
                    link.check(self._quiet_s, self.patience_s)
            if frame is not None:
                yield frame

    def _is_back(self) -> None:
        if self._waited_s is not None:
            self._waited_s = None
            logger.warning("the camera is back")

    def _reconnect(self, why: str) -> Link | None:
        """Wait for a lost camera, ever longer between two looks; None when interrupted.

        One that is found and stays silent was not back: the time goes on.
        """
        if self._waited_s is None:
            self._waited_s = 0.0
            self._counts[TIMES_LOST] += 1
            logger.warning(
                "the camera was lost: %s; waiting for it up to %g s", why, self.reconnect_s
            )
        else:
            self._waited_s += self._quiet_s
        pause_s = 0.5
        while self._waited_s < self.reconnect_s:
            if self._pause(pause_s):
                return None
            self._waited_s += pause_s
            pause_s = min(2 * pause_s, 5.0)
            try:
                return self._connect()
            except DeviceError as error:
                logger.debug("%s", error)
        raise DeviceError(
            f"the camera was lost ({why}) and did not come back within {self.reconnect_s:g} s"
        )

    def _connect(self) -> Link:
        """Open and start the recording, or the camera with its settings."""
        try:
            link = self._open_file(self.file) if self.file else self._open_camera()
            link.start()
        except RuntimeError as error:  # a camera that goes while it is set up, for instance
            raise DeviceError(f"librealsense says: {error}") from error
        return link

    def _open_file(self, path: Path) -> FileLink:
        if not path.is_file():
            raise UsageError(f"{path}: there is no such recording")
        ignored = [
            name for name in ("preset", "serial", *_OPTIONS) if getattr(self, name) is not None
        ]
        if ignored:
            logger.warning("of no effect on a recording: %s", ", ".join(ignored))
        return FileLink(self._context(), path)

    def _open_camera(self) -> CameraLink:
        depth = _size(self.depth) if self.depth else None
        link = CameraLink(
            self._context(), Request(_size(self.color), depth, self.fps, self._serial)
        )
        self._serial = link.serial
        camera = link.profile.get_device()
        if depth:
            sensor = camera.first_depth_sensor()
            if self.preset is not None:
                device.set_preset(sensor, self.preset)
            given = {name: getattr(self, name) for name in _OPTIONS}
            device.set_options(sensor, {k: v for k, v in given.items() if v is not None})
            device.set_options(sensor, self.depth_options, "source.depth_options")
        if self.color_options:
            sensor = camera.first_color_sensor()
            device.set_options(sensor, self.color_options, "source.color_options")
        return link

    def _context(self) -> Any:
        """Return librealsense's view of the connected cameras; tests put a simulated one here."""
        return import_realsense().context()

    def _pause(self, seconds: float) -> bool:
        """Wait between two attempts; return whether to give up."""
        return self._interrupted.wait(seconds)


def _begin(maker: FrameMaker, link: Link) -> None:
    """Begin with a link; a camera may go while it is asked for its calibration."""
    try:
        maker.begin(link)
    except RuntimeError as error:
        if not link.live:
            raise
        raise CameraLostError(f"librealsense says: {error}") from error


def _size(text: str) -> tuple[int, int]:
    width, height = text.split("x")
    return int(width), int(height)
