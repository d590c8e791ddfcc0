"""Where a fit starts, and how far the caps of a scene lean: what the single fit cannot know."""

from __future__ import annotations

import numpy as np

from mushpipe.core.jit import jit
from mushpipe.stages.cap_linear import solve3
from mushpipe.stages.cap_model import BULGE, HEIGHT, RADIUS, Floats, N, Singles, Vector, span

ASPECT = 0.62
USUAL, CONICAL = (ASPECT, 0.0), (0.85, -0.1)  # aspect and bulge that a fit may start with
RIM = 0.73  # depth of the rim plane below the middle of the visible part, in heights of the dome
STEEPEST = 0.9  # rad off the line of sight at which a fit may start
DEGREES = 4.0  # of freedom of Student's t: how readily a leaning cap is let go
PRIOR_CAPS = 0.1  # the spread that is set counts as much as so many caps
NARROWEST = np.radians(2.0)


@jit
def plane(points: Singles, count: int, ray: Vector, out: Floats) -> bool:
    """Fill the unit normal (3,), towards the camera, of the plane through points (6, M)."""
    matrix, right = np.zeros((3, 3)), np.zeros(3)
    for j in range(count):
        far = points[3, j]
        row = (far * (points[0, j] - ray[0]), far * (points[1, j] - ray[1]), 1.0)
        for i in range(3):
            right[i] += row[i] * far * points[2, j]
            for k in range(3):
                matrix[i, k] += row[i] * row[k]
    if not solve3(matrix, right, out):
        return False
    x, y = out[0], out[1]
    norm = np.sqrt(x * x + y * y + 1.0)
    out[0], out[1], out[2] = x / norm, y / norm, -1.0 / norm
    return True


@jit
def lean(axis: Floats, ray: Vector, aspect: float) -> None:
    """Turn an axis (3,) further away from the line of sight, as a cap leans more than its plane.

    The plane through a spheroid's visible points leans 1 - aspect^2 times as much as its axis.
    """
    cosine = -(axis[0] * ray[0] + axis[1] * ray[1] + axis[2] * ray[2])
    across = np.empty(3)
    for i in range(3):
        across[i] = axis[i] + cosine * ray[i]
    sine = np.sqrt(across[0] ** 2 + across[1] ** 2 + across[2] ** 2)
    if sine < 1e-6:
        return
    angle = min(np.arctan2(sine, cosine) / (1.0 - aspect**2), STEEPEST)
    for i in range(3):
        axis[i] = across[i] / sine * np.sin(angle) - ray[i] * np.cos(angle)


@jit
def axis_of(points: Singles, count: int, up: Floats, ray: Vector, aspect: float) -> Floats:
    """Return the axis (3,) to start with: from the plane through points (6, M), `up` without one.

    Args:
        points: (6, M) unit rays and range, m.
        count: How many columns are points.
        up: (3,) unit.
        ray: Unit, through the circle's centre.
        aspect: h/R of the cap.
    """
    axis = up.copy()
    if plane(points, count, ray, axis):
        lean(axis, ray, aspect)
    return axis


@jit
def start(
    cap: Floats, axis: Floats, form: tuple[float, float], ray: Vector, middle: float, size: float
) -> None:
    """Fill a cap (15,) from its circle.

    Args:
        cap: (15,) out.
        axis: (3,) unit.
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


@jit
def spread_of(squares: Floats, variances: Floats, spread: float, out: Floats) -> None:
    """Estimate how far the caps of a scene lean, and what that says of each of them.

    Expectation maximisation for Student's t around the upright: a scene of upright caps holds its
    caps tight, one of leaning caps does not, and a cap that clearly leans is let go in either.

    Args:
        squares: (N,) squared tilt of each fit, rad^2; negative where there is none.
        variances: (N,) its variance per direction, the prior's share included.
        spread: The spread per direction (rad) those fits were made with.
        out: (N,) out: the spread to fit each cap with, rad.
    """
    count = len(squares)
    data, mean = np.zeros(count), np.zeros(count)
    for i in range(count):
        if squares[i] >= 0.0:
            data[i] = max(1.0 / variances[i] - 1.0 / spread**2, 1e-6)
            mean[i] = squares[i] * (1.0 / variances[i] / data[i]) ** 2
    square = spread**2
    for _ in range(15):
        total, number = PRIOR_CAPS * spread**2, PRIOR_CAPS
        for i in range(count):
            out[i] = square
            if squares[i] < 0.0:
                continue
            precision = data[i] + 1.0 / square
            expected = mean[i] * (data[i] / precision) ** 2 + 2.0 / precision
            loose = (DEGREES + 2.0) / (DEGREES + expected / square)
            out[i] = square / loose
            total += 0.5 * loose * expected
            number += 1.0
        square = max(total / number, NARROWEST**2)
    for i in range(count):
        out[i] = np.sqrt(out[i])
