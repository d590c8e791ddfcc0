from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from mushpipe import Circles, DepthSource, InputError, Locations
from mushpipe.core.errors import DependencyError, UsageError
from mushpipe.core.truth import TRUTH_TOPIC
from mushpipe.stages.nearest_depth import NearestDepth
from mushpipe.stages.registration import Registration, _inside
from mushpipe.stages.upright_model import made, read
from tests.stages.caps import angle, cap, circles_of, draw, frame_from
from tests.stages.frames import simulated

try:
    from mushpipe.core.libraries import import_open3d

    o3d = import_open3d()
except DependencyError as error:
    pytest.skip(str(error), allow_module_level=True)

UP = np.array([0.0, 0.0, -1.0])


def stage(**settings: object) -> Registration:
    made = Registration.model_validate(settings)
    made.open()
    return made


def seen(tilt: float, turn: float, noise: float = 0.0) -> tuple[np.ndarray, np.ndarray]:
    """Points (M, 3) of the model, 20 mm in radius, as a camera above sees them; its axis."""
    model = made(full=False, spacing=0.05)
    lean = Rotation.from_euler("zyx", [turn, tilt, 0], degrees=True)
    flip = Rotation.from_euler("x", 180, degrees=True)  # z up to z towards the camera
    points = (flip * lean).apply(model.points) * 0.02
    normals = (flip * lean).apply(model.normals)
    points = points[normals[:, 2] < -0.2] + [0.03, -0.02, 0.4]
    points = points + np.random.default_rng(0).normal(0, noise, points.shape)
    return points, (flip * lean).apply([0, 0, 1])


@pytest.mark.parametrize("local", ["point-to-point", "point-to-plane"])
@pytest.mark.parametrize("start", ["none", "fgr", "ransac"])
def test_a_clean_cloud_of_the_model_itself_is_found(local: str, start: str) -> None:
    found = stage(model="cap", local=local, **{"global": start})
    for tilt, turn in [(0, 0), (12, 40), (20, 200)]:
        points, axis = seen(tilt, turn)
        result = found.register(points, np.array([0.03, -0.02, 0.4]), 0.02, UP)
        assert result is not None
        # what the camera does not see of the model pulls it back to where it stood
        assert angle(result.axis, axis) < 9
        assert np.linalg.norm(result.apex - ([0.03, -0.02, 0.4] + 0.62 * 0.02 * axis)) < 4.5e-3
        assert 0.8 < result.fitness <= 1


def test_the_pieces_are_those_of_open3d_called_by_hand() -> None:
    points, _ = seen(18, 70, 0.0005)
    center = np.array([0.03, -0.02, 0.4])
    ours = stage(model="cap", **{"global": "fgr"})
    o3d.utility.random.seed(5)
    found = ours.register(points, center, 0.02, UP) or pytest.fail("no pose")

    model, flip = made(False, 0.12), np.diag([1.0, -1.0, -1.0])
    source = o3d.geometry.PointCloud(o3d.utility.Vector3dVector(model.points @ flip))
    source.normals = o3d.utility.Vector3dVector(model.normals @ flip)
    target = o3d.geometry.PointCloud(o3d.utility.Vector3dVector((points - center) / 0.02))
    target = target.voxel_down_sample(0.12)
    target.estimate_normals(o3d.geometry.KDTreeSearchParamHybrid(0.36, 30))
    target.orient_normals_towards_camera_location(-center / 0.02)
    r = o3d.pipelines.registration
    search = o3d.geometry.KDTreeSearchParamHybrid(0.6, 100)
    of_source, of_target = (r.compute_fpfh_feature(c, search).data.T for c in (source, target))
    apart = np.linalg.norm(of_target[:, None] - of_source, axis=2)
    matches = np.column_stack([apart.argmin(axis=1), np.arange(len(of_target))]).astype(np.int32)
    o3d.utility.random.seed(5)
    option = r.FastGlobalRegistrationOption(
        maximum_correspondence_distance=0.18, use_absolute_scale=True, decrease_mu=True
    )
    coarse = r.registration_fgr_based_on_correspondence(
        source, target, o3d.utility.Vector2iVector(matches), option
    )
    start = coarse.transformation
    if start[2, 2] < 0.5:
        start = np.eye(4)
    fine = r.registration_icp(
        source,
        target,
        0.36,
        start,
        r.TransformationEstimationPointToPoint(),
        r.ICPConvergenceCriteria(max_iteration=200),
    ).transformation
    assert found.axis == pytest.approx(fine[:3, :3] @ [0, 0, -1], abs=1e-4)
    assert found.apex == pytest.approx((fine @ [0, 0, -0.62, 1])[:3] * 0.02 + center, abs=1e-5)


