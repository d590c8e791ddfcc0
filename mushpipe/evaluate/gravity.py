"""Which way is up for a camera that stands still, from the accelerometer in its recording."""

from __future__ import annotations

import logging
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from mushpipe.core.arrays import Floats, Singles
from mushpipe.core.errors import InputError, UsageError
from mushpipe.core.recording import GARBAGE, RecordingReader
from mushpipe.sources.decoding import Decoder
from mushpipe.sources.mcap import McapSource
from mushpipe.sources.topics import topic_fault
from mushpipe.stages.upright import bed_normal, pixel_rays

logger = logging.getLogger("mushpipe")
IMU = "sensor_msgs/msg/Imu"
STANDARD = 9.80665  # m/s^2
TURNED_DEG = 20.0  # from the bed's normal; beds lie more level
OFF = 0.1  # share of it; an accelerometer that is off by more, or in g, measures something else
SWAY_DEG = 3.0  # root mean square; a camera that sways more does not stand still


@dataclass(frozen=True, eq=False)
class Upright:
    """The mean reading of an accelerometer at rest.

    Attributes:
        topic: Where it stands.
        frame_id: The frame of its axes, by its own name.
        count: Number of readings.
        up: (3,) unit vector against gravity, in that frame.
        strength: m/s^2.
        sway_deg: Root mean square angle of the readings about their mean, degrees.
        beside_bed_deg: Angle to the normal of the bed as the first frame's depth shows it, degrees;
            None without depth.
    """

    topic: str
    frame_id: str
    count: int
    up: Floats
    strength: float
    sway_deg: float
    beside_bed_deg: float | None

    def fragment(self) -> str:
        """Return what the setting `up` of a stage takes, with what it was found on, as YAML."""
        x, y, z = (round(float(part), 4) + 0.0 for part in self.up)  # 0.0 for -0.0
        bed = ""
        if self.beside_bed_deg is not None:
            bed = f", {self.beside_bed_deg:.1f} degrees from the bed's normal"
        return (
            f"# {self.count} readings of {self.topic}, along the axes of '{self.frame_id}': "
            f"{self.strength:.2f} m/s^2, swaying by {self.sway_deg:.1f} degrees{bed}\n"
            f"up: [{x}, {y}, {z}]\n"
        )


def measure_up(path: Path, topic: str | None = None) -> Upright:
    """Return the upright of a recording, whose IMU has the axes of the colour camera.

    Args:
        path: The recording.
        topic: Of the readings; needed where there are several.

    Raises:
        UsageError: There is no such file or topic, or one has to be chosen.
        InputError: There are no readings, they are not of gravity alone, or along other axes than
            the camera's as far as can be told.
    """
    reader = RecordingReader(path)
    topic = topic or _only(path, reader)
    read = list(_readings(reader, topic))
    for damage in reader.damage:
        logger.warning("%s: %s", path, damage)
    values = np.array([acceleration for _, acceleration in read]).reshape(-1, 3)
    if not len(values) or not np.isfinite(values).all():
        raise InputError(f"{path}: {topic} holds no readings, or such as are no numbers")
    mean = values.mean(axis=0)
    strength = float(np.linalg.norm(mean))
    if abs(strength - STANDARD) > OFF * STANDARD:
        raise InputError(
            f"{path}: {topic} reads {strength:.2f} m/s^2 in the mean, at rest it is {STANDARD:.2f}:"
            " did the camera move, is it in g, or a gyroscope?"
        )
    up = mean / strength
    across = np.linalg.norm(values - np.outer(values @ up, up), axis=1)
    sway = float(np.degrees(np.sqrt((np.arctan2(across, values @ up) ** 2).mean())))
    if sway > SWAY_DEG:
        raise InputError(f"{path}: {topic} sways by {sway:.1f} degrees: the camera did not rest")
    frame_id, (beside, unseen) = read[-1][0], _beside_bed(path, up)
    if beside is None and not frame_id.endswith("optical_frame"):
        raise InputError(
            f"{path}: {topic} is along the axes of '{frame_id}', and no bed shows whether these "
            f"are the camera's (x right, y down, z forward): {unseen}"
        )
    if beside is not None and beside > TURNED_DEG:
        raise InputError(
            f"{path}: by {topic}, up is {beside:.0f} degrees from the normal of what depth shows: "
            f"it is not the bed, or the axes of '{frame_id}' are not the camera's (x right, y "
            "down, z forward)"
        )
    return Upright(topic, frame_id, len(values), up, strength, sway, beside)


def _only(path: Path, reader: RecordingReader) -> str:
    index = reader.index()
    topics = [t for t in sorted(index.channels) if index.schema_name(t) == IMU and index.counts[t]]
    accelerometers = [t for t in topics if "gyro" not in t] or topics
    if len(accelerometers) == 1:
        return accelerometers[0]
    if not topics:
        raise InputError(f"{path}: it holds no {IMU}, which an accelerometer's readings come in")
    raise UsageError(f"{path}: which is it? --topic {' or --topic '.join(accelerometers)}")


def _readings(reader: RecordingReader, topic: str) -> Iterator[tuple[str, tuple[float, ...]]]:
    """Yield the frame and the acceleration, m/s^2, of each message."""
    if fault := topic_fault(reader.index(), topic, {IMU}):
        raise UsageError(f"{reader.path}: {fault}")
    decoder = Decoder()
    for raw in reader.messages({topic}):
        try:
            message = decoder.decode(raw)
        except GARBAGE as error:
            raise InputError(f"{reader.path}: {topic} cannot be decoded: {error}") from error
        read = message.linear_acceleration
        yield message.header.frame_id, (read.x, read.y, read.z)


def _beside_bed(path: Path, up: Floats) -> tuple[float | None, str]:
    """Return the angle, degrees, between an upright and the bed's normal, or why there is none."""
    try:
        frame = next(McapSource(path=path, max_frames=1).frames(), None)
    except InputError as error:  # a recording of the IMU alone, or one that has to be chosen from
        return None, str(error).removeprefix(f"{path}: ").split(";")[0]
    if frame is None or frame.depth is None:
        return None, "its first frame has no depth"
    if frame.camera is None:
        return None, "it has no calibration"
    depth: Singles = np.fmax(frame.depth_m, np.float32(0))
    normal = bed_normal(depth, pixel_rays(frame.camera))
    if normal is None:
        return None, "its first frame has too little depth"
    return float(np.degrees(np.arccos(np.clip(normal @ up, -1, 1)))), ""
