"""Table types of plugins: whether their values can be recorded, told before a run."""

from __future__ import annotations

import inspect
from dataclasses import fields, is_dataclass

import numpy as np

from mushpipe.core.columns import Columns
from mushpipe.core.wire import JSON_KINDS

_HEADER = ("timestamp", "sequence")


def table_fault(table: type[Columns]) -> str:
    """Say what keeps a table type from being recorded; nothing where it can be."""
    decorated = "__dataclass_params__" in vars(table)
    if not is_dataclass(table) or (inspect.get_annotations(table) and not decorated):
        return "is no dataclass: write @dataclass(frozen=True, eq=False) above it"
    columns = {item.name: item.metadata for item in fields(table) if "shape" in item.metadata}
    if not columns:
        return "has no column: declare its fields by column()"
    for name in (item.name for item in fields(table)):
        if name in _HEADER or (name == "frame_id" and name in columns):
            return f"has a field '{name}', where a recording has that of the frame: rename it"
    for name, metadata in columns.items():
        dtype = np.dtype(metadata["dtype"])
        if dtype == np.dtype(str):
            continue
        if dtype.kind not in JSON_KINDS or dtype.kind == "U" or dtype.itemsize > 8:
            return (
                f"has a column '{name}' of {dtype}, which is not recorded: take int, bool, str, "
                "or a float or integer of up to 64 bits"
            )
    return ""