@pytest.mark.parametrize("angle_deg", [20.0, 45.0, 90.0])
def test_global_registration_finds_a_turn_far_from_upright(angle_deg: float) -> None:
    """Of a body that is no surface of revolution: three arms of different lengths."""
    rng, arms = np.random.default_rng(0), []
    for k, length in enumerate((0.5, 0.9, 1.4)):
        arm = rng.uniform(-0.15, 0.15, (700, 3))
        side = (k + 1) % 3
        arm[:, side] = np.sign(arm[:, side]) * 0.15
        arm[:, k] = rng.uniform(0, length, 700)
        arms.append(arm)
    turn = Rotation.from_rotvec(np.radians(angle_deg) * np.array([0.6, 0.48, 0.64]))
    clouds, body = [], np.concatenate(arms)
    for points in (body, turn.apply(body) + np.array([0.2, -0.1, 0.1])):
        cloud = o3d.geometry.PointCloud(o3d.utility.Vector3dVector(points))
        cloud = cloud.voxel_down_sample(0.06)
        cloud.estimate_normals(o3d.geometry.KDTreeSearchParamHybrid(0.18, 30))
        cloud.orient_normals_towards_camera_location(points.mean(axis=0) * 2)
        clouds.append(cloud)
    o3d.utility.random.seed(1)
    found = stage(voxel=0.06, **{"global": "fgr"})._start(o3d, *clouds)
    assert (Rotation.from_matrix(found[:3, :3].copy()) * turn.inv()).magnitude() < np.radians(8)


def test_global_registration_turns_the_model_of_most_mushrooms() -> None:
    found = stage(**{"global": "fgr"})
    turned = []
    begin = Registration._start

    def noted(self: Registration, library: Any, source: Any, target: Any) -> np.ndarray:
        start = begin(self, library, source, target)
        turned.append(not np.array_equal(start, np.eye(4)))
        return start

    frame = simulated(9000, width=640, height=480, tilt_deg=(5, 30))
    truth = frame.attached[TRUTH_TOPIC].take(frame.attached[TRUTH_TOPIC].ignore == 0)
    circles = Circles(truth.center, truth.radius, np.ones(len(truth)))
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(Registration, "_start", noted)
        found.process(
            frame, circles, NearestDepth().process(frame, circles), np.random.default_rng(0)
        )
    assert np.mean(turned) > 0.6


def test_the_clouds_before_and_after_show_the_model_move_onto_the_sample() -> None:
    points, _ = seen(15, 40)
    ours = stage(model="cap", voxel=0.08, **{"global": "none"})
    found = ours.register(points, np.array([0.034, -0.023, 0.402]), 0.02, UP)
    assert found is not None

    def distance(model: np.ndarray) -> float:
        away = np.linalg.norm(points[:, None] - model[None], axis=2)
        return float(np.sqrt((away.min(axis=1) ** 2).mean()))

    assert distance(found.sample) < 0.08 * 0.02  # the points themselves, thinned
    assert distance(found.after) < 0.5 * distance(found.before)
    # the model is moved as a rigid body, and its top ends at the apex
    top = np.argmin(np.linalg.norm(found.after - found.apex, axis=1))
    assert np.linalg.norm(found.after[top] - found.apex) < 0.08 * 0.02
    sides = [np.linalg.norm(c - c.mean(axis=0), axis=1) for c in (found.before, found.after)]
    assert sides[0] == pytest.approx(sides[1])


def scene() -> tuple[np.ndarray, np.ndarray, Circles]:
    caps = [cap(15, 30, (-0.03, 0, 0.3), 0.02, 0.6), cap(10, 200, (0.04, 0.01, 0.3), 0.022, 0.6)]
    return *draw(caps, 0.34), circles_of(caps)


def test_the_stage_gives_the_same_twice_and_marks_what_it_cannot_know() -> None:
    depth, gray, circles = scene()
    circles = Circles(
        np.vstack([circles.center, [[20, 20]]]), [*circles.radius, 12], [1.0, 1.0, 1.0]
    )
    depth[5:36, 5:36] = np.nan
    frame = frame_from(depth, gray)
    locations = NearestDepth().process(frame, circles)
    assert locations.source[2] == DepthSource.MISSING
    poses = [
        stage(up="camera").process(frame, circles, locations, np.random.default_rng(1))
        for _ in range(2)
    ]
    assert poses[0].valid.tolist() == [True, True, False]
    assert (poses[0].axis[:2] == poses[1].axis[:2]).all()
    assert np.isnan(poses[0].sigma_rad).all()
    turned = Rotation.from_quat(poses[0].quaternion[:2]).apply([0, 0, 1])
    assert turned == pytest.approx(poses[0].axis[:2])
    assert (poses[0].quaternion[:2, 2] == 0).all()  # no spin


