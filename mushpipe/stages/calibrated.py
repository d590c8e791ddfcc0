"""What stages need to turn depth into metres."""

from __future__ import annotations

from mushpipe import Camera, InputError, RgbdFrame


def calibration_of(frame: RgbdFrame) -> Camera:
    """Return the calibration of a frame.

    Raises:
        InputError: It has none.
    """
    if frame.camera is None:
        raise InputError(
            "depth cannot be turned into metres without the camera's calibration: record "
            "camera_info, or set source.camera: {fx: , fy: , cx: , cy: }"
        )
    return frame.camera
