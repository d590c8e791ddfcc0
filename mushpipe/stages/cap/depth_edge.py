"""The depth edge of a cap: where it ends in each direction, and something deeper follows."""

from __future__ import annotations

import numpy as np

from mushpipe.core.arrays import Floats, Ints32, Singles
from mushpipe.core.jit import borrower
from mushpipe.stages.cap.blocks import Image, Sensor, Window
from mushpipe.stages.cap.model import Single
from mushpipe.stages.cap.samples import (
    COMPASS,
    DIRECTIONS,
    EAST,
    EDGE_SHARE,
    INNER,
    OUTER,
    RADII,
    SOUTH,
    STEP,
    place,
    touch,
)

EDGE_PX = 2.0  # sigma of a depth edge
FALL = np.sqrt(2 * STEP)  # in radii: how far a ball falls in the last step before its rim
CLEAR = 5.0  # sigmas of depth by which it does not fall by chance


@borrower
def look_around(
    window: Window, own: Singles, at: tuple[float, float], far: float, state: Singles,
    pixels: Ints32,
) -> None:  # fmt: skip
    """Put the depth in each direction into the last row of `state`, 0 outside of the window.

    Args:
        window: From `own_depth`.
        own: (H W,) its depth.
        at: x and y to look from, half a pixel added, in the window.
        far: Distance, px.
        state: As in `follow`.
        pixels: (DIRECTIONS or more,) room.
    """
    width, height, none = np.int32(window.width), np.int32(window.height), Single(0)
    for j in range(DIRECTIONS):
        u, v = np.int32(np.floor(at[0] + far * EAST[j])), np.int32(np.floor(at[1] + far * SOUTH[j]))
        inside = (u >= 0) & (v >= 0) & (u < width) & (v < height)
        pixels[j] = v * width + u if inside else -1
    for j in range(DIRECTIONS):
        z = own[max(pixels[j], 0)]
        state[j + 5 * DIRECTIONS] = z if pixels[j] >= 0 else none


@borrower
def look_for_ground(
    window: Window, own: Singles, circle: Floats, gate: tuple[float, float, float, float],
    state: Singles, pixels: Ints32,
) -> None:  # fmt: skip
    """Begin `follow`: fill in how deep the cap is at most, and how far its depth falls in a step.

    That counts where, at the farthest place, there is depth like a cap's: the ground or another.

    Arguments as `follow`, whose rows 0 to 4 and 6 to 8 are filled.
    """
    none, one = Single(0), Single(1)
    at = (Single(circle[0] - window.left + 0.5), Single(circle[1] - window.top + 0.5))
    near = Single(gate[1] + gate[3])
    look_around(window, own, at, Single(circle[2] * OUTER), state, pixels)
    for j in range(DIRECTIONS):
        z = state[j + 5 * DIRECTIONS]
        state[j], state[j + DIRECTIONS], state[j + 2 * DIRECTIONS] = one, none, none
        state[j + 3 * DIRECTIONS], state[j + 4 * DIRECTIONS] = -one, none
        state[j + 6 * DIRECTIONS], state[j + 7 * DIRECTIONS] = none, Single(gate[1])
        state[j + 8 * DIRECTIONS] = Single(gate[2]) if (z > none) & (z < near) else near


