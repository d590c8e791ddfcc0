"""Where depth denies a fitted cap, and the circle that it suggests in place of the detected one."""

from __future__ import annotations

import numpy as np

from mushpipe.core.arrays import Floats, Singles
from mushpipe.core.jit import borrower, jit
from mushpipe.stages.cap.blocks import Image
from mushpipe.stages.cap.linear import tukey
from mushpipe.stages.cap.model import HEIGHT, RADIUS, N
from mushpipe.stages.cap.samples import COMPASS, DIRECTIONS
from mushpipe.stages.linear import solve

FROM, TO = 0.3, 2.2  # in radii of the circle: where the surface in it may end
JUMP = 0.35  # in radii of the cap: its depth does not change so much from pixel to pixel
LOST = 6  # px without depth, beyond which nobody knows where a surface ended
FEWEST = 6  # ends that make a circle
ROUNDS = 8
SLACK = 1.2  # in rim radii: how far off the circle of a cap is whose image shows nothing
HELD = np.array([0.02, 0.02, 0.05])  # weight of the detected x, y and radius, that of an end is 1


@borrower
def look(image: Image, circle: Floats, j: int, far: float) -> tuple[float, int]:
    """Return depth (m, 0 = missing) and rank (-1 out of the image) in a direction of `COMPASS`.

    Args:
        image: Where it is looked.
        circle: (3,) x, y, radius, px.
        j: Number of the direction.
        far: Distance from the centre, px.
    """
    depth, ranks = image.depth, image.ranks
    u = int(np.floor(circle[0] + far * COMPASS[j, 0] + 0.5))
    v = int(np.floor(circle[1] + far * COMPASS[j, 1] + 0.5))
    if 0 <= v < depth.shape[0] and 0 <= u < depth.shape[1]:
        return float(depth[v, u] if depth[v, u] > 0 else 0), int(ranks[v, u])
    return 0.0, -1


@borrower
def beyond(image: Image, circle: Floats) -> float:
    """Return the share of a circle (3,) that lies beyond the image."""
    outside = 0
    for j in range(DIRECTIONS):
        outside += look(image, circle, j, circle[2])[1] < 0
    return outside / DIRECTIONS


@borrower
def slack(image: Image, circle: Floats) -> float:
    """Return how far off (rim radii) a detected circle (3,) may be as the image's border cuts it.

    Detectors take what they see for most of the cap: the radii of such circles are small.
    """
    return SLACK * beyond(image, circle) ** 2


@borrower
def denials(
    image: Image, ranks: tuple[int, int], cap: Floats, bias: float, circle: Floats, reach: Singles
) -> int:
    """Return in how many directions depth denies the outline of a fitted cap.

    There the surface goes on outside of it, and not as another circle's, or has ended inside.

    Args:
        image: As in `look`.
        ranks: Of the cap's circle, and of no circle.
        cap: (15,) the cap.
        bias: Of the depth, m.
        circle: (3,) x, y, radius, px.
        reach: (DIRECTIONS or more,) how far the outline lies from the circle's centre, px.
    """
    rim = cap[2] + bias
    low, high = rim + cap[HEIGHT] * cap[N + 2] - 0.3 * cap[RADIUS], rim + 0.5 * cap[RADIUS]
    count = 0
    for j in range(DIRECTIONS):
        margin = max(2.0, 0.1 * reach[j])
        inside, here = look(image, circle, j, reach[j] - margin)
        outside, there = look(image, circle, j, reach[j] + margin)
        if here < ranks[0] or there < ranks[0]:
            continue
        goes_on = inside > 0.0 and low < outside < high and there in ranks
        count += inside > high or goes_on
    return count


@borrower
def end_along(
    image: Image, ranks: tuple[int, int], circle: Floats, j: int, gate: tuple[float, float, float]
) -> float:
    """Return how far (px) a surface reaches until something deeper follows; -1 if none is seen to.

    Args:
        image: As in `look`.
        ranks: Of the circle, and of none: a pixel of another's is no end of this surface.
        circle: (3,) x, y, radius, px.
        j: Number of the direction.
        gate: Between which depths the surface lies, and by how much they may jump, m.
    """
    last, missing, start = 0.0, 0, FROM * circle[2]
    for k in range(int((TO - FROM) * circle[2])):
        z, rank = look(image, circle, j, start + k)
        if rank not in ranks or missing > LOST:
            return -1.0
        if z <= 0.0:
            missing += 1
        elif z > gate[1] or (last > 0.0 and z - last > gate[2]):
            return float(start + k - missing - 0.5)
        elif z < gate[0] or last - z > gate[2]:
            return -1.0
        else:
            last, missing = z, 0
    return -1.0


@jit
def regrow(
    image: Image, ranks: tuple[int, int], circle: Floats, middle: float, out: Floats
) -> bool:
    """Fill the circle (3,) around the surface in a circle, by where it ends; False if unknown.

    Args:
        image: As in `look`.
        ranks: Of the circle, and of none.
        circle: (3,) x, y, radius, px.
        middle: Depth of the surface, m.
        out: (3,) out.
    """
    size, n = circle[2] * middle / image.focal, 0
    gate = (middle - 0.8 * size, middle + 1.3 * size, JUMP * size)
    ends = np.empty((2, DIRECTIONS))
    for j in range(DIRECTIONS):
        far = end_along(image, ranks, circle, j, gate)
        if far >= 0.0:
            ends[0, n], ends[1, n] = far * COMPASS[j, 0], far * COMPASS[j, 1]
            n += 1
    if n < FEWEST:
        return False
    matrix, right, off = np.empty((3, 3)), np.empty(3), np.array([0.0, 0.0, circle[2]])
    for k in range(ROUNDS):
        for a in range(3):
            matrix[a, :], matrix[a, a] = 0.0, HELD[a]
            right[a] = HELD[a] * ((circle[2] if a == 2 else 0.0) - off[a])
        cut = max(0.6 - 0.1 * k, 0.2) * off[2]
        for j in range(n):
            x, y = ends[0, j] - off[0], ends[1, j] - off[1]
            far = max(np.sqrt(x * x + y * y), 1e-9)
            row = (x / far, y / far, 1.0)
            weight = tukey((far - off[2]) ** 2, cut * cut)
            for a in range(3):
                right[a] += weight * row[a] * (far - off[2])
                for b in range(3):
                    matrix[a, b] += weight * row[a] * row[b]
        solve(matrix, right)
        for a in range(3):
            off[a] += right[a]
        off[2] = min(max(off[2], 0.6 * circle[2]), 2.0 * circle[2])
    out[0], out[1], out[2] = circle[0] + off[0], circle[1] + off[1], off[2]
    return True
