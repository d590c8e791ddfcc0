"""Depth put right by what a calibration found out about the camera."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from pydantic import Field

from mushpipe import RgbdFrame, Stage


class DepthCorrect(Stage):
    """Takes a polynomial in depth off the depth: z - offset - slope z - curve z^2.

    The SR300 of Baisa and Al-Diri 2022 measures 2.85 mm too far (mean of their Table I).
    """

    offset_mm: float = Field(0, ge=-50, le=50, description="constant error, mm")
    slope_mm_per_m: float = Field(0, ge=-100, le=100, description="its growth, mm per m")
    curve_mm_per_m2: float = Field(0, ge=-100, le=100, description="its bend, mm per m^2")

    def process(self, frame: RgbdFrame) -> RgbdFrame:
        """Return the frame with corrected depth, float32 in the sensor's unit, 0 = missing."""
        if frame.depth is None:
            return frame
        z = np.fmax(frame.depth_m, np.float32(0))
        error = np.float32(self.offset_mm / 1000)
        if self.slope_mm_per_m or self.curve_mm_per_m2:
            slope, curve = (
                np.float32(k / 1000) for k in (self.slope_mm_per_m, self.curve_mm_per_m2)
            )
            error = error + z * (slope + z * curve)
        unit = np.float32(1 / frame.depth_scale)
        corrected = np.where(z > 0, np.maximum(z - error, 0), np.float32(0)) * unit
        return replace(frame, depth=corrected.astype(np.float32))