def test_no_depth_gives_no_pose_and_no_calibration_an_error() -> None:
    depth, gray, circles = scene()
    frame = frame_from(depth, gray)
    locations = NearestDepth().process(frame, circles)
    nothing = frame_from(np.full(depth.shape, np.nan), gray)
    poses = stage().process(nothing, circles, locations, np.random.default_rng(0))
    assert not poses.valid.any()
    with pytest.raises(InputError, match="calibration"):
        stage().process(frame_from(depth, gray, None), circles, locations, np.random.default_rng(0))


def test_a_mesh_is_the_same_model_each_time_it_is_read(tmp_path) -> None:
    mesh = o3d.geometry.TriangleMesh.create_sphere(radius=20)
    o3d.io.write_triangle_mesh(str(tmp_path / "m.ply"), mesh)
    first, second = (read(tmp_path / "m.ply", 0.1) for _ in range(2))
    np.testing.assert_array_equal(first.points, second.points)


def test_a_model_of_the_users_own_is_read_in_any_unit(tmp_path, capfd) -> None:
    own = made(full=True, spacing=0.05)
    cloud = o3d.geometry.PointCloud(o3d.utility.Vector3dVector(own.points * 40 + [7, -3, 90]))
    o3d.io.write_point_cloud(str(tmp_path / "m.ply"), cloud)
    model = read(tmp_path / "m.ply", 0.1)
    assert capfd.readouterr() == ("", "")
    assert np.hypot(*model.points[:, :2].T).max() == pytest.approx(1, abs=0.05)
    assert model.top == pytest.approx(0.62, abs=0.08)
    assert angle(model.axis, np.array([0, 0, 1])) < 3
    upper = model.points[:, 2] > 0.2
    assert (model.normals[upper] * model.points[upper]).sum(axis=1).min() > 0


def test_the_normal_vector_of_a_model_that_leans_does_so_too_and_points_up(tmp_path) -> None:
    own, up = made(full=False, spacing=0.05), np.array([0, 0, 1.0])
    for tilt, turn in ((9, 20), (9, 200), (9, 110)):
        lean = Rotation.from_euler("zyx", [turn, tilt, 0], degrees=True)
        cloud = o3d.geometry.PointCloud(o3d.utility.Vector3dVector(lean.apply(own.points)))
        o3d.io.write_point_cloud(str(tmp_path / "m.ply"), cloud)
        axis = read(tmp_path / "m.ply", 0.1).axis
        assert angle(axis, lean.apply(up)) < 9 - 1 < angle(up, lean.apply(up))


@pytest.mark.parametrize("full", [True, False])
def test_the_projects_mushroom_is_an_ellipsoid_over_a_rolled_margin_and_a_stem(full: bool) -> None:
    spacing = 0.06
    model = made(full, spacing)
    rho, z = np.hypot(*model.points[:, :2].T), model.points[:, 2]
    outward = (model.points[:, :2] * model.normals[:, :2]).sum(axis=1) / rho
    upward = model.normals[:, 2]
    assert np.linalg.norm(model.normals, axis=1) == pytest.approx(1)

    def belongs(part: np.ndarray, off: np.ndarray, out: np.ndarray, up: np.ndarray) -> None:
        """Points lie on a curve, their normals as its gradient, but for where two meet."""
        assert np.abs(off[part]).max() < 0.01
        size = np.hypot(out, up)
        cosine = ((outward * out + upward * up) / size)[part]
        assert np.mean(cosine > 0.99) > 0.85
        assert cosine.min() > 0.6

    dome, margin = z >= 0, (z < 0) & (rho > 0.75)
    belongs(dome, rho**2 + (z / 0.62) ** 2 - 1, rho, z / 0.62**2)
    bend = (rho - 0.75) / 0.25
    belongs(margin, bend**2 + (z / 0.2) ** 2 - 1, bend / 0.25, z / 0.2**2)
    under, stem = (z < 0) & (rho <= 0.75) & (rho > 0.401), (z < 0) & (rho <= 0.401)
    assert under.any() == stem.any() == full
    if full:
        belongs(under, z + 0.2, np.zeros_like(z), -np.ones_like(z))
        belongs(stem, rho - 0.4, np.ones_like(z), np.zeros_like(z))
        assert z.min() == pytest.approx(-1.6, abs=spacing)
        assert stem.sum() * spacing**2 == pytest.approx(2 * np.pi * 0.4 * 1.4, rel=0.05)
        assert under.sum() * spacing**2 == pytest.approx(np.pi * (0.75**2 - 0.4**2), rel=0.15)
    e = np.sqrt(1 - 0.62**2)  # half an oblate spheroid
    area = np.pi * (1 + 0.62**2 / e * np.arctanh(e))
    assert dome.sum() * spacing**2 == pytest.approx(area, rel=0.06)
    assert model.top == pytest.approx(z.max(), abs=0.01)
    assert model.axis.tolist() == [0, 0, 1]


