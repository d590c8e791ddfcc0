"""Segmentation by height above the bed: it tells a brown cap from brown soil."""

from __future__ import annotations

from typing import Self

import cv2
import numpy as np
from pydantic import Field, model_validator

from mushpipe import Mask, RgbdFrame, Stage
from mushpipe.core.arrays import Bools, Singles
from mushpipe.core.jit import jit
from mushpipe.stages.bed import bed_depth
from mushpipe.stages.chan_vese_fast import solve_fast
from mushpipe.stages.warm_up import example_frame

REACH_PX = 32  # the widest gap that one side can fill: a shadow, or half of a shiny cap


class Height(Stage):
    """Segments what stands above the bed, with a Chan-Vese contour on the height map.

    The bed is a plane through the farthest depth, bent to the relief of the soil. Missing depth is
    filled from what is known on its four sides; without any depth the mask is empty.
    """

    min_mm: float = Field(
        8, ge=0.1, le=1000, description="height at which a pixel is more cap than bed, mm"
    )
    max_mm: float = Field(150, gt=0, le=1000, description="what rises higher is no mushroom, mm")
    mu: float = Field(0.05, gt=0, description="weight of the contour's length, on height in 0..1")
    smallest_px: float = Field(
        10,
        ge=0,
        le=10_000,
        description="diameter of the smallest piece that is kept: clods and pins are less",
    )
    relief: bool = Field(True, description="follow the relief of the soil; false for a table")

    @model_validator(mode="after")
    def _ordered(self) -> Self:
        if self.min_mm >= self.max_mm:
            raise ValueError("min_mm must be less than max_mm")
        return self

    def open(self) -> None:
        """Compile the kernels."""
        self.process(example_frame())

    def process(self, frame: RgbdFrame) -> Mask:
        """Return the mask; its initial contour is the plain threshold."""
        height = height_map(frame, self.relief)
        if height is None:
            return Mask(np.zeros(frame.gray.shape, bool))
        scaled = height_image(height, self.min_mm / 1000, self.max_mm / 1000)
        initial = scaled > 0.5
        if not initial.any():
            return Mask(initial, initial)
        region = solve_fast(scaled, initial, self.mu, levels=(1.0, 0.0))
        return Mask(without_crumbs(region, self.smallest_px), initial)


def without_crumbs(region: Bools, diameter: float) -> Bools:
    """Return a region without the pieces of a smaller area than a disc of the diameter (px)."""
    _, label, stats, _ = cv2.connectedComponentsWithStats(region.view(np.uint8))
    keep = stats[:, cv2.CC_STAT_AREA] >= np.pi / 4 * diameter**2
    keep[0] = False
    return np.asarray(keep[label])


def height_map(frame: RgbdFrame, relief: bool = True) -> Singles | None:
    """Return (H, W) metres above the bed, holes filled; None without enough depth for a bed."""
    bed = bed_depth(frame.depth_m, relief) if frame.depth is not None else None
    return None if bed is None else filled(bed - frame.depth_m)


def height_image(height: Singles, middle: float, highest: float) -> Singles:
    """Return height as an image in 0..1 in which ``middle`` is 0.5 and what is too high is 0.

    It saturates as far above the middle as the bed lies below it, so that both classes weigh alike.
    """
    image = np.clip(height / np.float32(2 * middle), 0, 1)
    image[height > highest] = 0
    return np.asarray(image, np.float32)


@jit
def filled(height: Singles) -> Singles:
    """Fill missing values from what is known on the four sides.

    Of two opposite sides the lower counts: between a cap and the bed lies a shadow on the bed,
    within a cap there is the cap on both sides. What is not known within 32 px counts as bed, 0.
    Of the row and the column it is the mean.
    """
    rows, columns = height.shape
    result = height.copy()
    earlier = np.zeros((2, rows, columns), np.float32)
    for direction in range(2):
        last = np.zeros(columns, np.float32)
        age = np.full(columns, REACH_PX, np.float32)
        for step in range(rows):
            y = step if direction == 0 else rows - 1 - step
            side, since = np.float32(0), np.float32(REACH_PX)
            for k in range(columns):
                x = k if direction == 0 else columns - 1 - k
                value = height[y, x]
                if np.isfinite(value):
                    last[x], age[x] = value, np.float32(0)
                    side, since = value, np.float32(0)
                    continue
                age[x] += np.float32(1)
                since += np.float32(1)
                above = last[x] if age[x] <= REACH_PX else np.float32(0)
                beside = side if since <= REACH_PX else np.float32(0)
                if direction == 0:
                    earlier[0, y, x], earlier[1, y, x] = above, beside
                else:
                    lower = min(above, earlier[0, y, x]) + min(beside, earlier[1, y, x])
                    result[y, x] = np.float32(0.5) * lower
    return result
