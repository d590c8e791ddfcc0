"""What a result recording answers: detections frame by frame, and the time its stages took."""

from __future__ import annotations

from dataclasses import dataclass, field, fields
from pathlib import Path
from typing import Any

import numpy as np

from mushpipe.core.arrays import Bools, Floats
from mushpipe.core.columns import Columns, column
from mushpipe.core.errors import InputError, UsageError, suggest
from mushpipe.core.recording import MANIFEST, SUMMARY, Index, Raw, RecordingReader
from mushpipe.core.tables import Circles, PickFlag, Picks
from mushpipe.core.types import Header
from mushpipe.core.wire import TIMING_TOPIC, TOTAL, decode_table
from mushpipe.traces import stage_times, stated

PICKS, CIRCLES = "mushpipe.Picks", "mushpipe.Circles"


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
    apex: Bools = column(dtype=np.bool_)
    surface: Floats = column(3)
    diameter: Floats = column()
    axis: Floats = column(3)
    sigma_position: Floats = column(3)
    sigma_diameter: Floats = column()
    sigma_tilt: Floats = column()
    score: Floats = column()
    frame_id: str = ""


def of_picks(picks: Picks) -> Detections:
    """Return picks as detections."""
    apex = np.asarray((picks.flags & PickFlag.POSE_UNKNOWN) == 0) & np.isfinite(picks.axis[:, 0])
    same = {item.name for item in fields(Detections)} - {"apex"}
    return Detections(apex=apex, **{name: getattr(picks, name) for name in same})


def of_circles(circles: Circles) -> Detections:
    """Return circles as detections of which nothing in 3D is known."""
    known = {name: getattr(circles, name) for name in ("center", "radius", "score")}
    return Detections.unknown(len(circles), **known)


@dataclass
class Results:
    """A result recording.

    Attributes:
        path: The file.
        topic: The topic that is judged.
        frames: Per frame that was answered, in order.
        durations_ms: Per stage, the time it took on each frame.
        manifest: What the run was made of; empty where the file does not say.
        summary: How the run went; empty where the file does not say.
        damage: What could not be read, in words.
    """

    path: Path
    topic: str
    frames: list[tuple[Header, Detections]] = field(default_factory=list)
    durations_ms: dict[str, list[float]] = field(default_factory=dict)
    manifest: dict[str, Any] = field(default_factory=dict)
    summary: dict[str, Any] = field(default_factory=dict)
    damage: list[str] = field(default_factory=list)

    @property
    def partial(self) -> bool:
        """Whether these are the results of a part of the source: asked for, or in this file."""
        source = self.manifest.get("graph", {}).get("source", {})
        asked = any(source.get(key) for key in ("max_frames", "max_seconds", "start", "end"))
        return asked or self.split

    @property
    def split(self) -> bool:
        """Whether this is one of several files that a sink with `split_size` wrote."""
        sinks = self.manifest.get("graph", {}).get("sinks", {}).values()
        processed = self.summary.get("frames", {}).get("processed")
        return any(sink.get("split_size") for sink in sinks) and processed != len(self.frames)

    @property
    def complete(self) -> bool:
        """Whether the run is known to have looked at all frames of what it played."""
        return not self.partial and self.summary.get("exit_code") == 0 and "span" in self.summary

    @property
    def played(self) -> dict[str, str]:
        """The recordings that were played, by SHA-256; empty where the file does not say."""
        stated = self.manifest.get("recordings") or []
        return {entry["sha256"]: entry["file"] for entry in stated if entry.get("sha256")}

    @property
    def failed(self) -> int:
        """How many frames failed in the run, as far as the file says."""
        return int(self.summary.get("frames", {}).get("failed", 0))

    def span(self, name: str) -> range:
        """Return from which to which ``stamp_ns`` or ``sequence`` the run looked at frames.

        Where the file does not say how the run went, those it answered stand for them; so they do
        in one of several files, of which the last alone says where the run ended.
        """
        answered = [getattr(header, name) for header, _ in self.frames]
        stated = self.summary.get("span", {}).get(name, [])
        seen = [*answered, *stated[1:]] if self.split else stated or answered
        return range(min(seen), max(seen) + 1) if seen else range(0)

    @property
    def robot_frames(self) -> set[str]:
        """Frames that a stage took its results to from the camera's."""
        stages = self.manifest.get("graph", {}).get("stages", {}).values()
        transforms = (stage.get("T_base_camera") for stage in stages)
        # a stage of somebody else may call something else so
        known = (each for each in transforms if isinstance(each, dict) and "frame" in each)
        return {str(transform["frame"]) for transform in known}


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
    manifest, summary = stated(path, index, MANIFEST), stated(path, index, SUMMARY)
    topic = _choose(reader, index, topic)
    results = Results(path, topic, manifest=manifest, summary=summary)
    found: dict[tuple[int, int], tuple[Header, Detections]] = {}
    for raw in reader.messages({topic, TIMING_TOPIC}):
        if raw.channel.topic == TIMING_TOPIC:
            _add_durations(results, raw)
        else:
            header, detections = _decode(path, raw)
            found[header.stamp_ns, header.sequence] = header, detections
    results.frames = list(found.values())
    results.damage = list(reader.damage)
    return results


def _choose(reader: RecordingReader, index: Index, topic: str | None) -> str:
    """Return the topic to judge: the picks, or else the circles."""
    path = reader.path
    groups = [
        sorted(t for t in index.channels if index.table(t) == schema) for schema in (PICKS, CIRCLES)
    ]
    known = [t for group in groups for t in group]
    if topic is not None and topic not in known:
        raise UsageError(f"{path}: nothing to judge on '{topic}'; {suggest(topic, known)}")
    if not known:
        raise InputError(f"{path}: no picks or circles to judge ({reader.contents()})")
    candidates = groups[0] or groups[1]
    if topic is None and len(candidates) > 1:
        raise UsageError(f"{path}: choose with --topic {' or --topic '.join(candidates)}")
    return topic or candidates[0]


def _decode(path: Path, raw: Raw) -> tuple[Header, Detections]:
    try:
        decoded = decode_table(raw.table, raw.message.data, raw.message.log_time)
    except (ValueError, KeyError, TypeError) as error:
        raise InputError(f"{path}: a message on {raw.channel.topic}: {error}") from error
    if decoded is not None and isinstance(decoded.table, Picks):
        return decoded.header, of_picks(decoded.table)
    if decoded is not None and isinstance(decoded.table, Circles):
        return decoded.header, of_circles(decoded.table)
    held = f"{raw.channel.topic} holds {raw.table or 'messages without a schema'} as well"
    raise InputError(f"{path}: {held}, expected picks or circles alone")


def _add_durations(results: Results, raw: Raw) -> None:
    try:
        stages = stage_times(raw.message.data)
    except ValueError as error:
        raise InputError(f"{results.path}: a message on {TIMING_TOPIC}: {error}") from error
    for stage, duration in {**stages, TOTAL: sum(stages.values())}.items():
        results.durations_ms.setdefault(stage, []).append(duration / 1e6)
