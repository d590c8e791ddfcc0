"""The bed below the mushrooms: a plane through the farthest depth, bent to the relief around it.

In inverse depth a plane is affine in the pixel coordinates, so one linear fit serves any tilt of
the camera (Labayrade et al. 2002 use the same in disparity). Casing soil rises and falls by more
than a small cap is high, but over larger distances; a smooth correction follows it.
"""

from __future__ import annotations

import cv2
import numpy as np

from mushpipe.core.arrays import Floats, Singles
from mushpipe.core.jit import borrower, jit
from mushpipe.stages.linear import solve

# Wide cells see the bed between dense caps, fine ones follow the soil.
CELL, FINE_CELL = 32, 16  # px
RELIEF_M = 0.02  # largest departure of the soil from the plane
# What lies farther above or below the surface is not bed. Caps only ever rise above it.
RISE_M, FALL_M = 0.006, 0.018
_FEWEST = 12
# Below dense caps half of the cells lie on the bed; of a plane with fewer than this share is asked
# whether it leans from the bed to a floor beside it.
WELL_SUPPORTED, CLEARLY = 0.4, 1.1  # and how much more another must have to take its place
WIDEST = 2.0  # misfit that a fit to a part of the image reaches for: caps, but no floor
_REACH_CELLS = 2.5


