"""The cap as two halves of spheroids, and how a ray of sight meets it.

A cap is seven numbers: the centre C of its rim plane, its unit axis n (two degrees of freedom), the
radius R of the rim and the height h of the dome. With s = (p - C).n and rho^2 = |p - C|^2 - s^2 its
surface is F = 1, F^2 = rho^2/R^2 + s^2/k^2, where k = h above the rim plane (the dome) and
k = LIP R below it (the margin that rolls in). A cap is held in an array of 14: C, n, R, h, and two
unit vectors e1, e2 that span the plane across n. Lengths are metres, in the camera's optical frame.

Kernels assume finite numbers. They take a cap as a tuple and rays as scalars, and loop over columns
of arrays (k, M), so that the compiler can work on several rays at once.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from mushpipe.core.jit import jit

Floats = NDArray[np.float64]
Cap = tuple[float, ...]
Vector = tuple[float, float, float]
LIP = 0.25  # depth of the margin below the rim plane, in rim radii
SIZE = 14
N, RADIUS, HEIGHT, E1, E2 = 3, 6, 7, 8, 11
UNKNOWNS = 7  # C (3), turn along e1 and e2 (2), R, h


@jit
def span(cap: Floats) -> None:
    """Fill e1 and e2 of a cap from its axis (Duff et al. 2017, without branches)."""
    x, y, z = cap[N], cap[N + 1], cap[N + 2]
    sign = 1.0 if z >= 0 else -1.0
    a = -1.0 / (sign + z)
    b = x * y * a
    cap[E1], cap[E1 + 1], cap[E1 + 2] = 1.0 + sign * x * x * a, sign * b, -sign * x
    cap[E2], cap[E2 + 1], cap[E2 + 2] = b, sign + y * y * a, -y


@jit
def move(cap: Floats, step: Floats) -> None:
    """Add a step (7,) to a cap and renew its axis and span."""
    norm = 0.0
    for i in range(3):
        cap[i] += step[i]
        cap[N + i] += step[3] * cap[E1 + i] + step[4] * cap[E2 + i]
        norm += cap[N + i] * cap[N + i]
    for i in range(3):
        cap[N + i] /= np.sqrt(norm)
    cap[RADIUS] += step[5]
    cap[HEIGHT] += step[6]
    span(cap)


@jit
def frozen(cap: Floats) -> Cap:
    """Return the array (14,) as a tuple."""
    return (
        cap[0], cap[1], cap[2], cap[3], cap[4], cap[5], cap[6],
        cap[7], cap[8], cap[9], cap[10], cap[11], cap[12], cap[13],
    )  # fmt: skip


@jit
def dot(a: Vector, b: Vector) -> float:
    """Return the scalar product."""
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


@jit
def enter(c: Cap, ray: Vector, k: float, tangent: bool) -> tuple[float, float, bool]:
    """Return (t, s, hit) for one half of a cap, taken as a whole spheroid.

    Solves A t^2 + 2 B t + G = F^2 - 1 = 0 for the point t ray.

    Args:
        c: Cap.
        ray: Unit vector.
        k: Half-axis along n, m.
        tangent: Take the closest approach even where the ray hits.

    Returns:
        Where the ray enters, or where it comes closest if it misses; the height of that point over
        the rim plane; and whether it hits.
    """
    center, axis = (c[0], c[1], c[2]), (c[3], c[4], c[5])
    inverse = 1.0 / (c[RADIUS] * c[RADIUS])
    d = 1.0 / (k * k) - inverse
    un, qn = dot(ray, axis), -dot(center, axis)
    a = inverse + d * un * un
    b = d * un * qn - dot(center, ray) * inverse
    g = dot(center, center) * inverse + d * qn * qn - 1.0
    free = b * b - a * g
    t = (-b if tangent else -b - np.sqrt(max(free, 0.0))) / a
    return t, t * un + qn, free > 0.0


@jit
def meet(c: Cap, ray: Vector, tangent: bool) -> tuple[float, float, bool]:
    """Return (t, k, hit): where a ray meets the cap, in which half, and whether it does at all."""
    lip = LIP * c[RADIUS]
    t, s, hit = enter(c, ray, c[HEIGHT], tangent)
    t_lip, _, hit_lip = enter(c, ray, lip, tangent)
    dome = s > 0.0
    return (t if dome else t_lip), (c[HEIGHT] if dome else lip), (hit if dome else hit_lip)


@jit
def slope(c: Cap, ray: Vector, t: float, k: float) -> tuple[float, ...]:
    """Return how F changes at the point t ray in the half with half-axis k.

    Returns:
        F, |grad F| and |cos| of incidence; then the derivative of F by C, the two turns, R and h,
        over |grad F|: that of the distance to the surface, positive where the surface recedes.
    """
    q = (t * ray[0] - c[0], t * ray[1] - c[1], t * ray[2] - c[2])
    axis = (c[3], c[4], c[5])
    inverse = 1.0 / (c[RADIUS] * c[RADIUS])
    d = 1.0 / (k * k) - inverse
    s, square = dot(q, axis), dot(q, q)
    f = np.sqrt(max(square * inverse + d * s * s, 1e-12))
    g = (
        (q[0] * inverse + d * s * axis[0]) / f,
        (q[1] * inverse + d * s * axis[1]) / f,
        (q[2] * inverse + d * s * axis[2]) / f,
    )
    length = np.sqrt(max(dot(g, g), 1e-12))
    over = 1.0 / (length * f)
    by_radius = max(square - s * s, 0.0) * inverse / c[RADIUS]
    by_half = s * s / (k * k)  # k is h on the dome and LIP R on the margin
    return (
        f,
        length,
        abs(dot(g, ray)) / length,
        -g[0] / length,
        -g[1] / length,
        -g[2] / length,
        d * s * dot(q, (c[E1], c[E1 + 1], c[E1 + 2])) * over,
        d * s * dot(q, (c[E2], c[E2 + 1], c[E2 + 2])) * over,
        -(by_radius + (0.0 if s > 0.0 else by_half / c[RADIUS])) * over,
        -(by_half / k if s > 0.0 else 0.0) * over,
    )


@jit
def depth_rows(cap: Floats, points: Floats, count: int, rows: Floats) -> None:
    """Fill a column of `rows` for each of the measured points.

    The residual is the distance from the point to the cap along the ray, times the cosine of
    incidence. A ray that misses has the distance from its closest approach, and a cosine of 0:
    without that, points just outside the outline would not hold the radius.

    Args:
        cap: (14,).
        points: (5, M): unit ray (3), range and its sigma, m.
        count: How many columns are points.
        rows: (9, M) out: derivatives (7), the cosine held fixed; residual, m; cosine.
    """
    c = frozen(cap)
    for j in range(count):
        ray = (points[0, j], points[1, j], points[2, j])
        t, k, hit = meet(c, ray, False)
        f, length, cosine, d0, d1, d2, d3, d4, d5, d6 = slope(c, ray, t, k)
        rows[0, j], rows[1, j], rows[2, j] = d0, d1, d2
        rows[3, j], rows[4, j], rows[5, j], rows[6, j] = d3, d4, d5, d6
        rows[7, j] = cosine * (t - points[3, j]) if hit else (f - 1.0) / length
        rows[8, j] = cosine if hit else 0.0


@jit
def tangent_rows(cap: Floats, rays: Floats, count: int, rows: Floats) -> None:
    """Fill a column of `rows` for each ray (3, M) of an outline.

    The residual is how far outside (negative: inside) the cap's outline the ray passes, m.
    """
    c = frozen(cap)
    for j in range(count):
        ray = (rays[0, j], rays[1, j], rays[2, j])
        t, k, _ = meet(c, ray, True)
        f, length, _, d0, d1, d2, d3, d4, d5, d6 = slope(c, ray, t, k)
        rows[0, j], rows[1, j], rows[2, j] = d0, d1, d2
        rows[3, j], rows[4, j], rows[5, j], rows[6, j] = d3, d4, d5, d6
        rows[7, j] = (f - 1.0) / length
