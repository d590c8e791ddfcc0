from __future__ import annotations

import logging
from dataclasses import replace
from itertools import product
from typing import Any

import numpy as np
import pytest
from pydantic import ValidationError
from scipy.spatial.transform import Rotation

from mushpipe import (
    Circles,
    DepthSource,
    Locations,
    PickFlag,
    Picks,
    Poses,
    quaternion_from_axis,
)
from mushpipe.core.errors import UsageError
from mushpipe.stages.nearest_depth import NearestDepth
from mushpipe.stages.picks import MakePicks
from mushpipe.stages.surroundings import hidden_share
from tests.stages.scenes import CAMERA, frame_of

NAN = np.nan


def circles_at(*centers: tuple[float, float], radius: float = 8.0) -> Circles:
    n = len(centers)
    return Circles(np.reshape(centers, (n, 2)), np.full(n, radius), np.ones(n))


def locations(*sources: DepthSource, at: tuple[float, ...] = (50, 80)) -> Locations:
    """Surface points 0.5 m deep, seen at v = 50 px and `at` px."""
    n = len(sources)
    present = np.array(sources) != DepthSource.MISSING
    pixels = np.array([(u, 50.0) for u in at[:n]]).reshape(n, 2)
    position = np.where(present[:, None], CAMERA.deproject(pixels, np.full(n, 0.5)), NAN)
    return Locations(
        position,
        np.linalg.norm(position, axis=1),
        np.where(present, 0.04, NAN),
        sources,
        np.full((n, 3), NAN),
        np.full(n, NAN),
    )


def test_flags_say_what_is_not_measured() -> None:
    circles = circles_at((50, 50), (80, 50), (110, 50), (4, 50))
    sources = (DepthSource.MEASURED, DepthSource.NEIGHBOURS, DepthSource.MISSING)
    found = locations(*sources, DepthSource.MEASURED, at=(50, 80, 110, 4))
    picks = MakePicks().process(frame_of(np.zeros((120, 160))), circles, found)
    unknown = PickFlag.POSE_UNKNOWN
    flags = picks.flags[np.argsort(picks.id)].tolist()
    assert [PickFlag(f) for f in flags] == [
        unknown,
        unknown | PickFlag.DEPTH_ESTIMATED,
        unknown | PickFlag.DEPTH_MISSING,
        unknown | PickFlag.AT_BORDER,
    ]
    assert np.isnan(picks.position[picks.id == 2]).all()
    assert np.isnan(picks.quaternion).all()
    assert picks.frame_id == "camera_color_optical_frame"


@pytest.mark.parametrize(
    ("center", "cut"),
    [
        ((8, 60), False),  # from the first pixel on
        ((7.5, 60), True),
        ((151, 60), False),  # up to the last of 160
        ((151.5, 60), True),
        ((80, 8), False),
        ((80, 7.5), True),
        ((80, 111), False),  # up to the last of 120
        ((80, 111.5), True),
    ],
)
def test_what_any_border_of_the_image_cuts_is_flagged(
    center: tuple[float, float], cut: bool
) -> None:
    frame = frame_of(np.zeros((120, 160)))
    picks = MakePicks().process(frame, circles_at(center), Locations.unknown(1))
    assert bool(picks.flags[0] & PickFlag.AT_BORDER) is cut


def test_the_apex_stands_in_for_the_surface_only_where_the_pose_is_valid() -> None:
    circles = circles_at((50, 50), (80, 50))
    apex = CAMERA.deproject(np.array([[52.0, 50.0]]), np.array([0.48]))[0].tolist()
    poses = Poses(
        quaternion=[[1, 0, 0, 0], [NAN] * 4],
        axis=[[0, 0, -1], [NAN] * 3],
        apex=[apex, [NAN] * 3],
        sigma_rad=[0.1, NAN],
        fitness=[1.0, NAN],
        valid=[True, False],
    )
    found = locations(DepthSource.MEASURED, DepthSource.MEASURED)
    picks = MakePicks().process(frame_of(np.zeros((120, 160))), circles, found, poses)
    assert picks.position.tolist() == [apex, found.position[1].tolist()]
    assert [bool(f & PickFlag.POSE_UNKNOWN) for f in picks.flags] == [False, True]


