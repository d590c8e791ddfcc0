"""What a result recording answers: detections frame by frame, and the time its stages took."""

from __future__ import annotations

import json
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import orjson
from numpy.typing import NDArray

from mushpipe.core.errors import InputError, UsageError, suggest
from mushpipe.core.recording import MANIFEST, Index, Raw, RecordingReader
from mushpipe.core.tables import Circles, Columns, Floats, Locations, PickFlag, Picks, column
from mushpipe.core.types import Header
from mushpipe.core.wire import RESULT_PREFIX, TIMING_TOPIC, decode_table

PICKS, CIRCLES, LOCATIONS = "mushpipe.Picks", "mushpipe.Circles", "mushpipe.Locations"


@dataclass(frozen=True, eq=False)
class Detections(Columns):
    """What a graph found in a frame; NaN where it does not say.

    Attributes:
        center: (N, 2) px.
        radius: (N,) px.
        position: (N, 3) m, where a robot would go.
        apex: (N,) bool, whether `position` is meant to be the apex of the cap.
        surface: (N, 3) m, the surface point at the circle's centre.
        diameter: (N,) m.
        axis: (N, 3) unit cap normal.
        sigma_position: (N, 3) m one sigma.
        sigma_diameter: (N,) m one sigma.
        sigma_tilt: (N,) rad one sigma.
        score: (N,) 0..1, how likely it is right.
        frame_id: The frame of the 3D values.
    """

    center: Floats = column(2)
    radius: Floats = column()
    position: Floats = column(3)
    apex: NDArray[np.bool_] = column(dtype=np.bool_)
    surface: Floats = column(3)
    diameter: Floats = column()
    axis: Floats = column(3)
    sigma_position: Floats = column(3)
    sigma_diameter: Floats = column()
    sigma_tilt: Floats = column()
    score: Floats = column()
    frame_id: str = ""


def of_picks(picks: Picks, locations: Locations | None = None) -> Detections:
    """Return picks as detections.

    Args:
        picks: What the robot gets.
        locations: Of the same rows, for the surface points; without them the surface point of a
            pick whose position is the apex is unknown.
    """
    apex = np.asarray((picks.flags & PickFlag.POSE_UNKNOWN) == 0) & np.isfinite(picks.axis[:, 0])
    if locations is not None and len(locations) == len(picks):
        surface = locations.position
    else:
        surface = np.where(apex[:, None], np.nan, picks.position)
    return Detections(
        center=picks.center,
        radius=picks.radius,
        position=picks.position,
        apex=apex,
        surface=surface,
        diameter=picks.diameter,
        axis=picks.axis,
        sigma_position=picks.sigma_position,
        sigma_diameter=picks.sigma_diameter,
        sigma_tilt=picks.sigma_tilt,
        score=picks.score,
        frame_id=picks.frame_id,
    )


def of_circles(circles: Circles) -> Detections:
    """Return circles as detections of which nothing in 3D is known."""
    n = len(circles)
    vectors, numbers = np.full((n, 3), np.nan), np.full(n, np.nan)
    return Detections(
        center=circles.center,
        radius=circles.radius,
        position=vectors,
        apex=np.zeros(n, bool),
        surface=vectors,
        diameter=numbers,
        axis=vectors,
        sigma_position=vectors,
        sigma_diameter=numbers,
        sigma_tilt=numbers,
        score=circles.score,
    )


def none_found() -> Detections:
    """Return the answer of a graph that found nothing."""
    return of_circles(Circles(np.empty((0, 2)), np.empty(0), np.empty(0)))


@dataclass
class Results:
    """A result recording.

    Attributes:
        path: The file.
        topic: The topic that is judged.
        frames: Per frame that was answered, in order.
        durations_ms: Per stage, the time it took on each frame.
        manifest: What the run was made of; empty where the file does not say.
        damage: What could not be read, in words.
    """

    path: Path
    topic: str
    frames: list[tuple[Header, Detections]] = field(default_factory=list)
    durations_ms: dict[str, list[float]] = field(default_factory=dict)
    manifest: dict[str, Any] = field(default_factory=dict)
    damage: list[str] = field(default_factory=list)

    @property
    def partial(self) -> bool:
        """Whether the run was asked to play only a part of its source."""
        source = self.manifest.get("graph", {}).get("source", {})
        return any(source.get(key) for key in ("max_frames", "start", "end"))


