"""What the robot gets: circles, locations and poses joined, with ids that stay."""

from __future__ import annotations

import logging
import operator
from dataclasses import replace
from functools import reduce
from typing import Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import Field, PrivateAttr, field_validator

from mushpipe import Circles, DepthSource, Locations, PickFlag, Picks, Poses, RgbdFrame, Stage
from mushpipe.core.arrays import Floats, Ints, Rows
from mushpipe.core.errors import UsageError
from mushpipe.core.transform import Transform, TransformSetting
from mushpipe.stages.plausible import UsualSize, contradictory
from mushpipe.stages.rows import require_same_rows
from mushpipe.stages.surroundings import clearance, hidden_share
from mushpipe.stages.tracks import Tracks

logger = logging.getLogger("mushpipe")
SMALLEST_MM = 1.0
LEVEL = 0.2  # of a camera that looks level, the rise along its axis
SLIDE = 0.4  # diameters that the apex moves per radian that a cap leans otherwise than was found
TIP = 0.012  # sigma of the top of a cap about that of its model, in diameters
Rank = Literal["unoccluded", "highest", "largest", "score"]
FlagName = Literal[
    "depth_missing",
    "depth_estimated",
    "pose_unknown",
    "at_border",
    "occluded",
    "tilt_unobservable",
    "too_close_to_neighbour",
]