def test_the_sigma_of_a_position_is_that_of_the_apex_where_there_is_one() -> None:
    rng, n, sigma_deg = np.random.default_rng(0), 20000, 12.0
    axis, curve, surface = np.array([0.48, 0.0, -0.8773]), 0.016, 0.0008
    axis /= np.linalg.norm(axis)
    lean = rng.normal(0, np.radians(sigma_deg) / np.sqrt(2), (n, 2))  # the angle is their length
    sides = np.stack([np.cross(axis, [0, 1, 0]), [0, 1, 0]])
    top = rng.normal(0, 0.012 * 0.04, n)  # of a cap 40 mm wide
    apexes = curve * lean @ sides + top[:, None] * axis + rng.normal(0, surface, (n, 3))
    found = replace(
        locations(DepthSource.MEASURED, DepthSource.MEASURED),
        sigma_position=np.full((2, 3), surface),
    )
    poses = Poses(
        quaternion=[[*Rotation.align_vectors([axis], [[0, 0, 1]])[0].as_quat()], [NAN] * 4],
        axis=[axis, [NAN] * 3],
        apex=[CAMERA.deproject(np.array([[52.0, 50.0]]), np.array([0.48]))[0], [NAN] * 3],
        sigma_rad=[np.radians(sigma_deg), NAN],
        fitness=[1.0, NAN],
        valid=[True, False],
    )
    circles = circles_at((50, 50), (80, 50))
    picks = MakePicks().process(frame_of(np.zeros((120, 160))), circles, found, poses)
    picks = picks.take(np.argsort(picks.id))
    np.testing.assert_allclose(picks.sigma_position[0], apexes.std(axis=0), rtol=0.03)
    np.testing.assert_array_equal(picks.sigma_position[1], surface)


def test_locations_of_other_circles_are_refused() -> None:
    found = locations(DepthSource.MEASURED, DepthSource.MISSING, at=(80, 50))
    with pytest.raises(ValueError, match=r"row 0: the circle is at \(50, 50\).* \(80, 50\)"):
        MakePicks().process(frame_of(np.zeros((120, 160))), circles_at((50, 50), (80, 50)), found)


@pytest.mark.parametrize("side", [(1, 0), (-1, 0), (0, 1), (0, -1)])
def test_depth_on_the_rim_itself_is_depth_of_the_circle(side: tuple[int, int]) -> None:
    for column, row, radius in product(range(30, 120, 7), range(30, 90, 5), (5, 10, 17)):
        depth = np.full((120, 160), NAN)
        depth[row + radius * side[1], column + radius * side[0]] = 0.4
        frame = frame_of(np.zeros((120, 160)), depth)
        circles = circles_at((column, row), radius=radius)
        assert len(MakePicks().process(frame, circles, NearestDepth().process(frame, circles))) == 1


def test_locations_of_two_neighbours_that_changed_places_are_refused() -> None:
    """Sorted by score behind the localizer, say: each would have the other's score and outline."""
    found = locations(DepthSource.MEASURED, DepthSource.MEASURED, at=(66, 50))
    circles = circles_at((50, 50), (66, 50))
    with pytest.raises(ValueError, match=r"row 0: the circle is at \(50, 50\), its location at"):
        MakePicks().process(frame_of(np.zeros((120, 160))), circles, found)
    assert (
        len(
            MakePicks().process(
                frame_of(np.zeros((120, 160))), circles, found.take(np.array([1, 0]))
            )
        )
        == 2
    )


def test_poses_of_other_circles_are_refused() -> None:
    found = locations(DepthSource.MEASURED, DepthSource.MEASURED)
    poses = Poses(
        quaternion=np.tile([1.0, 0.0, 0.0, 0.0], (2, 1)),
        axis=np.tile([0.0, 0.0, -1.0], (2, 1)),
        apex=found.position[::-1],
        sigma_rad=np.zeros(2),
        fitness=np.ones(2),
        valid=np.ones(2, bool),
    )
    with pytest.raises(ValueError, match=r"row 0: .* its pose at \(80, 50\)"):
        MakePicks().process(
            frame_of(np.zeros((120, 160))), circles_at((50, 50), (80, 50)), found, poses
        )