def read_results(path: Path, topic: str | None = None) -> Results:
    """Read a result recording.

    Args:
        path: Written by the sink ``mcap``, or by anything that writes `Picks` the same way.
        topic: The picks or circles to judge, where there are several.

    Raises:
        InputError: It holds no picks and no circles, or they cannot be read.
        UsageError: Several topics hold some and none is named.
    """
    reader = RecordingReader(path)
    index = reader.index()
    manifest = json.loads(index.metadata.get(MANIFEST, {}).get("json", "{}"))
    order = list(manifest.get("graph", {}).get("stages", {}))
    topic = _choose(path, index, topic)
    beside = _locations_of(index, topic, order)
    results = Results(path, topic, manifest=manifest)
    wanted = {topic, TIMING_TOPIC, *([beside] if beside else [])}
    tables: dict[tuple[int, int], dict[str, Columns]] = {}
    headers: dict[tuple[int, int], Header] = {}
    for raw in reader.messages(wanted):
        if raw.channel.topic == TIMING_TOPIC:
            _add_durations(results, raw)
            continue
        header, table = _decode(path, raw)
        key = (header.stamp_ns, header.sequence)
        tables.setdefault(key, {})[raw.channel.topic] = table
        if raw.channel.topic == topic:
            headers[key] = header
    for key, header in headers.items():
        found = _detections(tables[key][topic], tables[key].get(beside or ""))
        results.frames.append((header, found))
    results.damage = list(reader.damage)
    return results


def _choose(path: Path, index: Index, topic: str | None) -> str:
    """Return the topic to judge: the picks, or else the circles."""
    groups = [
        sorted(t for t in index.channels if index.schema_name(t) == schema)
        for schema in (PICKS, CIRCLES)
    ]
    known = [t for group in groups for t in group]
    if topic is not None and topic not in known:
        raise UsageError(f"{path}: nothing to judge on '{topic}'; {suggest(topic, known)}")
    if not known:
        found = ", ".join(sorted(index.channels)) or "nothing"
        raise InputError(f"{path}: no picks or circles to judge (it holds {found})")
    candidates = groups[0] or groups[1]
    if topic is None and len(candidates) > 1:
        raise UsageError(f"{path}: choose with --topic {' or --topic '.join(candidates)}")
    return topic or candidates[0]


def _locations_of(index: Index, picks: str, order: list[str]) -> str | None:
    """Return the topic of the locations that the picks were made of: the nearest stage above."""
    topics = [t for t in index.channels if index.schema_name(t) == LOCATIONS]
    if len(topics) < 2 or _stage(picks) not in order:
        return topics[0] if len(topics) == 1 else None
    above = order[: order.index(_stage(picks))]
    ranked = [t for t in topics if _stage(t) in above]
    return max(ranked, key=lambda t: above.index(_stage(t)), default=None)


def _stage(topic: str) -> str:
    return topic.removeprefix(RESULT_PREFIX).partition("/")[0]


def _decode(path: Path, raw: Raw) -> tuple[Header, Columns]:
    try:
        decoded = decode_table(
            raw.schema.name if raw.schema else "", raw.message.data, raw.message.log_time
        )
    except (ValueError, KeyError, TypeError) as error:
        raise InputError(f"{path}: a message on {raw.channel.topic}: {error}") from error
    if decoded is None:
        raise InputError(f"{path}: {raw.channel.topic} holds no table of mushpipe")
    return decoded.header, decoded.table


def _detections(table: Columns, beside: Columns | None) -> Detections:
    if isinstance(table, Picks):
        return of_picks(table, beside if isinstance(beside, Locations) else None)
    return of_circles(table) if isinstance(table, Circles) else none_found()


def _add_durations(results: Results, raw: Raw) -> None:
    stages: dict[str, int] = orjson.loads(raw.message.data)["stages_ns"]
    for stage, duration in {**stages, "total": sum(stages.values())}.items():
        results.durations_ms.setdefault(stage, []).append(duration / 1e6)
