"""The depth that is a circle's own: cut out of the image, and averaged over blocks of a grid."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from mushpipe.core.arrays import Floats, Ints32, Singles
from mushpipe.core.jit import borrower, inlined, jit
from mushpipe.stages.cap.model import Single

GRID = 11
HIDDEN = Single(-1)
WIDEST = 32.0  # px, half width of a block from which on more pixels tell no more
ENOUGH = 0.4  # share of a block's pixels that must have depth

_CENTERS: Floats = (np.arange(GRID) + 0.5) / GRID * 2 - 1
_X, _Y = np.meshgrid(_CENTERS, _CENTERS)
_INSIDE = _X**2 + _Y**2 <= 1
CELLS: Floats = np.stack([_X[_INSIDE], _Y[_INSIDE]], axis=-1)
K = 104  # and some in the middle: the compiler works on several at once
CELL_X, CELL_Y = np.pad(CELLS, ((0, K - len(CELLS)), (0, 0))).T.copy()
# rows of K in the table of blocks: valid pixels, mean u and v (px), mean depth (m), its variance
COUNT, U, V, DEPTH, SPREAD = range(5)


class Image(NamedTuple):
    """Depth as kernels see it.

    Attributes:
        depth: (H, W) m, missing where not above 0.
        rays: (H, W, 2) rays of the pixels at z = 1, beyond 1e3 where a pixel has none.
        ranks: (H, W) rank of the nearest circle that covers the pixel, from `by_depth`.
        focal: Focal length, px.
    """

    depth: Singles
    rays: Singles
    ranks: NDArray[np.int16]
    focal: float


class Sensor(NamedTuple):
    """A depth camera.

    Attributes:
        noise: Sigma of depth at the camera, m.
        growth: Its growth with depth, m per m.
        bias: Of the depth, m.
        edge: How much of an edge it loses, px.
    """

    noise: float
    growth: float
    bias: float
    edge: float


class Window(NamedTuple):
    """A part of an image, px: its first column and row, and its size."""

    left: int
    top: int
    width: int
    height: int


class Cut(NamedTuple):
    """Room for what is taken from an image around one circle after the other.

    Attributes:
        own: (H W,) the depth of a window, row by row.
        pixels: (3 K,) rows of K, where in the window a block's middle is, and a pixel of it.
        blocks: (6 K,) rows of K, the blocks, and the depth of a pixel of each.
        values: (K,) to sort.
    """

    own: Singles
    pixels: Ints32
    blocks: Singles
    values: Singles


@jit
def room_to_cut(height: int, width: int) -> Cut:
    """Return room for images (H, W)."""
    return Cut(
        np.empty(height * width, np.float32),
        np.empty(3 * K, np.int32),
        np.empty(6 * K, np.float32),
        np.empty(K, np.float32),
    )


@inlined
def half_width(radius: float) -> int:
    """Return the half width of the blocks in a circle (px)."""
    return int(min(np.floor(radius / GRID), WIDEST))


@borrower
def own_depth(image: Image, rank: int, circle: Floats, reach: float, own: Singles) -> Window:
    """Cut the depth around a circle out of an image.

    Args:
        image: What it is cut out of.
        rank: This circle's; pixels of a lower one are hidden.
        circle: (3,) x, y, radius, px.
        reach: How far around the centre, in radii.
        own: (H W,) out, row by row: the depth, 0 where it is missing, HIDDEN where a nearer circle
            hides it.

    Returns:
        What of the image that is.
    """
    depth, ranks, far = image.depth, image.ranks, reach * circle[2] + 2.0
    left = min(max(int(circle[0] - far), 0), depth.shape[1])
    right = min(max(int(circle[0] + far) + 2, left), depth.shape[1])
    top = min(max(int(circle[1] - far), 0), depth.shape[0])
    bottom = min(max(int(circle[1] + far) + 2, top), depth.shape[0])
    width, lowest = right - left, np.int16(rank)
    for i in range(bottom - top):
        seen, nearest = depth[top + i, left:right], ranks[top + i, left:right]
        for j in range(width):
            z = seen[j] if seen[j] > Single(0) else Single(0)  # false for NaN
            own[i * width + j] = z if nearest[j] >= lowest else HIDDEN
    return Window(left, top, width, bottom - top)


@borrower
def average(window: Window, circle: Floats, half: int, cut: Cut) -> None:
    """Average the valid pixels of square blocks, of the width 2 half + 1, around CELLS.

    Args:
        window: From `own_depth`, whose depth is in `cut`.
        circle: (3,) x, y, radius, px.
        half: Half width of a block, px.
        cut: Out: its blocks, whose numbers are 0 where no pixel is valid.
    """
    blocks, pixels, own = cut.blocks, cut.pixels, cut.own
    none, one = Single(0), Single(1)
    left, top = np.int32(window.left), np.int32(window.top)
    width, height = np.int32(window.width), np.int32(window.height)
    for j in range(K):
        pixels[j] = np.int32(np.floor(circle[0] + circle[2] * CELL_X[j] + 0.5)) - left
        pixels[j + K] = np.int32(np.floor(circle[1] + circle[2] * CELL_Y[j] + 0.5)) - top
        for i in range(5):
            blocks[j + i * K] = none
    for n in range((2 * half + 1) ** 2):
        du, dv = np.int32(n % (2 * half + 1) - half), np.int32(n // (2 * half + 1) - half)
        beside, below = Single(du), Single(dv)
        for j in range(K):
            u, v = pixels[j] + du, pixels[j + K] + dv
            inside = (u >= 0) & (v >= 0) & (u < width) & (v < height)
            pixels[j + 2 * K] = v * width + u if inside else -1
        for j in range(K):
            z = own[max(pixels[j + 2 * K], 0)]
            blocks[j + 5 * K] = z if pixels[j + 2 * K] >= 0 else none
        for j in range(K):
            z = max(blocks[j + 5 * K], none)
            valid = one if z > none else none
            blocks[j] += valid
            blocks[j + U * K] += beside * valid
            blocks[j + V * K] += below * valid
            blocks[j + DEPTH * K] += z
            blocks[j + SPREAD * K] += z * z
    for j in range(K):
        share = one / max(blocks[j], one)
        mean = blocks[j + DEPTH * K] * share
        blocks[j + U * K] = share * blocks[j + U * K] + Single(pixels[j] + left)
        blocks[j + V * K] = share * blocks[j + V * K] + Single(pixels[j + K] + top)
        blocks[j + DEPTH * K] = mean
        blocks[j + SPREAD * K] = max(blocks[j + SPREAD * K] * share - mean * mean, none)


@inlined
def enough(half: int) -> float:
    """Return of how many valid pixels a block of a half width (px) must have more."""
    return ENOUGH * (2 * half + 1) ** 2


@borrower
def middle_depth(cut: Cut, half: int, core: float) -> float:
    """Return the median depth (m) of the blocks near the centre, 0 without any.

    Args:
        cut: With blocks from `average`.
        half: Half width of a block, px.
        core: Squared share of the radius that is near.
    """
    values, n = cut.values, 0
    for j in range(len(CELLS)):
        near = CELLS[j, 0] ** 2 + CELLS[j, 1] ** 2 < core
        if near and cut.blocks[j] > enough(half):
            values[n] = cut.blocks[j + DEPTH * K]
            n += 1
    return median(values, n)


@borrower
def median(values: Singles, n: int) -> float:
    """Return the median of the first n values; 0 without any.

    Counts for each how many are smaller and how many are not larger: for some tens of values that
    is faster than to sort them, since no branch depends on them.
    """
    lower, upper = Single(0), Single(0)
    for i in range(n):
        value, smaller, equal = values[i], np.int32(0), np.int32(0)
        for j in range(n):
            smaller += np.int32(values[j] < value)
            equal += np.int32(values[j] == value)
        lower = value if smaller <= (n - 1) // 2 < smaller + equal else lower
        upper = value if smaller <= n // 2 < smaller + equal else upper
    return 0.5 * float(lower + upper)