def exchange(apart_px: float, *seen_px: float) -> tuple[Circles, Locations, Poses]:
    """Return two caps of radius 8 px side by side; their apexes are seen right of the first."""
    found = locations(DepthSource.MEASURED, DepthSource.MEASURED, at=(50, 50 + apart_px))
    pixels = np.array([(50 + u, 50.0) for u in seen_px])
    poses = Poses(
        quaternion=np.tile([1.0, 0.0, 0.0, 0.0], (2, 1)),
        axis=np.tile([0.0, 0.0, -1.0], (2, 1)),
        apex=CAMERA.deproject(pixels, np.full(2, 0.48)),
        sigma_rad=np.zeros(2),
        fitness=np.ones(2),
        valid=np.ones(2, bool),
    )
    return circles_at((50, 50), (50 + apart_px, 50)), found, poses


@pytest.mark.parametrize("seen_px", [(16, 0), (11, 5), (20, -4)])
def test_poses_of_two_neighbours_that_changed_places_are_refused(
    seen_px: tuple[float, float],
) -> None:
    """They are within the three radii of a leaning cap; a robot got the one for the other."""
    with pytest.raises(ValueError, match="rows 0 and 1: the pose of each is seen in the circle of"):
        MakePicks().process(frame_of(np.zeros((120, 160))), *exchange(16, *seen_px))


@pytest.mark.parametrize(
    ("apart_px", "seen_px"),
    [
        (16, (0, 16)),
        (16, (15, 15)),  # one leans over the other
        (16, (15, 23)),  # both lean the same way
        (16, (7, 9)),  # towards each other
        (6, (4, 2)),  # two circles on one cap
        (6, (6, 0)),
    ],
)
def test_poses_of_caps_that_lean_are_taken(apart_px: float, seen_px: tuple[float, float]) -> None:
    frame = frame_of(np.zeros((120, 160)))
    assert len(MakePicks().process(frame, *exchange(apart_px, *seen_px))) == 2


def test_rows_must_agree() -> None:
    with pytest.raises(ValueError, match="2 circles, 1 locations, 2 poses"):
        MakePicks().process(
            frame_of(np.zeros((120, 160))),
            circles_at((50, 50), (80, 50)),
            locations(DepthSource.MEASURED),
        )


def test_the_end_of_a_run_says_how_many_have_no_position(
    caplog: pytest.LogCaptureFixture,
) -> None:
    stage = MakePicks()
    found = locations(DepthSource.MISSING, DepthSource.MEASURED)
    stage.process(frame_of(np.zeros((120, 160))), circles_at((50, 50), (80, 50)), found)
    with caplog.at_level(logging.WARNING, "mushpipe"):
        stage.close()
    assert "1 of 2 mushrooms have no position: there is no depth at them" in caplog.text


def test_an_empty_bed_gives_empty_picks() -> None:
    picks = MakePicks().process(frame_of(np.zeros((120, 160))), circles_at(), locations())
    assert len(picks) == 0


def test_picks_are_in_the_frame_of_their_image() -> None:
    frame = frame_of(np.zeros((120, 160)))
    other = replace(frame, header=replace(frame.header, frame_id="another_optical_frame"))
    picks = MakePicks().process(other, circles_at((50, 50)), locations(DepthSource.MEASURED))
    assert picks.frame_id == "another_optical_frame"


def bed(*rows: tuple[float, float, float, float]) -> tuple[Circles, Locations]:
    """Mushrooms at u, v (px), z and diameter (m); a z of NaN is missing."""
    u, v, z, size = np.array(rows).T
    center, radius = np.stack([u, v], axis=1), np.full(len(u), 12.0)
    position = CAMERA.deproject(center, z)
    missing = np.isnan(position).any(axis=1)
    position[missing] = NAN
    found = Locations.unknown(
        len(u),
        position=position,
        distance=np.linalg.norm(position, axis=1),
        diameter=size,
        source=np.where(missing, DepthSource.MISSING, DepthSource.MEASURED),
    )
    return Circles(center, radius, np.linspace(0.9, 0.5, len(u))), found


def picked(rows: list[tuple[float, float, float, float]], **settings: Any) -> Picks:
    circles, found = bed(*rows)
    return MakePicks(**settings).process(frame_of(np.zeros((120, 160))), circles, found)


# id 1 is the highest and hides half of id 0, which is higher than id 2; id 3 has no depth
BED = [(40, 60, 0.45, 0.04), (52, 60, 0.40, 0.05), (120, 60, 0.50, 0.03), (80, 30, NAN, NAN)]


def test_the_highest_comes_first_what_is_hidden_later_what_has_no_depth_last() -> None:
    picks = picked(BED)
    assert picks.id.tolist() == [1, 2, 0, 3]
    assert ((picks.flags & PickFlag.OCCLUDED) > 0).tolist() == [False, False, True, False]


