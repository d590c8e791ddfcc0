"""Chan-Vese in milliseconds: a pyramid of convolution-thresholding, then descent on the contour.

ICTM (Esedoglu & Tsai 2006; Wang et al. 2017) replaces the length by
sqrt(2 pi) / sigma * sum u (1 - G_sigma * u); linearised, an iteration is a blur and a threshold:

    u <- 1 where (c1 - c2)(2 I - c1 - c2) - mu sqrt(2 pi) / sigma (1 - 2 G_sigma * u) > 0

The sweeps that follow, on every level, descend the exact discrete energy pixel by pixel (ICM, Besag
1986), which convolution with its finite kernel cannot reach.

Regions are bytes, 1 inside, 0 outside: a quarter of the memory that floats would need.
"""

from __future__ import annotations

import math
from typing import Any

import cv2
import numpy as np

from mushpipe.core.arrays import Bools, Bytes, Floats, Singles
from mushpipe.core.jit import inlined, jit
from mushpipe.stages.doubling import doubled

Levels = tuple[float, float]
SIGMA = 1.5
DEPTH = 5  # levels of the pyramid, the full resolution among them
# Most ICTM iterations and sweeps of descent at full resolution, fewer where nothing moves any more;
# each coarser level takes twice the iterations and four times the sweeps.
ITERATIONS, SWEEPS = 3, 2
_TAPS = np.exp(-(np.arange(-3, 4) ** 2) / (2 * SIGMA**2)).astype(np.float32)
_TAPS /= _TAPS.sum()


