"""Random beds with truth, and detections that err in a known way."""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from mushpipe import Camera, DepthSource, Header, PickFlag, Picks, RgbdFrame
from mushpipe.core import wire
from mushpipe.core.geometry import quaternion_from_axis
from mushpipe.core.recorder import RecordingWriter
from mushpipe.core.recording import MANIFEST, SUMMARY
from mushpipe.core.truth import TRUTH_TOPIC, Truth

CAMERA = Camera(640, 480, 600.0, 600.0, 319.5, 239.5)
FRAME = "camera_color_optical_frame"


def bed(seed: int, rows: int = 4, columns: int = 5) -> Truth:
    """Caps on a jittered grid, none overlapping."""
    rng = np.random.default_rng(seed)
    n = rows * columns
    grid = np.stack(np.meshgrid(np.arange(columns), np.arange(rows)), axis=-1).reshape(-1, 2)
    center = 100 + 90 * grid + rng.uniform(-8, 8, (n, 2))
    radius = rng.uniform(14, 30, n)
    surface = CAMERA.deproject(center, rng.uniform(0.45, 0.5, n))
    axis = tilted(rng.uniform(0, np.radians(40), n), rng.uniform(0, 2 * np.pi, n))
    return Truth(
        id=np.arange(n),
        center=center,
        radius=radius,
        visible=np.ones(n),
        apex=surface + 0.004 * axis,
        surface=surface,
        axis=axis,
        diameter=2 * radius * surface[:, 2] / 600,
        diameter_max=2.1 * radius * surface[:, 2] / 600,
        ignore=np.zeros(n, np.uint8),
    )


def tilted(tilt: np.ndarray, turn: np.ndarray) -> np.ndarray:
    """Unit axes at a tilt from up (-z)."""
    sine = np.sin(tilt)
    return np.stack([sine * np.cos(turn), sine * np.sin(turn), -np.cos(tilt)], axis=1)


def picks_of(truth: Truth, **errors: Any) -> Picks:
    """The truth as a graph would find it, with errors added to its columns."""
    n = len(truth)
    axis = errors.get("axis", truth.axis)
    known = np.isfinite(axis).all(axis=1)
    position = np.where(known[:, None], truth.apex, truth.surface) + errors.get("position", 0.0)
    sigma = errors.get("sigma", np.nan)
    return Picks(
        id=np.arange(n),
        center=truth.center + errors.get("center", 0.0),
        radius=truth.radius + errors.get("radius", 0.0),
        position=position,
        surface=truth.surface,
        distance=np.linalg.norm(truth.surface, axis=1),
        diameter=truth.diameter + errors.get("diameter", 0.0),
        quaternion=quaternion_from_axis(axis),
        axis=axis,
        score=np.ones(n),
        sigma_position=np.full((n, 3), errors.get("sigma_position", sigma)),
        sigma_diameter=np.full(n, errors.get("sigma_diameter", sigma)),
        sigma_tilt=np.full(n, errors.get("sigma_tilt", sigma)),
        source=np.full(n, DepthSource.MEASURED, np.uint8),
        flags=np.where(known, 0, PickFlag.POSE_UNKNOWN).astype(np.uint32),
        frame_id=FRAME,
    )


def header(number: int) -> Header:
    return Header(1_700_000_000_000_000_000 + number * 33_000_000, number, FRAME)


def frame(number: int, truth: Truth | None = None, depth: np.ndarray | None = None) -> RgbdFrame:
    """A frame that shows the caps as disks, with its truth attached."""
    color = np.full((480, 640, 3), (70, 50, 40), np.uint8)
    if truth is not None:
        v, u = np.mgrid[:480, :640]
        for (x, y), r in zip(truth.center, truth.radius, strict=True):
            color[(u - x) ** 2 + (v - y) ** 2 < r**2] = 225
    attached = {} if truth is None else {TRUTH_TOPIC: truth}
    return RgbdFrame(header(number), color, depth, 0.000125, CAMERA, attached)


def write_results(
    path: Path,
    answers: Mapping[int, Picks],
    truths: Mapping[int, Truth] | None = None,
    manifest: str = "{}",
    milliseconds: float | None = None,
    summary: Mapping[str, Any] | None = None,
) -> Path:
    """A result recording with its truth and without images."""
    writer = RecordingWriter(path, {MANIFEST: {"json": manifest}})
    for number in sorted({*answers, *(truths or {})}):
        at = header(number)
        if truths and number in truths:
            writer.value(TRUTH_TOPIC, truths[number], at)
        if number in answers:
            writer.value("/mushpipe/pick", answers[number], at)
        if milliseconds is not None:
            content = {"stages_ns": {"pick": int(1e6 * milliseconds)}}
            writer.write(wire.TIMING_TOPIC, wire.json_message(wire.TIMING, at, content), at)
    if summary is not None:
        writer.metadata(SUMMARY, {"json": json.dumps(summary)})
    writer.close()
    return path


def write_recording(path: Path, truths: Mapping[int, Truth]) -> Path:
    """A recording as a simulator writes it."""
    writer = RecordingWriter(path, {})
    for number, truth in truths.items():
        writer.frame(frame(number, truth))
    writer.close()
    return path
