"""Small least-squares problems, solved without a threaded BLAS.

A library that starts threads for a 7 x 7 system costs more than the system, and far more where the
cores are busy.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]


def least_squares(columns: Floats, target: Floats, weight: Floats | None = None) -> Floats:
    """Solve min sum w (columns x - target)^2 by the normal equations.

    Args:
        columns: (M, K) with small K and entries of about 1: the equations square the condition.
        target: (M,).
        weight: (M,) or None for 1.

    Returns:
        (K,) the solution; of least norm where the columns do not determine it.
    """
    weighted = columns if weight is None else columns * weight[:, None]
    normal = np.einsum("mi,mj->ij", weighted, columns)
    right = np.einsum("mi,m->i", weighted, target)
    return np.asarray(np.linalg.lstsq(normal, right)[0])
