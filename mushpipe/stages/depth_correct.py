"""Depth put right by what a calibration found out about the camera."""

from __future__ import annotations

import logging
from dataclasses import replace
from pathlib import Path
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray
from pydantic import Field, PrivateAttr, model_validator

from mushpipe import GraphPath, InputError, RgbdFrame, Stage
from mushpipe.core.arrays import Singles
from mushpipe.core.document import read_document
from mushpipe.core.errors import GraphError
from mushpipe.core.jit import jit
from mushpipe.core.settings import told
from mushpipe.core.types import end_of_scale
from mushpipe.stages.warm_up import example_frame

logger = logging.getLogger("mushpipe")


class DepthCorrect(Stage):
    """Takes a polynomial in depth off the depth: z - offset - slope z - curve z^2.

    The SR300 of Baisa and Al-Diri 2022 measures 2.85 mm too far (mean of their Table I).
    """

    offset_mm: float = Field(0.0, ge=-50, le=50, description="constant error, mm")
    slope_mm_per_m: float = Field(0.0, ge=-100, le=100, description="its growth, mm per m")
    curve_mm_per_m2: float = Field(0.0, ge=-100, le=100, description="its bend, mm per m^2")

    calibration: GraphPath | None = Field(
        None, description="YAML file with these three, from `mushpipe calibrate depth`"
    )

    @model_validator(mode="after")
    def _one_way(self) -> Self:
        stated = self.offset_mm or self.slope_mm_per_m or self.curve_mm_per_m2
        if self.calibration is not None and stated:
            raise ValueError("the errors stand either here or in the file of 'calibration'")
        return self

    _errors: tuple[float, float, float] = PrivateAttr((0.0, 0.0, 0.0))

    def model_post_init(self, context: Any) -> None:
        """Take the errors from the settings."""
        super().model_post_init(context)
        self._errors = (self.offset_mm, self.slope_mm_per_m, self.curve_mm_per_m2)

    def open(self) -> None:
        """Read the calibration, or say what is taken off without one; compile the kernel.

        Raises:
            InputError: The file is missing or no such calibration.
        """
        if self.calibration is not None:
            self._errors = self._read(self.calibration)
        elif any(self._errors):
            logger.info(
                "%g mm, %g mm per m and %g mm per m^2 are taken off all depth, which is the error "
                "of one camera: 'mushpipe calibrate depth' finds that of yours",
                *self._errors,
            )
        for native in (np.uint16, np.float32):
            self.process(example_frame(native=native))

    def _read(self, path: Path) -> tuple[float, float, float]:
        try:
            found = DepthCorrect.model_validate(read_document(path, "offset_mm: 2.85").data)
            if found.calibration is not None:
                raise ValueError("it names another file")
        except (GraphError, ValueError) as error:
            raise InputError(f"{path}: no calibration of depth: {told(error)}") from error
        return found._errors

    def process(self, frame: RgbdFrame) -> RgbdFrame:
        """Return the frame with corrected depth, float32 in the sensor's unit, 0 = missing."""
        if frame.depth is None:
            return frame
        errors = np.array(self._errors, np.float32) / np.float32(1000)
        depth, scale = frame.depth, frame.depth_scale
        return replace(frame, depth=corrected(depth, scale, errors, end_of_scale(depth)))


@jit
def corrected(depth: NDArray[Any], scale: float, errors: Singles, end: np.float32) -> Singles:
    """Take a polynomial with coefficients from the constant on (m) off depth in units of scale (m).

    What is missing, from the end of the scale on, or not above 0 afterwards, is 0.
    """
    out = np.empty(depth.shape, np.float32)
    unit, per_m, none = np.float32(scale), np.float32(1 / scale), np.float32(0)
    constant, linear, square = errors[0], errors[1], errors[2]
    for y in range(depth.shape[0]):
        row, to = depth[y], out[y]
        for x in range(depth.shape[1]):  # without branches, for SIMD
            value = np.float32(row[x])
            z = value * unit
            left = z - (constant + z * (linear + z * square))
            known = (value < end) & (z > none) & (left > none) & (left < np.inf)
            to[x] = left * per_m if known else none
    return out
