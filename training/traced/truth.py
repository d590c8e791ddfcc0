"""The truth of a traced view, from its meshes; what counts is as in `mushpipe.sim.annotate`."""

from __future__ import annotations

import numpy as np

from mushpipe import Camera
from mushpipe.core.arrays import Floats
from mushpipe.core.truth import Truth
from mushpipe.sim.annotate import outline_along, outline_around, reason_of
from training.traced.bed import Bed, Mushroom
from training.traced.mesh import Mesh
from training.traced.render import View, seen

LARGEST_PX = 60.0


def truth_of(bed: Bed, view: View, camera: Camera) -> Truth:
    """Return the truth of all mushrooms of which a pixel is seen."""
    pixels = np.bincount(view.owner[view.owner >= 0], minlength=len(bed.mushrooms))
    numbers = np.flatnonzero(pixels)
    grown = [bed.mushrooms[k] for k in numbers]
    outlines = [outline_around(camera.project(seen(bed, m.skin.vertices))) for m in grown]
    across = [outline_along(m.axis, m.skin.vertices - m.position) for m in grown]
    visible = np.minimum(1, pixels[numbers] / [o.area for o in outlines])
    size = camera.width, camera.height
    reasons = [
        reason_of((m.rest is None, m.axis[2]), o, v, size, LARGEST_PX)
        for m, o, v in zip(grown, outlines, visible.tolist(), strict=True)
    ]
    centers = np.array([o.center for o in outlines]).reshape(-1, 2)
    sights = [_surface(bed, m, camera, c) for m, c in zip(grown, centers, strict=True)]
    return Truth(
        numbers,
        centers,
        np.array([o.radius for o in outlines]),
        visible,
        np.array([_apex(bed, m) for m in grown]).reshape(-1, 3),
        np.array(sights).reshape(-1, 3),
        np.array([bed.rotation @ m.axis for m in grown]).reshape(-1, 3),
        np.array([2 * o.radius for o in across]),
        np.array([o.extent() for o in across]),
        np.array(reasons, np.uint8),
    )


def _apex(bed: Bed, mushroom: Mushroom) -> Floats:
    """Return where the axis leaves the skin (3,) m, optical frame; NaN where it misses."""
    start = mushroom.position + 0.2 * mushroom.axis
    hit = start - first_hit(mushroom.skin, start, -mushroom.axis) * mushroom.axis
    return np.asarray(seen(bed, hit[None])[0])


def _surface(bed: Bed, mushroom: Mushroom, camera: Camera, center: Floats) -> Floats:
    """Return where the ray of an outline's centre meets the skin (3,) m, optical frame."""
    sight = camera.deproject(center[None], np.ones(1))[0]
    start = -bed.distance * bed.rotation[2]  # the camera, in the bed frame
    return np.asarray(sight * first_hit(mushroom.skin, start, bed.rotation.T @ sight))


def first_hit(mesh: Mesh, start: Floats, direction: Floats) -> float:
    """Return how many `direction` (3,) from `start` (3,) a mesh begins; NaN if it is missed.

    Möller & Trumbore 1997, "Fast, Minimum Storage Ray/Triangle Intersection".
    """
    a, b, c = (mesh.vertices[mesh.triangles[:, k]] for k in range(3))
    e1, e2, way = b - a, c - a, start - a
    p, q = np.cross(direction, e2), np.cross(way, e1)
    with np.errstate(divide="ignore", invalid="ignore"):
        volume = (e1 * p).sum(axis=1)
        u, v = (way * p).sum(axis=1) / volume, q @ direction / volume
        t = (e2 * q).sum(axis=1) / volume
        hit = t[(u >= 0) & (v >= 0) & (u + v <= 1) & (t > 0)]
    return float(hit.min()) if len(hit) else float("nan")
