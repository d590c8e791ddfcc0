"""Small linear problems, solved without a threaded BLAS.

A library that starts threads for a 7 x 7 system costs more than the system, and far more where the
cores are busy.
"""

from __future__ import annotations

import numpy as np

from mushpipe.core.arrays import Floats
from mushpipe.core.jit import borrower, jit


def least_squares(columns: Floats, target: Floats) -> Floats:
    """Solve min |columns x - target|^2 by the normal equations.

    Args:
        columns: (M, K) with small K and entries of about 1: the equations square the condition.
        target: (M,).

    Returns:
        (K,) the solution; of least norm where the columns do not determine it.
    """
    # copies: of one type whatever is given, so that the kernel is compiled once
    basis, values = (np.array(part, np.float64, order="C") for part in (columns, target))
    normal, right = normal_equations(basis, values, np.ones(len(values)))
    return np.asarray(np.linalg.lstsq(normal, right)[0])


@jit
def normal_equations(columns: Floats, target: Floats, weight: Floats) -> tuple[Floats, Floats]:
    """Return the matrix (K, K) and the right side (K,), each of M rows with its weight."""
    size = columns.shape[1]
    normal, right = np.zeros((size, size)), np.zeros(size)
    for m in range(len(target)):
        for i in range(size):
            term = weight[m] * columns[m, i]
            right[i] += term * target[m]
            for j in range(size):
                normal[i, j] += term * columns[m, j]
    return normal, right


@borrower
def solve(a: Floats, b: Floats) -> None:
    """Solve a x = b in place for a small positive definite matrix; x replaces b."""
    size = len(b)
    for i in range(size):
        for j in range(i + 1, size):
            factor = a[j, i] / a[i, i]
            for k in range(i, size):
                a[j, k] -= factor * a[i, k]
            b[j] -= factor * b[i]
    for i in range(size - 1, -1, -1):
        for k in range(i + 1, size):
            b[i] -= a[i, k] * b[k]
        b[i] /= a[i, i]
