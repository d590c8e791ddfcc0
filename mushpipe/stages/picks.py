"""What the robot gets: circles, locations and poses joined, with ids that stay."""

from __future__ import annotations

import logging

import numpy as np
from numpy.typing import NDArray
from pydantic import Field, PrivateAttr

from mushpipe import Circles, DepthSource, Locations, PickFlag, Picks, Poses, RgbdFrame, Stage
from mushpipe.stages.tracks import Tracks

logger = logging.getLogger("mushpipe")


class MakePicks(Stage):
    """Joins what is known of each mushroom into a pick, and gives it an id that stays with it.

    The position is the cap's apex where the pose is valid, else the surface point at the circle's
    centre. Nothing is filled in: what is unknown stays NaN and is flagged.
    """

    memory_s: float = Field(1.0, ge=0, description="how long an id survives its mushroom unseen")

    _tracks: Tracks = PrivateAttr(default_factory=Tracks)
    _total: int = PrivateAttr(0)
    _missing: int = PrivateAttr(0)

    def process(
        self,
        frame: RgbdFrame,
        circles: Circles,
        locations: Locations,
        poses: Poses | None = None,
    ) -> Picks:
        """Return one pick per circle, in the camera's frame.

        Raises:
            ValueError: The inputs differ in their number of rows.
        """
        n = len(circles)
        poses = poses or _unknown_poses(n)
        if not n == len(locations) == len(poses):
            raise ValueError(f"{n} circles, {len(locations)} locations, {len(poses)} poses")
        located = locations.source != DepthSource.MISSING
        self._total += n
        self._missing += int((~located).sum())
        return Picks(
            id=self._tracks.update(circles, frame.header.stamp_ns, round(self.memory_s * 1e9)),
            center=circles.center,
            radius=circles.radius,
            position=np.where((located & poses.valid)[:, None], poses.apex, locations.position),
            distance=locations.distance,
            diameter=locations.diameter,
            quaternion=poses.quaternion,
            axis=poses.axis,
            score=circles.score,
            sigma_position=locations.sigma_position,
            sigma_diameter=locations.sigma_diameter,
            sigma_tilt=poses.sigma_rad,
            source=locations.source,
            flags=_flags(frame, circles, locations, poses),
            frame_id=frame.header.frame_id,
        )

    def close(self) -> None:
        """Say how many picks a robot could not have reached."""
        if self._missing:
            logger.warning(
                "%d of %d picks have no position: there is no depth at them",
                self._missing,
                self._total,
            )


def _flags(
    frame: RgbdFrame, circles: Circles, locations: Locations, poses: Poses
) -> NDArray[np.uint32]:
    height, width = frame.color.shape[:2]
    x, y = circles.center.T
    left, right = x - circles.radius, x + circles.radius
    top, bottom = y - circles.radius, y + circles.radius
    border = (left < 0) | (top < 0) | (right > width - 1) | (bottom > height - 1)
    flags = np.zeros(len(circles), np.uint32)
    for flag, where in (
        (PickFlag.DEPTH_MISSING, locations.source == DepthSource.MISSING),
        (PickFlag.DEPTH_ESTIMATED, locations.source == DepthSource.NEIGHBOURS),
        (PickFlag.POSE_UNKNOWN, ~poses.valid),
        (PickFlag.AT_BORDER, border),
    ):
        flags[where] |= np.uint32(flag)
    return flags


def _unknown_poses(n: int) -> Poses:
    nan = np.full((n, 4), np.nan)
    return Poses(nan, nan[:, :3], nan[:, :3], nan[:, 0], nan[:, 0], np.zeros(n, bool))
