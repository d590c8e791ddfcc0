"""Circles by the Hough transforms of OpenCV and scikit-image: peers of the phase-coded one."""

from __future__ import annotations

from typing import Literal, Self

import cv2
import numpy as np
from pydantic import Field, model_validator

from mushpipe import Circles, Mask, RgbdFrame, Stage
from mushpipe.core.arrays import Bools, Floats, Rows, Singles
from mushpipe.stages.discs import Extent


class _Peer(Stage):
    """What the peers share: their input, and which of their circles are kept."""

    input: Literal["image", "mask"] = Field("image", description="where the edges are taken from")
    radius_px: tuple[Extent, Extent] = Field((8, 38), description="smallest and largest radius, px")
    apart: float = Field(
        0.7,
        ge=0,
        le=100,
        description="smallest distance of two centres, in radii of the larger circle",
    )
    min_score: float = Field(0.6, ge=0, le=1, description="smallest score that is kept")

    @model_validator(mode="after")
    def _ordered(self) -> Self:
        if self.radius_px[0] > self.radius_px[1]:
            raise ValueError("radius_px must be [smallest, largest]")
        return self

    def process(self, frame: RgbdFrame, mask: Mask) -> Circles:
        """Return the circles in the library's order of evidence."""
        gray = frame.gray if self.input == "image" else mask.foreground.astype(np.float32)
        circles = self._candidates(gray)
        score = np.array([disc_cover(mask.foreground, *circle) for circle in circles])
        covered = np.flatnonzero(score >= self.min_score)
        keep = covered[first_of_each_place(circles[covered], self.apart)]
        return Circles(circles[keep, :2], circles[keep, 2], score[keep])

    def _candidates(self, gray: Singles) -> Floats:
        """Return (N, 3) x, y, radius of circles in an image (H, W) of 0..1, the best first."""
        raise NotImplementedError


class Hough(_Peer):
    """Detects circles with OpenCV's HoughCircles, in the gray image or in the mask.

    A circle's score is the share of its disc that the mask covers. Of circles that stand in the
    same place the one OpenCV ranks first is kept.
    """

    method: Literal["alt", "gradient"] = Field(
        "alt", description="HOUGH_GRADIENT_ALT, which is more precise, or HOUGH_GRADIENT"
    )
    edge: float = Field(150, gt=0, description="upper Canny threshold, in OpenCV's units")
    perfectness: float = Field(0.6, gt=0, lt=1, description="`alt`: how round a circle must be")
    votes: float = Field(14, gt=0, description="`gradient`: fewest votes of a centre")
    min_distance_px: float = Field(
        12, gt=0, le=10_000, description="smallest distance of two centres, px"
    )

    def _candidates(self, gray: Singles) -> Floats:
        image = np.rint(gray * 255).astype(np.uint8)
        alt = self.method == "alt"
        found = cv2.HoughCircles(
            cv2.GaussianBlur(image, (5, 5), 1.2),
            cv2.HOUGH_GRADIENT_ALT if alt else cv2.HOUGH_GRADIENT,
            dp=1.5 if alt else 1,
            minDist=self.min_distance_px,
            param1=self.edge,
            param2=self.perfectness if alt else self.votes,
            minRadius=max(1, round(self.radius_px[0])),
            maxRadius=max(1, min(round(self.radius_px[1]), max(gray.shape))),
        )
        circles = np.zeros((0, 3)) if found is None else np.asarray(found[0, :, :3], np.float64)
        return circles[circles[:, 2] > 0]


class HoughSkimage(_Peer):
    """Detects circles with scikit-image's hough_circle, on Canny edges of the image or the mask.

    The textbook's transform: an accumulator per radius, in whole pixels, without gradients; it
    takes about a second per frame. Scores and places as in `hough`.
    """

    sigma: float = Field(1.5, gt=0, le=100, description="smoothing before Canny's edges, px")
    votes: float = Field(0.35, gt=0, le=1, description="least share of the outline with edges")

    def _candidates(self, gray: Singles) -> Floats:
        from skimage.feature import canny
        from skimage.transform import hough_circle, hough_circle_peaks

        smallest, largest = self.radius_px
        radii = np.arange(max(1, round(smallest)), min(round(largest), max(gray.shape)) + 1)
        if not len(radii):
            return np.zeros((0, 3))
        space = hough_circle(canny(np.asarray(gray, np.float64), self.sigma), radii)
        votes, x, y, radius = hough_circle_peaks(space, radii, threshold=self.votes)
        order = np.lexsort([x, y, radius, -votes])  # ties come in another order on other processors
        return np.column_stack([x, y, radius]).astype(np.float64)[order]


def first_of_each_place(circles: Floats, apart: float) -> Rows:
    """Return the rows of (N, 3) circles that are not too near to a kept one before them."""
    kept: list[int] = []
    for row, (x, y, radius) in enumerate(circles):
        others = circles[kept]
        distance = np.hypot(others[:, 0] - x, others[:, 1] - y)
        if np.all(distance >= apart * np.maximum(others[:, 2], radius)):
            kept.append(row)
    return np.array(kept, np.intp)


def disc_cover(foreground: Bools, x: float, y: float, radius: float) -> float:
    """Return the share of a disc's pixels, as far as they lie in the image, that are set."""
    height, width = foreground.shape
    left, right = max(0, int(x - radius)), min(width, int(x + radius) + 2)
    top, bottom = max(0, int(y - radius)), min(height, int(y + radius) + 2)
    v, u = np.ogrid[top:bottom, left:right]
    disc = (u - x) ** 2 + (v - y) ** 2 <= radius**2
    return float(foreground[top:bottom, left:right][disc].mean()) if disc.any() else 0.0
