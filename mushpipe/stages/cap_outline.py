"""The outline of a cap in the colour image, looked for where the fit so far expects it.

Depth cameras tear and lose the edge of a cap; the colour image shows it to a fraction of a pixel.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from mushpipe.core.jit import jit
from mushpipe.stages.cap_model import RADIUS, Floats, Single, Singles, beside, frozen, meet, slope
from mushpipe.stages.cap_samples import (
    COMPASS,
    DIRECTIONS,
    EAST,
    EDGE_SHARE,
    SOUTH,
    ray_at,
    touch,
)

STEP = 0.5  # px between places on a line
REACH = 12  # steps to either side that are looked at, at most
EDGE = 1.01  # px, from a last place to the image's, rounding of single precision included
LEAST_STEP = 0.04  # of luma, between 1 px inside and 1 px outside


@jit
def look_along(
    gray: Singles, x: float, y: float, turn: Floats, half: int, profile: Singles
) -> bool:
    """Fill the luma (2 half + 1,) along a line, bilinear; False where it leaves the image.

    Args:
        gray: (H, W) luma.
        x: Of the middle of the line, px.
        y: Likewise.
        turn: (2,) its direction.
        half: Number of steps to either side.
        profile: Out.
    """
    far_x, far_y = half * STEP * abs(turn[0]), half * STEP * abs(turn[1])
    if not (
        far_x <= x < gray.shape[1] - EDGE - far_x and far_y <= y < gray.shape[0] - EDGE - far_y
    ):
        return False
    one, dx, dy = np.uint32(1), Single(STEP * turn[0]), Single(STEP * turn[1])
    left, top = Single(x - half * STEP * turn[0]), Single(y - half * STEP * turn[1])
    for k in range(2 * half + 1):
        at_x = max(left + Single(k) * dx, Single(0))
        at_y = max(top + Single(k) * dy, Single(0))
        u, v = np.uint32(at_x), np.uint32(at_y)
        fx, fy = at_x - Single(u), at_y - Single(v)
        up = gray[v, u] + fx * (gray[v, u + one] - gray[v, u])
        low = gray[v + one, u] + fx * (gray[v + one, u + one] - gray[v + one, u])
        profile[k] = up + fy * (low - up)
    return True


@jit
def expected_reach(cap: Floats, rays: Singles, focal: float, circle: Floats, reach: Floats) -> None:
    """Fill how far (DIRECTIONS,), px, the outline of a cap lies from the centre of a circle.

    Two steps, each by how far outside of the outline the ray of the place found so far passes.

    Args:
        cap: (15,) the cap.
        rays: (H, W, 2) rays at z = 1; outside of the image as without distortion.
        focal: Focal length, px.
        circle: (3,) x, y, radius, px, near the outline.
        reach: Out, per direction of `COMPASS`.
    """
    c, half = frozen(cap), Single(0.5)
    x, y, z, per_radius = Single(cap[0]), Single(cap[1]), Single(cap[2]), Single(1 / cap[RADIUS])
    middle, per_focal = np.sqrt(x * x + y * y + z * z), Single(1 / focal)
    right, bottom = np.int32(rays.shape[1] - 1), np.int32(rays.shape[0] - 1)
    u0, v0, longest = Single(circle[0]), Single(circle[1]), Single(0.3 * circle[2])
    pixel = Single(focal / cap[2])
    # in one array at fixed distances the compiler sees that nothing overlaps: SIMD
    row, pixels = np.empty(5 * DIRECTIONS, np.float32), np.empty((2, DIRECTIONS), np.int32)
    row[:DIRECTIONS] = Single(circle[2])
    for _ in range(2):
        for j in range(DIRECTIONS):
            u, v = u0 + row[j] * EAST[j], v0 + row[j] * SOUTH[j]
            column = min(max(np.int32(np.floor(u + half)), np.int32(0)), right)
            line = min(max(np.int32(np.floor(v + half)), np.int32(0)), bottom)
            row[j + DIRECTIONS] = (u - Single(column)) * per_focal
            row[j + 2 * DIRECTIONS] = (v - Single(line)) * per_focal
            pixels[0, j], pixels[1, j] = column, line
        for j in range(DIRECTIONS):
            near = rays[pixels[1, j], pixels[0, j]]
            row[j + 3 * DIRECTIONS], row[j + 4 * DIRECTIONS] = near[0], near[1]
        for j in range(DIRECTIONS):
            across = row[j + 3 * DIRECTIONS] + row[j + DIRECTIONS]
            down = row[j + 4 * DIRECTIONS] + row[j + 2 * DIRECTIONS]
            along = Single(1) / np.sqrt(Single(1) + across * across + down * down)
            ray = (across * along, down * along, along)
            q0, q1, q2 = beside((x, y, z), middle, per_radius, ray)
            t, k, _ = meet(c, (q0, q1, q2), ray, True)
            outside = slope(c, (q0 + t * ray[0], q1 + t * ray[1], q2 + t * ray[2]), ray, k)[0]
            row[j] -= min(max(outside * pixel, -longest), longest)
    reach[:] = row[:DIRECTIONS]


@jit
def steepest(profile: Singles, count: int, sign: float) -> tuple[float, float]:
    """Return where a profile (count,) falls (sign 1) or rises (-1) most steeply, and by how much.

    The place is in steps, to a fraction of one by a parabola, and -1 where it lies at an end.
    """
    wide = int(1.0 / STEP)
    best, place = 0.0, -1
    for k in range(wide, count - wide):
        fall = sign * (profile[k - wide] - profile[k + wide])
        # of two equal steps the nearer one to where it is expected
        fall *= 1.0 - 0.4 * abs(k - 0.5 * (count - 1)) / (0.5 * count)
        if fall > best:
            best, place = fall, k
    if place <= wide or place >= count - wide - 1:
        return -1.0, 0.0
    left = sign * (profile[place - 1 - wide] - profile[place - 1 + wide])
    right = sign * (profile[place + 1 - wide] - profile[place + 1 + wide])
    middle = sign * (profile[place - wide] - profile[place + wide])
    bend = left - 2.0 * middle + right
    shift = 0.5 * (left - right) / bend if bend < -1e-9 else 0.0
    return place + min(max(shift, -0.5), 0.5), middle


@jit
def sample_outline(
    gray: Singles, rays: Singles, ranks: NDArray[np.int16], rank: int, cap: Floats, circle: Floats,
    focal: float, sigma: float, out: Singles,
) -> int:  # fmt: skip
    """Find the outline of a cap in the colour image, in 32 directions.

    Args:
        gray: (H, W) luma, 0..1.
        rays: (H, W, 2) rays at z = 1.
        ranks: (H, W) rank of the nearest circle per pixel.
        rank: This circle's; a place that a nearer one covers is left out.
        cap: (15,) the estimate.
        circle: (3,) x, y, radius, px.
        focal: Focal length, px.
        sigma: Of a place on the outline, px.
        out: (6, DIRECTIONS) out: rays that touch the cap, as in `touch`.

    Returns:
        Number of rays.
    """
    profiles, reaches = np.empty((DIRECTIONS, 2 * REACH + 1), np.float32), np.empty(DIRECTIONS)
    expected_reach(cap, rays, focal, circle, reaches)
    half = min(REACH, max(5, int(0.2 * circle[2] / STEP)))
    count, contrast = 2 * half + 1, 0.0
    for j in range(DIRECTIONS):
        turn, reach = COMPASS[j], reaches[j]
        reaches[j] = 0.0
        if not 0.5 * circle[2] < reach < 1.6 * circle[2]:
            continue
        x, y = circle[0] + reach * turn[0], circle[1] + reach * turn[1]
        u, v = int(np.floor(x + 0.5)), int(np.floor(y + 0.5))
        if not (0 <= u < ranks.shape[1] and 0 <= v < ranks.shape[0]) or ranks[v, u] < rank:
            continue
        if look_along(gray, x, y, turn, half, profiles[j]):
            reaches[j] = reach
            contrast += profiles[j, 0] - profiles[j, count - 1]
    n = 0
    for j in range(DIRECTIONS):
        if reaches[j] == 0.0:
            continue
        place, fall = steepest(profiles[j], count, 1.0 if contrast > 0 else -1.0)
        if place < 0.0 or fall < LEAST_STEP:
            continue
        reach = reaches[j] + (place - half) * STEP
        x, y = circle[0] + reach * COMPASS[j, 0], circle[1] + reach * COMPASS[j, 1]
        touch(out, n, ray_at(rays, focal, x, y), sigma * cap[2] / focal, EDGE_SHARE)
        n += 1
    return n
