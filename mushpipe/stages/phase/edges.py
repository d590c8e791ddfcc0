"""Sub-pixel edges: gradients, an adaptive threshold, and where the outlines lie beside them."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from mushpipe.core.arrays import Bytes, Ints32, Singles
from mushpipe.core.jit import borrower, jit
from mushpipe.stages.phase.thin import thin

SIGMA = 1.1
TOP = 64.0  # gray levels per px; larger gradients count as this in Otsu's threshold
DEPTH_ALONE = 0.6  # weight of a depth edge without a gray one
# Between two caps the steepest step lies within the shaded rim, not on the outline. How far within
# depends on how bright it is outside, over inside: fitted to the simulator's outlines.
DIM, BRIGHT, SHIFT = 0.25, 0.8, 2.3
BRIGHT_TRUST = 0.4
_OFFSETS = np.arange(-3, 4)
SMOOTH = np.exp(-(_OFFSETS**2) / (2 * SIGMA**2)).astype(np.float32)
SMOOTH /= SMOOTH.sum()
# Weights of the differences at a distance of 1, 2, 3 px; a ramp of 1 per px has the gradient 1.
SLOPE = (_OFFSETS * SMOOTH / (_OFFSETS**2 * SMOOTH).sum()).astype(np.float32)[4:]


class Gradient(NamedTuple):
    """Derivatives of a smoothed image.

    Attributes:
        x: (H, W) per px.
        y: (H, W) per px.
        size: (H, W) magnitude.
    """

    x: Singles
    y: Singles
    size: Singles


class Edges(NamedTuple):
    """Edge points with their normals.

    Attributes:
        x: (M,) px, sub-pixel.
        y: (M,) px.
        nx: (M,) unit normal, towards the brighter or higher side.
        ny: (M,)
        weight: (M,) how far its place can be trusted, 0..1; depth edges less than gray ones.
    """

    x: Singles
    y: Singles
    nx: Singles
    ny: Singles
    weight: Singles


@jit
def gradient(image: Singles, smooth: Singles, slope: Singles) -> tuple[Singles, Singles, Singles]:
    """Return the derivatives by x and y and the magnitude, by 7 taps each way; borders repeat."""
    height, width = image.shape
    gx, gy, size = np.empty_like(image), np.empty_like(image), np.empty_like(image)
    level, change = np.empty(width + 6, np.float32), np.empty(width + 6, np.float32)
    s0, s1, s2, s3 = smooth[3], smooth[2], smooth[1], smooth[0]
    d1, d2, d3 = slope[0], slope[1], slope[2]
    for y in range(height):
        a, b, c = max(y - 3, 0), max(y - 2, 0), max(y - 1, 0)
        d, e, f = min(y + 1, height - 1), min(y + 2, height - 1), min(y + 3, height - 1)
        for x in range(width):
            p1, m1, p2, m2 = image[d, x], image[c, x], image[e, x], image[b, x]
            p3, m3 = image[f, x], image[a, x]
            level[x + 3] = s0 * image[y, x] + s1 * (p1 + m1) + s2 * (p2 + m2) + s3 * (p3 + m3)
            change[x + 3] = d1 * (p1 - m1) + d2 * (p2 - m2) + d3 * (p3 - m3)
        for k in range(3):
            level[k], change[k] = level[3], change[3]
            level[width + 3 + k], change[width + 3 + k] = level[width + 2], change[width + 2]
        for x in range(width):
            u = (
                d1 * (level[x + 4] - level[x + 2])
                + d2 * (level[x + 5] - level[x + 1])
                + d3 * (level[x + 6] - level[x])
            )
            v = (
                s0 * change[x + 3]
                + s1 * (change[x + 4] + change[x + 2])
                + s2 * (change[x + 5] + change[x + 1])
                + s3 * (change[x + 6] + change[x])
            )
            gx[y, x], gy[y, x] = u, v
            size[y, x] = np.sqrt(u * u + v * v)
    return gx, gy, size


def gradient_of(image: Singles) -> Gradient:
    """Return the gradient of an (H, W) float32 image."""
    return Gradient(*gradient(image, SMOOTH, SLOPE))


@jit
def otsu_of(size: Singles) -> float:
    """Return Otsu's threshold (1979) of the values at every second pixel, in 256 bins to `TOP`."""
    bins = np.zeros(256, np.int64)
    scale = np.float32(256 / TOP)
    for y in range(0, size.shape[0], 2):
        for x in range(0, size.shape[1], 2):
            bins[min(255, int(size[y, x] * scale))] += 1
    total, mean = 0.0, 0.0
    for k in range(256):
        total += bins[k]
        mean += k * bins[k]
    best, threshold, weight, first = -1.0, 0, 0.0, 0.0
    for k in range(255):
        weight += bins[k]
        first += k * bins[k]
        if weight == 0 or weight == total:
            continue
        between = (mean * weight / total - first) ** 2 / (weight * (total - weight))
        if between > best:
            best, threshold = between, k
    return float((threshold + 1) / scale)