@pytest.mark.parametrize(
    ("order", "ids"),
    [
        (("highest",), [1, 0, 2, 3]),
        (("largest",), [1, 0, 2, 3]),
        (("score",), [0, 1, 2, 3]),
        (("unoccluded", "score"), [1, 2, 0, 3]),
        ((), [0, 1, 2, 3]),
    ],
)
def test_other_orders(order: tuple[str, ...], ids: list[int]) -> None:
    assert picked(BED, order=order).id.tolist() == ids


def test_what_is_not_wanted_is_left_out() -> None:
    assert picked(BED, min_score=0.7).id.tolist() == [1, 0]
    assert picked(BED, diameter_mm=(35, 60)).id.tolist() == [1, 0]
    assert picked(BED, withhold=("occluded", "depth_missing")).id.tolist() == [1, 2]
    twice = ("occluded", "occluded", "depth_missing")
    assert picked(BED, withhold=twice).id.tolist() == [1, 2]
    with pytest.raises(ValidationError, match="smallest and the largest"):
        picked(BED, diameter_mm=(60, 35))


@pytest.mark.parametrize(
    ("quaternion", "told"),
    [((1, 0, 0, 0), False), ((0, 0, 0, 1), True), ((0.7071, 0, 0, 0.7071), False)],
)
def test_a_camera_that_looks_up_is_told_of(
    quaternion: tuple[float, ...], told: bool, caplog: pytest.LogCaptureFixture
) -> None:
    pose = {"frame": "robot_base", "translation": (0, 0, 1), "quaternion": quaternion}
    with caplog.at_level(logging.WARNING, "mushpipe"):
        MakePicks(T_base_camera=pose).open()
    assert ("the camera looks up along z of 'robot_base'" in caplog.text) is told


def test_axes_into_the_bed_are_left_out_and_told_of_once(caplog: pytest.LogCaptureFixture) -> None:
    stage, found = MakePicks(), locations(DepthSource.MEASURED, DepthSource.MEASURED)
    axis, one = np.array([[0.0, 0.6, 0.8], [0.0, 0.6, -0.8]]), np.ones(2)
    apex = found.position - 0.01 * np.array([0, 0, 1])
    poses = Poses(quaternion_from_axis(axis), axis, apex, one, one, one > 0)
    circles = circles_at((50, 50), (80, 50))
    with caplog.at_level(logging.WARNING, "mushpipe"):
        for _ in range(2):
            picks = stage.process(frame_of(np.zeros((120, 160))), circles, found, poses)
    assert caplog.text.count("1 of 2 axes point away from the camera") == 1
    picks = picks.take(np.argsort(picks.id))
    np.testing.assert_array_equal(picks.axis, [[NAN] * 3, axis[1]])
    assert np.isnan(picks.quaternion[0]).all()
    assert picks.position.tolist() == [found.position[0].tolist(), apex[1].tolist()]
    assert [bool(f & PickFlag.POSE_UNKNOWN) for f in picks.flags] == [True, False]


def test_the_end_of_a_run_says_how_many_were_left_out(caplog: pytest.LogCaptureFixture) -> None:
    stage = MakePicks(withhold=("depth_missing",))
    found = locations(DepthSource.MISSING, DepthSource.MEASURED)
    stage.process(frame_of(np.zeros((120, 160))), circles_at((50, 50), (80, 50)), found)
    with caplog.at_level(logging.WARNING, "mushpipe"):
        stage.close()
    assert "1 of 2 mushrooms are left out of the picks" in caplog.text


def test_the_end_of_a_run_that_gave_all_mushrooms_says_nothing(
    caplog: pytest.LogCaptureFixture,
) -> None:
    stage = MakePicks()
    with caplog.at_level(logging.WARNING, "mushpipe"):
        stage.open()
        stage.process(frame_of(np.zeros((120, 160))), *bed(BED[0], BED[2]))
        stage.close()
    assert caplog.messages == []


@pytest.mark.parametrize(("memory_s", "again"), [(2.4, 2), (2.6, 0)])
def test_an_id_is_remembered_for_so_many_seconds(memory_s: float, again: int) -> None:
    """Something is before the mushroom from the second picture on, up to 2.5 s."""
    stage, ids = MakePicks(memory_s=memory_s), []
    for at_ms, u in ((0, 50), (1000, 110), (2500, 50)):
        frame = frame_of(np.zeros((120, 160)))
        frame = replace(frame, header=replace(frame.header, stamp_ns=at_ms * 1_000_000))
        found = locations(DepthSource.MEASURED, at=(u,))
        ids.extend(stage.process(frame, circles_at((u, 50)), found).id.tolist())
    assert ids == [0, 1, again]


