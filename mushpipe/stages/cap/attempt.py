"""One cap: its rays gathered and fitted, and fitted again where the fit is poor.

A fit may end in a wrong minimum: a high cap that leans looks much like a smaller upright one. And
it may have started in a wrong circle. Both show in its misfit, and in what surrounds it.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from mushpipe.core.arrays import Floats, Singles
from mushpipe.core.jit import borrower, jit
from mushpipe.stages.cap.blocks import Cut, Image, Sensor, own_depth, room_to_cut
from mushpipe.stages.cap.depth_edge import sample_edges
from mushpipe.stages.cap.model import HEIGHT, ROOM, SIZE
from mushpipe.stages.cap.outline import LANES_ROOM, Lanes, expected_reach, sample_outline
from mushpipe.stages.cap.regrow import denials, regrow, slack
from mushpipe.stages.cap.samples import (
    ASTRAY,
    COMPASS,
    DIRECTIONS,
    OUTER,
    normalise,
    place,
    ray_at,
    sample_depth,
    touch,
)
from mushpipe.stages.cap.solve import (
    ROUND,
    STAGES,
    Habit,
    Noise,
    Work,
    refine,
    variance_of_aspect,
    variance_of_tilt,
    workspace,
)
from mushpipe.stages.cap.start import CONICAL, USUAL, axis_of, start

POOR = 0.9  # misfit (a usual cap has 0.25) at which a fit starts again; it widens the sigmas, too
BETTER = 0.8  # how much smaller the misfit of another start must be
ODD = 0.5  # misfit at which is looked whether depth denies the outline:
DENIED = 4  # in so many of 32 directions, and the circle is put right;
DENIAL = 0.05  # each counts as so much misfit,
MENDED = 0.7  # and so much smaller the sum must be in another circle
COUNTS = 9  # numbers that are kept of a fit:
# how many points, edge rays and outline rays it has, and points of other depth; the sum of the
# points' weights; the radius of the circle at the cap, m; misfit; and variances of the tilt, rad^2,
# per direction, and of the dome's height beside the usual one, m^2. Without points there is no fit.
POINTS, EDGES, LINES, OTHERS, WEIGHT, EXTENT, MISFIT, TILT, DOME = range(COUNTS)


class Frame(NamedTuple):
    """What caps are fitted to: luma (H, W) 0..1, and depth."""

    gray: Singles
    image: Image


class Settings(NamedTuple):
    """How caps are fitted.

    Attributes:
        noise: Standard deviations of the model.
        sensor: The depth camera.
        outline_px: Sigma of the outline in colour, px.
        least: Fewest points that make a fit.
    """

    noise: Noise
    sensor: Sensor
    outline_px: float
    least: int


class Fit(NamedTuple):
    """What is kept of a fit: rays (6, ROOM), parameters (15,) and counts (COUNTS,)."""

    rays: Singles
    cap: Floats
    counts: Floats


class Room(NamedTuple):
    """Room to work in, made once for all caps of a frame.

    Attributes:
        work: From `workspace`.
        cut: For the depth around a circle.
        lanes: (LANES_ROOM,) and (2 DIRECTIONS,) for what is done in all directions at once.
        rival: Another start's fit.
        other: Another circle's fit.
        grown: (3,) that circle: x, y, radius, px.
    """

    work: Work
    cut: Cut
    lanes: Lanes
    rival: Fit
    other: Fit
    grown: Floats


@jit
def blank() -> Fit:
    """Return room for a fit."""
    return Fit(np.empty((6, ROOM), np.float32), np.empty(SIZE), np.zeros(COUNTS))


@jit
def scratch(height: int, width: int) -> Room:
    """Return room for images (H, W)."""
    lanes = (np.empty(LANES_ROOM, np.float32), np.empty(2 * DIRECTIONS, np.int32))
    return Room(workspace(), room_to_cut(height, width), lanes, blank(), blank(), np.empty(3))


@borrower
def gather(
    image: Image, circle: Floats, rank: int, sensor: Sensor, room: Room, rays: Singles
) -> tuple[int, int, int, float]:
    """Take the rays of a cap; return what there is of it.

    Returns:
        Numbers of its points, of points of other depth and of edge rays; its middle depth, m.
    """
    cut, lanes = room.cut, room.lanes
    window = own_depth(image, rank, circle, OUTER, cut.own)
    n, other, middle = sample_depth(window, cut, image, circle, sensor, rays[:, ROUND:])
    if n == 0:
        return 0, other, 0, 0.0
    edges = rays[:, ROUND + n :]
    m = sample_edges(window, cut.own, image, circle, middle, sensor, lanes, edges)
    for j in range(ROUND):
        turn = COMPASS[j * (DIRECTIONS // ROUND)]
        x, y = circle[0] + circle[2] * turn[0], circle[1] + circle[2] * turn[1]
        touch(rays, j, place(image, x, y), 0.0, 0.0)
    normalise(rays, ROUND + n + m)
    return n, other, m, middle - sensor.bias


@borrower
def attempt(
    frame: Frame, circle: Floats, rank: int, size: float, seen: tuple[Singles, int],
    habit: Habit, settings: Settings, cap: Floats, room: Room,
) -> tuple[int, float]:  # fmt: skip
    """Fit a cap from where it starts: to its depth, then to its outline in colour as well.

    Args:
        frame: What it is fitted to.
        circle: (3,) x, y, radius, px.
        rank: Of the circle.
        size: Its radius at the cap, m.
        seen: The cap's rays (6, ROOM), with room for those of the outline, and how many there are.
        habit: How caps grow.
        settings: How.
        cap: (15,) parameters, in and out.
        room: From `scratch`; the last step's normal matrix, factored, stays in its workspace.

    Returns:
        Number of rays along the outline in colour, and the misfit, infinite without a solution.
    """
    gray, image = frame
    (rays, count), work = seen, room.work
    setting = (settings.noise, 1.0 / image.focal, size, slack(image, circle))
    if refine(cap, rays, count, habit, setting, STAGES[0], STAGES[1], work)[0] < 0.0:
        return 0, np.inf
    lines = sample_outline(
        gray, image, rank, cap, circle, settings.outline_px, room.lanes, rays[:, count:]
    )
    total, misfit = refine(cap, rays, count + lines, habit, setting, STAGES[1], STAGES[2], work)
    return (lines, misfit) if total >= 0.0 else (0, np.inf)


@borrower
def take(rays: Singles, other: Singles, first: int, last: int) -> None:
    """Copy columns of other rays (6, ROOM)."""
    for i in range(6):
        for j in range(first, last):
            rays[i, j] = other[i, j]


@borrower
def fit_circle(
    frame: Frame, circle: Floats, rank: int, habit: Habit, settings: Settings,
    fit: Fit, room: Room,
) -> float:  # fmt: skip
    """Fit the cap in a circle, from several starts if the first fit is poor; return the misfit.

    Args:
        frame: What it is fitted to.
        circle: (3,) x, y, radius, px.
        rank: Of the circle.
        habit: How caps grow.
        settings: How.
        fit: Out, but for weight and misfit, which `second_fit` adds. Without a fit the counts stay
            as they are and the misfit is infinite.
        room: From `scratch`.
    """
    image, (rays, cap, counts) = frame.image, fit
    rival, normal = room.rival, room.work[0][0]
    n, other, m, middle = gather(image, circle, rank, settings.sensor, room, rays)
    if n < settings.least or middle <= 0.0:
        return np.inf
    size, count, points = circle[2] * middle / image.focal, ROUND + n + m, rays[:, ROUND:]
    ray = ray_at(image, circle[0], circle[1])
    start(cap, axis_of(points, n, habit.up, ray, USUAL[0]), USUAL, ray, middle, size)
    lines, misfit = attempt(frame, circle, rank, size, (rays, count), habit, settings, cap, room)
    tilt, dome = variance_of_tilt(normal), variance_of_aspect(normal, habit.aspect)
    if misfit > POOR:
        take(rival.rays, rays, 0, count)
        leaning = axis_of(points, n, habit.up, ray, CONICAL[0])
        for axis in (habit.up, (-ray[0], -ray[1], -ray[2]), leaning):
            start(rival.cap, axis, CONICAL, ray, middle, size)
            found, rest = attempt(
                frame, circle, rank, size, (rival.rays, count), habit, settings, rival.cap, room
            )
            if rest < BETTER * misfit:
                lines, misfit, tilt = found, rest, variance_of_tilt(normal)
                dome = variance_of_aspect(normal, habit.aspect)
                take(rays, rival.rays, count, ROOM)
                put(cap, rival.cap)
    if np.isfinite(misfit):
        counts[POINTS], counts[EDGES], counts[LINES], counts[OTHERS] = n, m, lines, other
        counts[EXTENT], counts[TILT], counts[DOME] = size, tilt, dome
    return misfit


@borrower
def denied_by(
    frame: Frame, circle: Floats, ranks: tuple[int, int], cap: Floats, bias: float, room: Room
) -> int:
    """Return in how many directions depth denies the outline of a cap (15,) fitted in a circle."""
    expected_reach(cap, frame.image, circle, *room.lanes)
    return denials(frame.image, ranks, cap, bias, circle, room.lanes[0])


@borrower
def fit_cap(
    frame: Frame, circle: Floats, ranks: tuple[int, int], habit: Habit,
    settings: Settings, fit: Fit, room: Room,
) -> None:  # fmt: skip
    """Fit the cap in a circle; where depth denies it, in the circle that depth suggests, too.

    The better fit stays. Not where much of the circle's depth lies elsewhere: it would be fitted to
    whatever hides it.

    Args:
        frame: What it is fitted to.
        circle: (3,) x, y, radius, px, as detected.
        ranks: Of the circle, and of no circle.
        habit: How caps grow.
        settings: How.
        fit: Out, as by `fit_circle`; without a fit it keeps its count of 0.
        room: From `scratch`.
    """
    misfit = fit_circle(frame, circle, ranks[0], habit, settings, fit, room)
    others = fit.counts[OTHERS]
    astray = others > ASTRAY * (fit.counts[POINTS] + others)
    if astray or not ODD < misfit < np.inf:
        return
    other, grown, bias = room.other, room.grown, settings.sensor.bias
    denied = denied_by(frame, circle, ranks, fit.cap, bias, room)
    if misfit < POOR and denied < DENIED:
        return
    middle = fit.cap[2] - 0.5 * fit.cap[HEIGHT] + bias
    if not regrow(frame.image, ranks, circle, middle, grown):
        return
    rest = fit_circle(frame, grown, ranks[0], habit, settings, other, room)
    if not rest < 2.0 * POOR:
        return  # neither is believed
    still = denied_by(frame, grown, ranks, other.cap, bias, room)
    if rest + DENIAL * still < MENDED * (misfit + DENIAL * denied):
        take(fit.rays, other.rays, 0, ROOM)
        put(fit.cap, other.cap)
        put(fit.counts, other.counts)


@borrower
def put(values: Floats, other: Floats) -> None:
    """Copy other values of the same number."""
    for i in range(len(values)):
        values[i] = other[i]
