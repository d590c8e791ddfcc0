"""Arrays by the type of their elements; what shape one has stands in docstrings."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]
Singles = NDArray[np.float32]
Ints = NDArray[np.int64]
Ints32 = NDArray[np.int32]
Rows = NDArray[np.intp]  # of other arrays
Bytes = NDArray[np.uint8]
Bools = NDArray[np.bool_]