def test_diameters_in_metres_are_refused() -> None:
    with pytest.raises(ValueError, match="in mm, not in m"):
        MakePicks(diameter_mm=(0.02, 0.06))


def test_every_flag_can_be_withheld() -> None:
    for flag in PickFlag:
        assert flag.name is not None
        MakePicks(withhold=(flag.name.lower(),))  # type: ignore[arg-type]


def test_the_hidden_share_is_that_of_the_circles() -> None:
    # Two circles of radius r whose centres are r apart share 2/3 - sqrt(3)/(2 pi) of their area.
    share = 2 / 3 - np.sqrt(3) / (2 * np.pi)
    rows = [(40, 60, 0.45, 0.04), (52, 60, 0.40, 0.05)]
    for margin, flagged in ((-0.03, True), (0.03, False)):
        picks = picked(rows, occluded_share=share + margin)
        assert ((picks.flags & PickFlag.OCCLUDED) > 0).tolist() == [False, flagged]


def test_room_for_the_gripper_is_the_gap_between_the_outlines() -> None:
    # 80 px at 0.5 m and f = 200 px are 200 mm between centres, 160 mm between outlines.
    rows = [(40, 60, 0.5, 0.04), (120, 60, 0.5, 0.04)]
    for clearance, flagged in ((159, False), (161, True)):
        picks = picked(rows, clearance_mm=clearance)
        close = (picks.flags & PickFlag.TOO_CLOSE_TO_NEIGHBOUR) > 0
        assert close.tolist() == [flagged, flagged]
    alone = picked(rows[:1], clearance_mm=500)
    assert not alone.flags[0] & PickFlag.TOO_CLOSE_TO_NEIGHBOUR


def test_room_is_seen_from_above_where_the_camera_leans() -> None:
    leans = Rotation.from_euler("x", 150, degrees=True)  # 30 degrees off straight down
    base = {"frame": "base", "translation": (0, 0, 0.6), "quaternion": leans.as_quat().tolist()}
    rows = [(80, 60, 0.5, 0.04), (80, 90, 0.53, 0.04)]
    points = np.array([((v - 59.5) * z / 200, z) for _, v, z, _ in rows])  # y and z
    apart = np.diff(points @ [np.cos(np.radians(150)), -np.sin(np.radians(150))])
    gap = 1000 * (float(np.abs(apart[0])) - 0.04)
    for clearance, flagged in ((gap - 0.5, False), (gap + 0.5, True)):
        picks = picked(rows, clearance_mm=clearance, T_base_camera=base)
        close = (picks.flags & PickFlag.TOO_CLOSE_TO_NEIGHBOUR) > 0
        assert close.tolist() == [flagged, flagged]


def test_a_neighbour_without_depth_takes_room_as_well() -> None:
    # 40 px to the left, 16 px between outlines; the cap's 20 mm of radius are 12 px: 26.7 mm.
    rows = [(80, 60, 0.5, 0.04), (40, 60, NAN, NAN)]
    for clearance, flagged in ((26, False), (27, True)):
        picks = picked(rows, clearance_mm=clearance)
        close = (picks.flags & PickFlag.TOO_CLOSE_TO_NEIGHBOUR) > 0
        assert close.tolist() == [flagged, False]


def test_room_around_a_cap_of_unknown_size_is_not_free() -> None:
    rows = [(40, 60, 0.5, NAN), (120, 60, 0.5, 0.04)]
    picks = picked(rows, clearance_mm=1)
    close = (picks.flags & PickFlag.TOO_CLOSE_TO_NEIGHBOUR) > 0
    assert close[np.argsort(picks.id)].tolist() == [True, False]


def test_a_tilt_that_is_a_guess_is_flagged() -> None:
    circles, found = bed(*BED[:2])
    poses = Poses.unknown(
        2,
        quaternion=np.tile([1.0, 0, 0, 0], (2, 1)),
        axis=np.tile([0.0, 0, -1], (2, 1)),
        apex=found.position,
        sigma_rad=np.radians([9.0, 11.0]),
        valid=[True, True],
    )
    picks = MakePicks().process(frame_of(np.zeros((120, 160))), circles, found, poses)
    flagged = picks.id[(picks.flags & PickFlag.TILT_UNOBSERVABLE) > 0]
    assert flagged.tolist() == [1]


