"""Chan-Vese in milliseconds: a pyramid of convolution-thresholding, then descent on the contour.

ICTM (Esedoglu & Tsai 2006; Wang et al. 2017) replaces the length by
sqrt(2 pi) / sigma * sum u (1 - G_sigma * u); linearised, an iteration is a blur and a threshold:

    u <- 1 where (c1 - c2)(2 I - c1 - c2) - mu sqrt(2 pi) / sigma (1 - 2 G_sigma * u) > 0

The sweeps that follow, on every level, descend the exact discrete energy on the pixels of the
contour (ICM, Besag 1986), which convolution with its finite kernel cannot reach.
"""

from __future__ import annotations

import math

import cv2
import numpy as np
from numpy.typing import NDArray

from mushpipe.core.jit import jit

Plane = NDArray[np.float32]
Planes = NDArray[np.float32]
Levels = tuple[float, float]
SIGMA = 1.5
_TAPS = np.exp(-(np.arange(-3, 4) ** 2) / (2 * SIGMA**2)).astype(np.float32)
_TAPS /= _TAPS.sum()


@jit
def ictm_sweep(
    image: Plane, old: Plane, new: Plane, taps: Plane, gain: float, offset: float, pull: float
) -> int:
    """One iteration: new = 1 where gain I + offset + pull (2 G*old - 1) > 0, borders replicated.

    Returns the number of pixels that changed.
    """
    height, width = image.shape
    row = np.empty(width + 6, np.float32)
    changed = 0
    g0, g1, g2, g3 = taps[3], taps[4], taps[5], taps[6]
    slope, level, bend = np.float32(gain), np.float32(offset - pull), np.float32(2 * pull)
    for y in range(height):
        a, b, c = max(y - 3, 0), max(y - 2, 0), max(y - 1, 0)
        d, e, f = min(y + 1, height - 1), min(y + 2, height - 1), min(y + 3, height - 1)
        for x in range(width):
            row[x + 3] = (
                g0 * old[y, x]
                + g1 * (old[c, x] + old[d, x])
                + g2 * (old[b, x] + old[e, x])
                + g3 * (old[a, x] + old[f, x])
            )
        row[0] = row[1] = row[2] = row[3]
        row[width + 3] = row[width + 4] = row[width + 5] = row[width + 2]
        moved = np.float32(0)
        for x in range(width):
            blur = (
                g0 * row[x + 3]
                + g1 * (row[x + 2] + row[x + 4])
                + g2 * (row[x + 1] + row[x + 5])
                + g3 * (row[x] + row[x + 6])
            )
            phi = slope * image[y, x] + level + bend * blur
            label = np.float32(1) if phi > 0 else np.float32(0)
            moved += abs(label - old[y, x])
            new[y, x] = label
        changed += int(moved)
    return changed


@jit
def region_sums(image: Plane, u: Plane) -> tuple[int, float, float]:
    """Return the number of pixels inside, the image's sum over them, and its sum over all."""
    height, width = image.shape
    inside = 0
    total = 0.0
    everything = 0.0
    for y in range(height):
        # Sums of one row in float32 keep the loop vectorised; a row is too short to lose digits.
        count = sum_row = all_row = np.float32(0)
        for x in range(width):
            count += u[y, x]
            sum_row += u[y, x] * image[y, x]
            all_row += image[y, x]
        inside += int(count)
        total += float(sum_row)
        everything += float(all_row)
    return inside, total, everything


@jit
def icm_sweep(image: Plane, u: Plane, gain: float, offset: float, mu: float) -> int:
    """Flip, in raster order and in place, each pixel of the contour that lowers the energy by it.

    Label 1 where -(gain I + offset) + a (4 - 2 n4) + b (4 - 2 nd) < 0, with a = mu pi/8 and
    b = a / sqrt 2, n4 and nd the set axial and diagonal neighbours; none lie beyond the border.

    Returns the number of flips.
    """
    height, width = image.shape
    a = np.float32(mu * math.pi / 8)
    b = np.float32(mu * math.pi / 8 / math.sqrt(2))
    slope, level, one, two = np.float32(gain), np.float32(offset), np.float32(1), np.float32(2)
    column = np.empty(width + 2, np.float32)
    flips = 0
    for y in range(height):
        up, down = max(y - 1, 0), min(y + 1, height - 1)
        for x in range(width):
            column[x + 1] = u[up, x] + u[y, x] + u[down, x]
        column[0], column[width + 1] = column[1], column[width]
        above, below = np.float32(y > 0), np.float32(y < height - 1)
        for x in range(width):
            around = column[x] + column[x + 1] + column[x + 2]
            if around < np.float32(0.5) or around > np.float32(8.5):
                continue
            left, right = max(x - 1, 0), min(x + 1, width - 1)
            west, east = np.float32(x > 0), np.float32(x < width - 1)
            axial = above * (one - two * u[up, x]) + below * (one - two * u[down, x])
            axial += west * (one - two * u[y, left]) + east * (one - two * u[y, right])
            diagonal = above * (
                west * (one - two * u[up, left]) + east * (one - two * u[up, right])
            )
            diagonal += below * (
                west * (one - two * u[down, left]) + east * (one - two * u[down, right])
            )
            inside = a * axial + b * diagonal < slope * image[y, x] + level
            if inside != (u[y, x] > 0):
                flips += 1
                u[y, x] = np.float32(inside)
    return flips


