"""Base of the tables that flow through a graph: columns in which row ``i`` is of the same thing."""

from __future__ import annotations

from dataclasses import field, fields, replace
from functools import cache
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray

from mushpipe.core.arrays import Bools, locked


def _as_given(array: NDArray[Any], given: Any) -> bool:
    """Return whether conversion has changed no value; NumPy cuts a fraction off without a word.

    And of None it makes the text "None".
    """
    return getattr(given, "dtype", None) == array.dtype or np.array_equal(array, given)


def column(*shape: int, dtype: type = np.float64) -> Any:
    """Declare a field of `Columns`: an array of shape (N, *shape) and the given dtype."""
    return field(metadata={"shape": shape, "dtype": dtype})


class Columns:
    """Base of the per-mushroom types: every field made by `column` has the same length N.

    Raises:
        ValueError: A shape or length is wrong, a value is none of its dtype, or `check` objects.
    """

    def __post_init__(self) -> None:
        length: int | None = None
        for name, (shape, dtype) in self._columns().items():
            given, where = getattr(self, name), f"{type(self).__name__}.{name}"
            try:
                array = locked(given, dtype)
            except (TypeError, ValueError, OverflowError) as error:
                raise ValueError(f"{where}: {error}") from error
            if dtype.kind in "biuU" and not _as_given(array, given):
                raise ValueError(
                    f"{where} is declared {dtype.name}, and was given what that cannot hold"
                )
            if array.shape == (0,):  # an empty list, of which nothing tells the shape of a row
                array = array.reshape(0, *shape)
            if array.shape[1:] != shape or array.ndim == 0:
                expected = ", ".join(map(str, ("N", *shape))) + ("" if shape else ",")
                raise ValueError(f"{where} has shape {array.shape}, expected ({expected})")
            if length is not None and len(array) != length:
                raise ValueError(f"{where} has {len(array)} rows, expected {length}")
            length = len(array)
            object.__setattr__(self, name, array)
        self.check()
        self.check_rows()

    def check(self) -> None:
        """Raise ValueError where values of a row contradict each other; overridden by each type.

        Rows of a table are not checked again when they are taken or joined.
        """

    def check_rows(self) -> None:
        """Raise ValueError where rows contradict each other; also of rows taken or joined."""

    @classmethod
    @cache
    def _columns(cls) -> dict[str, tuple[tuple[int, ...], np.dtype[Any]]]:
        """Return the shape of a row and the dtype of each column."""
        return {
            item.name: (item.metadata["shape"], np.dtype(item.metadata["dtype"]))
            for item in fields(cls)  # type: ignore[arg-type]
            if "shape" in item.metadata
        }

    @classmethod
    def unknown(cls, n: int, **known: Any) -> Self:
        """Return n rows of which only the given fields are known: NaN, 0, False or "" elsewhere."""
        blank = {}
        for name, (shape, dtype) in cls._columns().items():
            value = {"f": np.nan, "U": ""}.get(dtype.kind, 0)
            blank[name] = np.full((n, *shape), value, dtype)
        return cls(**{**blank, **known})

    def take(self, rows: NDArray[Any]) -> Self:
        """Return the given rows (indices or a mask), in that order.

        Raises:
            ValueError: They are no list of rows, but one, say.
        """
        # a slice may leave gaps, over which messages are not written
        taken = {n: np.asarray(getattr(self, n)[rows], order="C") for n in self._columns()}
        name, (shape, _) = next(iter(self._columns().items()))
        if taken[name].ndim != 1 + len(shape):
            raise ValueError(
                f"{type(self).__name__}.take needs indices (N,) or a mask, not {rows!r}"
            )
        return self._of(taken)

    def without(self, rows: Bools) -> Self:
        """Return the same rows, of which those of a mask (N,) are unknown."""
        if not rows.any():
            return self
        n = len(self)
        return self.joined(type(self).unknown(1)).take(np.where(rows, n, np.arange(n)))

    def joined(self, other: Self) -> Self:
        """Return these rows, and behind them those of another."""
        names = self._columns()
        return self._of({n: np.concatenate([getattr(self, n), getattr(other, n)]) for n in names})

    def _of(self, columns: dict[str, NDArray[Any]]) -> Self:
        """Return a table like this one, of rows that were checked before, each by itself."""
        if type(self).__post_init__ is not Columns.__post_init__:
            return replace(self, **columns)  # type: ignore[type-var]
        table = object.__new__(type(self))
        for array in columns.values():
            array.flags.writeable = False
        for item in fields(self):  # type: ignore[arg-type]
            value = columns[item.name] if item.name in columns else getattr(self, item.name)
            object.__setattr__(table, item.name, value)
        table.check_rows()
        return table

    def __len__(self) -> int:
        return len(getattr(self, next(iter(self._columns()))))

    def _require(self, condition: Bools, text: str) -> None:
        """Raise ValueError with the first row of which a condition (N, ...) does not hold."""
        if np.count_nonzero(condition) < condition.size:  # `all` takes ten times as long
            row = np.argwhere(~condition)[0, 0]
            raise ValueError(f"{type(self).__name__}: {text} (row {row})")