def test_picks_are_given_in_the_robots_frame() -> None:
    """Against SciPy's rotations, of a camera that looks down aslant."""
    circles, found = bed(*BED)
    rng = np.random.default_rng(3)
    own = Rotation.from_euler("xyz", rng.normal(0, 0.2, (4, 3))) * Rotation.from_quat([1, 0, 0, 0])
    valid = np.array([True, True, True, False])
    poses = Poses(
        quaternion=np.where(valid[:, None], own.as_quat(), NAN),
        axis=np.where(valid[:, None], own.apply([0, 0, 1]), NAN),
        apex=np.where(valid[:, None], found.position - [0, 0, 0.001], NAN),
        sigma_rad=np.full(4, 0.1),
        fitness=np.ones(4),
        valid=valid,
    )
    frame = frame_of(np.zeros((120, 160)))
    plain = MakePicks(order=()).process(frame, circles, found, poses)
    mount = Rotation.from_euler("zyx", [30, 10, 170], degrees=True)
    setting = {"frame": "base", "translation": [1, 2, 3], "quaternion": mount.as_quat().tolist()}
    moved = MakePicks(order=(), T_base_camera=setting).process(frame, circles, found, poses)
    assert (plain.frame_id, moved.frame_id) == ("camera_color_optical_frame", "base")
    for name in ("position", "surface"):
        expected = getattr(plain, name) @ mount.as_matrix().T + [1, 2, 3]
        np.testing.assert_allclose(getattr(moved, name), expected, atol=1e-12)
    np.testing.assert_allclose(moved.axis, plain.axis @ mount.as_matrix().T, atol=1e-12)
    # the quaternion still takes +z to the axis
    turned = Rotation.from_quat(moved.quaternion[valid]).apply([0, 0, 1])
    np.testing.assert_allclose(turned, moved.axis[valid], atol=1e-9)
    assert np.isnan(moved.quaternion[3]).all()
    assert moved.distance.tolist()[:3] == plain.distance.tolist()[:3]


def test_height_is_z_of_the_robots_frame() -> None:
    # A robot whose z points along the camera's sight: what is far is high.
    along = {"frame": "base", "translation": [0, 0, 0], "quaternion": [0, 0, 0, 1]}
    assert picked(BED, order=("highest",), T_base_camera=along).id.tolist() == [2, 0, 1, 3]


def test_spreads_turn_with_the_axes() -> None:
    circles, found = bed(BED[0])
    found = replace(found, sigma_position=[[0.001, 0.002, 0.003]])
    quarter = {"frame": "b", "translation": [0, 0, 0], "quaternion": [0, 0, 0.5**0.5, 0.5**0.5]}
    picks = MakePicks(T_base_camera=quarter).process(frame_of(np.zeros((120, 160))), circles, found)
    assert picks.sigma_position[0] == pytest.approx([0.002, 0.001, 0.003])


def test_the_sigma_of_a_leaning_apex_turns_with_the_cap() -> None:
    """Along the cap's axis, here z of the robot's frame, no tilt moves the apex of a cap."""
    circles, found = circles_at((50, 50), (80, 50)), locations(*[DepthSource.MEASURED] * 2)
    found = replace(found, diameter=np.full(2, 0.05), sigma_position=np.zeros((2, 3)))
    lean = Rotation.from_euler("y", 135, degrees=True)  # takes z to an axis 45 degrees off upright
    axis = lean.apply([0, 0, 1.0])
    poses = Poses(
        quaternion=np.tile(lean.as_quat(), (2, 1)),
        axis=np.tile(axis, (2, 1)),
        apex=found.position,
        sigma_rad=np.full(2, np.radians(20)),
        fitness=np.ones(2),
        valid=np.ones(2, bool),
    )
    base = {"frame": "b", "translation": [0, 0, 0], "quaternion": [*lean.inv().as_quat()]}
    picks = MakePicks(T_base_camera=base).process(
        frame_of(np.zeros((120, 160))), circles, found, poses
    )
    across = 0.4 * 0.05 * np.radians(20) / np.sqrt(2)
    along = 0.05 * 0.012
    np.testing.assert_allclose(picks.sigma_position[0], [across, across, along], atol=1e-9)


