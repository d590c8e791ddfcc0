"""The bed below the mushrooms: a plane through the farthest depth, bent to the relief around it.

In inverse depth a plane is affine in the pixel coordinates, so one linear fit serves any tilt of
the camera (Labayrade et al. 2002 use the same in disparity). Casing soil rises and falls by more
than a small cap is high, but over larger distances; a smooth correction follows it.
"""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from mushpipe.core.jit import jit
from mushpipe.stages.linear import least_squares

Floats = NDArray[np.float64]
Plane = NDArray[np.float32]
CELL = 16
RELIEF_M = 0.02  # largest departure of the soil from the plane
ROUGH_M = 0.004  # roughness below the size of a cap
_REACH_CELLS = 2.5


def bed_depth(depth_m: Plane, relief: bool = True) -> Plane | None:
    """Fit the bed and return its depth at every pixel.

    Caps only ever rise above the bed, so the fit starts from the far side of each cell of 16 x 16
    px and then drops, round by round, the cells that stand above the surface.

    Args:
        depth_m: (H, W) metres, NaN = missing.
        relief: Follow the soil's relief; False gives the plane.

    Returns:
        (H, W) metres, or None where there is too little depth for a fit.
    """
    far = far_cells(depth_m, CELL)
    known = np.isfinite(far)
    if known.sum() < 12:
        return None
    rows, columns = far.shape
    plane = fit_plane(far, known)
    surface = plane + bend(far - plane, known) if relief else plane
    # The centre of cell i lies at (i + 0.5) CELL - 0.5 px, as cv2.resize assumes.
    size = (columns * CELL, rows * CELL)
    full = cv2.resize(surface.astype(np.float32), size, interpolation=cv2.INTER_LINEAR)
    height, width = depth_m.shape
    edge = (0, height - size[1], 0, width - size[0])
    return np.asarray(cv2.copyMakeBorder(full, *edge, cv2.BORDER_REPLICATE), np.float32)


@jit
def far_cells(depth_m: Plane, cell: int) -> Plane:
    """Return the 90th percentile of depth per cell; NaN where less than 30 % is known.

    Every second pixel each way is looked at.
    """
    rows, columns = depth_m.shape[0] // cell, depth_m.shape[1] // cell
    result = np.full((rows, columns), np.nan, np.float32)
    values = np.empty(cell * cell, np.float32)
    for i in range(rows):
        for j in range(columns):
            count = 0
            for y in range(i * cell, (i + 1) * cell, 2):
                for x in range(j * cell, (j + 1) * cell, 2):
                    z = depth_m[y, x]
                    if z > 0:  # false for NaN
                        values[count] = z
                        count += 1
            if count >= 0.3 * (cell // 2) ** 2:
                result[i, j] = np.sort(values[:count])[int(0.9 * (count - 1))]
    return result


def fit_plane(far: Plane, known: NDArray[np.bool_]) -> Floats:
    """Return the depth of a plane below the cells (rows, columns), by Tukey's biweight."""
    i, j = np.nonzero(known)
    basis = np.column_stack([np.ones(len(i)), i / len(far), j / len(far)])
    z = far[known].astype(np.float64)
    weight: Floats = np.ones(len(z))
    solution: Floats = np.zeros(3)
    for _ in range(12):
        solution = least_squares(basis, 1 / z, weight)
        above = 1 / np.maximum(basis @ solution, 1e-3) - z
        # Tight for what rises, loose for what lies deeper; wide while most of it does not fit.
        scaled = above / np.where(above > 0, 0.5 * RELIEF_M, 1.5 * RELIEF_M)
        spread = max(1.0, 1.5 * float(np.median(np.abs(scaled))))
        weight = np.maximum(0, 1 - (scaled / spread) ** 2) ** 2 + 1e-6
    u, v = np.meshgrid(np.arange(far.shape[1]), np.arange(far.shape[0]))
    inverse = solution[0] + (solution[1] * v + solution[2] * u) / len(far)
    return np.asarray(1 / np.maximum(inverse, 1e-3))


def bend(rest: Floats, known: NDArray[np.bool_]) -> Floats:
    """Return a smooth correction (rows, columns) that follows the cells of the bed.

    Normalised convolution (Knutsson & Westin 1993), with a little weight on no correction where
    caps hide the bed; cells that rise above the surface are dropped, round by round.
    """
    values = np.where(known, rest, 0.0)
    weight = known & (np.abs(values) < RELIEF_M)
    surface = np.zeros(rest.shape)
    for _ in range(4):
        share = weight.astype(np.float64)
        total = cv2.GaussianBlur(share * values, (0, 0), _REACH_CELLS)
        surface = np.asarray(total / (cv2.GaussianBlur(share, (0, 0), _REACH_CELLS) + 0.02))
        above = surface - values
        weight = known & (above < 1.5 * ROUGH_M) & (above > -4 * ROUGH_M)
    return surface
