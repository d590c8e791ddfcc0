"""Values that stages put out, for tests of what becomes of them."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from mushpipe import (
    Camera,
    Circles,
    DepthSource,
    Header,
    PickFlag,
    Picks,
    RgbdFrame,
    RunInfo,
    Sink,
    Trace,
)
from tests.io.bags import FX, FY, OPTICAL, PERIOD, T0, color_pixels, depth_pixels

NAN = float("nan")
SIZE = (32, 24)
LENS = Camera(*SIZE, FX, FY, 15.5, 11.5, "brown_conrady", (0.1, -0.2, 0.001, 0.002, 0.05))
EIGHTH_MM = 0.000125


def make_frame(i: int = 0, size: tuple[int, int] = SIZE, **changes: Any) -> RgbdFrame:
    """Make a calibrated frame; the host gets it 5 ms after the sensor took it."""
    stamp = T0 + i * PERIOD
    fields: dict[str, Any] = {
        "header": Header(stamp, 10 + i, OPTICAL, stamp + 5_000_000),
        "color": color_pixels(i, size),
        "depth": depth_pixels(i, size),
        "depth_scale": EIGHTH_MM,
        "camera": LENS if size == SIZE else None,
    }
    return RgbdFrame(**(fields | changes))


def make_circles() -> Circles:
    return Circles(np.array([[10.25, 5.5], [20.0, 12.0]]), np.array([3.5, 1 / 3]), np.ones(2))


def make_picks() -> Picks:
    """One mushroom of which all is known, and one of which nothing but its circle is."""
    circles = make_circles()
    return Picks(
        id=np.array([7, 8]),
        center=circles.center,
        radius=circles.radius,
        position=np.array([[0.1, -0.2, 0.5], [NAN] * 3]),
        surface=np.array([[0.1, -0.2, 0.5], [NAN] * 3]),
        distance=np.array([0.55, NAN]),
        diameter=np.array([0.04, NAN]),
        quaternion=np.array([[0, 0, 0.6, 0.8], [NAN] * 4]),
        axis=np.array([[0, 0, 1.0], [NAN] * 3]),
        score=np.array([0.9, 0.25]),
        sigma_position=np.array([[0.001, 0.002, 0.003], [NAN] * 3]),
        sigma_diameter=np.array([0.0015, NAN]),
        sigma_tilt=np.array([0.1, NAN]),
        source=np.array([DepthSource.NEIGHBOURS, DepthSource.MISSING]),
        flags=np.array(
            [
                PickFlag.DEPTH_ESTIMATED,
                PickFlag.DEPTH_MISSING | PickFlag.POSE_UNKNOWN | PickFlag.AT_BORDER,
            ]
        ),
        frame_id=OPTICAL,
    )


def no_picks() -> Picks:
    full = make_picks()
    columns = {name: getattr(full, name) for name in vars(full)}
    empty = {k: v[:0] if isinstance(v, np.ndarray) else v for k, v in columns.items()}
    return Picks(**empty)


def trace_of(frame: RgbdFrame, **outputs: Any) -> Trace:
    """Make the trace of a frame; each stage took 1000 ns more than the one before."""
    given = {k: v if isinstance(v, tuple) else (v,) for k, v in outputs.items()}
    durations = {name: 1000 * (i + 1) for i, name in enumerate(given)}
    return Trace(frame, {"source": (frame,), **given}, durations)


MANIFEST = {"seed": 3, "graph": {"mushpipe": 1}}


def feed(
    sink: Sink, inputs: list[dict[str, Any]], summary: Mapping[str, Any] | None = None
) -> None:
    """Run a sink as the engine does."""
    sink.open(RunInfo("bed", MANIFEST))
    try:
        for arguments in inputs:
            sink.consume(**arguments)  # type: ignore[attr-defined]
        sink.finish(summary or {})
    finally:
        sink.close()


def record(path: Path, traces: list[Trace], **settings: Any) -> Path:
    from mushpipe.sinks.mcap import McapSink

    sink = McapSink(path=path, **settings)
    feed(sink, [{"trace": trace} for trace in traces], {"exit_code": 0})
    return path