class _Regions:
    """The two means of a region, and the force they exert on each pixel."""

    def __init__(self, planes: Planes, u: Plane, levels: Levels | None) -> None:
        self.planes = planes
        self.levels = levels
        self.update(u)

    def update(self, u: Plane) -> None:
        sums = [region_sums(plane, u) for plane in self.planes]
        self.inside = sums[0][0]
        outside = max(1, u.size - self.inside)
        self.c1 = np.array([total / max(1, self.inside) for _, total, _ in sums])
        self.c2 = np.array([(everything - total) / outside for _, total, everything in sums])
        self.one_sided = self.inside in (0, u.size)
        if self.levels is not None:
            self.c1, self.c2 = (np.full(len(sums), level) for level in self.levels)

    def force(self) -> tuple[Plane, float, float]:
        """Return P, gain and offset of |I - c2|^2 - |I - c1|^2 = gain P + offset."""
        gain = 2 * (self.c1 - self.c2) / len(self.planes)
        offset = float((self.c2**2 - self.c1**2).mean())
        if len(self.planes) == 1:
            return self.planes[0], float(gain[0]), offset
        return np.tensordot(gain.astype(np.float32), self.planes, 1), 1.0, offset


def solve_fast(
    image: Plane,
    initial: NDArray[np.bool_],
    mu: float,
    levels: Levels | None = None,
    depth: int = 5,
    iterations: int = 3,
    sweeps: int = 2,
) -> NDArray[np.bool_]:
    """Minimise the Chan-Vese energy from an initial region.

    Args:
        image: (H, W) or (H, W, C) in 0..1.
        initial: (H, W) region to start from.
        mu: Weight of the length.
        levels: c1 and c2 where they are known; else they are the means of the two sides.
        depth: Levels of the pyramid, the full resolution among them.
        iterations: Most ICTM iterations at full resolution, doubled per level; fewer where nothing
            moves any more.
        sweeps: Most sweeps of descent on the contour at full resolution, four times more per level.
    """
    planes = np.ascontiguousarray(np.moveaxis(image, -1, 0) if image.ndim == 3 else image[None])
    u = _pyramid(planes, initial.astype(np.float32), mu, levels, depth, iterations, sweeps)
    return u > 0


def _pyramid(
    planes: Planes,
    u: Plane,
    mu: float,
    levels: Levels | None,
    depth: int,
    iterations: int,
    sweeps: int,
) -> Plane:
    """Solve at half resolution first, with mu / 2: the length halves while the area quarters."""
    height, width = u.shape
    if depth > 1 and min(height, width) >= 32:
        half = (width // 2, height // 2)
        small = np.stack([cv2.resize(p, half, interpolation=cv2.INTER_AREA) for p in planes])
        start = cv2.resize(u, half, interpolation=cv2.INTER_AREA).round()
        solved = _pyramid(small, start, mu / 2, levels, depth - 1, 2 * iterations, 4 * sweeps)
        u = cv2.resize(solved, (width, height)).round()
    u = _ictm(planes, u, mu, levels, iterations)
    return _descend(planes, u, mu, levels, sweeps)


def _ictm(planes: Planes, u: Plane, mu: float, levels: Levels | None, iterations: int) -> Plane:
    regions, other = _Regions(planes, u, levels), np.empty_like(u)
    pull = mu * math.sqrt(2 * math.pi) / SIGMA
    for _ in range(iterations):
        if regions.one_sided:
            break
        plane, gain, offset = regions.force()
        changed = ictm_sweep(plane, u, other, _TAPS, gain, offset, pull)
        u, other = other, u
        if not changed:
            break
        regions.update(u)
    return u


def _descend(planes: Planes, u: Plane, mu: float, levels: Levels | None, sweeps: int) -> Plane:
    regions = _Regions(planes, u, levels)
    for _ in range(sweeps):
        if regions.one_sided:
            break
        plane, gain, offset = regions.force()
        if not icm_sweep(plane, u, gain, offset, mu):
            break
        regions.update(u)
    return u
