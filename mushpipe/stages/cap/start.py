"""Where the fit of a cap starts: at the plane through its points."""

from __future__ import annotations

import numpy as np

from mushpipe.core.arrays import Floats, Singles
from mushpipe.core.jit import borrower
from mushpipe.stages.cap.linear import solve3
from mushpipe.stages.cap.model import ASPECT, BULGE, HEIGHT, RADIUS, N, Vector, span

USUAL, CONICAL = (ASPECT, 0.0), (0.85, -0.1)  # aspect and bulge that a fit may start with
RIM = 0.73  # depth of the rim plane below the middle of the visible part, in heights of the dome
STEEPEST = 0.9  # rad off the line of sight at which a fit may start


@borrower
def plane(points: Singles, count: int, ray: Vector) -> tuple[bool, Vector]:
    """Return whether points (6, M) determine a plane, and its unit normal, towards the camera."""
    xx = xy = yy = x = y = xz = yz = z = 0.0
    for j in range(count):
        far = points[3, j]
        across, down = far * (points[0, j] - ray[0]), far * (points[1, j] - ray[1])
        deep = far * points[2, j]
        xx, xy, yy = xx + across * across, xy + across * down, yy + down * down
        x, y = x + across, y + down
        xz, yz, z = xz + across * deep, yz + down * deep, z + deep
    found, (a, b, _) = solve3((xx, xy, x, yy, y, float(count)), (xz, yz, z))
    norm = np.sqrt(a * a + b * b + 1.0)
    return found, (a / norm, b / norm, -1.0 / norm)


@borrower
def lean(axis: Vector, ray: Vector, aspect: float) -> Vector:
    """Turn an axis further away from the line of sight: a cap leans more than its plane.

    The plane through a spheroid's visible points leans 1 - aspect^2 times as much as its axis.
    """
    cosine = -(axis[0] * ray[0] + axis[1] * ray[1] + axis[2] * ray[2])
    x, y, z = axis[0] + cosine * ray[0], axis[1] + cosine * ray[1], axis[2] + cosine * ray[2]
    sine = np.sqrt(x * x + y * y + z * z)
    if sine < 1e-6:
        return axis
    angle = min(np.arctan2(sine, cosine) / (1.0 - aspect**2), STEEPEST)
    across, along = np.sin(angle) / sine, np.cos(angle)
    return across * x - along * ray[0], across * y - along * ray[1], across * z - along * ray[2]


@borrower
def axis_of(points: Singles, count: int, up: Vector, ray: Vector, aspect: float) -> Vector:
    """Return the axis to start with: from the plane through points (6, M), `up` without one.

    Args:
        points: (6, M) unit rays and range, m.
        count: How many columns are points.
        up: Unit.
        ray: Unit, through the circle's centre.
        aspect: h/R of the cap.
    """
    found, normal = plane(points, count, ray)
    return lean(normal, ray, aspect) if found else up


@borrower
def start(
    cap: Floats, axis: Vector, form: tuple[float, float], ray: Vector, middle: float, size: float
) -> None:
    """Fill a cap (15,) from its circle.

    Args:
        cap: (15,) out.
        axis: Unit.
        form: Aspect h/R and bulge.
        ray: Unit, through the circle's centre.
        middle: Middle depth of the cap, m.
        size: Radius of the circle at that depth, m.
    """
    for i in range(3):
        cap[i] = ray[i] / ray[2] * (middle + RIM * form[0] * size)
        cap[N + i] = axis[i]
    cap[RADIUS] = 1.03 * size
    cap[HEIGHT] = form[0] * cap[RADIUS]
    cap[BULGE] = form[1]
    span(cap)
