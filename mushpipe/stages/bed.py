"""The bed below the mushrooms: a robust low-order surface through the farthest depth.

In inverse depth a plane is affine in the pixel coordinates, so one linear fit serves any tilt of the
camera (Labayrade et al. 2002 use the same in disparity); quadratic terms follow a sagging bed.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]
Plane = NDArray[np.float32]
CELL = 16


def bed_depth(depth_m: Plane, order: int = 1, noise_m: float = 0.003) -> Plane | None:
    """Fit the bed and return its depth at every pixel.

    Caps only ever rise above the bed, so the fit starts from the far side of each cell of 16 x 16
    px and then drops, round by round, the cells that stand above the surface.

    Args:
        depth_m: (H, W) metres, NaN = missing.
        order: 1 for a plane, 2 for a quadratic surface in inverse depth.
        noise_m: Roughness of the bed that still counts as bed, m.

    Returns:
        (H, W) metres, or None where there is too little depth for a fit.
    """
    x, y, far = _far_cells(depth_m)
    basis = _basis(x, y, order)
    if len(far) < 2 * basis.shape[1]:
        return None
    weight = np.ones(len(far))
    for _ in range(12):
        root = np.sqrt(weight)
        solution = np.linalg.lstsq(basis * root[:, None], root / far, rcond=None)[0]
        above = 1 / np.maximum(basis @ solution, 1e-3) - far
        # Tukey's biweight, tight for what rises and loose for what lies deeper.
        scaled = np.where(above > 0, above / (2 * noise_m), above / (6 * noise_m))
        spread = max(1.0, float(np.median(np.abs(scaled))) * 1.5)
        weight = np.maximum(0, 1 - (scaled / spread) ** 2) ** 2 + 1e-6
    height, width = depth_m.shape
    v, u = np.mgrid[:height, :width]
    full = _basis((u / width - 0.5).ravel(), (v / height - 0.5).ravel(), order) @ solution
    return (1 / np.maximum(full, 1e-3)).reshape(height, width).astype(np.float32)


def _far_cells(depth_m: Plane) -> tuple[Floats, Floats, Floats]:
    """Return centre (x, y in -0.5..0.5) and 90th percentile of depth of each cell that has some."""
    height, width = depth_m.shape
    rows, columns = height // CELL, width // CELL
    cells = depth_m[: rows * CELL, : columns * CELL].reshape(rows, CELL, columns, CELL)
    cells = cells.transpose(0, 2, 1, 3).reshape(rows * columns, CELL * CELL)
    known = np.isfinite(cells).mean(axis=1) > 0.3
    far = np.nanpercentile(cells[known], 90, axis=1).astype(np.float64)
    v, u = np.divmod(np.flatnonzero(known), max(columns, 1))
    return (u + 0.5) * CELL / width - 0.5, (v + 0.5) * CELL / height - 0.5, far


def _basis(x: Floats, y: Floats, order: int) -> Floats:
    columns = [np.ones_like(x), x, y]
    if order == 2:
        columns += [x * x, x * y, y * y]
    return np.column_stack(columns)
