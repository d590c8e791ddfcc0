"""What `depth-correct` must take off the depth, from planes at known distances."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from pydantic import ValidationError

from mushpipe.core.arrays import Floats
from mushpipe.core.errors import InputError, UsageError
from mushpipe.evaluate.plane import PlaneRow
from mushpipe.stages.depth_correct import DepthCorrect

UNEVEN_MM = 8.0  # standard deviation of depth about a plane: beyond, it is none
LEFT_MM = 10.0  # what a correction may leave


@dataclass(frozen=True, eq=False)
class Correction:
    """A polynomial error of depth, and what it was found on.

    Attributes:
        coefficients: (3,) offset mm, slope mm/m, curve mm/m^2, of the measured depth.
        rows: The planes.
        left: (P,) mm, the error of each plane that the polynomial does not explain.
    """

    coefficients: Floats
    rows: Sequence[PlaneRow]
    left: Floats

    def fragment(self) -> str:
        """Return the YAML that the setting `calibration` of `depth-correct` reads."""
        offset, slope, curve = (float(value) for value in self.coefficients)
        found = [
            f"# {row.name}: {1e3 * row.distance_m:.1f} mm, error {_offset(row):+.3f} mm, "
            f"left over {left:+.3f} mm"
            for row, left in zip(self.rows, self.left, strict=True)
        ]
        lines = [
            "# Depth errors of a camera; a graph takes them off with",
            "#   correct: {use: depth-correct, calibration: this-file.yaml}",
            *found,
            f"offset_mm: {offset:.4f}",
            f"slope_mm_per_m: {slope:.4f}",
            f"curve_mm_per_m2: {curve:.4f}",
        ]
        return "\n".join(lines) + "\n"


def fit_correction(rows: Sequence[PlaneRow], order: int) -> Correction:
    """Fit the error of depth as a polynomial of the measured depth, by least squares.

    Args:
        rows: Planes as `evaluate.plane.measure_plane` measures them.
        order: Of the polynomial, 0 to 2; it needs more distances than that.

    Raises:
        UsageError: There are too few distances, or they are not those of the planes.
        InputError: A plane has no depth, or is none.
    """
    distances = {row.distance_m for row in rows}
    if len(distances) <= order:
        raise UsageError(f"--order {order} needs {order + 1} distances, there are {len(distances)}")
    for row in rows:
        if not np.isfinite(_offset(row)):
            raise InputError(f"{row.name}: there is no depth in the middle of its images")
        if row.values["flat_std_mm"].value > UNEVEN_MM:
            raise InputError(
                f"{row.name}: what is in the middle of its images is no plane, depth departs from "
                f"one by {row.values['flat_std_mm'].value:.1f} mm (at most {UNEVEN_MM:g})"
            )
    z = np.array([row.values["mean_mm"].value / 1e3 for row in rows])
    error = np.array([_offset(row) for row in rows])
    powers = np.vander(z, order + 1, increasing=True)
    found, *_ = np.linalg.lstsq(powers, error, rcond=None)
    coefficients = np.zeros(3)
    coefficients[: order + 1] = found
    left = error - powers @ found
    if np.abs(left).max() > LEFT_MM or not _taken(coefficients):
        listed = ", ".join(f"{row.name} {_offset(row):+.1f} mm" for row in rows)
        raise UsageError(
            f"depth is off by {listed}: no camera's is; are the distances those of the recordings, "
            "in their order?"
        )
    return Correction(coefficients, rows, left)


def _taken(coefficients: Floats) -> bool:
    """Return whether `depth-correct` takes such a correction."""
    offset, slope, curve = coefficients
    try:
        DepthCorrect(offset_mm=offset, slope_mm_per_m=slope, curve_mm_per_m2=curve)
    except ValidationError:
        return False
    return True


def _offset(row: PlaneRow) -> float:
    return row.values["offset_mm"].value
