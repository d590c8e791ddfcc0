"""The picks of a result recording as NDJSON or CSV."""

from __future__ import annotations

import csv
import io
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import orjson

from mushpipe.core.errors import InputError, UsageError
from mushpipe.core.recording import RecordingReader
from mushpipe.core.tables import DepthSource, PickFlag, Picks
from mushpipe.core.types import Header
from mushpipe.core.wire import decode_table

_SCHEMA = "mushpipe.Picks"
_VECTORS = {
    "position_m": ("x_m", "y_m", "z_m"),
    "quaternion_xyzw": ("qx", "qy", "qz", "qw"),
    "axis": ("axis_x", "axis_y", "axis_z"),
    "sigma_position_m": ("sigma_x_m", "sigma_y_m", "sigma_z_m"),
}

_HEADING = [
    *("stamp_ns", "sequence", "frame_id", "id", "u", "v", "radius_px"),
    *(*_VECTORS["position_m"], "distance_m", "diameter_m", *_VECTORS["quaternion_xyzw"]),
    *(*_VECTORS["axis"], "score", *_VECTORS["sigma_position_m"], "sigma_diameter_m"),
    *("sigma_tilt_rad", "depth_source", "flags"),
]


def read_picks(path: Path, topic: str | None = None) -> Iterator[tuple[Header, Picks]]:
    """Yield the picks of a result recording, frame by frame.

    Raises:
        InputError: It holds no picks or, after the last good frame, is damaged.
        UsageError: The topic holds none, or several topics do and none is named.
    """
    reader = RecordingReader(path)
    index = reader.index()
    topics = sorted(t for t in index.channels if index.table(t) == _SCHEMA)
    if topic is None and len(topics) > 1:
        raise UsageError(
            f"{path}: several topics hold picks: choose with --topic {' or --topic '.join(topics)}"
        )
    if not topics:
        raise InputError(
            f"{path}: no picks on any topic ({reader.contents()}); a stage 'picks' makes them, "
            "behind one that locates, such as cap-fit"
        )
    if topic not in (None, *topics):
        raise UsageError(f"{path}: no picks on {topic}; they are on {', '.join(topics)}")
    for raw in reader.messages({topic or topics[0]}):
        try:
            decoded = decode_table(_SCHEMA, raw.message.data, raw.message.log_time)
        except (ValueError, KeyError, TypeError) as error:
            raise InputError(f"{path}: a pick message cannot be read: {error}") from error
        if decoded is not None and isinstance(decoded.table, Picks):
            yield decoded.header, decoded.table
    if reader.damage:
        raise InputError(f"{path} is damaged: {'; '.join(reader.damage)}")


def pick_rows(picks: Picks) -> list[dict[str, Any]]:
    """Return one plain mapping per pick; None where unknown."""
    return [
        {
            "id": int(picks.id[i]),
            "u": _number(picks.center[i, 0]),
            "v": _number(picks.center[i, 1]),
            "radius_px": _number(picks.radius[i]),
            "position_m": _vector(picks.position[i]),
            "distance_m": _number(picks.distance[i]),
            "diameter_m": _number(picks.diameter[i]),
            "quaternion_xyzw": _vector(picks.quaternion[i]),
            "axis": _vector(picks.axis[i]),
            "score": _number(picks.score[i]),
            "sigma_position_m": _vector(picks.sigma_position[i]),
            "sigma_diameter_m": _number(picks.sigma_diameter[i]),
            "sigma_tilt_rad": _number(picks.sigma_tilt[i]),
            "depth_source": DepthSource(int(picks.source[i])).name.lower(),
            "flags": [f.name.lower() for f in PickFlag(int(picks.flags[i])) if f.name],
        }
        for i in range(len(picks))
    ]


def _number(value: float) -> float | None:
    return float(value) if np.isfinite(value) else None


def _vector(values: Any) -> list[float] | None:
    return [float(v) for v in values] if np.isfinite(values).all() else None


def ndjson_lines(path: Path, topic: str | None = None) -> Iterator[str]:
    """Yield one JSON line per frame."""
    for header, picks in read_picks(path, topic):
        line = {
            "stamp_ns": header.stamp_ns,
            "sequence": header.sequence,
            "frame_id": header.frame_id,
            "picks": pick_rows(picks),
        }
        yield orjson.dumps(line).decode()


def csv_lines(path: Path, topic: str | None = None) -> Iterator[str]:
    """Yield a heading and one line per pick; an empty field is unknown."""
    yield _csv(_HEADING)
    for header, picks in read_picks(path, topic):
        for row in pick_rows(picks):
            flat = {
                "stamp_ns": header.stamp_ns,
                "sequence": header.sequence,
                "frame_id": header.frame_id,
                **_flat(row),
            }
            yield _csv([flat[name] for name in _HEADING])


def _flat(row: dict[str, Any]) -> dict[str, Any]:
    flat: dict[str, Any] = {}
    for key, value in row.items():
        if key in _VECTORS:
            names = _VECTORS[key]
            flat |= dict(zip(names, value or [None] * len(names), strict=True))
        else:
            flat[key] = "|".join(value) if isinstance(value, list) else value
    return flat


def _csv(values: list[Any]) -> str:
    buffer = io.StringIO()
    csv.writer(buffer, lineterminator="").writerow(values)
    return buffer.getvalue()
