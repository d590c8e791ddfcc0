"""Depth put right by what a calibration found out about the camera."""

from __future__ import annotations

from dataclasses import replace
from typing import Any, Self

import numpy as np
from pydantic import Field, PrivateAttr, model_validator

from mushpipe import GraphPath, InputError, RgbdFrame, Stage
from mushpipe.core.document import read_document
from mushpipe.core.errors import GraphError


class DepthCorrect(Stage):
    """Takes a polynomial in depth off the depth: z - offset - slope z - curve z^2.

    The SR300 of Baisa and Al-Diri 2022 measures 2.85 mm too far (mean of their Table I).
    """

    offset_mm: float = Field(0, ge=-50, le=50, description="constant error, mm")
    slope_mm_per_m: float = Field(0, ge=-100, le=100, description="its growth, mm per m")
    curve_mm_per_m2: float = Field(0, ge=-100, le=100, description="its bend, mm per m^2")

    calibration: GraphPath | None = Field(
        None, description="YAML file with these three, from `mushpipe calibrate depth`"
    )

    @model_validator(mode="after")
    def _one_way(self) -> Self:
        if self.calibration is not None and self.model_fields_set != {"calibration"}:
            raise ValueError("the errors stand either here or in the file of 'calibration'")
        return self

    _errors: tuple[float, float, float] = PrivateAttr((0.0, 0.0, 0.0))

    def model_post_init(self, context: Any) -> None:
        """Take the errors from the settings."""
        super().model_post_init(context)
        self._errors = (self.offset_mm, self.slope_mm_per_m, self.curve_mm_per_m2)

    def open(self) -> None:
        """Read the calibration.

        Raises:
            InputError: The file is missing or no such calibration.
        """
        if self.calibration is None:
            return
        try:
            found = DepthCorrect.model_validate(read_document(self.calibration).data)
            if found.calibration is not None:
                raise ValueError("it names another file")
        except (GraphError, ValueError) as error:
            raise InputError(f"{self.calibration}: no calibration of depth: {error}") from error
        self._errors = found._errors

    def process(self, frame: RgbdFrame) -> RgbdFrame:
        """Return the frame with corrected depth, float32 in the sensor's unit, 0 = missing."""
        if frame.depth is None:
            return frame
        z = np.fmax(frame.depth_m, np.float32(0))
        offset, slope, curve = (np.float32(k / 1000) for k in self._errors)
        error = offset + z * (slope + z * curve) if slope or curve else offset
        unit = np.float32(1 / frame.depth_scale)
        corrected = np.where(z > 0, np.maximum(z - error, 0), np.float32(0)) * unit
        return replace(frame, depth=corrected.astype(np.float32))
