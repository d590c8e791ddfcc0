"""numba's `njit`, cached on disk where that is possible."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, TypeVar, cast

from numba import njit

F = TypeVar("F", bound=Callable[..., Any])


def jit(function: F) -> F:
    """Compile a kernel on first use; on a machine without a writable cache, in every process."""
    try:
        return cast(F, njit(cache=True, nogil=True, fastmath=True, error_model="numpy")(function))
    except RuntimeError:  # numba found no folder it may write to
        return cast(F, njit(nogil=True, fastmath=True, error_model="numpy")(function))
