"""Normal equations of a cap: built from rows, solved by Cholesky; and a robust weight."""

from __future__ import annotations

from typing import Any

import numpy as np

from mushpipe.core.jit import inlined, jit
from mushpipe.stages.cap_model import UNKNOWNS, Floats, Single, Singles


@jit
def multiply(rows: Singles, count: int, system: Any) -> None:
    """Fill the lower triangle of a normal matrix, and the gradient, from weighted rows.

    Args:
        rows: (9 or more, M) derivatives and residual, times the root of their weight.
        count: How many columns are rows.
        system: Normal matrix (8, 8) and gradient (8,), out.
    """
    normal, gradient = system
    for i in range(UNKNOWNS):
        for j in range(i + 1):
            normal[i, j] = dot(rows[i], rows[j], count)
        gradient[i] = dot(rows[i], rows[UNKNOWNS], count)


@inlined
def dot(a: Singles, b: Singles, count: int) -> float:
    """Return the sum of the first `count` products."""
    total = np.float32(0)
    for k in range(count):
        total += a[k] * b[k]
    return float(total)


@jit
def scale(rows: Singles, weights: Singles, count: int) -> None:
    """Multiply `count` columns of rows (9, M) by the roots of their weights (M,)."""
    for k in range(count):
        weights[k] = np.sqrt(weights[k])
    for i in range(UNKNOWNS + 1):
        for k in range(count):
            rows[i, k] *= weights[k]


@jit
def cholesky(matrix: Floats) -> bool:
    """Factor the lower triangle in place; False where it is not positive definite."""
    for j in range(UNKNOWNS):
        pivot = matrix[j, j]
        for k in range(j):
            pivot -= matrix[j, k] * matrix[j, k]
        if not 1e-12 < pivot < 1e30:
            return False
        matrix[j, j] = np.sqrt(pivot)
        over = 1.0 / matrix[j, j]
        for i in range(j + 1, UNKNOWNS):
            value = matrix[i, j]
            for k in range(j):
                value -= matrix[i, k] * matrix[j, k]
            matrix[i, j] = value * over
    return True


@jit
def substitute(factor: Floats, vector: Floats) -> None:
    """Solve factor factor^T x = vector in place."""
    for i in range(UNKNOWNS):
        for k in range(i):
            vector[i] -= factor[i, k] * vector[k]
        vector[i] /= factor[i, i]
    for i in range(UNKNOWNS - 1, -1, -1):
        for k in range(i + 1, UNKNOWNS):
            vector[i] -= factor[k, i] * vector[k]
        vector[i] /= factor[i, i]


@jit
def solve3(matrix: Floats, right: Floats, out: Floats) -> bool:
    """Fill the solution (3,) of a symmetric system; False where it has none.

    By Cramer's rule: numpy's solvers take seconds to compile into a kernel.
    """
    a, b, c = matrix[0, 0], matrix[0, 1], matrix[0, 2]
    d, e, f = matrix[1, 1], matrix[1, 2], matrix[2, 2]
    p, q, r = d * f - e * e, c * e - b * f, b * e - c * d
    det = a * p + b * q + c * r
    if not abs(det) > 1e-16:
        return False
    s, t, u = a * f - c * c, b * c - a * e, a * d - b * b
    out[0] = (p * right[0] + q * right[1] + r * right[2]) / det
    out[1] = (q * right[0] + s * right[1] + t * right[2]) / det
    out[2] = (r * right[0] + t * right[1] + u * right[2]) / det
    return True


@jit
def tukey(squared: float, cut: float) -> float:
    """Return Tukey's weight of a squared, normalised residual."""
    rest: float = max(Single(1) - squared / cut, Single(0))  # as precise as what is given
    return rest * rest
