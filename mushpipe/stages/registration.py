"""The paper's 3D pose (section VI): an upright model registered to each mushroom's points."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
from pydantic import Field, PrivateAttr

from mushpipe import Circles, GraphPath, Locations, Poses, RgbdFrame, Stage, quaternion_from_axis
from mushpipe.core.arrays import Floats, Singles
from mushpipe.core.libraries import import_open3d
from mushpipe.stages.calibrated import calibration_of
from mushpipe.stages.discs import radii_on_rays
from mushpipe.stages.upright import Up, pixel_rays, upright
from mushpipe.stages.upright_model import Model, made, read
from mushpipe.stages.warm_up import CAMERA, example_frame

_FARTHEST = 1.0  # radii; ICP slides along a smooth cap, and off it where its error is along normals
_LEAST_FITNESS = 0.2  # share of the model; half of it faces away from the camera


@dataclass(frozen=True, eq=False)
class Alignment:
    """One mushroom, registered: the pose, and the clouds of the paper's before and after figures.

    Attributes:
        axis: (3,) unit, the model's own normal vector, turned.
        apex: (3,) m.
        fitness: 0..1, ICP's share of the model that found a partner.
        sample: (M, 3) m, the mushroom's points, thinned.
        before: (K, 3) m, the model where it started: upright, in the mushroom's size.
        after: (K, 3) m, the model where it ended.
    """

    axis: Floats
    apex: Floats
    fitness: float
    sample: Floats
    before: Floats
    after: Floats

    @property
    def middle(self) -> Floats:
        """Middle (3,) of the sample, m."""
        return np.asarray(self.sample.mean(axis=0))

    @property
    def reach(self) -> float:
        """How far the model lies from there along x, y or z at most, before or after, m."""
        return float(np.abs(np.concatenate([self.before, self.after]) - self.middle).max())


class Registration(Stage):
    """Registers the cloud of an upright mushroom to each mushroom's depth, with Open3D.

    As in the paper: voxel downsampling, normals, FPFH features, Fast Global Registration, then
    ICP; the pose is the turn that takes the upright model to the mushroom, without its spin. The
    tilt's sigma is unknown. `cap-fit` is better and far faster; this is for comparison.
    """

    model: Literal["mushroom", "cap"] | GraphPath = Field(
        "mushroom", description="the project's mushroom, its cap alone, or a mesh or cloud, z up"
    )
    global_: Literal["fgr", "ransac", "none"] = Field(
        "fgr", alias="global", description="global registration; none starts upright"
    )
    local: Literal["point-to-point", "point-to-plane"] = Field(
        "point-to-point", description="error that ICP makes small"
    )
    voxel: float = Field(0.12, gt=0.01, le=1, description="voxel, in radii of the cap")
    up: Up = "bed"
    steepest_deg: float = Field(
        60, gt=0, le=180, description="what leans more has failed: no start, and no pose, degrees"
    )
    min_points: int = Field(30, ge=10, description="fewest points of a mushroom, after thinning")

    _model: Any = PrivateAttr(None)

    def open(self) -> None:
        """Load Open3D and the model, and compile the kernels.

        Raises:
            DependencyError: open3d or a library of the system is missing.
            UsageError: There is no such file as the model's.
            InputError: The model's file has too few points.
        """
        import_open3d()
        upright(self.up, np.fmax(example_frame().depth_m, np.float32(0)), pixel_rays(CAMERA))
        if self.model in ("mushroom", "cap"):
            self._model = made(self.model == "mushroom", self.voxel)
        else:
            self._model = read(self.model, self.voxel)  # type: ignore[arg-type]

    def process(
        self, frame: RgbdFrame, circles: Circles, locations: Locations, rng: np.random.Generator
    ) -> Poses:
        """Return one pose per circle; not valid where too few points have depth.

        Raises:
            InputError: The frame has depth but no calibration.
        """
        n = len(circles)
        axis, apex, fitness = np.full((n, 3), np.nan), np.full((n, 3), np.nan), np.full(n, np.nan)
        if frame.depth is not None:
            seed = int(rng.integers(2**31))
            for i in np.flatnonzero(np.isfinite(locations.distance)):
                found = self.align(frame, circles, locations, int(i), seed)
                if found is not None:
                    axis[i], apex[i], fitness[i] = found.axis, found.apex, found.fitness
        valid = np.isfinite(axis).all(axis=1)
        return Poses(quaternion_from_axis(axis), axis, apex, np.full(n, np.nan), fitness, valid)

    def align(
        self, frame: RgbdFrame, circles: Circles, locations: Locations, row: int, seed: int
    ) -> Alignment | None:
        """Register the mushroom of one row; the same seed gives what a run of all rows gives.

        Returns:
            None where it has too few points or no location, or where the model ran away.

        Raises:
            InputError: The frame has no calibration.
        """
        camera = calibration_of(frame)
        if self._model is None:
            self.open()
        position, radius = locations.position[row], circles.radius[row]
        if not np.isfinite(position).all():
            return None
        depth, rays = np.fmax(frame.depth_m, np.float32(0)), pixel_rays(camera)
        size = float(radii_on_rays(circles, camera)[row] * position[2])
        if not np.isfinite(size):
            return None
        points = _inside(depth, rays, circles.center[row], radius, size)
        deeper = 1 + self._model.top * size / locations.distance[row]
        # seeds RANSAC and the tuple test of FGR; ICP and FPFH draw nothing
        import_open3d().utility.random.seed((seed + row) % 2**31)
        return self.register(points, position * deeper, size, upright(self.up, depth, rays))

    def register(self, points: Floats, center: Floats, size: float, up: Floats) -> Alignment | None:
        """Register the model to the points of one mushroom.

        Args:
            points: (M, 3) m.
            center: (3,) m, where the model starts: about the centre of the rim.
            size: Radius of the cap, m.
            up: (3,) unit, how the model stands at the start.

        Returns:
            None where there are too few points, or where the model ran away: leans more than
            `steepest_deg`, is off its start by a radius, or lies on hardly a point.
        """
        o3d, model = import_open3d(), self._model
        if not isinstance(model, Model) or len(points) < self.min_points:
            return None
        # In radii around the start and with the model upright there: distances need no unit.
        turn = upright_turn(up)
        target = _cloud(o3d, (points - center) / size, None).voxel_down_sample(self.voxel)
        if len(target.points) < self.min_points:
            return None
        self._orient(o3d, target, -center / size)
        source = _cloud(o3d, model.points @ turn.T, model.normals @ turn.T)
        with o3d.utility.VerbosityContextManager(o3d.utility.VerbosityLevel.Error):
            start = self._start(o3d, source, target)
            top = turn @ (model.top * model.axis)
            if not self._stayed(start, up, top):
                start = np.eye(4)  # a smooth cap fits upside down as well
            result = self._refine(o3d, source, target, start)
        total = np.asarray(result.transformation)
        if not self._stayed(total, up, top) or result.fitness < _LEAST_FITNESS:
            return None  # ICP ran away
        axis = total[:3, :3] @ turn @ model.axis
        apex = total[:3, :3] @ top + total[:3, 3]
        before, sample = np.asarray(source.points), np.asarray(target.points)
        after = before @ total[:3, :3].T + total[:3, 3]
        clouds = (cloud * size + center for cloud in (sample, before, after))
        fitness = float(min(result.fitness, 1.0))
        return Alignment(axis / np.linalg.norm(axis), apex * size + center, fitness, *clouds)

    def _stayed(self, moved: Floats, up: Floats, top: Floats) -> bool:
        """Return whether a motion (4, 4), in radii about the rim's centre, can be a mushroom's."""
        leans = up @ moved[:3, :3] @ up < np.cos(np.radians(self.steepest_deg))
        shifts = moved[:3, 3], moved[:3, :3] @ top + moved[:3, 3] - top  # of centre and apex
        return bool(not leans and np.linalg.norm(shifts, axis=1).max() <= _FARTHEST)

    def _orient(self, o3d: Any, cloud: Any, eye: Floats) -> None:
        cloud.estimate_normals(o3d.geometry.KDTreeSearchParamHybrid(3 * self.voxel, 30))
        cloud.orient_normals_towards_camera_location(eye)

    def _start(self, o3d: Any, source: Any, target: Any) -> Floats:
        """Return the global registration (4, 4); the identity, which is upright, where it fails.

        Fast Global Registration (Zhou et al. 2016) gets for each point the model's with the nearest
        feature: of the model half is out of sight, and what is nearest both ways are a dozen points
        of a smooth cap. Its scale mu falls from the size of the model to `reach`.
        """
        if self.global_ == "none":
            return np.eye(4)
        registration = o3d.pipelines.registration
        search = o3d.geometry.KDTreeSearchParamHybrid(5 * self.voxel, 100)
        features = [registration.compute_fpfh_feature(c, search) for c in (source, target)]
        reach = 1.5 * self.voxel
        if self.global_ == "fgr":
            # distances are normalised unless absolute scale is asked for
            option = registration.FastGlobalRegistrationOption(
                maximum_correspondence_distance=reach, use_absolute_scale=True, decrease_mu=True
            )
            back = registration.correspondences_from_features(*reversed(features), False)
            matches = o3d.utility.Vector2iVector(np.asarray(back)[:, ::-1])
            result = registration.registration_fgr_based_on_correspondence(
                source, target, matches, option
            )
            if np.allclose(np.asarray(result.transformation)[:3, :3], np.eye(3)):
                return np.eye(4)  # too few matches: Open3D moves one centroid onto the other
        else:
            result = registration.registration_ransac_based_on_feature_matching(
                source, target, *features, True, reach,
                registration.TransformationEstimationPointToPoint(False), 3,
                [registration.CorrespondenceCheckerBasedOnDistance(reach)],
                registration.RANSACConvergenceCriteria(20_000, 0.999),
            )  # fmt: skip
        return np.asarray(result.transformation)

    def _refine(self, o3d: Any, source: Any, target: Any, start: Floats) -> Any:
        registration = o3d.pipelines.registration
        if self.local == "point-to-plane":
            estimation = registration.TransformationEstimationPointToPlane(
                registration.TukeyLoss(self.voxel)
            )
        else:
            estimation = registration.TransformationEstimationPointToPoint()
        criteria = registration.ICPConvergenceCriteria(max_iteration=200)
        return registration.registration_icp(
            source, target, 3 * self.voxel, start, estimation, criteria
        )


def upright_turn(up: Floats) -> Floats:
    """Return the shortest rotation (3, 3) that takes +z to a unit vector."""
    from scipy.spatial.transform import Rotation

    return np.asarray(Rotation.from_quat(quaternion_from_axis(up[None])[0]).as_matrix())


def _cloud(o3d: Any, points: Floats, normals: Floats | None) -> Any:
    cloud = o3d.geometry.PointCloud(o3d.utility.Vector3dVector(points))
    if normals is not None:
        cloud.normals = o3d.utility.Vector3dVector(normals)
    return cloud


def _inside(depth: Singles, rays: Singles, center: Floats, radius: float, size: float) -> Floats:
    """Return the points (M, 3) m in a circle (px), within the depth a cap of that size spans."""
    height, width = depth.shape
    (left, top), (right, bottom) = (
        np.clip(np.floor(center - radius), 0, (width, height)).astype(int),
        np.clip(np.ceil(center + radius) + 1, 0, (width, height)).astype(int),
    )
    v, u = np.mgrid[top:bottom, left:right]
    z = depth[top:bottom, left:right].astype(np.float64)
    inside = (z > 0) & ((u - center[0]) ** 2 + (v - center[1]) ** 2 <= radius**2)
    if not inside.any():
        return np.zeros((0, 3))
    middle = np.median(z[inside])
    inside &= (z > middle - 0.8 * size) & (z < middle + size)
    inside &= rays[top:bottom, left:right, 0] < 1e3  # where the lens has none
    xy = rays[top:bottom, left:right][inside].astype(np.float64)
    return np.column_stack([xy * z[inside, None], z[inside]])