def test_a_file_without_points_is_an_input_error(tmp_path) -> None:
    (tmp_path / "empty.ply").write_text("ply\nformat ascii 1.0\nelement vertex 0\nend_header\n")
    with pytest.raises(InputError, match="0 points"):
        read(tmp_path / "empty.ply", 0.1)


def test_a_file_that_is_not_there_is_a_usage_error(tmp_path, capfd) -> None:
    with pytest.raises(UsageError, match=r"model .*gone\.ply: there is no such file"):
        read(tmp_path / "gone.ply", 0.1)
    with pytest.raises(UsageError, match="it is a folder"):
        read(tmp_path, 0.1)
    assert capfd.readouterr() == ("", "")


def test_locations_may_come_from_any_stage() -> None:
    depth, gray, circles = scene()
    position = np.array([[-0.03, 0, 0.289], [0.04, 0.01, 0.287]])
    nan = np.full(2, np.nan)
    locations = Locations(
        position, np.linalg.norm(position, axis=1), nan, [1, 1], np.full((2, 3), np.nan), nan
    )
    poses = stage(up="camera").process(
        frame_from(depth, gray), circles, locations, np.random.default_rng(0)
    )
    assert poses.valid.all()


@pytest.mark.parametrize("start", ["none", "fgr"])
@pytest.mark.parametrize("local", ["point-to-point", "point-to-plane"])
def test_a_model_that_slid_off_gives_no_pose(local: str, start: str) -> None:
    """A smooth cap that leans holds an error along its normals nowhere."""
    steep = stage(model="mushroom", local=local, **{"global": start})
    center, poses = np.array([0.03, -0.02, 0.4]), 0
    for tilt, turn in [(25, 20), (30, 110), (40, 200), (40, 20)]:
        points, axis = seen(tilt, turn)
        found = steep.register(points, center, 0.02, UP)
        if found is not None:
            poses += 1
            assert np.linalg.norm(found.apex - (center + 0.62 * 0.02 * axis)) < 0.02
            assert angle(found.axis, axis) < 60
    assert local == "point-to-plane" or poses == 4


@pytest.mark.parametrize("steepest", [30, 60])
def test_a_motion_that_no_mushroom_makes_is_told_from_one_that_it_may(steepest: float) -> None:
    found, top = stage(steepest_deg=steepest), 0.62 * UP

    def stayed(lean: float, *shift: float) -> bool:
        moved = np.eye(4)
        moved[:3, :3] = Rotation.from_euler("x", lean, degrees=True).as_matrix()
        moved[:3, 3] = shift
        return found._stayed(moved, UP, top)

    assert stayed(steepest - 1, 0, 0, 0)
    assert not stayed(steepest + 1, 0, 0, 0)
    for axis in np.eye(3):
        assert stayed(0, *(0.99 * axis))
        assert not stayed(0, *(1.01 * axis))
    # turned by 29 degrees the top goes 0.3 radii towards +y, and 0.8 on is too far for it alone
    assert stayed(29, 0, -0.8, 0)
    assert not stayed(29, 0, 0.8, 0)


def test_a_patch_of_a_cap_lies_on_too_little_of_a_whole_mushroom() -> None:
    points, _ = seen(0, 0)
    center = np.array([0.03, -0.02, 0.4])
    patch = points[np.hypot(*(points - center)[:, :2].T) < 0.42 * 0.02]
    for model, known in (("cap", True), ("mushroom", False)):
        found = stage(model=model, **{"global": "none"}).register(patch, center, 0.02, UP)
        assert (found is not None) == known


def test_the_points_of_a_mushroom_are_those_in_its_circle_at_about_its_depth() -> None:
    rng = np.random.default_rng(0)
    depth = rng.uniform(0.3, 0.4, (40, 50)).astype(np.float32)
    depth[rng.random(depth.shape) < 0.2] = 0
    rays = rng.uniform(-0.5, 0.5, (40, 50, 2)).astype(np.float32)
    rays[rng.random(depth.shape) < 0.1] = 1e6
    for center, radius in (((24.3, 19.6), 12.0), ((2.0, 37.0), 9.0), ((-30.0, 5.0), 9.0)):
        places = [
            (v, u)
            for v, u in np.ndindex(40, 50)
            if depth[v, u] > 0 and np.hypot(u - center[0], v - center[1]) <= radius
        ]
        middle = np.median([depth[place] for place in places]) if places else 0.0
        expected = [
            (*(rays[place] * depth[place]), depth[place])
            for place in places
            if middle - 0.8 * 0.03 < depth[place] < middle + 0.03 and rays[place][0] < 1e3
        ]
        found = _inside(depth, rays, np.array(center), radius, 0.03)
        assert found == pytest.approx(np.array(expected).reshape(-1, 3), rel=1e-6)
