"""The cap as two halves of spheroids with a bulge, and how a ray of sight meets it.

A cap is eight numbers: the centre C of its rim plane, its unit axis n (two degrees of freedom), the
radius R of the rim, the height h of the dome and the bulge b of its profile. With s = (p - C).n and
rho^2 = |p - C|^2 - s^2, F^2 = rho^2/R^2 + s^2/k^2 where k = h above the rim plane (the dome) and
k = LIP R below it (the margin that rolls in). The surface is F = 1 + b w, w = 4 x (1 - x) with
x = s^2/(k F)^2 on the dome: b > 0 is a flat-topped cap, b < 0 a conical one; top and rim stay.
To first order a superellipse of exponent 2 + d has b = 0.17 d.

A cap is held in an array of 15: C, n, R, h, b, and two unit vectors e1, e2 that span the plane
across n. Lengths are metres, in the camera's optical frame.

Kernels assume finite numbers. They take a cap as a tuple and rays as scalars, and loop over columns
of arrays (k, M), so that the compiler can work on several rays at once. That is done in single
precision: lengths are in rim radii from C, where it is worth a thousandth of a micrometre.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from mushpipe.core.arrays import Floats, Singles
from mushpipe.core.jit import borrower, inlined

Cap = tuple[float, ...]
Single: Any = np.float32  # to type checkers a float
Vector = tuple[float, float, float]
LIP = 0.25  # depth of the margin below the rim plane, in rim radii
ASPECT, ASPECT_SIGMA = 0.62, 0.2  # height of a dome, in rim radii: what is usual, and its spread
SIZE = 15
N, RADIUS, HEIGHT, BULGE, E1, E2 = 3, 6, 7, 8, 9, 12
LANES = 16  # columns that a kernel works on at once
# most rays of a cap: 8 around the circle, 97 points, 32 each along depth and colour edge; in LANES
ROOM = 192
UNKNOWNS = 8  # C (3), turn along e1 and e2 (2), R, h, b


@borrower
def span(cap: Floats) -> None:
    """Fill e1 and e2 of a cap from its axis (Duff et al. 2017, without branches)."""
    x, y, z = cap[N], cap[N + 1], cap[N + 2]
    sign = 1.0 if z >= 0 else -1.0
    a = -1.0 / (sign + z)
    b = x * y * a
    cap[E1], cap[E1 + 1], cap[E1 + 2] = 1.0 + sign * x * x * a, sign * b, -sign * x
    cap[E2], cap[E2 + 1], cap[E2 + 2] = b, sign + y * y * a, -y


@borrower
def move(cap: Floats, step: Floats) -> None:
    """Add a step (8,) to a cap and renew its axis and span."""
    norm = 0.0
    for i in range(3):
        cap[i] += step[i]
        cap[N + i] += step[3] * cap[E1 + i] + step[4] * cap[E2 + i]
        norm += cap[N + i] * cap[N + i]
    for i in range(3):
        cap[N + i] /= np.sqrt(norm)
    cap[RADIUS] += step[5]
    cap[HEIGHT] += step[6]
    cap[BULGE] += step[7]
    span(cap)


@inlined
def frozen(cap: Floats) -> Cap:
    """Return axis, e1, e2, R/h, b and R of the array (15,) as a tuple of singles."""
    return (
        Single(cap[3]), Single(cap[4]), Single(cap[5]),
        Single(cap[9]), Single(cap[10]), Single(cap[11]),
        Single(cap[12]), Single(cap[13]), Single(cap[14]),
        Single(cap[RADIUS] / cap[HEIGHT]), Single(cap[BULGE]), Single(cap[RADIUS]),
    )  # fmt: skip


@inlined
def dot(a: Vector, b: Vector) -> float:
    """Return the scalar product."""
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


@inlined
def enter(
    ray: Vector, q: Vector, axis: Vector, per_k: float, tangent: bool
) -> tuple[float, float, float]:
    """Return (top, A, free) for one half of a cap, taken as a whole spheroid without bulge.

    Solves A t^2 + 2 B t + G = F^2 - 1 = 0 for the point q + t ray.

    Args:
        ray: Unit vector.
        q: A point of the ray, from C in radii.
        axis: Unit vector.
        per_k: 1 over the half-axis along it, per radius.
        tangent: Take the closest approach even where the ray hits.

    Returns:
        With A: t = top / A, where the ray enters, or where it comes closest if it misses; free > 0
        if it hits.
    """
    d = per_k * per_k - Single(1)
    un, qn = dot(ray, axis), dot(q, axis)
    a = Single(1) + d * un * un
    b = dot(q, ray) + d * un * qn
    g = dot(q, q) + d * qn * qn - Single(1)
    free = b * b - a * g
    root = np.sqrt(max(free, Single(0)))
    return -(b + (Single(0) if tangent else root)), a, free


@inlined
def meet(c: Cap, q: Vector, ray: Vector, tangent: bool) -> tuple[float, float, bool]:
    """Return (t, 1/k, hit): where a ray meets the cap, in which half, and whether it does."""
    axis, per_lip = (c[0], c[1], c[2]), Single(1 / LIP)
    top, a, free = enter(ray, q, axis, c[9], tangent)
    top_lip, a_lip, free_lip = enter(ray, q, axis, per_lip, tangent)
    dome = top * dot(ray, axis) + a * dot(q, axis) > Single(0)  # t ray.n + q.n, times A
    t = (top if dome else top_lip) / (a if dome else a_lip)
    return t, (c[9] if dome else per_lip), (free if dome else free_lip) > Single(0)


@inlined
def slope(c: Cap, q: Vector, ray: Vector, per_k: float) -> tuple[float, ...]:
    """Return P = F - 1 - b w at the point q of a ray, in one half of the cap, and its change.

    Args:
        c: From `frozen`.
        q: From C in radii.
        ray: Unit vector.
        per_k: 1 over the half-axis of that half, per radius.

    Returns:
        P over |grad P|, m; 1 over |grad P|, in radii; and |cos| of incidence. Then the derivative
        of P by C, the two turns, R, h and b, over |grad P|: that of the distance to the surface,
        m, positive where it recedes.
    """
    one, two, four, least = Single(1), Single(2), Single(4), Single(1e-12)
    axis, bulge, radius = (c[0], c[1], c[2]), c[10], c[11]
    d = per_k * per_k - one
    s, square = dot(q, axis), dot(q, q)
    dome = one if s > Single(0) else Single(0)  # a factor: branches hinder SIMD
    by_half = s * s * per_k * per_k  # k is h on the dome and LIP R on the margin
    square_f = max(square + d * s * s, least)  # F^2
    per_f = one / np.sqrt(square_f)
    x = dome * by_half * per_f * per_f
    # w depends on F and on s: dP = own dF + by_s ds
    bend = dome * four * bulge * (one - two * x)
    own = (one + two * bend * x * per_f) * per_f
    lean = own * d * s - two * bend * s * per_k * per_k * per_f * per_f
    g = (own * q[0] + lean * axis[0], own * q[1] + lean * axis[1], own * q[2] + lean * axis[2])
    over = one / np.sqrt(max(dot(g, g), least))
    w = four * x * (one - x)
    rim = max(square - s * s, Single(0))
    return (
        (square_f * per_f - one - bulge * w) * over * radius,
        over,
        abs(dot(g, ray)) * over,
        -g[0] * over,
        -g[1] * over,
        -g[2] * over,
        lean * dot(q, (c[3], c[4], c[5])) * over * radius,
        lean * dot(q, (c[6], c[7], c[8])) * over * radius,
        -own * (rim + (one - dome) * by_half) * over,
        dome * (two * bend * x - own * by_half) * per_k * over,
        -w * over * radius,
    )


@inlined
def beside(center: Vector, middle: float, per_radius: float, ray: Vector) -> Vector:
    """Return where a ray is as far away as C, from C in radii.

    Args:
        center: C, m.
        middle: How far away C is, m.
        per_radius: 1 over the radius, 1/m.
        ray: Unit vector.
    """
    return (
        (middle * ray[0] - center[0]) * per_radius,
        (middle * ray[1] - center[1]) * per_radius,
        (middle * ray[2] - center[2]) * per_radius,
    )


@borrower
def fill_rows(cap: Floats, rays: Singles, count: int, flat: Singles) -> None:
    """Fill a column of rows for each ray.

    A ray with a range has hit the cap there: its residual is the distance from that point to the
    cap along the ray, times the cosine of incidence. If it misses the cap, the residual is the
    distance from its closest approach, and the cosine 0: without that, points just outside the
    outline would not hold the radius. A ray without a range touches the cap: its residual is how
    far outside (negative: inside) of the cap's outline it passes.

    Args:
        cap: (15,).
        rays: (4 or more, M): unit ray (3) and range, m; 0 for a ray that touches.
        count: How many columns are rays, at most ROOM.
        flat: (14 ROOM,) out, rows of ROOM: derivatives (8), the cosine held fixed; residual, m;
            cosine, 1 for a ray that touches; then a copy of the rays and ranges. In one array at
            fixed distances the compiler sees that nothing overlaps.
    """
    c = frozen(cap)
    x, y, z = Single(cap[0]), Single(cap[1]), Single(cap[2])
    middle, per_radius = np.sqrt(x * x + y * y + z * z), Single(1) / c[11]
    for i in range(4):
        for j in range(count):
            flat[(10 + i) * ROOM + j] = rays[i, j]
    for j in range(count):
        ray = (flat[j + 10 * ROOM], flat[j + 11 * ROOM], flat[j + 12 * ROOM])
        far = flat[j + 13 * ROOM]
        touches = far == Single(0)
        q0, q1, q2 = beside((x, y, z), middle, per_radius, ray)
        t, per_k, crosses = meet(c, (q0, q1, q2), ray, touches)
        hit = crosses & (not touches)
        q = (q0 + t * ray[0], q1 + t * ray[1], q2 + t * ray[2])
        p, _, cosine, d0, d1, d2, d3, d4, d5, d6, d7 = slope(c, q, ray, per_k)
        flat[j], flat[j + ROOM], flat[j + 2 * ROOM], flat[j + 3 * ROOM] = d0, d1, d2, d3
        flat[j + 4 * ROOM], flat[j + 5 * ROOM] = d4, d5
        flat[j + 6 * ROOM], flat[j + 7 * ROOM] = d6, d7
        # one Newton step from the spheroid without bulge to the surface with it
        off = cosine * (t * c[11] + middle - far)
        flat[j + 8 * ROOM] = p + (off if hit else Single(0))
        flat[j + 9 * ROOM] = cosine if hit else (Single(1) if touches else Single(0))
