"""Otsu's automatic threshold (Otsu 1979): the paper's initial contour, also as a segmenter."""

from __future__ import annotations

import cv2
import numpy as np
from pydantic import Field

from mushpipe import Mask, RgbdFrame, Stage
from mushpipe.core.arrays import Bools, Singles
from mushpipe.stages.channels import Channel, channel_image
from mushpipe.stages.evidence import Evidence, believed_foreground


def otsu_foreground(gray: Singles) -> Bools:
    """Return the pixels brighter than Otsu's threshold of an (H, W) image in 0..1.

    An image of one gray level has no two classes; its foreground is empty.
    """
    levels = cv2.convertScaleAbs(gray, alpha=255)
    if levels.min() == levels.max():
        return np.zeros(gray.shape, bool)
    _, binary = cv2.threshold(levels, 0, 1, cv2.THRESH_BINARY | cv2.THRESH_OTSU)
    return np.asarray(binary, np.uint8).view(np.bool_)


def initial_contour(image: Singles, check: bool) -> Evidence:
    """Return Otsu's foreground of an (H, W[, C]) image, or with ``check`` the believed one."""
    plane = image
    if image.ndim == 3:
        plane = np.asarray(cv2.transform(image, np.full((1, image.shape[2]), 1 / image.shape[2])))
    return believed_foreground(plane) if check else Evidence(otsu_foreground(plane), 0.0, 0.0)


class Otsu(Stage):
    """Segments by Otsu's threshold: caps are what is brighter than the threshold."""

    channel: Channel = Field("gray", description="what it looks at")
    check: bool = Field(
        True, description="empty mask where there are no two classes; false is plain Otsu"
    )

    def process(self, frame: RgbdFrame) -> Mask:
        """Return the mask; it is its own initial contour."""
        foreground = initial_contour(channel_image(frame, self.channel), self.check).region
        return Mask(foreground, initial=foreground)