@jit
def ictm_sweep(
    image: Singles, old: Bytes, new: Bytes, taps: Singles, gain: float, offset: float, pull: float
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
                g0 * np.float32(old[y, x])
                + g1 * (np.float32(old[c, x]) + np.float32(old[d, x]))
                + g2 * (np.float32(old[b, x]) + np.float32(old[e, x]))
                + g3 * (np.float32(old[a, x]) + np.float32(old[f, x]))
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
            moved += abs(label - np.float32(old[y, x]))
            new[y, x] = np.uint8(label)
        changed += int(moved)
    return changed


@jit
def region_sums(image: Singles, u: Bytes) -> tuple[int, float, float]:
    """Return the number of pixels inside, the image's sum over them, and its sum over all."""
    height, width = image.shape
    inside = 0
    total = 0.0
    everything = 0.0
    for y in range(height):
        # Sums of one row in float32 keep the loop vectorised; a row is too short to lose digits.
        count = sum_row = all_row = np.float32(0)
        for x in range(width):
            member = np.float32(u[y, x])
            count += member
            sum_row += member * image[y, x]
            all_row += image[y, x]
        inside += int(count)
        total += float(sum_row)
        everything += float(all_row)
    return inside, total, everything


@jit
def icm_sweep(image: Singles, u: Bytes, gain: float, offset: float, mu: float) -> int:
    """Flip, in raster order and in place, each pixel that lowers the energy by it.

    With s = 1 outside, -1 inside and 0 beyond the border, a flip lowers the energy by
    s (gain I + offset - a sum s4 - b sum sd), a = mu pi/8 and b = a / sqrt 2, s4 and sd the axial
    and diagonal neighbours. Few pixels flip: which may is asked of a row at once, and of those each
    again in its turn.

    Returns the number of flips.
    """
    height, width = image.shape
    a, b = np.float32(mu * math.pi / 8), np.float32(mu * math.pi / 8 / math.sqrt(2))
    slope, level = np.float32(gain), np.float32(offset)
    above, here, below = np.zeros((3, width + 2), np.float32)
    force = np.empty(width, np.float32)
    may = np.zeros((width + 7) // 8 * 8, np.uint8)
    eight = may.view(np.uint64)
    flips = 0
    _signs(u, 0, below)
    for y in range(height):
        above, here, below = here, below, above
        _signs(u, y + 1, below)
        for x in range(width):
            force[x] = slope * image[y, x] + level
            may[x] = here[x + 1] * (force[x] - _pull(above, here, below, x, a, b)) > 0
        for k in range(len(eight)):
            if eight[k] == 0:
                continue
            for x in range(8 * k, min(8 * k + 8, width)):
                falls = here[x + 1] * (force[x] - _pull(above, here, below, x, a, b))
                if falls > 0:
                    here[x + 1] = -here[x + 1]
                    u[y, x] ^= np.uint8(1)
                    flips += 1
    return flips


@jit
def _signs(u: Bytes, y: int, row: Singles) -> None:
    """Write the signs of a row, 1 px to the right."""
    height, width = u.shape
    for x in range(width):
        row[x + 1] = np.float32(1) - np.float32(2) * np.float32(u[y, x]) if y < height else 0


@inlined
def _pull(
    above: Singles, here: Singles, below: Singles, x: int, a: np.float32, b: np.float32
) -> Any:
    axial = above[x + 1] + below[x + 1] + here[x] + here[x + 2]
    return a * axial + b * (above[x] + above[x + 2] + below[x] + below[x + 2])


@jit
def _means(planes: Singles, u: Bytes, c1: Floats, c2: Floats, known: bool) -> tuple[int, float]:
    """Write the means of the two sides, unless they are known.

    Returns:
        The pixels inside, and the sum of the squared differences from the means less the squares of
        the image, which are the same for all regions.
    """
    inside, fit = 0, 0.0
    for k in range(len(planes)):
        inside, total, everything = region_sums(planes[k], u)
        outside, rest = u.size - inside, everything - total
        if not known:
            c1[k], c2[k] = total / max(1, inside), rest / max(1, outside)
        fit += c1[k] * (inside * c1[k] - 2 * total) + c2[k] * (outside * c2[k] - 2 * rest)
    return inside, fit / len(planes)


@jit
def _force(planes: Singles, c1: Floats, c2: Floats, mixed: Singles) -> tuple[Singles, float, float]:
    """Return P, gain and offset of |I - c2|^2 - |I - c1|^2 = gain P + offset; mixed is scratch."""
    count = len(planes)
    gain, offset = 2 * (c1 - c2) / count, ((c2 * c2).sum() - (c1 * c1).sum()) / count
    if count == 1:
        return planes[0], gain[0], offset
    mixed[:] = 0
    for k in range(count):
        mixed += np.float32(gain[k]) * planes[k]
    return mixed, 1.0, offset


@jit
def _solve_level(
    planes: Singles, u: Bytes, mu: float, c1: Floats, c2: Floats, known: bool, most: tuple[int, int]
) -> Bytes:
    """Run at most so many ICTM iterations and sweeps of descent on a region, which is changed.

    One kernel, since each return to Python may have to wait for other threads.
    """
    other, mixed = np.empty_like(u), np.empty_like(planes[0])
    pull = mu * math.sqrt(2 * math.pi) / SIGMA
    inside, _ = _means(planes, u, c1, c2, known)
    for _ in range(most[0]):
        if inside == 0 or inside == u.size:
            break
        plane, gain, offset = _force(planes, c1, c2, mixed)
        changed = ictm_sweep(plane, u, other, _TAPS, gain, offset, pull)
        u, other = other, u
        if changed == 0:
            break
        inside, _ = _means(planes, u, c1, c2, known)
    for _ in range(most[1]):
        if inside == 0 or inside == u.size:
            break
        plane, gain, offset = _force(planes, c1, c2, mixed)
        if icm_sweep(plane, u, gain, offset, mu) == 0:
            break
        inside, _ = _means(planes, u, c1, c2, known)
    return u


@jit
def _length(u: Bytes) -> float:
    """Return the length of a contour, px, as `contour_length` does."""
    height, width = u.shape
    axial = diagonal = 0
    for y in range(height):
        above, here = u[max(y - 1, 0)], u[y]
        for x in range(width):
            axial += here[x] ^ above[x]
        for x in range(width - 1):
            axial += here[x] ^ here[x + 1]
            diagonal += (here[x] ^ above[x + 1]) + (here[x + 1] ^ above[x]) if y else 0
    return math.pi / 8 * (axial + diagonal / math.sqrt(2))


@jit
def _cost(planes: Singles, u: Bytes, mu: float, c1: Floats, c2: Floats, known: bool) -> float:
    """Return the energy of a region, times the pixels, less the squares of the image."""
    return _means(planes, u, c1, c2, known)[1] + mu * _length(u)


def solve_fast(image: Singles, initial: Bools, mu: float, levels: Levels | None = None) -> Bools:
    """Minimise the Chan-Vese energy from an initial region.

    Args:
        image: (H, W) or (H, W, C) in 0..1.
        initial: (H, W) region to start from.
        mu: Weight of the length.
        levels: c1 and c2 where they are known; else they are the means of the two sides.
    """
    # A copy: read-only planes would be a type of their own to the compiler.
    planes = np.stack(cv2.split(image)) if image.ndim == 3 else image[None].copy()
    bits = initial.view(np.uint8)
    return _pyramid(planes, bits, mu, levels, DEPTH, ITERATIONS, SWEEPS).view(np.bool_)


def _pyramid(
    planes: Singles,
    initial: Bytes,
    mu: float,
    levels: Levels | None,
    depth: int,
    iterations: int,
    sweeps: int,
) -> Bytes:
    """Solve at half resolution first, with mu / 2: the length halves while the area quarters.

    What is small is nothing at a coarse level. Where no contour is left there this level begins
    with its own; where none is left here, or one that costs more than the first, the descent alone
    decides, which never goes up.
    """
    height, width = initial.shape
    if depth > 1 and min(height, width) >= 32:
        half = (width // 2, height // 2)
        small = np.stack([cv2.resize(p, half, interpolation=cv2.INTER_AREA) for p in planes])
        share = cv2.resize(2 * initial, half, interpolation=cv2.INTER_AREA)
        start = np.asarray(share > 1).view(np.uint8)
        solved = _pyramid(small, start, mu / 2, levels, depth - 1, 2 * iterations, 4 * sweeps)
        u = doubled(solved, height, width) if _divides(solved) else initial.copy()
    else:
        u = initial.copy()
    c1, c2 = (np.full(len(planes), level) for level in levels or (0.0, 0.0))
    known = levels is not None
    u = _solve_level(planes, u, mu, c1, c2, known, (iterations, sweeps))
    own = initial.copy()
    worse = _cost(planes, u, mu, c1, c2, known) > _cost(planes, own, mu, c1, c2, known)
    if worse or not _divides(u):
        u = _solve_level(planes, own, mu, c1, c2, known, (0, sweeps))
    return np.asarray(u, np.uint8)


def _divides(u: Bytes) -> bool:
    """Return whether a region has an inside and an outside."""
    return bool(u.any() and not u.all())
