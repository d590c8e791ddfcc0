"""The sink `rerun` fed as the engine does it, and its file read back by Rerun's own reader."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pyarrow as pa
from rerun.chunk import RrdReader

from mushpipe import RunInfo, Trace
from mushpipe.sinks.rerun import RerunSink

IMAGE = "/camera/image"


def feed(sink: RerunSink, traces: list[Trace], live: bool = False, graph: Any = None) -> None:
    """Run the sink as the engine does."""
    stages = {name: {} for trace in traces for name in trace.durations_ns}
    sink.open(RunInfo("bed", {"graph": graph or {"stages": stages}}, live))
    try:
        for trace in traces:
            sink.consume(trace)
    finally:
        sink.close()


def show(
    tmp_path: Path, traces: list[Trace], live: bool = False, graph: Any = None, **settings: Any
) -> dict[str, Any]:
    """Feed the sink and return what the file holds: columns by entity and component."""
    feed(RerunSink(save=tmp_path / "out.rrd", **settings), traces, live, graph)
    return read(tmp_path / "out.rrd")


def read(path: Path) -> dict[str, Any]:
    found: dict[str, dict[str, list[Any]]] = {}
    for chunk in RrdReader(path).stream():
        batch = chunk.to_record_batch()
        columns = found.setdefault(chunk.entity_path, {})
        for name in batch.schema.names:
            column = batch.column(name)
            if pa.types.is_timestamp(column.type):
                column = column.cast(pa.int64())
            columns.setdefault(name, []).extend(column.to_pylist())
    return found


def values(found: dict[str, Any], entity: str, component: str) -> list[Any]:
    """Return one value per row of a column, whatever archetype it belongs to."""
    (name,) = (n for n in found[entity] if n.endswith(f":{component}"))
    return found[entity][name]


def unpack(color: int) -> tuple[int, int, int]:
    return (color >> 24 & 255, color >> 16 & 255, color >> 8 & 255)
