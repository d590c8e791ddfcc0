"""An image laid into a rectangle of another size and shape, and the way back."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from mushpipe.core.arrays import Bytes, Floats, Singles

_GRAY = 114  # what YOLO pads with


@dataclass(frozen=True)
class Letterbox:
    """Where an image of `image` px lies in a canvas of `canvas` px: scaled to `inner`, centred.

    All sizes are (width, height).
    """

    image: tuple[int, int]
    inner: tuple[int, int]
    canvas: tuple[int, int]

    @property
    def corner(self) -> tuple[int, int]:
        """Left and top of the image in the canvas, px."""
        left, top = ((c - i) // 2 for c, i in zip(self.canvas, self.inner, strict=True))
        return left, top

    def fill(self, color: Bytes) -> Bytes:
        """Return the canvas (h, w, 3) with the image (H, W, 3) in it."""
        canvas = np.full((*self.canvas[::-1], 3), _GRAY, np.uint8)
        (left, top), (width, height) = self.corner, self.inner
        canvas[top : top + height, left : left + width] = resized(color, self.inner)
        return canvas

    def cut(self, values: Singles) -> Singles:
        """Return the image's part (H, W) of values (h, w) that cover the canvas.

        Raises:
            ValueError: They have another shape than the canvas, by more than two columns or rows.
        """
        (rows, columns), (across, down) = values.shape, self.canvas
        if abs(columns * down - rows * across) > 2 * max(across, down):
            raise ValueError(f"{columns}x{rows} values cover no image of {across}x{down} px")
        (left, top), (width, height) = self.corner, self.inner
        whole = resized(values, self.canvas)[top : top + height, left : left + width]
        return resized(whole, self.image)

    def back(self, boxes: Floats) -> Floats:
        """Take boxes (N, 4), centre x, y, width, height from the canvas' corner, to the image.

        In the image the middle of the first pixel is (0, 0).
        """
        ratio = np.array(self.image) / np.array(self.inner)
        center = (boxes[:, :2] - self.corner) * ratio - 0.5
        return np.column_stack([center, boxes[:, 2:] * ratio])


def letterbox(image: tuple[int, int], canvas: tuple[int, int], enlarge: bool) -> Letterbox:
    """Return how an image fits into a canvas, keeping its shape; sizes are (width, height)."""
    scale = min(c / i for c, i in zip(canvas, image, strict=True))
    scale = scale if enlarge else min(scale, 1.0)
    width, height = (max(1, round(i * scale)) for i in image)
    return Letterbox(image, (width, height), canvas)


def resized(image: NDArray[Any], size: tuple[int, int]) -> NDArray[Any]:
    """Scale an image to (width, height): linearly, below half the size by area.

    From half the size on no pixel is passed over, and area would take five times as long.
    """
    if image.shape[1::-1] == size:
        return image
    how = cv2.INTER_AREA if 2 * size[0] < image.shape[1] else cv2.INTER_LINEAR
    return np.asarray(cv2.resize(image, size, interpolation=how))