class MakePicks(Stage):
    """Joins what is known of each mushroom into a pick, and puts the picks in order.

    The position is the cap's apex where the pose is valid, else the surface point at the circle's
    centre. Nothing is filled in: what is unknown stays NaN and is flagged. An id stays with its
    mushroom while it is visible, also under a camera that moves sideways.
    """

    T_base_camera: TransformSetting | None = Field(
        None,
        description="pose of a camera that stands still in the robot's frame, {frame, translation "
        "(m), quaternion (x y z w)} or a YAML file with these; picks are given in that frame",
    )
    order: tuple[Rank, ...] = Field(
        ("unoccluded", "highest"),
        description="what comes first; the next one decides between equals. Height is z of the "
        "robot's frame, or nearness along the optical axis without one",
    )
    min_score: float = Field(0, ge=0, le=1, description="circles with a lower score are left out")
    diameter_mm: tuple[float, float] | None = Field(
        None, description="only caps of such a diameter, mm; an unknown one is left out"
    )
    withhold: tuple[FlagName, ...] = Field(
        (), description="mushrooms with any of these flags are left out instead of flagged"
    )
    occluded_share: float = Field(
        0.1, ge=0, le=1, description="share of the outline behind nearer mushrooms to be flagged"
    )
    clearance_mm: float = Field(
        0, ge=0, le=500, description="room the gripper needs around a cap, to other caps, mm"
    )
    tilt_sigma_deg: float = Field(
        10, gt=0, description="from this sigma on the tilt counts as unobservable, degrees"
    )
    memory_s: float = Field(
        1.0,
        ge=0,
        le=1e6,
        description="how long an id survives its mushroom unseen: longer than an arm hides it, and "
        "than the time between two pictures where that is over a second",
    )

    @field_validator("diameter_mm")
    @classmethod
    def _range(cls, value: tuple[float, float] | None) -> tuple[float, float] | None:
        if value is not None and not 0 <= value[0] < value[1]:
            raise ValueError("expected the smallest and the largest diameter, mm")
        if value is not None and value[1] < SMALLEST_MM:
            raise ValueError("no mushroom is so small; it is in mm, not in m")
        return value

    _tracks: Tracks = PrivateAttr(default_factory=Tracks)
    _total: int = PrivateAttr(0)
    _missing: int = PrivateAttr(0)
    _left_out: int = PrivateAttr(0)
    _inward: bool = PrivateAttr(False)
    _size: UsualSize = PrivateAttr(default_factory=UsualSize)

    def open(self) -> None:
        """Compile the kernels, and say where a camera above the bed would look up."""
        if self.T_base_camera is not None and self.T_base_camera.rise > LEVEL:
            logger.warning(
                "by T_base_camera the camera looks up along z of '%s': is the quaternion x y z w, "
                "and the pose that of the camera in the robot's frame? What counts as highest goes "
                "by that z",
                self.T_base_camera.frame,
            )
        two, unknown = Circles(np.full((2, 2), 4.0), np.ones(2), np.ones(2)), Locations.unknown(2)
        hidden_share(two, unknown.distance, (8, 8))
        clearance(two, unknown, self._above(unknown))
        Tracks().update(two, unknown, (8, 8), 0, 0)

    def process(
        self, frame: RgbdFrame, circles: Circles, locations: Locations, poses: Poses | None = None
    ) -> Picks:
        """Return the picks, the first to pick first, in the robot's frame or the camera's.

        Raises:
            ValueError: The inputs differ in their number of rows, are of different circles, or
                cannot be as a camera sees them.
            UsageError: `T_base_camera` names the camera's frame for the robot's.
        """
        n = len(circles)
        poses = Poses.unknown(n) if poses is None else poses
        require_same_rows(circles, locations, poses, frame.camera)
        wrong = contradictory(circles, locations, poses, frame.camera)
        locations, poses = locations.without(wrong), poses.without(wrong)
        self._size.look(frame.header.sequence, locations.diameter)
        poses = self._outward(poses, locations, frame.header.sequence)
        self._total += n
        self._missing += int(locations.missing.sum())
        image, memory_ns = frame.color.shape[1::-1], round(self.memory_s * 1e9)
        ids = self._tracks.update(circles, locations, image, frame.header.stamp_ns, memory_ns)
        hidden = hidden_share(circles, locations.distance, image)
        flags = self._flags(image, circles, locations, poses, hidden)
        picks = _joined(ids, circles, locations, poses, flags, frame.header.frame_id)
        up = -locations.position[:, 2]
        if self.T_base_camera is not None:
            if self.T_base_camera.frame == picks.frame_id:
                raise UsageError(
                    f"T_base_camera.frame is '{picks.frame_id}', the camera's own: name the frame "
                    "of the robot that the picks are to be in, such as robot_base"
                )
            picks = in_base(picks, self.T_base_camera)
            up = picks.surface[:, 2]
        picks = replace(picks, sigma_position=_sigma_position(picks))
        chosen = self._chosen(picks, up, hidden)
        self._left_out += n - len(chosen)
        return picks.take(chosen)

    def _outward(self, poses: Poses, locations: Locations, sequence: int) -> Poses:
        """Return the poses; unknown, which is said once, where a robot would come from below."""
        away = np.einsum("ij,ij->i", poses.axis, locations.position) > 0
        if not away.any():
            return poses
        if not self._inward:
            self._inward = True
            logger.warning(
                "frame %d: %d of %d axes point away from the camera, which sees the caps; these "
                "poses are left out: an axis points out of its cap, and a robot comes from there",
                *(sequence, away.sum(), poses.valid.sum()),
            )
        return poses.without(away)

    def _flags(
        self,
        image: tuple[int, int],
        circles: Circles,
        locations: Locations,
        poses: Poses,
        hidden: Floats,
    ) -> NDArray[np.uint32]:
        reach, tilt_sigma = circles.radius[:, None], np.radians(self.tilt_sigma_deg)
        cut = (circles.center < reach) | (circles.center + reach > np.array(image) - 1)
        flags = np.zeros(len(circles), np.uint32)
        missing, above = locations.missing, self._above(locations)
        for flag, where in (
            (PickFlag.DEPTH_MISSING, missing),
            (PickFlag.DEPTH_ESTIMATED, locations.source == DepthSource.NEIGHBOURS),
            (PickFlag.POSE_UNKNOWN, ~poses.valid),
            (PickFlag.AT_BORDER, cut.any(axis=1)),
            (PickFlag.OCCLUDED, hidden > self.occluded_share),
            (PickFlag.TILT_UNOBSERVABLE, poses.valid & ~(poses.sigma_rad < tilt_sigma)),
            (
                PickFlag.TOO_CLOSE_TO_NEIGHBOUR,
                ~missing & ~(1000 * clearance(circles, locations, above) >= self.clearance_mm),
            ),
        ):
            flags[where] |= np.uint32(flag)
        return flags

    def _above(self, locations: Locations) -> Floats:
        """Return where positions (N, 2), m, lie seen from above: along the robot's z if known."""
        place = locations.position
        if self.T_base_camera is not None:
            place = self.T_base_camera.points(place)
        return np.ascontiguousarray(place[:, :2])  # as the kernels want it

    def _chosen(self, picks: Picks, up: Floats, hidden: Floats) -> Rows:
        """Return the rows that are given, the first to pick first; without depth comes last."""
        unwanted = reduce(operator.or_, (PickFlag[name.upper()] for name in self.withhold), 0)
        keep = (picks.score >= self.min_score) & ((picks.flags & np.uint32(unwanted)) == 0)
        if self.diameter_mm is not None:
            low, high = self.diameter_mm
            keep &= (1000 * picks.diameter >= low) & (1000 * picks.diameter <= high)
        keys = {
            "unoccluded": hidden > self.occluded_share,
            "highest": -up,
            "largest": -picks.diameter,
            "score": -picks.score,
        }
        # the last key is the first to decide; NaN goes to the end
        order = np.lexsort([picks.id, *(keys[name] for name in self.order[::-1]), picks.missing])
        return np.asarray(order[keep[order]])

    def close(self) -> None:
        """Say how many mushrooms a robot was not told of, or could not have reached."""
        if self._left_out:
            logger.warning(
                "%d of %d mushrooms are left out of the picks by 'min_score', 'diameter_mm' or "
                "'withhold'",
                self._left_out,
                self._total,
            )
        if self._missing:
            logger.warning(
                "%d of %d mushrooms have no position: there is no depth at them, or none that fits",
                self._missing,
                self._total,
            )