@pytest.mark.parametrize("seed", range(5))
def test_a_hidden_share_is_that_of_the_pixels_counted_one_by_one(seed: int) -> None:
    """Also of circles that reach beyond the image, of which only what is in view counts."""
    rng, n = np.random.default_rng(seed), 12
    center, radius = rng.uniform(-8, [88, 68], (n, 2)), rng.uniform(3, 20, n)
    distance = np.where(rng.random(n) < 0.2, NAN, rng.uniform(0.3, 0.6, n))
    v, u = np.mgrid[:60, :80]
    inside = [np.hypot(u - x, v - y) <= r for (x, y), r in zip(center, radius, strict=True)]
    expected = []
    for own, away in zip(inside, distance, strict=True):
        nearer = distance < (np.inf if np.isnan(away) else away)  # what has no depth hides nothing
        hidden = np.any([own & inside[k] for k in np.flatnonzero(nearer)], axis=0)
        expected.append(hidden.sum() / max(own.sum(), 1))
    found = hidden_share(Circles(center, radius, np.ones(n)), distance, (80, 60))
    assert found == pytest.approx(expected, abs=1e-12)


def test_a_mushroom_without_depth_hides_nothing() -> None:
    circles = circles_at((50, 50), (56, 50), (62, 50))
    depth = np.array([NAN, NAN, 0.5])
    shares = hidden_share(circles, depth, (160, 120))
    swapped = hidden_share(circles.take(np.array([1, 0, 2])), depth, (160, 120))
    assert shares[2] == 0
    assert shares.tolist() == swapped[[1, 0, 2]].tolist()
    alone = hidden_share(circles.take(np.array([0, 1])), depth[:2], (160, 120))
    assert alone.tolist() == [0, 0]


def test_poses_of_no_rows_are_refused() -> None:
    circles, found = circles_at((50, 50), (80, 50)), locations(*[DepthSource.MEASURED] * 2)
    with pytest.raises(ValueError, match="2 circles, 2 locations, 0 poses"):
        MakePicks().process(frame_of(np.zeros((120, 160))), circles, found, Poses.unknown(0))


def test_picks_in_the_robots_frame_cannot_have_the_cameras_name() -> None:
    circles, found = circles_at((50, 50)), locations(DepthSource.MEASURED)
    own = {"frame": "camera_color_optical_frame", "translation": [0, 0, 1]}
    stage = MakePicks(T_base_camera=own | {"quaternion": [1, 0, 0, 0]})
    with pytest.raises(UsageError, match="frame is 'camera_color_optical_frame'"):
        stage.process(frame_of(np.zeros((120, 160))), circles, found)


@pytest.mark.parametrize(
    ("position", "diameter"),
    [
        (9.0, 0.04),  # a flying pixel at the centre: there the circle is most of a metre wide
        (50.0, 0.04),  # one mushroom, its position in cm
        (0.5, 0.4),  # its diameter in dm
        (100.0, 8.0),  # both in a unit of their own: no mushroom is that large
    ],
)
def test_one_cap_whose_size_and_place_contradict_its_circle_has_no_position(
    position: float, diameter: float
) -> None:
    circles = circles_at((50, 50))
    found = locations(DepthSource.MEASURED)
    point = found.position * position / 0.5
    away = np.linalg.norm(point, axis=1)
    found = replace(found, position=point, distance=away, diameter=np.array([diameter]))
    picks = MakePicks().process(frame_of(np.zeros((120, 160))), circles, found)
    assert np.isnan(picks.position).all()
    assert np.isnan(picks.diameter).all()
    assert picks.source.tolist() == [DepthSource.MISSING]
    assert PickFlag(int(picks.flags[0])) & PickFlag.DEPTH_MISSING


def test_the_others_keep_their_position_beside_such_a_cap() -> None:
    circles = circles_at((50, 50), (80, 50), (110, 50))
    found = locations(*[DepthSource.MEASURED] * 3, at=(50, 80, 110))
    point = found.position * np.array([[1.0], [18.0], [1.0]])
    found = replace(found, position=point, distance=np.linalg.norm(point, axis=1))
    picks = MakePicks().process(frame_of(np.zeros((120, 160))), circles, found)
    assert sorted(picks.center[np.isfinite(picks.position[:, 2]), 0].tolist()) == [50, 110]
