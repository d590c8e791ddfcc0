"""The cap as two halves of spheroids, and how a ray of sight meets it.

A cap is seven numbers: the centre C of its rim plane, its unit axis n (two degrees of freedom), the
radius R of the rim and the height h of the dome. With s = (p - C).n and rho^2 = |p - C|^2 - s^2 its
surface is F = 1, F^2 = rho^2/R^2 + s^2/k^2, where k = h above the rim plane (the dome) and
k = LIP R below it (the margin that rolls in). A cap is held in an array of 14: C, n, R, h, and two
unit vectors e1, e2 that span the plane across n. Lengths are metres, in the camera's optical frame.

Kernels assume finite numbers.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from mushpipe.core.jit import jit

Floats = NDArray[np.float64]
LIP = 0.25  # depth of the margin below the rim plane, in rim radii
SIZE = 14
N, RADIUS, HEIGHT, E1, E2 = 3, 6, 7, 8, 11
UNKNOWNS = 7  # C (3), turn about e2 and -e1 (2), R, h


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
def quadratic(cap: Floats, ray: Floats, k: float) -> tuple[float, float, float]:
    """Return A, B, G of A t^2 + 2 B t + G = F^2 - 1 at the point t ray."""
    inverse = 1.0 / (cap[RADIUS] * cap[RADIUS])
    d = 1.0 / (k * k) - inverse
    un, qn, qu, qq = 0.0, 0.0, 0.0, 0.0
    for i in range(3):
        un += ray[i] * cap[N + i]
        qn -= cap[i] * cap[N + i]
        qu -= cap[i] * ray[i]
        qq += cap[i] * cap[i]
    return inverse + d * un * un, qu * inverse + d * un * qn, qq * inverse + d * qn * qn - 1.0


@jit
def nearest_on_ray(a: float, b: float, g: float) -> float:
    """Return where the ray enters the surface, or where it comes closest to it."""
    return (-b - np.sqrt(max(b * b - a * g, 0.0))) / a


@jit
def along_axis(cap: Floats, ray: Floats, t: float) -> float:
    """Return s of the point t ray: its height above the rim plane."""
    s = 0.0
    for i in range(3):
        s += (t * ray[i] - cap[i]) * cap[N + i]
    return s


@jit
def meet(cap: Floats, ray: Floats, tangent: bool) -> tuple[float, float, bool]:
    """Return (t, k, hit): where a ray meets the cap, in which half, and whether it does at all.

    Args:
        cap: (14,) as above.
        ray: (3,) unit.
        tangent: Take the closest approach even where the ray hits: for rays along the outline.
    """
    k = cap[HEIGHT]
    a, b, g = quadratic(cap, ray, k)
    t = -b / a if tangent else nearest_on_ray(a, b, g)
    if along_axis(cap, ray, t) <= 0.0:
        k = LIP * cap[RADIUS]
        a, b, g = quadratic(cap, ray, k)
        t = -b / a if tangent else nearest_on_ray(a, b, g)
    return t, k, b * b - a * g > 0.0 and not tangent


@jit
def slope(cap: Floats, ray: Floats, t: float, k: float, row: Floats) -> tuple[float, float, float]:
    """Return F, |grad F| and |cos| of incidence at the point t ray; fill row with dF/|grad F|.

    Args:
        cap: (14,) as above.
        ray: (3,) unit.
        t: Distance along the ray, m.
        k: Half-axis of the half in question, m.
        row: (7,) out: derivative of F by C, the two turns, R and h, over the gradient's length. It
            is the derivative of the distance to the surface, positive where the surface recedes.
    """
    radius = cap[RADIUS]
    inverse = 1.0 / (radius * radius)
    d = 1.0 / (k * k) - inverse
    s, qq, q1, q2 = 0.0, 0.0, 0.0, 0.0
    for i in range(3):
        q = t * ray[i] - cap[i]
        s += q * cap[N + i]
        q1 += q * cap[E1 + i]
        q2 += q * cap[E2 + i]
        qq += q * q
    f = np.sqrt(max(qq * inverse + d * s * s, 1e-12))
    gg, gu = 0.0, 0.0
    for i in range(3):
        g = ((t * ray[i] - cap[i]) * inverse + d * s * cap[N + i]) / f
        row[i] = -g
        gg += g * g
        gu += g * ray[i]
    row[3], row[4] = d * s * q1 / f, d * s * q2 / f
    row[5] = -max(qq - s * s, 0.0) * inverse / (radius * f)
    row[6] = 0.0
    if s > 0.0:
        row[6] = -s * s / (k * k * k * f)
    else:
        row[5] -= s * s / (k * k * radius * f)
    length = np.sqrt(max(gg, 1e-12))
    for i in range(7):
        row[i] /= length
    return f, length, abs(gu) / length


@jit
def depth_residual(cap: Floats, ray: Floats, measured: float, row: Floats) -> tuple[float, float]:
    """Return the distance from a measured point to the cap, along its ray, and |cos| of incidence.

    A ray that misses the cap has the distance from its closest approach and a cosine of 0: without
    it points just outside the outline would not hold the radius.

    Args:
        cap: (14,) as above.
        ray: (3,) unit.
        measured: Range of the measured point, m.
        row: (7,) out: its derivative, the cosine held fixed.
    """
    t, k, hit = meet(cap, ray, False)
    f, length, cosine = slope(cap, ray, t, k, row)
    if hit:
        return cosine * (t - measured), cosine
    return (f - 1.0) / length, 0.0


@jit
def tangent_residual(cap: Floats, ray: Floats, row: Floats) -> float:
    """Return how far outside (negative: inside) the cap's outline a ray passes, m; fill its row."""
    t, k, _ = meet(cap, ray, True)
    f, length, _ = slope(cap, ray, t, k, row)
    return (f - 1.0) / length


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