def _sigma_position(picks: Picks) -> Floats:
    """Return the sigma (N, 3), m, of the apex where there is a pose, of the surface point else.

    The picks come with that of the surface point, in the frame in which they are given. Where a cap
    leans by an angle more than was found, what is seen of its dome stays where it is, so it turns
    about the middle of that curve and the apex slides along it by that angle times SLIDE D, in any
    direction across its axis n: the covariance is (SLIDE D sigma)^2 (I - n n^T) / 2, sigma being
    that of the whole angle and D the diameter. Along the axis the top of a pointed or flat cap is
    not where that of a model is: (TIP D)^2 n n^T.
    """
    diameter, along = picks.diameter[:, None], picks.axis**2
    slide = 0.5 * (SLIDE * diameter * picks.sigma_tilt[:, None]) ** 2 * np.maximum(1 - along, 0)
    apex = np.sqrt(picks.sigma_position**2 + slide + (TIP * diameter) ** 2 * along)
    posed = (picks.flags & np.uint32(PickFlag.POSE_UNKNOWN)) == 0
    return np.where(posed[:, None], apex, picks.sigma_position)


def _joined(
    ids: Ints,
    circles: Circles,
    locations: Locations,
    poses: Poses,
    flags: NDArray[np.uint32],
    frame_id: str,
) -> Picks:
    located = ~locations.missing
    return Picks(
        id=ids,
        center=circles.center,
        radius=circles.radius,
        position=np.where((located & poses.valid)[:, None], poses.apex, locations.position),
        surface=locations.position,
        distance=locations.distance,
        diameter=locations.diameter,
        quaternion=poses.quaternion,
        axis=poses.axis,
        score=circles.score,
        sigma_position=locations.sigma_position,
        sigma_diameter=locations.sigma_diameter,
        sigma_tilt=poses.sigma_rad,
        source=locations.source,
        flags=flags,
        frame_id=frame_id,
    )


def in_base(picks: Picks, transform: Transform) -> Picks:
    """Return picks in the target frame of a transform from the frame they are in."""
    return replace(
        picks,
        position=transform.points(picks.position),
        surface=transform.points(picks.surface),
        quaternion=transform.rotations(picks.quaternion),
        axis=transform.directions(picks.axis),
        sigma_position=transform.spreads(picks.sigma_position, picks.surface),
        frame_id=transform.frame,
    )
