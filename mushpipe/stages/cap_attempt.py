"""One cap: its rays gathered and fitted, and fitted again where the fit is poor.

A fit may end in a wrong minimum: a high cap that leans looks much like a smaller upright one. And
it may have started in a wrong circle. Both show in its misfit, and in what surrounds it.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from mushpipe.core.jit import jit
from mushpipe.stages.cap_blocks import own_depth
from mushpipe.stages.cap_model import HEIGHT, ROOM, SIZE, Floats, Singles
from mushpipe.stages.cap_outline import expected_reach, sample_outline
from mushpipe.stages.cap_regrow import denials, regrow
from mushpipe.stages.cap_samples import (
    ASTRAY,
    COMPASS,
    DIRECTIONS,
    OUTER,
    ray_at,
    sample_depth,
    sample_edges,
    touch,
)
from mushpipe.stages.cap_solve import ROUND, refine, variance_of_tilt, workspace
from mushpipe.stages.cap_start import CONICAL, USUAL, axis_of, start

POOR = 0.9  # misfit (a usual cap has 0.25) at which a fit starts again; it widens the sigmas, too
BETTER = 0.8  # how much smaller the misfit of another start must be
ODD = 0.5  # misfit at which is looked whether depth denies the outline:
DENIED = 4  # in so many of 32 directions, and the circle is put right;
DENIAL = 0.05  # each counts as so much misfit,
MENDED = 0.7  # and so much smaller the sum must be in another circle
COUNTS = 8  # numbers that are kept of a fit, see `fit_circle`


@jit
def gather(
    image: Any,
    circle: Floats,
    rank: int,
    focal: float,
    sensor: tuple[float, float, float, float],
    rays: Singles,
) -> tuple[int, int, int, float]:
    """Take the rays of a cap; return what there is of it.

    Returns:
        Numbers of its points, of points of other depth and of edge rays; its middle depth, m.
    """
    cut = own_depth(image[0], image[2], rank, circle, OUTER)
    noise = (sensor[0], sensor[1])
    n, other, middle = sample_depth(cut, image[1], circle, focal, noise, rays[:, ROUND:])
    if n == 0:
        return 0, other, 0, 0.0
    for j in range(ROUND, ROUND + n):
        rays[3, j] -= sensor[2] / rays[2, j]
    m = sample_edges(cut, image[1], circle, focal, middle, sensor[3], rays[:, ROUND + n :])
    for j in range(ROUND):
        turn = COMPASS[j * (DIRECTIONS // ROUND)]
        x, y = circle[0] + circle[2] * turn[0], circle[1] + circle[2] * turn[1]
        touch(rays, j, ray_at(image[1], focal, x, y), 0.0, 0.0)
    return n, other, m, middle - sensor[2]


@jit
def attempt(
    frame: Any, circle: Floats, rank: int, size: float, seen: tuple[Singles, int],
    upright: tuple[Floats, float], settings: Any, cap: Floats, work: Any,
) -> tuple[int, float]:  # fmt: skip
    """Fit a cap from where it starts: to its depth, then to its outline in colour as well.

    Args:
        frame: As in `cap_batch.first_fits`.
        circle: (3,) x, y, radius, px.
        rank: Of the circle.
        size: Its radius at the cap, m.
        seen: The cap's rays (6, ROOM), with room for those of the outline, and how many there are.
        upright: Unit vector (3,) and spread of tilts, rad.
        settings: As in `cap_batch.first_fits`.
        cap: (15,) parameters, in and out.
        work: From `workspace`; the last step's normal matrix, factored, stays in it.

    Returns:
        Number of rays along the outline in colour, and the misfit, infinite without a solution.
    """
    gray, image, focal = frame
    (rays, count), setting = seen, (settings[0], 1.0 / focal, size)
    if refine(cap, rays, count, upright, setting, (0, 2), work)[0] < 0.0:
        return 0, np.inf
    lines = sample_outline(
        gray, image[1], image[2], rank, cap, circle, focal, settings[2], rays[:, count:]
    )
    total, misfit = refine(cap, rays, count + lines, upright, setting, (2, 4), work)
    return (lines, misfit) if total >= 0.0 else (0, np.inf)


@jit
def blank() -> Any:
    """Return room for a fit: rays (6, ROOM), parameters (15,) and counts (8,)."""
    return np.empty((6, ROOM), np.float32), np.empty(SIZE), np.zeros(COUNTS)


@jit
def scratch() -> Any:
    """Return room to work in: a `workspace`, and two fits, of another start and another circle."""
    return workspace(), blank(), blank()


@jit
def fit_circle(
    frame: Any, circle: Floats, rank: int, upright: tuple[Floats, float], settings: Any, fit: Any,
    room: Any,
) -> float:  # fmt: skip
    """Fit the cap in a circle, from several starts if the first fit is poor; return the misfit.

    Args:
        frame: As in `cap_batch.first_fits`.
        circle: (3,) x, y, radius, px.
        rank: Of the circle.
        upright: Unit vector (3,) and spread of tilts, rad.
        settings: As in `cap_batch.first_fits`.
        fit: Out: rays (6, ROOM), parameters (15,), and counts (8,) of points, edge rays, outline
            rays, weight; size, m; misfit; points of other depth; variance of the tilt, rad^2, per
            direction. Without a fit the counts stay as they are and the misfit is infinite.
        room: From `scratch`.
    """
    _, image, focal = frame
    (rays, cap, counts), (work, rival, _) = fit, room
    n, other, m, middle = gather(image, circle, rank, focal, settings[1], rays)
    if n < settings[3] or middle <= 0.0:
        return np.inf
    size, count, points = circle[2] * middle / focal, ROUND + n + m, rays[:, ROUND:]
    ray = ray_at(image[1], focal, circle[0], circle[1])
    start(cap, axis_of(points, n, upright[0], ray, USUAL[0]), USUAL, ray, middle, size)
    lines, misfit = attempt(frame, circle, rank, size, (rays, count), upright, settings, cap, work)
    variance = variance_of_tilt(work[0][0])
    if misfit > POOR:
        rival[0][:, :count] = rays[:, :count]
        leaning = axis_of(points, n, upright[0], ray, CONICAL[0])
        for axis in (upright[0], -np.array(ray), leaning):
            start(rival[1], axis, CONICAL, ray, middle, size)
            found, rest = attempt(
                frame, circle, rank, size, (rival[0], count), upright, settings, rival[1], work
            )
            if rest < BETTER * misfit:
                lines, misfit, rays[:, count:] = found, rest, rival[0][:, count:]
                cap[:], variance = rival[1], variance_of_tilt(work[0][0])
    if np.isfinite(misfit):
        counts[0], counts[1], counts[2], counts[4], counts[6] = n, m, lines, size, other
        counts[7] = variance
    return misfit


@jit
def mend(
    frame: Any, circle: Floats, ranks: tuple[int, int], misfit: float,
    upright: tuple[Floats, float], settings: Any, fit: Any, room: Any,
) -> None:  # fmt: skip
    """Fit again in the circle that depth suggests, where depth denies the fit; the better stays.

    Not where much of the circle's depth lies elsewhere: it would be fitted to whatever hides it.

    Args:
        frame: As in `cap_batch.first_fits`.
        circle: (3,) x, y, radius, px, as detected.
        ranks: Of the circle, and of no circle.
        misfit: Of the fit.
        upright: Unit vector (3,) and spread of tilts, rad.
        settings: As in `cap_batch.first_fits`.
        fit: As in `fit_circle`, in and out.
        room: From `scratch`.
    """
    _, image, focal = frame
    bias, other = settings[1][2], room[2]
    if fit[2][6] > ASTRAY * (fit[2][0] + fit[2][6]):
        return
    reach, grown = np.empty(DIRECTIONS), np.empty(3)
    expected_reach(fit[1], image[1], focal, circle, reach)
    denied = denials(image, ranks, fit[1], bias, circle, reach)
    if misfit < POOR and denied < DENIED:
        return
    middle = fit[1][2] - 0.5 * fit[1][HEIGHT] + bias
    if not regrow(image, ranks, circle, focal, middle, grown):
        return
    rest = fit_circle(frame, grown, ranks[0], upright, settings, other, room)
    if not rest < 2.0 * POOR:
        return  # neither is believed
    expected_reach(other[1], image[1], focal, grown, reach)
    still = denials(image, ranks, other[1], bias, grown, reach)
    if rest + DENIAL * still < MENDED * (misfit + DENIAL * denied):
        fit[0][:], fit[1][:], fit[2][:] = other
