"""The outline of a cap in the colour image, looked for where the fit so far expects it.

Depth cameras tear and lose the edge of a cap; the colour image shows it to a fraction of a pixel.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from mushpipe.core.arrays import Floats, Ints32, Singles
from mushpipe.core.jit import borrower
from mushpipe.stages.cap.blocks import Image
from mushpipe.stages.cap.model import RADIUS, Single, beside, frozen, meet, slope
from mushpipe.stages.cap.samples import (
    COMPASS,
    DIRECTIONS,
    EAST,
    EDGE_SHARE,
    SOUTH,
    normalise,
    place,
    touch,
)

STEP = 0.5  # px between places on a line
WIDE = int(1.0 / STEP)  # steps to either side that a slope is taken over
REACH = 12  # steps to either side that are looked at, at most
EDGE = 1.01  # px, from a last place to the image's, rounding of single precision included
FAINT = 0.4  # share of the luma inside by which it falls; with less a rim may be darker than both
LEAST_STEP = 0.04  # of luma, between 1 px inside and 1 px outside
# Rows of DIRECTIONS in the room to work in. First how far the outline lies, px, 0 where it is not
# looked for; then room for `expected_reach`, then for lines across it: first place, step, shares of
# the next pixels, four pixels; then the luma by steps. `find_steepest` puts its finds in place of
# the first places: by how much the luma falls at most, weighted, and at which step; and in place of
# the steps the sign of the change.
X, Y, DX, DY, FX, FY, CORNERS = (k * DIRECTIONS for k in range(1, 8))
BEST, PLACE, SIGN, LINES = X, Y, DX, CORNERS + 4 * DIRECTIONS
LANES_ROOM = LINES + (2 * REACH + 1) * DIRECTIONS
Lanes = tuple[Singles, Ints32]  # (LANES_ROOM,) and (2 DIRECTIONS,)


@borrower
def expected_reach(cap: Floats, image: Image, circle: Floats, row: Singles, pixels: Ints32) -> None:
    """Fill how far (DIRECTIONS,), px, the outline of a cap lies from the centre of a circle.

    Two steps, each by how far outside of the outline the ray of the place found so far passes.

    Args:
        cap: (15,) the cap.
        image: Whose rays are taken; outside of it as without distortion.
        circle: (3,) x, y, radius, px, near the outline.
        row: (5 DIRECTIONS or more,) room; out, in front, per direction of `COMPASS`.
        pixels: (2 DIRECTIONS or more,) room.
    """
    c, half, rays, focal = frozen(cap), Single(0.5), image.rays, image.focal
    x, y, z, per_radius = Single(cap[0]), Single(cap[1]), Single(cap[2]), Single(1 / cap[RADIUS])
    middle, per_focal = np.sqrt(x * x + y * y + z * z), Single(1 / focal)
    right, bottom = np.int32(rays.shape[1] - 1), np.int32(rays.shape[0] - 1)
    u0, v0, longest = Single(circle[0]), Single(circle[1]), Single(0.3 * circle[2])
    pixel = Single(focal / cap[2])
    for j in range(DIRECTIONS):
        row[j] = Single(circle[2])
    for _ in range(2):
        for j in range(DIRECTIONS):
            u, v = u0 + row[j] * EAST[j], v0 + row[j] * SOUTH[j]
            column = min(max(np.int32(np.floor(u + half)), np.int32(0)), right)
            line = min(max(np.int32(np.floor(v + half)), np.int32(0)), bottom)
            row[j + DIRECTIONS] = (u - Single(column)) * per_focal
            row[j + 2 * DIRECTIONS] = (v - Single(line)) * per_focal
            pixels[j], pixels[j + DIRECTIONS] = column, line
        for j in range(DIRECTIONS):
            v, u = pixels[j + DIRECTIONS], pixels[j]
            row[j + 3 * DIRECTIONS], row[j + 4 * DIRECTIONS] = rays[v, u, 0], rays[v, u, 1]
        for j in range(DIRECTIONS):
            across = row[j + 3 * DIRECTIONS] + row[j + DIRECTIONS]
            down = row[j + 4 * DIRECTIONS] + row[j + 2 * DIRECTIONS]
            along = Single(1) / np.sqrt(Single(1) + across * across + down * down)
            ray = (across * along, down * along, along)
            q0, q1, q2 = beside((x, y, z), middle, per_radius, ray)
            t, per_k, _ = meet(c, (q0, q1, q2), ray, True)
            q = (q0 + t * ray[0], q1 + t * ray[1], q2 + t * ray[2])
            outside = slope(c, q, ray, per_k)[0]
            row[j] -= min(max(outside * pixel, -longest), longest)


@borrower
def place_lines(
    ranks: NDArray[np.int16], rank: int, circle: Floats, half: int, row: Singles,
    pixels: Ints32,
) -> None:  # fmt: skip
    """Place a line across the outline in each direction, if the image and the cap show it there.

    Args:
        ranks: (H, W) rank of the nearest circle per pixel.
        rank: This circle's; a place that a nearer one covers is left out.
        circle: (3,) x, y, radius, px.
        half: Number of steps to either side.
        row: In and out: how far the outline is expected, then 0 where it is left out; lines.
        pixels: Out: of the middles of the lines, -1 outside.
    """
    height, width = np.int32(ranks.shape[0]), np.int32(ranks.shape[1])
    right, bottom = Single(width) - Single(EDGE), Single(height) - Single(EDGE)
    cx, cy, middle, none = Single(circle[0]), Single(circle[1]), Single(0.5), Single(0)
    low, high = Single(0.5 * circle[2]), Single(1.6 * circle[2])
    step, far = Single(STEP), Single(half * STEP)
    for j in range(DIRECTIONS):
        reach, east, south = row[j], EAST[j], SOUTH[j]
        x, y, far_x, far_y = (
            cx + reach * east,
            cy + reach * south,
            far * abs(east),
            far * abs(south),
        )
        across = (far_x <= x) & (x < right - far_x) & (far_y <= y) & (y < bottom - far_y)
        good = across & (low < reach) & (reach < high)
        row[j + X], row[j + Y] = x - far * east if good else none, y - far * south if good else none
        row[j + DX], row[j + DY] = step * east if good else none, step * south if good else none
        pixel = np.int32(y + middle) * width + np.int32(x + middle)
        pixels[j] = pixel if good else -1
    every = ranks.reshape(-1)
    for j in range(DIRECTIONS):
        if pixels[j] < 0 or every[pixels[j]] < rank:
            row[j] = none


@borrower
def look_along(gray: Singles, count: int, row: Singles, pixels: Ints32) -> float:
    """Fill the luma along the lines, bilinear; return its fall along all, as share of the inside.

    Args:
        gray: (H, W) luma, at least 2 by 2.
        count: Number of steps.
        row: (LANES_ROOM,) with lines from `place_lines`, in and out.
        pixels: (DIRECTIONS or more,) room.
    """
    every, width, none = gray.reshape(-1), np.int32(gray.shape[1]), Single(0)
    for k in range(count):
        far, step = Single(k), LINES + k * DIRECTIONS
        for j in range(DIRECTIONS):
            x = max(row[j + X] + far * row[j + DX], none)
            y = max(row[j + Y] + far * row[j + DY], none)
            u, v = np.int32(x), np.int32(y)
            row[j + FX], row[j + FY] = x - Single(u), y - Single(v)
            pixels[j] = v * width + u
        for j in range(DIRECTIONS):
            p = max(pixels[j], 0)
            row[j + CORNERS], row[j + CORNERS + DIRECTIONS] = every[p], every[p + 1]
            row[j + CORNERS + 2 * DIRECTIONS] = every[p + width]
            row[j + CORNERS + 3 * DIRECTIONS] = every[p + width + 1]
        for j in range(DIRECTIONS):
            a, b = row[j + CORNERS], row[j + CORNERS + DIRECTIONS]
            c, d = row[j + CORNERS + 2 * DIRECTIONS], row[j + CORNERS + 3 * DIRECTIONS]
            up, low = a + row[j + FX] * (b - a), c + row[j + FX] * (d - c)
            row[j + step] = up + row[j + FY] * (low - up)
    inside, outside, last = none, none, LINES + (count - 1) * DIRECTIONS
    for j in range(DIRECTIONS):
        inside += row[j + LINES] if row[j] > none else none
        outside += row[j + last] if row[j] > none else none
    return float(inside - outside) / max(float(inside), 1e-6)


@borrower
def find_steepest(row: Singles, count: int, sign: float) -> None:
    """Find where the luma falls (sign 1) or rises (-1) most steeply, in all directions at once.

    Args:
        row: (LANES_ROOM,) in and out.
        count: Number of steps.
        sign: Of what is looked for.
    """
    for j in range(DIRECTIONS):
        row[j + BEST], row[j + PLACE], row[j + SIGN] = Single(0), Single(-1), Single(sign)
    for k in range(WIDE, count - WIDE):
        # of two equal steps the nearer one to where it is expected
        weight = Single(sign * (1.0 - 0.4 * abs(k - 0.5 * (count - 1)) / (0.5 * count)))
        before, after, step = LINES + (k - WIDE) * DIRECTIONS, LINES + (k + WIDE) * DIRECTIONS, k
        for j in range(DIRECTIONS):
            fall = weight * (row[j + before] - row[j + after])
            better = fall > row[j + BEST]
            row[j + BEST] = fall if better else row[j + BEST]
            row[j + PLACE] = Single(step) if better else row[j + PLACE]


@borrower
def find_sharpest(row: Singles, count: int) -> None:
    """Find where the luma changes most steeply in each direction, whether it falls or rises.

    Arguments as `find_steepest`. The rim of a cap is darker than its middle; where what is outside
    is as bright as that, the outline is the other side of the rim, and the sharper one.
    """
    find_steepest(row, count, 1.0)
    for j in range(DIRECTIONS):
        row[j + FX], row[j + FY] = row[j + BEST], row[j + PLACE]
    find_steepest(row, count, -1.0)
    for j in range(DIRECTIONS):
        falls = row[j + FX] > row[j + BEST]
        row[j + PLACE] = row[j + FY] if falls else row[j + PLACE]
        row[j + SIGN] = Single(1) if falls else Single(-1)


@borrower
def vertex(row: Singles, j: int, count: int, sign: float) -> tuple[float, float]:
    """Return the place of a steepest step, to a fraction of one by a parabola, and the fall there.

    The place is -1 where it lies at an end.

    Args:
        row: (LANES_ROOM,) from `find_steepest`.
        j: Number of the direction.
        count: Number of steps.
        sign: As in `find_steepest`.
    """
    place = int(row[j + PLACE])
    if place <= WIDE or place >= count - WIDE - 1:
        return -1.0, 0.0
    at, wide = LINES + place * DIRECTIONS + j, WIDE * DIRECTIONS
    left = sign * (row[at - DIRECTIONS - wide] - row[at - DIRECTIONS + wide])
    right = sign * (row[at + DIRECTIONS - wide] - row[at + DIRECTIONS + wide])
    middle = sign * (row[at - wide] - row[at + wide])
    bend = left - 2.0 * middle + right
    shift = 0.5 * (left - right) / bend if bend < -1e-9 else 0.0
    return place + min(max(shift, -0.5), 0.5), middle


@borrower
def sample_outline(
    gray: Singles, image: Image, rank: int, cap: Floats, circle: Floats, sigma: float, room: Lanes,
    out: Singles,
) -> int:  # fmt: skip
    """Find the outline of a cap in the colour image, in 32 directions.

    Args:
        gray: (H, W) luma, 0..1.
        image: Rays and ranks of its pixels.
        rank: This circle's; a place that a nearer one covers is left out.
        cap: (15,) the estimate.
        circle: (3,) x, y, radius, px.
        sigma: Of a place on the outline, px.
        room: To work in.
        out: (6, DIRECTIONS) out: rays that touch the cap, as in `touch`.

    Returns:
        Number of rays.
    """
    (row, pixels), n = room, 0
    if min(gray.shape) < 2:
        return 0
    expected_reach(cap, image, circle, row, pixels)
    half = min(REACH, max(5, int(0.2 * circle[2] / STEP)))
    count = 2 * half + 1
    place_lines(image.ranks, rank, circle, half, row, pixels)
    contrast = look_along(gray, count, row, pixels)
    if abs(contrast) < FAINT:
        find_sharpest(row, count)
    else:
        find_steepest(row, count, 1.0 if contrast > 0 else -1.0)
    for j in range(DIRECTIONS):
        if row[j] == 0.0:
            continue
        step, fall = vertex(row, j, count, row[j + SIGN])
        if step < 0.0 or fall < LEAST_STEP:
            continue
        reach = row[j] + (step - half) * STEP
        x, y = circle[0] + reach * COMPASS[j, 0], circle[1] + reach * COMPASS[j, 1]
        touch(out, n, place(image, x, y), sigma * cap[2] / image.focal, EDGE_SHARE)
        n += 1
    normalise(out, n)
    return n