@borrower
def follow(
    window: Window,
    own: Singles,
    circle: Floats,
    gate: tuple[float, float, float, float],
    state: Singles,
    pixels: Ints32,
) -> None:
    """Find the last step of a cap in each direction, where its edge is to be trusted.

    The edge is the maximum of a running sum that rewards what lies within the cap's depth and
    punishes the rest: deeper by 1, nearer or another's by 1/2, missing by 0.15. It counts only
    where something deeper follows within 4 steps, for there the cap ends and is not merely hidden.
    Ground close below a rim is as deep as a cap may be; so where there is such depth beyond and
    depth falls faster than a ball's over so many steps, the cap goes half-way at most.

    Args:
        window: From `own_depth`.
        own: (H W,) its depth.
        circle: (3,) x, y, radius, px.
        gate: Depths of the cap; how far a ball falls in its last step, and what noise may do, m.
        state: (9 DIRECTIONS or more,) out, rows of DIRECTIONS: whether it goes on, the sum, its
            maximum, the step of that (-1 without), what follows it (1 something deeper, -1 nearer,
            0 neither yet), the depth at the last step and at the maximum, the cap's deepest, and
            its fall in a step. In one array at fixed distances the compiler sees that nothing
            overlaps, and works on several directions at once.
        pixels: (DIRECTIONS or more,) room.
    """
    none, one, low, noise = Single(0), Single(1), Single(gate[0]), Single(gate[3])
    half, little, four = Single(0.5), Single(0.15), Single(4)
    at = (Single(circle[0] - window.left + 0.5), Single(circle[1] - window.top + 0.5))
    look_for_ground(window, own, circle, gate, state, pixels)
    for k in range(RADII):
        step, going = Single(k), none
        look_around(window, own, at, Single(circle[2] * (INNER + k * STEP)), state, pixels)
        for j in range(DIRECTIONS):
            on, total = state[j] > none, state[j + DIRECTIONS]
            best, edge = state[j + 2 * DIRECTIONS], state[j + 3 * DIRECTIONS]
            follows, z = state[j + 4 * DIRECTIONS], state[j + 5 * DIRECTIONS]
            last, high = state[j + 6 * DIRECTIONS], state[j + 7 * DIRECTIONS]
            far = max(state[j + 8 * DIRECTIONS] * np.sqrt(step - edge), noise)
            falls = (z > last + far) & (last > none) & (step <= edge + four)
            high = min(high, half * (last + z)) if falls else high
            missing, deeper = z == none, z > high
            nearer = (z < low) & (z != none)  # or another's
            change = -half if nearer else (-little if missing else (-one if deeper else one))
            total += change if on else none
            top = on & (change == one) & (total > best)
            ends = one if deeper & (step <= edge + four) else none
            ends = -one if nearer else ends
            follows = ends if on & (follows == none) else follows
            best, edge = total if top else best, step if top else edge
            on = on & ((edge < none) | (total >= best - four))
            state[j], state[j + DIRECTIONS] = one if on else none, total
            state[j + 2 * DIRECTIONS], state[j + 3 * DIRECTIONS] = best, edge
            state[j + 4 * DIRECTIONS] = none if top else follows
            state[j + 6 * DIRECTIONS], state[j + 7 * DIRECTIONS] = z if top else last, high
            going += one if on else none
        if going == none:
            break


@borrower
def sample_edges(
    window: Window,
    own: Singles,
    image: Image,
    circle: Floats,
    middle: float,
    sensor: Sensor,
    room: tuple[Singles, Ints32],
    out: Singles,
) -> int:
    """Find the depth edge of a cap in 32 directions.

    Args:
        window: From `own_depth`, not empty.
        own: (H W,) its depth.
        image: What the window was cut out of.
        circle: (3,) x, y, radius, px.
        middle: Middle depth of the cap, m.
        sensor: What took the depth.
        room: As `state` and `pixels` of `follow`.
        out: (6, DIRECTIONS) out: rays that touch the cap, as in `touch`.

    Returns:
        Number of trusted edge rays.
    """
    size, state = circle[2] * middle / image.focal, room[0]
    noise = sensor.noise + sensor.growth * middle
    gate = (middle - 0.8 * size, middle + 0.95 * size, FALL * size, CLEAR * noise)
    follow(window, own, circle, gate, state, room[1])
    n = 0
    for j in range(DIRECTIONS):
        edge = state[j + 3 * DIRECTIONS]
        if edge < 0.0 or state[j + 4 * DIRECTIONS] <= 0.0:
            continue
        reach = circle[2] * (INNER + (edge + 0.5) * STEP) + sensor.edge
        x, y = circle[0] + reach * COMPASS[j, 0], circle[1] + reach * COMPASS[j, 1]
        touch(out, n, place(image, x, y), EDGE_PX * middle / image.focal, EDGE_SHARE)
        n += 1
    return n