@borrower
def _looked_up(
    image: Singles, x: Singles, y: Singles, nx: Singles, ny: Singles, t: float, out: Singles
) -> None:
    """Write the values of the pixels at a distance from points along their normals."""
    height, width = np.int32(image.shape[0] - 1), np.int32(image.shape[1] - 1)
    flat, far, half = image.reshape(-1), np.float32(t), np.float32(0.5)
    for k in range(len(x)):  # without branches, for SIMD
        u = min(max(np.int32(x[k] + far * nx[k] + half), np.int32(0)), width)
        v = min(max(np.int32(y[k] + far * ny[k] + half), np.int32(0)), height)
        out[k] = flat[np.uint32(v * (width + np.int32(1)) + u)]


@jit
def _beyond_over_before(
    image: Singles, x: Singles, y: Singles, nx: Singles, ny: Singles
) -> Singles:
    """Return how bright it is beyond edges, which the normals point away from, over before them."""
    inside, near, far = np.empty((3, len(x)), np.float32)
    _looked_up(image, x, y, nx, ny, 3.0, inside)
    _looked_up(image, x, y, nx, ny, -2.5, near)
    _looked_up(image, x, y, nx, ny, -3.5, far)
    nothing, least = np.float32(0), np.float32(1e-3)
    for k in range(len(x)):
        near[k] = max(min(near[k], far[k]), nothing) / max(inside[k], least)
    return near


def edges_of(
    image: Singles, grad: Gradient, region: Bytes, threshold: float, full: float
) -> tuple[Edges, Ints32]:
    """Return the thin edges of an image in the place of the outlines they stand for.

    Args:
        image: (H, W) gray levels.
        grad: Its gradient.
        region: (H, W) where to look.
        threshold: Least gradient.
        full: Gradient from which on an edge has its full weight.

    Returns:
        The edges, and (H, W) the row of the edge that was found at a pixel, -1 for none.
    """
    (x, y, nx, ny, strength, column, row), index = _thin_edges(grad, region, threshold)
    bright = _beyond_over_before(image, column, row, nx, ny)
    share = np.clip((bright - DIM) / (BRIGHT - DIM), 0, 1).astype(np.float32)
    weight = np.minimum(1, strength * np.float32(threshold / full))
    weight *= 1 - (1 - np.float32(BRIGHT_TRUST)) * share
    outward = np.float32(SHIFT) * share
    return Edges(x - outward * nx, y - outward * ny, nx, ny, weight), index


def depth_edges(height: Singles, threshold: float) -> Edges:
    """Return the thin edges of a height map (H, W), all of the same weight."""
    region = np.ones(height.shape, np.uint8)
    (x, y, nx, ny, strength, _, _), _ = _thin_edges(gradient_of(height), region, threshold)
    return Edges(x, y, nx, ny, np.full_like(strength, DEPTH_ALONE))


def _thin_edges(grad: Gradient, region: Bytes, threshold: float) -> tuple[Singles, Ints32]:
    index = np.full(grad.size.shape, -1, np.int32)
    room, pixels = grad.size.size // 6 + 16, grad.size.size
    points = np.empty((7, room), np.float32)
    count = thin(*grad, region, threshold, points, index)
    if count == room:  # a grainy image; with room for the worst at once every frame would be slower
        points = np.empty((7, pixels), np.float32)
        count = thin(*grad, region, threshold, points, index)
    return points[:, :count], index
