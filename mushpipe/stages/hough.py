"""Circles by OpenCV's Hough transform: the plain peer of the phase-coded one."""

from __future__ import annotations

from typing import Annotated, Literal, Self

import cv2
import numpy as np
from numpy.typing import NDArray
from pydantic import Field, model_validator

from mushpipe import Circles, Mask, RgbdFrame, Stage

Floats = NDArray[np.float64]
Radius = Annotated[float, Field(gt=0)]


class Hough(Stage):
    """Detects circles with OpenCV's HoughCircles, in the gray image or in the mask.

    A circle's score is the share of its disc that the mask covers. Of circles that stand in the
    same place the one OpenCV ranks first is kept.
    """

    input: Literal["image", "mask"] = Field("image", description="where the edges are taken from")
    method: Literal["alt", "gradient"] = Field(
        "alt", description="HOUGH_GRADIENT_ALT, which is more precise, or HOUGH_GRADIENT"
    )
    radius_px: tuple[Radius, Radius] = Field((8, 38), description="smallest and largest radius, px")
    edge: float = Field(150, gt=0, description="upper Canny threshold, in OpenCV's units")
    perfectness: float = Field(0.6, gt=0, lt=1, description="`alt`: how round a circle must be")
    votes: float = Field(14, gt=0, description="`gradient`: fewest votes of a centre")
    min_distance_px: float = Field(12, gt=0, description="smallest distance of two centres, px")
    apart: float = Field(
        0.7, ge=0, description="smallest distance of two centres, in radii of the larger circle"
    )
    min_score: float = Field(0.6, ge=0, le=1, description="smallest score that is kept")

    @model_validator(mode="after")
    def _ordered(self) -> Self:
        if self.radius_px[0] > self.radius_px[1]:
            raise ValueError("radius_px must be [smallest, largest]")
        return self

    def process(self, frame: RgbdFrame, mask: Mask) -> Circles:
        """Return the circles in OpenCV's order of evidence."""
        gray = frame.gray if self.input == "image" else mask.foreground.astype(np.float32)
        circles = self._candidates(np.rint(gray * 255).astype(np.uint8))
        score = np.array([disc_cover(mask.foreground, *circle) for circle in circles])
        covered = np.flatnonzero(score >= self.min_score)
        keep = covered[first_of_each_place(circles[covered], self.apart)]
        return Circles(circles[keep, :2], circles[keep, 2], score[keep])

    def _candidates(self, image: NDArray[np.uint8]) -> Floats:
        """Return (N, 3) x, y, radius."""
        alt = self.method == "alt"
        found = cv2.HoughCircles(
            cv2.GaussianBlur(image, (5, 5), 1.2),
            cv2.HOUGH_GRADIENT_ALT if alt else cv2.HOUGH_GRADIENT,
            dp=1.5 if alt else 1,
            minDist=self.min_distance_px,
            param1=self.edge,
            param2=self.perfectness if alt else self.votes,
            minRadius=max(1, round(self.radius_px[0])),
            maxRadius=max(1, round(self.radius_px[1])),
        )
        circles = np.zeros((0, 3)) if found is None else np.asarray(found[0, :, :3], np.float64)
        return circles[circles[:, 2] > 0]


def first_of_each_place(circles: Floats, apart: float) -> NDArray[np.intp]:
    """Return the rows of (N, 3) circles that are not too near to a kept one before them."""
    kept: list[int] = []
    for row, (x, y, radius) in enumerate(circles):
        others = circles[kept]
        distance = np.hypot(others[:, 0] - x, others[:, 1] - y)
        if np.all(distance >= apart * np.maximum(others[:, 2], radius)):
            kept.append(row)
    return np.array(kept, np.intp)


def disc_cover(foreground: NDArray[np.bool_], x: float, y: float, radius: float) -> float:
    """Return the share of a disc's pixels, as far as they lie in the image, that are set."""
    height, width = foreground.shape
    left, right = max(0, int(x - radius)), min(width, int(x + radius) + 2)
    top, bottom = max(0, int(y - radius)), min(height, int(y + radius) + 2)
    v, u = np.ogrid[top:bottom, left:right]
    disc = (u - x) ** 2 + (v - y) ** 2 <= radius**2
    return float(foreground[top:bottom, left:right][disc].mean()) if disc.any() else 0.0
