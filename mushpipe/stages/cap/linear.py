"""Normal equations of a cap: built from rows, solved by Cholesky; and a robust weight."""

from __future__ import annotations

import numpy as np

from mushpipe.core.arrays import Floats, Singles
from mushpipe.core.jit import borrower, inlined
from mushpipe.stages.cap.model import ROOM, UNKNOWNS, Single, Vector

Six = tuple[float, float, float, float, float, float]


@borrower
def multiply(flat: Singles, weights: Singles, count: int, system: tuple[Floats, Floats]) -> None:
    """Fill the lower triangle of a normal matrix, and the gradient, from rows and their weights.

    Args:
        flat: (9 ROOM or more,) rows of ROOM: derivatives and residual.
        weights: (ROOM,) of the columns.
        count: How many columns are rows.
        system: Normal matrix (8, 8) and gradient (8,), out; above the diagonal there may be
            anything.
    """
    normal, gradient = system
    for i in range(UNKNOWNS):
        for j in range(0, i + 1, 4):
            products = dots(flat, weights, i, j, count)
            for k in range(4):
                normal[i, j + k] = products[k]
            gradient[i] = products[4]


@inlined
def dots(
    flat: Singles, weights: Singles, i: int, j: int, count: int
) -> tuple[float, float, float, float, float]:
    """Return weighted products of row i with rows j to j + 3 and the last: read once for all."""
    a = b = c = d = e = np.float32(0)
    for k in range(count):
        x = weights[k] * flat[i * ROOM + k]
        e += x * flat[UNKNOWNS * ROOM + k]
        a += x * flat[j * ROOM + k]
        b += x * flat[(j + 1) * ROOM + k]
        c += x * flat[(j + 2) * ROOM + k]
        d += x * flat[(j + 3) * ROOM + k]
    return float(a), float(b), float(c), float(d), float(e)


@borrower
def cholesky(matrix: Floats) -> bool:
    """Factor the lower triangle in place; False where it is not positive definite.

    The factor's diagonal is stored inverted: it is only ever divided by.
    """
    for j in range(UNKNOWNS):
        pivot = matrix[j, j]
        for k in range(j):
            pivot -= matrix[j, k] * matrix[j, k]
        if not 1e-12 < pivot < 1e30:
            return False
        over = 1.0 / np.sqrt(pivot)
        matrix[j, j] = over
        for i in range(j + 1, UNKNOWNS):
            value = matrix[i, j]
            for k in range(j):
                value -= matrix[i, k] * matrix[j, k]
            matrix[i, j] = value * over
    return True


@borrower
def substitute(factor: Floats, vector: Floats) -> None:
    """Solve factor factor^T x = vector in place, with a factor from `cholesky`."""
    for i in range(UNKNOWNS):
        value = vector[i]
        for k in range(i):
            value -= factor[i, k] * vector[k]
        vector[i] = value * factor[i, i]
    for i in range(UNKNOWNS - 1, -1, -1):
        value = vector[i]
        for k in range(i + 1, UNKNOWNS):
            value -= factor[k, i] * vector[k]
        vector[i] = value * factor[i, i]


@borrower
def invert_factor(factor: Floats, first: int, last: int) -> None:
    """Replace columns of a factor from `cholesky`, up to the last, by those of its inverse."""
    for j in range(first, last + 1):
        for i in range(j + 1, UNKNOWNS):
            value = 0.0
            for k in range(j, i):
                value -= factor[i, k] * factor[k, j]
            factor[i, j] = value * factor[i, i]


@borrower
def invert(factor: Floats, out: Floats) -> None:
    """Fill the inverse (8, 8) of a matrix that `cholesky` has factored; the factor is lost."""
    invert_factor(factor, 0, UNKNOWNS - 1)
    for i in range(UNKNOWNS):
        for j in range(i + 1):
            total = 0.0
            for k in range(i, UNKNOWNS):
                total += factor[k, i] * factor[k, j]
            out[i, j] = out[j, i] = total


@inlined
def solve3(matrix: Six, right: Vector) -> tuple[bool, Vector]:
    """Return whether a symmetric system of three equations has a solution, and it (Cramer's rule).

    Args:
        matrix: Its upper triangle, row by row.
        right: Right side.
    """
    a, b, c, d, e, f = matrix
    p, q, r = d * f - e * e, c * e - b * f, b * e - c * d
    s, t, u = a * f - c * c, b * c - a * e, a * d - b * b
    det = a * p + b * q + c * r
    x = p * right[0] + q * right[1] + r * right[2]
    y = q * right[0] + s * right[1] + t * right[2]
    z = r * right[0] + t * right[1] + u * right[2]
    return abs(det) > 1e-16, (x / det, y / det, z / det)


@borrower
def tukey(squared: float, cut: float) -> float:
    """Return Tukey's weight of a squared, normalised residual."""
    rest: float = max(Single(1) - squared / cut, Single(0))  # as precise as what is given
    return rest * rest
