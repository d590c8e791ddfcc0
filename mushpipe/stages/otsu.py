"""Otsu's automatic threshold (Otsu 1979): the paper's initial contour as a segmenter."""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from mushpipe import Mask, RgbdFrame, Stage


def otsu_foreground(gray: NDArray[np.float32]) -> NDArray[np.bool_]:
    """Return the pixels brighter than Otsu's threshold of an (H, W) image in 0..1.

    An image of one gray level has no two classes; its foreground is empty.
    """
    levels = np.rint(gray * 255).astype(np.uint8)
    if levels.min() == levels.max():
        return np.zeros(gray.shape, bool)
    _, binary = cv2.threshold(levels, 0, 1, cv2.THRESH_BINARY | cv2.THRESH_OTSU)
    result: NDArray[Any] = np.asarray(binary, np.uint8)
    return result.view(np.bool_)


class Otsu(Stage):
    """Segments by Otsu's threshold on gray: caps are what is brighter than the threshold."""

    def process(self, frame: RgbdFrame) -> Mask:
        """Return the mask; it is its own initial contour."""
        foreground = otsu_foreground(frame.gray)
        return Mask(foreground, initial=foreground)