def bed_depth(depth_m: Singles, relief: bool = True) -> Singles | None:
    """Fit the bed and return its depth at every pixel.

    Args:
        depth_m: (H, W) metres, NaN = missing.
        relief: Follow the soil's relief; False gives the plane.

    Returns:
        (H, W) metres, or None where there is too little depth for a fit.
    """
    coefficients = fit_plane(far_cells(depth_m, CELL))
    if coefficients is None:
        return None
    height, width = depth_m.shape
    # One cell more on each side, so that the plane goes on to the border where the camera leans.
    rows, columns = (-(-n // FINE_CELL) + 2 for n in (height, width))
    # The centre of cell i lies at (i + 0.5) cells - 0.5 px, as cv2.resize assumes.
    v, u = (np.mgrid[:rows, :columns] - 1) * FINE_CELL + (FINE_CELL - 1) / 2
    surface = plane_depth(coefficients, u, v)
    if relief:
        far = far_cells(depth_m, FINE_CELL)
        bent = bend(far[..., 2] - plane_depth(coefficients, far[..., 0], far[..., 1]))
        after = (rows - 1 - bent.shape[0], columns - 1 - bent.shape[1])
        surface += np.pad(bent, ((1, after[0]), (1, after[1])), mode="edge")
    size = (columns * FINE_CELL, rows * FINE_CELL)
    full = cv2.resize(surface.astype(np.float32), size, interpolation=cv2.INTER_LINEAR)
    inside = full[FINE_CELL : FINE_CELL + height, FINE_CELL : FINE_CELL + width]
    return np.ascontiguousarray(inside, np.float32)


@jit
def far_cells(depth: Singles, cell: int) -> Floats:
    """Return (H / cell, W / cell, 3): x, y (px) and depth of a far sample of each cell.

    Of 4 x 4 samples of a cell it is the 90th percentile, at its own place, since on a slope the
    far side lies off the middle. Its depth is NaN where less than a third is known. What is not
    above 0 is missing. A cell is a multiple of 4 px.
    """
    rows, columns, step = depth.shape[0] // cell, depth.shape[1] // cell, cell // 4
    far = np.empty((rows, columns, 3))
    found = np.empty((16, 3))
    # row by row of the image, which comes from memory faster than cell by cell
    samples = depth[: rows * cell : step, : columns * cell : step].copy()
    for i in range(rows):
        for j in range(columns):
            known = 0
            for v in range(4 * i, 4 * i + 4):
                for u in range(4 * j, 4 * j + 4):
                    if samples[v, u] > 0:  # false for NaN
                        found[known, 0], found[known, 1] = step * u, step * v
                        found[known, 2] = samples[v, u]
                        known += 1
            far[i, j, 0], far[i, j, 1], far[i, j, 2] = j * cell, i * cell, np.nan
            if 3 * known >= len(found):
                _sort_farthest(found, known, known // 10)
                far[i, j] = found[known // 10]
    return far


@jit
def _sort_farthest(found: Floats, known: int, last: int) -> None:
    """Sort the known rows from the farthest on, as far as to the last place that is asked for."""
    for k in range(last + 1):
        best = k
        for m in range(k + 1, known):
            if found[m, 2] > found[best, 2]:
                best = m
        for c in range(3):
            found[k, c], found[best, c] = found[best, c], found[k, c]


def fit_plane(points: Floats) -> Floats | None:
    """Fit 1 / z = a + b x + c y by Tukey's biweight, tight for what rises, loose for what falls.

    Args:
        points: (..., 3) x, y (px or rays at z = 1) and depth z (m), NaN = missing.

    Returns:
        (3,) a, b, c; None where there are too few points.
    """
    solution = _biweight(np.ascontiguousarray(points, np.float64).reshape(-1, 3))
    return solution if np.isfinite(solution[0]) else None


@jit
def _biweight(points: Floats) -> Floats:
    """Solve 1 / z = a + b x + c y for points (N, 3) by reweighting, from weights of 1.

    Where few points lie on that plane it is looked for from parts of them, too; of the planes found
    it is the one on which the most lie.

    Returns:
        (3,) NaN where too few are known.
    """
    solution, other = np.zeros(3), np.zeros(3)
    basis, scale = _basis(points)
    if len(basis) < _FEWEST:
        solution[:] = np.nan
        return solution
    weight = np.ones(len(basis))
    support = _reweigh(basis, weight, np.inf, solution)
    for part in range(9 if support < WELL_SUPPORTED else 0):
        if not _weigh_part(basis, part, weight):
            continue
        found = _reweigh(basis, weight, WIDEST, other)
        if found > CLEARLY * support:
            support = found
            solution[:] = other
    solution[1:] /= scale
    return solution


@jit
def _weigh_part(basis: Floats, part: int, weight: Floats) -> bool:
    """Fill weights (N,) with 1 in a quarter, a half or the middle of the image, 0 elsewhere.

    Args:
        basis: (N, 4) from `_basis`.
        part: 0 to 8, row by row: left, any or right of the upper half, of any, of the lower half;
            any is the inner half.
        weight: Out.

    Returns:
        Whether there are enough points in that part.
    """
    x, y = basis[:, 1], basis[:, 2]
    left, top, right, bottom = x.min(), y.min(), x.max(), y.max()
    count = 0
    for m in range(len(basis)):
        across = (2 * x[m] - left - right) / max(right - left, 1e-9)  # -1..1
        down = (2 * y[m] - top - bottom) / max(bottom - top, 1e-9)
        column, row = part % 3 - 1, part // 3 - 1
        beside = abs(across) < 0.5 if column == 0 else column * across > 0
        below = abs(down) < 0.5 if row == 0 else row * down > 0
        inside = beside and below
        weight[m] = 1.0 if inside else 0.0
        count += inside
    return count >= _FEWEST


@jit
def _reweigh(basis: Floats, weight: Floats, widest: float, solution: Floats) -> float:
    """Reweigh until the solution rests.

    Args:
        basis: (N, 4) from `_basis`.
        weight: (N,) to start with, in and out.
        widest: Largest misfit of what still counts.
        solution: (3,) out.

    Returns:
        Share of the points that lies on the plane, each by its weight.
    """
    z = basis[:, 3]
    inverse, misfit, normal = 1 / z, np.empty(len(z)), np.empty((3, 3))
    for _ in range(20):
        if _step(basis, inverse, weight, normal, solution) < 1e-4:  # 1/m
            break
        _misfits(basis, z, solution, misfit)
        # wide while most does not fit
        spread = max(1.0, min(widest, 1.5 * np.median(misfit)))
        for m in range(len(z)):
            weight[m] = max(0.0, 1 - (misfit[m] / spread) ** 2) ** 2 + 1e-6
    _misfits(basis, z, solution, misfit)
    support = 0.0
    for m in range(len(z)):
        support += max(0.0, 1 - misfit[m] ** 2) ** 2
    return support / len(z)


@jit
def _basis(points: Floats) -> tuple[Floats, float]:
    """Return 1, x and y over a scale, and z of the points (N, 3) that are known; the scale."""
    basis, known, scale = np.empty((len(points), 4)), 0, 1e-6
    for m in range(len(points)):
        if np.isfinite(points[m, 2]):
            basis[known, 0], basis[known, 1:] = 1.0, points[m]
            scale = max(scale, abs(points[m, 0]), abs(points[m, 1]))
            known += 1
    basis[:known, 1:3] /= scale
    return basis[:known], scale


@borrower
def _step(
    basis: Floats, inverse: Floats, weight: Floats, normal: Floats, solution: Floats
) -> float:
    """Renew the solution by weighted least squares; return how far it moved."""
    aa = ab = ac = bb = bc = cc = az = bz = cz = 0.0
    for m in range(len(inverse)):
        a, b, c, w = basis[m, 0], basis[m, 1], basis[m, 2], weight[m]
        wa, wb, wc = w * a, w * b, w * c
        aa, ab, ac = aa + wa * a, ab + wa * b, ac + wa * c
        bb, bc, cc = bb + wb * b, bc + wb * c, cc + wc * c
        az, bz, cz = az + wa * inverse[m], bz + wb * inverse[m], cz + wc * inverse[m]
    firm = 1 + 1e-12  # points on one line determine no plane
    normal[0, 0], normal[0, 1], normal[0, 2] = aa * firm, ab, ac
    normal[1, 0], normal[1, 1], normal[1, 2] = ab, bb * firm, bc
    normal[2, 0], normal[2, 1], normal[2, 2] = ac, bc, cc * firm
    before = (solution[0], solution[1], solution[2])
    solution[0], solution[1], solution[2] = az, bz, cz
    solve(normal, solution)
    moved = 0.0
    for i in range(3):
        moved = max(moved, abs(solution[i] - before[i]))
    return moved


@borrower
def _misfits(basis: Floats, z: Floats, solution: Floats, misfit: Floats) -> None:
    """Fill how far (N,) the points lie off the plane, in what may rise and fall off the bed."""
    a, b, c = solution[0], solution[1], solution[2]
    for m in range(len(z)):
        model = basis[m, 0] * a + basis[m, 1] * b + basis[m, 2] * c
        above = 1 / max(model, 1e-3) - z[m]
        misfit[m] = above / RISE_M if above > 0 else -above / FALL_M


def plane_depth(coefficients: Floats, x: Floats, y: Floats) -> Floats:
    """Return the depth of the plane 1 / z = a + b x + c y."""
    a, b, c = coefficients
    return np.asarray(1 / np.maximum(a + b * x + c * y, 1e-3))


def bend(rest: Floats) -> Floats:
    """Return a smooth correction (rows, columns) that follows the cells of the bed.

    Normalised convolution (Knutsson & Westin 1993) of what the plane leaves, NaN = missing, with a
    little weight on no correction where caps hide the bed; cells that rise above the surface are
    dropped, round by round.
    """
    known, values = np.isfinite(rest), np.nan_to_num(rest)
    weight = known & (np.abs(values) < RELIEF_M)
    surface = np.zeros(rest.shape)
    for _ in range(4):
        share = weight.astype(np.float64)
        total = cv2.GaussianBlur(share * values, (0, 0), _REACH_CELLS)
        surface = np.asarray(total / (cv2.GaussianBlur(share, (0, 0), _REACH_CELLS) + 0.02))
        above = surface - values
        weight = known & (above < RISE_M) & (above > -FALL_M)
    return surface
