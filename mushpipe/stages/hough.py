"""Circles by OpenCV's Hough transform: the plain peer of the phase-coded one."""

from __future__ import annotations

from typing import Annotated, Literal

import cv2
import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from mushpipe import Circles, Mask, RgbdFrame, Stage

Radius = Annotated[float, Field(gt=0)]


class Hough(Stage):
    """Detects circles with OpenCV's HoughCircles in the mask or in the gray image.

    A circle's score is the share of its disc that the mask covers.
    """

    input: Literal["mask", "image"] = Field("mask", description="where the edges are taken from")
    radius_px: tuple[Radius, Radius] = Field((8, 38), description="smallest and largest radius, px")
    min_distance_px: float = Field(12, gt=0, description="smallest distance of two centres, px")
    edge: float = Field(100, gt=0, description="upper Canny threshold on 0..255 gray")
    votes: float = Field(12, gt=0, description="fewest votes of a centre in the accumulator")
    min_score: float = Field(0.6, ge=0, le=1, description="smallest score that is kept")

    def process(self, frame: RgbdFrame, mask: Mask) -> Circles:
        """Return the circles, best supported first."""
        gray = frame.gray if self.input == "image" else mask.foreground.astype(np.float32)
        image = cv2.GaussianBlur(np.rint(gray * 255).astype(np.uint8), (5, 5), 1.2)
        found = cv2.HoughCircles(
            image,
            cv2.HOUGH_GRADIENT,
            dp=1,
            minDist=self.min_distance_px,
            param1=self.edge,
            param2=self.votes,
            minRadius=round(self.radius_px[0]),
            maxRadius=round(self.radius_px[1]),
        )
        circles = np.zeros((0, 3)) if found is None else np.asarray(found[0, :, :3], np.float64)
        circles = circles[circles[:, 2] > 0]
        score = np.array([disc_cover(mask.foreground, *circle) for circle in circles])
        keep = score >= self.min_score
        return Circles(circles[keep, :2], circles[keep, 2], score[keep])


def disc_cover(foreground: NDArray[np.bool_], x: float, y: float, radius: float) -> float:
    """Return the share of a disc's pixels, as far as they lie in the image, that are set."""
    height, width = foreground.shape
    left, right = max(0, int(x - radius)), min(width, int(x + radius) + 2)
    top, bottom = max(0, int(y - radius)), min(height, int(y + radius) + 2)
    v, u = np.ogrid[top:bottom, left:right]
    disc = (u - x) ** 2 + (v - y) ** 2 <= radius**2
    return float(foreground[top:bottom, left:right][disc].mean()) if disc.any() else 0.0
