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
of arrays (k, M), so that the compiler can work on several rays at once.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from mushpipe.core.jit import inlined, jit

Floats = NDArray[np.float64]
Singles = NDArray[np.float32]
Cap = tuple[float, ...]
Vector = tuple[float, float, float]
LIP = 0.25  # depth of the margin below the rim plane, in rim radii
SIZE = 15
N, RADIUS, HEIGHT, BULGE, E1, E2 = 3, 6, 7, 8, 9, 12
ROOM = 169  # most rays of a cap: 8 around the circle, 97 points, 32 each along depth and color edge
UNKNOWNS = 8  # C (3), turn along e1 and e2 (2), R, h, b


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
    """Return the array (15,) as a tuple."""
    return (
        cap[0], cap[1], cap[2], cap[3], cap[4], cap[5], cap[6],
        cap[7], cap[8], cap[9], cap[10], cap[11], cap[12], cap[13], cap[14],
    )  # fmt: skip


@inlined
def dot(a: Vector, b: Vector) -> float:
    """Return the scalar product."""
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


@inlined
def enter(c: Cap, ray: Vector, k: float, tangent: bool) -> tuple[float, float, bool]:
    """Return (t, s, hit) for one half of a cap, taken as a whole spheroid without bulge.

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


@inlined
def meet(c: Cap, ray: Vector, tangent: bool) -> tuple[float, float, bool]:
    """Return (t, k, hit): where a ray meets the cap, in which half, and whether it does at all."""
    lip = LIP * c[RADIUS]
    t, s, hit = enter(c, ray, c[HEIGHT], tangent)
    t_lip, _, hit_lip = enter(c, ray, lip, tangent)
    dome = s > 0.0
    return (t if dome else t_lip), (c[HEIGHT] if dome else lip), (hit if dome else hit_lip)


@inlined
def slope(c: Cap, ray: Vector, t: float, k: float) -> tuple[float, ...]:
    """Return P = F - 1 - b w at the point t ray, in the half with half-axis k, and how it changes.

    Returns:
        P, |grad P| and |cos| of incidence; then the derivative of P by C, the two turns, R, h and
        b, over |grad P|: that of the distance to the surface, positive where it recedes.
    """
    q = (t * ray[0] - c[0], t * ray[1] - c[1], t * ray[2] - c[2])
    axis = (c[3], c[4], c[5])
    inverse = 1.0 / (c[RADIUS] * c[RADIUS])
    d = 1.0 / (k * k) - inverse
    s, square = dot(q, axis), dot(q, q)
    dome = 1.0 if s > 0.0 else 0.0  # a factor, for branches keep rays from being worked on at once
    f = np.sqrt(max(square * inverse + d * s * s, 1e-12))
    x = dome * s * s / (k * k * f * f)
    # w depends on F and on s: dP = own dF + by_s ds
    bend = dome * 4.0 * c[BULGE] * (1.0 - 2.0 * x)
    own = (1.0 + 2.0 * bend * x / f) / f
    by_s = -2.0 * bend * s / (k * k * f * f)
    lean = own * d * s + by_s
    g = (
        own * q[0] * inverse + lean * axis[0],
        own * q[1] * inverse + lean * axis[1],
        own * q[2] * inverse + lean * axis[2],
    )
    length = np.sqrt(max(dot(g, g), 1e-12))
    over = 1.0 / length
    by_radius = max(square - s * s, 0.0) * inverse / c[RADIUS]
    by_half = s * s / (k * k)  # k is h on the dome and LIP R on the margin
    w = 4.0 * x * (1.0 - x)
    return (
        f - 1.0 - c[BULGE] * w,
        length,
        abs(dot(g, ray)) * over,
        -g[0] * over,
        -g[1] * over,
        -g[2] * over,
        lean * dot(q, (c[E1], c[E1 + 1], c[E1 + 2])) * over,
        lean * dot(q, (c[E2], c[E2 + 1], c[E2 + 2])) * over,
        -own * (by_radius + (1.0 - dome) * by_half / c[RADIUS]) * over,
        dome * (2.0 * bend * x - own * by_half) / k * over,
        -w * over,
    )


@jit
def fill_rows(cap: Floats, rays: Singles, count: int, flat: Floats) -> None:
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
    for i in range(4):
        for j in range(count):
            flat[(10 + i) * ROOM + j] = rays[i, j]
    for j in range(count):
        ray = (flat[j + 10 * ROOM], flat[j + 11 * ROOM], flat[j + 12 * ROOM])
        touches = flat[j + 13 * ROOM] == 0.0
        t, k, crosses = meet(c, ray, touches)
        hit = crosses & (not touches)
        p, length, cosine, d0, d1, d2, d3, d4, d5, d6, d7 = slope(c, ray, t, k)
        flat[j], flat[j + ROOM], flat[j + 2 * ROOM], flat[j + 3 * ROOM] = d0, d1, d2, d3
        flat[j + 4 * ROOM], flat[j + 5 * ROOM] = d4, d5
        flat[j + 6 * ROOM], flat[j + 7 * ROOM] = d6, d7
        # one Newton step from the spheroid without bulge to the surface with it
        off = cosine * (t - flat[j + 13 * ROOM])
        flat[j + 8 * ROOM] = p / length + (off if hit else 0.0)
        flat[j + 9 * ROOM] = cosine if hit else (1.0 if touches else 0.0)
