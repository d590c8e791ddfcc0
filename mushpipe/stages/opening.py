"""Morphological opening of the mask (paper, section III): removes what is smaller than a cap."""

from __future__ import annotations

import cv2
import numpy as np
from pydantic import Field

from mushpipe import Mask, Stage


class Opening(Stage):
    """Opens the mask with an elliptical kernel; the result is always part of the mask."""

    size: int = Field(10, ge=1, le=255, description="diameter of the kernel, px")

    def process(self, mask: Mask) -> Mask:
        """Return the opened mask; the initial contour is handed on."""
        kernel = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (self.size, self.size))
        image = mask.foreground.view(np.uint8)
        # An opening dilates with the reflected kernel; OpenCV's own MORPH_OPEN does not reflect,
        # which moves the mask by half a pixel where the size is even.
        anchor = self.size // 2
        eroded = cv2.erode(image, kernel, anchor=(anchor, anchor), borderValue=1)
        mirrored = self.size - 1 - anchor
        opened = cv2.dilate(eroded, kernel[::-1, ::-1].copy(), anchor=(mirrored, mirrored))
        return Mask(np.asarray(opened, np.uint8).view(np.bool_), mask.initial)
