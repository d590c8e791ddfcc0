"""The truth of a view: what an evaluation may hold results against, exact from the geometry."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from mushpipe.core.arrays import Floats, Ints
from mushpipe.core.truth import Ignore, Instances, Truth
from mushpipe.sim.mushroom import Kind, turned_to
from mushpipe.sim.raycast import rays
from mushpipe.sim.render import Surface
from mushpipe.sim.world import View, World

MIN_VISIBLE = 0.5
SMALLEST_PX = 8.0
MIN_INSIDE = 0.7
UPRIGHT_COSINE = 0.5  # an axis more than 60 degrees off the vertical is not upright


@dataclass(frozen=True, eq=False)
class Outline:
    """A closed convex outline: corners (K, 2), area, centroid (2,)."""

    corners: Floats
    area: float
    center: Floats

    @property
    def radius(self) -> float:
        """Radius of the circle with the same area."""
        return float(np.sqrt(self.area / np.pi))

    def extent(self) -> float:
        """Return the largest distance of two corners."""
        offset = self.corners[:, None] - self.corners
        return float(np.sqrt((offset**2).sum(axis=-1).max()))

    def share_inside(self, width: int, height: int) -> float:
        """Return the share of its area that lies within an image."""
        frame = np.array([[0, 0], [width, 0], [width, height], [0, height]], np.float32) - 0.5
        area, _ = cv2.intersectConvexConvex(self.corners.astype(np.float32), frame)
        return float(min(area / self.area, 1.0))


def outline_around(points: Floats) -> Outline:
    """Return the convex hull of points (N, 2), area and centroid by the shoelace formula.

    Caps are convex but for bumps of a few tenths of a per cent, so the hull of a cap's projected
    vertices is its outline.
    """
    middle = points.mean(axis=0)
    hull = cv2.convexHull((points - middle).astype(np.float32))[:, 0].astype(np.float64)
    x, y = hull.T
    following = np.roll(hull, -1, axis=0)
    cross = x * following[:, 1] - y * following[:, 0]
    area = cross.sum() / 2
    center = ((hull + following) * cross[:, None]).sum(axis=0) / (6 * area)
    return Outline(hull + middle, abs(float(area)), center + middle)


def outline_along(axis: Floats, points: Floats) -> Outline:
    """Return the outline of points (N, 3) m, seen along a unit axis from infinitely far."""
    return outline_around(points @ turned_to(axis, 0.0)[:, :2])


def annotate(
    world: World, view: View, surface: Surface, largest_px: float
) -> tuple[Truth, Instances]:
    """Return the truth of all mushrooms of which at least one pixel is seen.

    Args:
        world: The scene.
        view: The camera.
        surface: What it sees.
        largest_px: Outlines with a larger radius are marked as too large.
    """
    owner = np.where(surface.outlined, surface.owner, -1)
    seen = np.bincount(owner[owner >= 0], minlength=len(world.mushrooms))
    numbers = np.flatnonzero(seen)
    mushrooms = [world.mushrooms[k] for k in numbers]
    bodies = [world.vertices[world.bodies[k]] for k in numbers]
    outlines = [outline_around(view.camera.project(view.seen(body))) for body in bodies]
    centers = np.array([o.center for o in outlines]).reshape(-1, 2)
    visible = np.minimum(seen[numbers] / [o.area for o in outlines], 1.0)
    across = [
        outline_along(m.axis, body - m.center) for m, body in zip(mushrooms, bodies, strict=True)
    ]
    size = view.camera.width, view.camera.height
    reasons = [
        reason_of((m.kind == Kind.STUMP, m.axis[2]), o, float(v), size, largest_px)
        for m, o, v in zip(mushrooms, outlines, visible, strict=True)
    ]
    truth = Truth(
        numbers,
        centers,
        np.array([o.radius for o in outlines]),
        visible,
        _apexes(world, view, numbers),
        _surfaces(world, view, numbers, centers),
        np.array([m.axis @ view.rotation for m in mushrooms]).reshape(-1, 3),
        np.array([2 * o.radius for o in across]),
        np.array([o.extent() for o in across]),
        np.array(reasons, np.uint8),
    )
    rows = np.zeros(len(world.mushrooms) + 1, np.uint16)
    rows[numbers] = 1 + np.arange(len(numbers))
    return truth, Instances(rows[owner].reshape(surface.shape))


def reason_of(
    mushroom: tuple[bool, float],
    outline: Outline,
    visible: float,
    size: tuple[int, int],
    largest_px: float,
) -> Ignore:
    """Return why a mushroom does not count; the first of several reasons.

    Args:
        mushroom: Whether it is a stump, and the cosine between its axis and the vertical.
        outline: In the image, px.
        visible: Share of it that is seen.
        size: Width and height of the image, px.
        largest_px: Outlines with a larger radius are too large.
    """
    stump, cosine = mushroom
    inside = (outline.center >= -0.5) & (outline.center < np.array(size) - 0.5)
    if stump:
        return Ignore.CUT_STUMP
    if cosine < UPRIGHT_COSINE:
        return Ignore.NOT_UPRIGHT
    if not inside.all() or outline.share_inside(*size) < MIN_INSIDE:
        return Ignore.AT_BORDER
    if outline.radius < SMALLEST_PX:
        return Ignore.TOO_SMALL
    if outline.radius > largest_px:
        return Ignore.TOO_LARGE
    return Ignore.HIDDEN if visible < MIN_VISIBLE else Ignore.COUNTS


def _apexes(world: World, view: View, numbers: Ints) -> Floats:
    """Return where each axis leaves its cap (N, 3) m, optical frame."""
    center = np.array([world.mushrooms[k].center for k in numbers]).reshape(-1, 3)
    axis = np.array([world.mushrooms[k].axis for k in numbers]).reshape(-1, 3)
    length = np.array([2 * world.mushrooms[k].radius for k in numbers])[:, None]
    start = center + length * axis
    distance = _first_own(world, start, -axis, numbers)
    return view.seen(start - distance[:, None] * axis)


def _surfaces(world: World, view: View, numbers: Ints, centers: Floats) -> Floats:
    """Return where the ray of each circle's centre meets its own cap (N, 3) m, optical frame."""
    sight = view.camera.deproject(centers, np.ones(len(centers)))
    start = np.broadcast_to(view.position, sight.shape)
    distance = _first_own(world, start, sight @ view.rotation.T, numbers)
    return np.asarray(sight * distance[:, None])


def _first_own(world: World, start: Floats, direction: Floats, numbers: Ints) -> Floats:
    """Return how far along ray i (N,) the outlined part of mushroom i begins; NaN if it misses."""
    ray, distance, triangle = world.caster.every(rays(start, direction))
    own = (world.owner[triangle] == numbers[ray]) & world.outlined[triangle]
    first = np.full(len(numbers), np.inf)
    np.minimum.at(first, ray[own], distance[own])
    return np.where(np.isfinite(first), first, np.nan)
