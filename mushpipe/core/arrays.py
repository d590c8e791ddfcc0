"""Names for arrays by the type of their elements, and how one is made read-only."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]
Singles = NDArray[np.float32]
Ints = NDArray[np.int64]
Ints32 = NDArray[np.int32]
Rows = NDArray[np.intp]  # of other arrays
Bytes = NDArray[np.uint8]
Bools = NDArray[np.bool_]


def locked(array: Any, dtype: Any) -> NDArray[Any]:
    """Return the array as C-contiguous dtype, read-only; itself where nothing needs converting.

    What it is a view of becomes read-only too, or it could still change. Memory that is not numpy's
    (a camera's buffer, a bytearray) cannot be locked: what can be written there is copied.
    """
    # NumPy would take what is behind the mask
    if isinstance(array, np.ma.MaskedArray) and np.ma.is_masked(array):
        numbers = np.dtype(dtype or array.dtype)
        unknown = "NaN: array.filled(np.nan)" if numbers.kind == "f" else "0: array.filled(0)"
        raise ValueError(f"it is a masked array; unknown is {unknown}")
    result: NDArray[Any] = np.asarray(array, dtype, order="C")
    owner = result
    while isinstance(owner.base, np.ndarray):
        owner = owner.base
    # numba's is reached through its arrays alone
    foreign = owner.base is not None and type(owner.base).__name__ != "_MemInfo"
    if foreign and owner.flags.writeable:
        result = result.copy()
    part: Any = result
    while isinstance(part, np.ndarray):
        part.flags.writeable = False
        part = part.base
    return result
