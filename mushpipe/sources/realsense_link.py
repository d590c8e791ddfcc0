"""A started librealsense pipeline: a camera or a recording, until it ends or is lost."""

from __future__ import annotations

from contextlib import suppress
from pathlib import Path
from typing import Any, NamedTuple

from mushpipe.core.errors import DeviceError, InputError
from mushpipe.core.libraries import import_realsense
from mushpipe.core.recording import CONVERT
from mushpipe.sources.realsense_bag import count_color_images
from mushpipe.sources.realsense_device import find_device, info

POLL_MS = 250
# Framesets that may wait inside librealsense while one is aligned and copied.
_QUEUE = 4
# So many images at the two ends of a good recording may find no partner.
_PARTNERLESS = 4


class CameraLostError(Exception):
    """The camera was unplugged, or is there and sends nothing."""


class Request(NamedTuple):
    """What is asked of a camera: sizes in px, ``depth`` None for colour only."""

    color: tuple[int, int]
    depth: tuple[int, int] | None
    fps: int
    serial: str | None


class CameraLink:
    """A camera, set up in `__init__` and started by `start`.

    Raises:
        DeviceError: No camera, not that one, or not these streams.
    """

    live = True

    def __init__(self, context: Any, request: Request) -> None:
        rs = import_realsense()
        device = find_device(context, request.serial)
        self.serial = info(device).get("serial_number")
        self._context = context
        self._pipeline = rs.pipeline(context)
        self._queue = rs.frame_queue(_QUEUE)
        self._config = rs.config()
        if len(context.query_devices()) > 1 and self.serial:
            self._config.enable_device(self.serial)
        rate = request.fps
        self._config.enable_stream(rs.stream.color, *request.color, rs.format.rgb8, rate)
        if request.depth:
            self._config.enable_stream(rs.stream.depth, *request.depth, rs.format.z16, rate)
        wrapper = rs.pipeline_wrapper(self._pipeline)
        # Asked first, because `start` takes 15 s to say the same.
        if not self._config.can_resolve(wrapper):
            raise DeviceError(_unsupported(device, request))
        self.profile = self._config.resolve(wrapper)

    def start(self) -> None:
        """Start streaming.

        Raises:
            DeviceError: The camera refuses, in use by another program for instance.
        """
        # Into a queue of our own: on a lost camera, the pipeline's own waiting tries to start it
        # again by itself and blocks for many seconds while it does.
        try:
            self.profile = self._pipeline.start(self._config, self._queue)
        except RuntimeError as error:
            text = f"the camera cannot be started ({error}); does another program use it?"
            raise DeviceError(text) from error

    def wait(self) -> Any:
        """Return the next frameset, or None when none came for a quarter of a second."""
        arrived, frame = self._queue.try_wait_for_frame(POLL_MS)
        return frame.as_frameset() if arrived and frame.is_frameset() else None

    def check(self, quiet_s: float, patience_s: float) -> None:
        """Raise CameraLostError where the camera is gone, or was silent beyond the patience."""
        if not self._connected():
            raise CameraLostError("it was unplugged")
        if quiet_s >= patience_s:
            raise CameraLostError(f"it is connected but sent no whole frame for {patience_s:g} s")

    def _connected(self) -> bool:
        try:
            devices = self._context.query_devices()
            return self.serial in {info(device).get("serial_number") for device in devices}
        except RuntimeError:  # it goes while it is asked
            return False

    def ended(self) -> bool:
        """Return whether no more frames can come."""
        return False

    def unplayed(self) -> int:
        """Return 0: this is for recordings."""
        return 0

    def stop(self) -> None:
        """Stop streaming; also after the camera was lost."""
        _stop(self._pipeline)


class FileLink:
    """A recording of librealsense (`.bag`), played frame by frame without losing any.

    Raises:
        InputError: It is not such a recording, or was never closed.
    """

    live = False
    serial = None

    def __init__(self, context: Any, path: Path) -> None:
        rs = import_realsense()
        self.path = path
        self._config = rs.config()
        self._config.enable_device_from_file(str(path), repeat_playback=False)
        self._pipeline = rs.pipeline(context)
        try:
            self.profile = self._config.resolve(rs.pipeline_wrapper(self._pipeline))
        except RuntimeError as error:
            reason = str(error).rpartition("reader: ")[2]
            if "unindexed" in reason.lower():
                reason = "it was never closed; 'rosbag reindex' repairs it"
            elif "file_version" in reason:
                reason = f"it is a bag of ROS 1: {CONVERT.format('FILE')} makes MCAP of it"
            raise InputError(f"{path}: not a readable RealSense recording: {reason}") from error
        self._playback = self.profile.get_device().as_playback()
        # Else it plays at its own pace and drops what comes too late.
        self._playback.set_real_time(False)
        # Else the first image is lost where its sensor is not the one that is started first.
        self._playback.pause()
        try:
            self._images = count_color_images(path)
        except ValueError:  # librealsense could read it, so it is not for us to refuse
            self._images = 0
        self._played = 0
        self._last_number: int | None = None

    def start(self) -> None:
        """Start playing."""
        self.profile = self._pipeline.start(self._config)
        self._playback.resume()

    def wait(self) -> Any:
        """Return the next frameset, or None when none came for a quarter of a second."""
        arrived, frames = self._pipeline.try_wait_for_frames(POLL_MS)
        if not arrived:
            return None
        color = frames.get_color_frame()
        if color and color.get_frame_number() != self._last_number:
            self._last_number = color.get_frame_number()
            self._played += 1
        return frames

    def check(self, quiet_s: float, patience_s: float) -> None:
        """Raise InputError where the player is stuck."""
        if quiet_s >= patience_s:
            raise InputError(f"{self.path}: no image came for {patience_s:g} s; it may be damaged")

    def ended(self) -> bool:
        """Return whether the recording was played to its end.

        Raises:
            InputError: The player stopped before; it does so without a word on a damaged file.
        """
        if self._playback.current_status() != import_realsense().playback_status.stopped:
            return False
        if self.unplayed() > _PARTNERLESS:
            raise InputError(
                f"{self.path} is damaged: {self._played} of its {self._images} colour images "
                "could be read"
            )
        return True

    def unplayed(self) -> int:
        """Return how many of the colour images in the file did not come."""
        return max(0, self._images - self._played)

    def stop(self) -> None:
        """Close the recording."""
        _stop(self._pipeline)


Link = CameraLink | FileLink


def _stop(pipeline: Any) -> None:
    with suppress(RuntimeError):  # it never started, or the camera is gone
        pipeline.stop()


def _unsupported(device: Any, request: Request) -> str:
    """Say which of the streams asked for the camera lacks, and what it has at that frame rate."""
    offers: dict[str, set[tuple[int, int, int]]] = {"color": set(), "depth": set()}
    for sensor in device.query_sensors():
        for profile in sensor.get_stream_profiles():
            kind = profile.stream_type().name
            wanted = {"color": "rgb8", "depth": "z16"}.get(kind)
            if profile.is_video_stream_profile() and profile.format().name == wanted:
                video = profile.as_video_stream_profile()
                offers[kind].add((video.width(), video.height(), video.fps()))
    texts = []
    for kind, size in (("color", request.color), ("depth", request.depth)):
        if size and (*size, request.fps) not in offers[kind]:
            listed = ", ".join(f"{w}x{h} @ {f}" for w, h, f in sorted(offers[kind])) or "none"
            texts.append(f"no {kind} of {size[0]}x{size[1]} @ {request.fps}; it has: {listed}")
    name = info(device).get("name", "the camera")
    return f"{name}: {'; '.join(texts) or 'these streams do not go together'}"
