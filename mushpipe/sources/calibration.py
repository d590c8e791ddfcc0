"""The calibration of recorded colour images: what it says, and whether it can be theirs."""

from __future__ import annotations

from collections.abc import Callable
from types import EllipsisType
from typing import Any

from mushpipe.core.errors import InputError
from mushpipe.core.geometry import Camera
from mushpipe.sources.images import GIVEN_CAMERA, decode_camera, distortion
from mushpipe.sources.recorded import RecordedSource
from mushpipe.sources.topics import Topics, is_beside, other_camera

Recorded = Camera | None | EllipsisType  # `...`: nothing was stated yet
_RECTIFIED = ("rect", "rectified")  # image_rect_color, as ROS has it; others say image_color_rect


class Calibration:
    """The calibration in force: that of the settings, or of the last message.

    Args:
        settings: Of the source.
        topics: Of the recording.
        warn: Says something of the recording, once.

    Attributes:
        topic: Where it is recorded; None where it is not, or does not matter.
        camera: What the last message says.
        stated: Whether there was a message, be it word that there is none.
        stamp_ns: Of the last message.
    """

    def __init__(
        self, settings: RecordedSource, topics: Topics, warn: Callable[[str], None]
    ) -> None:
        self.settings = settings
        self.color = topics.color
        # Where a camera is given, that of the recording does not matter.
        self.topic = topics.camera if settings.camera is None else None
        self.camera: Camera | None = None
        self.stated = False
        self.stamp_ns = 0
        self._frame_id = ""
        self._warn = warn

    def read(self, message: Any, stamp_ns: int, frame_id: str) -> Camera | None:
        """Return what a message says; errors as of `decode_camera`."""
        self.stamp_ns, self._frame_id = stamp_ns, frame_id
        name = self.color.split("/")
        words = {word for part in name for word in part.split("_")}
        if "image_rect_raw" in name and any(distortion(message)):
            # realsense2_camera's name, also where it rectified nothing
            self._warn(
                f"{self.color} is called rectified, so the distortion that its calibration "
                "states is not applied; if the images are as the lens made them, positions near "
                "their corners are off by some mm"
            )
        camera = decode_camera(message, rectified=not words.isdisjoint(_RECTIFIED))
        if camera is not None and not camera.centred:  # of a part of an image it may be right
            self._warn(
                f"the principal point of the calibration ({self.topic}), ({camera.cx:g}, "
                f"{camera.cy:g}), lies outside of the image, which is "
                f"{camera.width}x{camera.height}; if the images were made smaller, positions are "
                "off: set source.camera"
            )
        return camera

    def recorded(self) -> Recorded:
        """Return what to use for an image that came now.

        A calibration that changes holds from there on and for the image of its own stamp, not for
        others that wait for their depth; the first one does.
        """
        return self.camera if self.stated else ...

    def of_image(
        self, size: tuple[int, ...], first: tuple[int, ...], frame_id: str, recorded: Recorded
    ) -> Camera | None:
        """Return the calibration of an image.

        Args:
            size: Height and width, px.
            first: Those of the first image.
            frame_id: Of the image.
            recorded: As it was when the image came.

        Raises:
            InputError: It is that of another camera, or of images of another size.
            ValueError: The settings' is.
        """
        if (given := self.settings.camera) is not None:
            return given.of_image(size, first)
        self._require_same_frame(frame_id)
        camera = self.camera if recorded is ... else recorded
        if camera is not None and (camera.height, camera.width) != size:
            raise InputError(
                f"the image ({self.color}) is {size[1]}x{size[0]}, its calibration ({self.topic}) "
                f"for {camera.width}x{camera.height}: name that of these images (--set "
                f"source.camera_topic=), or set {GIVEN_CAMERA}"
            )
        return camera

    def _require_same_frame(self, frame_id: str) -> None:
        """Raise InputError for another camera's, unless it was named or stands beside colour.

        Two drivers may give one name to the frames of their cameras: what topics say is told.
        """
        if self.topic is None or self.settings.camera_topic or is_beside(self.topic, self.color):
            return
        if self._frame_id and frame_id and self._frame_id != frame_id:
            raise InputError(
                f"the only calibration ({self.topic}) is of frame '{self._frame_id}', "
                f"colour is in '{frame_id}': name it if it holds for colour (--set "
                f"source.camera_topic={self.topic}), or set {GIVEN_CAMERA}"
            )
        if other_camera(self.topic.rpartition("/")[0], self.color):
            self._warn(
                f"by its name, the only calibration ({self.topic}) is of another camera than "
                f"colour ({self.color}): positions and sizes are wrong if it is; where it holds "
                f"for colour, name it (--set source.camera_topic={self.topic})"
            )
