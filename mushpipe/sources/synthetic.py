"""Source `synthetic`: a simulated mushroom bed, for demos and tests without a camera."""

from __future__ import annotations

from collections.abc import Iterator
from itertools import count
from typing import Self

from pydantic import Field, model_validator

from mushpipe import Header, ReplaySource, RgbdFrame
from mushpipe.core.truth import INSTANCES_TOPIC, TRUTH_TOPIC
from mushpipe.core.types import COLOR_FRAME
from mushpipe.sim.photo import ColorCamera
from mushpipe.sim.scene import Scene
from mushpipe.sim.sensor import DepthSensor
from mushpipe.sim.settings import SceneSettings

_EPOCH_NS = 1_700_000_000 * 10**9


class SyntheticSource(SceneSettings, ReplaySource):
    """Renders a seeded mushroom bed, or a lab table, as an SR300-like camera sees it, with truth.

    The same settings give the same frames on the same machine, however many are asked for. The
    truth of each frame travels beside it on `/truth/mushrooms` and `/truth/instances`.
    """

    max_frames: int | None = Field(10, ge=1, lt=2**63, description="number of frames")
    fps: float = Field(30, ge=1e-6, le=1000, description="frames per second")
    step_mm: float = Field(
        0, ge=0, le=100, description="way of the gantry along x from frame to frame, mm"
    )
    travel_mm: float = Field(
        100, ge=0, le=1000, description="way after which a moving gantry turns back, mm"
    )
    missing_depth: int | None = Field(None, ge=2, description="every so many-th frame has no depth")
    gap_after: int | None = Field(None, ge=1, description="frames before a gap in time")
    gap_s: float = Field(2, ge=0, le=1e6, description="length of the gap, s")
    color: ColorCamera = Field(ColorCamera(), description="the colour camera")
    sensor: DepthSensor = Field(DepthSensor(), description="the depth camera")

    @model_validator(mode="after")
    def _moves(self) -> Self:
        if self.step_mm and not self.travel_mm:
            raise ValueError("step_mm moves the camera, and travel_mm 0 keeps it where it is")
        return self

    def name(self) -> str:
        """Return the name of the scene and its seed."""
        return f"synthetic-{self.scene}-{self.seed}"

    def frames(self) -> Iterator[RgbdFrame]:
        """Yield frames without end; `max_frames` ends them.

        Raises:
            DependencyError: open3d or a library of the system is missing.
        """
        travel = self.travel_mm / 1000 if self.step_mm else 0.0
        scene = Scene(self, self.color, self.sensor, travel)
        for sequence in count():
            yield self._frame(scene, sequence, travel)

    def _frame(self, scene: Scene, sequence: int, travel: float) -> RgbdFrame:
        still = scene.still(self._along(sequence, travel))
        lost = self.missing_depth is not None and sequence % self.missing_depth == 1
        return RgbdFrame(
            Header(self._stamp_ns(sequence), sequence, COLOR_FRAME),
            scene.color(still, sequence),
            None if lost else scene.depth(still, sequence),
            self.sensor.unit_mm / 1000,
            self.camera(),
            {TRUTH_TOPIC: still.truth, INSTANCES_TOPIC: still.instances},
        )

    def _along(self, sequence: int, travel: float) -> float:
        """Return where the gantry stands, m: to and fro along its way."""
        if not travel:
            return 0.0
        way = (sequence * self.step_mm / 1000) % (2 * travel)
        return min(way, 2 * travel - way)

    def _stamp_ns(self, sequence: int) -> int:
        late = self.gap_after is not None and sequence >= self.gap_after
        return _EPOCH_NS + round((sequence / self.fps + (self.gap_s if late else 0)) * 1e9)
