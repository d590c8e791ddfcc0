from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from mushpipe import Circles, DepthSource, Locations, PickFlag, Picks, Poses, quaternion_from_axis
from mushpipe.stages.picks import MakePicks
from tests.stages.scenes import CAMERA, frame_of

FRAME = frame_of(np.zeros((120, 160)))
CIRCLES = Circles([(50, 50), (80, 60)], [8, 8], [1, 1])
POSITION = CAMERA.deproject(CIRCLES.center, np.full(2, 0.5))
LOCATIONS = Locations.unknown(
    2,
    position=POSITION,
    distance=np.linalg.norm(POSITION, axis=1),
    diameter=8 / CAMERA.fx * np.ones(2),
    source=np.full(2, DepthSource.MEASURED),
)


def poses(apex: np.ndarray) -> Poses:
    axis = np.tile((0.0, 0.0, -1.0), (2, 1))
    return Poses(quaternion_from_axis(axis), axis, apex, np.ones(2), np.ones(2), np.ones(2, bool))


@pytest.mark.parametrize(
    ("position", "diameter", "message"),
    [
        (POSITION * 0, 1, r"row 0: its location is at .*0, 0\), which is not in front"),
        (-POSITION, 1, r"its location is at .*, which is not in front of the camera"),
        (POSITION, 1000, r"row 0: its diameter is 40 m, but its circle is 0\.04 m wide"),
        (POSITION * 1000, 1, "row 0: its distance is .* in metres"),
        (POSITION * 100, 1, "row 0: its distance is .* in metres"),
    ],
)
def test_a_location_that_no_camera_sees_is_refused(
    position: np.ndarray, diameter: float, message: str
) -> None:
    wrong = replace(LOCATIONS, position=position, diameter=LOCATIONS.diameter * diameter)
    with pytest.raises(ValueError, match=message):
        MakePicks().process(FRAME, CIRCLES, wrong)


def test_a_distance_in_another_unit_is_refused() -> None:
    wrong = replace(LOCATIONS, distance=LOCATIONS.distance * 1000)
    with pytest.raises(ValueError, match=r"row 0: its distance is .* m, but its location is"):
        MakePicks().process(FRAME, CIRCLES, wrong)


def test_lengths_that_are_all_in_mm_are_refused() -> None:
    sized = {name: getattr(LOCATIONS, name) * 1000 for name in ("position", "distance", "diameter")}
    with pytest.raises(ValueError, match=r"row 0: its diameter is [\d.]+ m, and more than 1 m in"):
        MakePicks().process(FRAME, CIRCLES, replace(LOCATIONS, **sized))


@pytest.mark.parametrize(
    ("apex", "message"),
    [
        (POSITION * 0, "row 0: its pose is at .* not in front"),
        (POSITION * 1000, "row 0: the apex of its pose is .* m from its location"),
    ],
)
def test_an_apex_far_from_its_cap_is_refused(apex: np.ndarray, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        MakePicks().process(FRAME, CIRCLES, LOCATIONS, poses(apex))


def test_one_bad_depth_ends_no_run() -> None:
    """The paper's method takes a diameter from other pixels than the position."""
    size = LOCATIONS.diameter * [30, 1]
    found = MakePicks().process(FRAME, CIRCLES, replace(LOCATIONS, diameter=size), poses(POSITION))
    assert len(found) == 2


@pytest.mark.parametrize(
    ("distance", "size", "rise"),
    [
        (0.5, 4.5, 0.0),  # the diameter is no more than four times as wide as the circle,
        (0.5, 1 / 4.5, 0.0),  # and no less than a fourth
        (0.5, 1, 4.5),  # the apex no more than four such widths away
        (6.0, 2.5, 0.0),  # and no cap is over a metre wide: circles of 16 px are 0.48 m at 6 m
    ],
)
def test_a_row_that_contradicts_itself_is_unknown_and_the_others_stay(
    distance: float, size: float, rise: float
) -> None:
    position = CAMERA.deproject(CIRCLES.center, np.full(2, distance))
    away, width = np.linalg.norm(position, axis=1), 16 / CAMERA.fx * distance
    found = replace(LOCATIONS, position=position, distance=away, diameter=width * np.ones(2))
    assert not missing(MakePicks().process(FRAME, CIRCLES, found, poses(position))).any()
    found = replace(found, diameter=found.diameter * [1, size])
    apex = position * (1 - np.array([[0], [rise * width]]) / away[:, None])
    picks = MakePicks().process(FRAME, CIRCLES, found, poses(apex))
    assert missing(picks).tolist() == [False, True]
    assert np.isnan(picks.position[1]).all()
    assert np.isnan(picks.axis).all(axis=1).tolist() == [False, True]


def missing(picks: Picks) -> np.ndarray:
    """Return which mushrooms have no position, the first circle's first."""
    return ((picks.flags & PickFlag.DEPTH_MISSING) > 0)[np.argsort(picks.id)]


def test_lengths_are_of_another_unit_where_most_are_not_where_two_of_five_are() -> None:
    circles, found = of_size(0.03, 5)
    for wrong in (2, 3):
        some = replace(found, diameter=found.diameter * np.where(np.arange(5) < wrong, 30, 1))
        if wrong == 2:
            assert missing(MakePicks().process(FRAME, circles, some)).tolist() == [1, 1, 0, 0, 0]
        else:
            with pytest.raises(ValueError, match="and so it is in most rows"):
                MakePicks().process(FRAME, circles, some)


def test_without_a_calibration_a_location_is_in_front_of_the_camera_all_the_same() -> None:
    blind = replace(FRAME, camera=None)
    with pytest.raises(ValueError, match="not in front"):
        MakePicks().process(blind, CIRCLES, replace(LOCATIONS, position=POSITION * 0))


def test_what_a_camera_sees_is_taken_and_so_is_what_is_unknown() -> None:
    assert len(MakePicks().process(FRAME, CIRCLES, LOCATIONS, poses(POSITION))) == 2
    assert len(MakePicks().process(FRAME, CIRCLES, Locations.unknown(2))) == 2


def of_size(diameter: float, n: int = 9, unknown: int = 0) -> tuple[Circles, Locations]:
    """Caps of such a diameter, m, at the depth that their circles of 8 px tell then."""
    circles = Circles([(10 + 15 * k, 60) for k in range(n)], np.full(n, 8), np.ones(n))
    position = CAMERA.deproject(circles.center, np.full(n, diameter * CAMERA.fx / 16))
    size = np.where(np.arange(n) < unknown, np.nan, diameter)
    source = np.full(n, DepthSource.MEASURED)
    away = np.linalg.norm(position, axis=1)
    return circles, Locations.unknown(
        n, position=position, distance=away, diameter=size, source=source
    )


@pytest.mark.parametrize(
    ("diameter", "n", "unknown", "told"),
    [
        (0.03, 9, 0, None),
        (0.0075, 9, 0, "half of the diameters of 9 mushrooms are below 7.5 mm"),  # a quarter of it
        (0.00004, 9, 0, "half of the diameters of 9 mushrooms are below 0.04 mm"),  # m taken for mm
        (0.12, 9, 1, "half of the diameters of 8 mushrooms are above 120 mm"),
        (0.0075, 7, 0, None),  # a few may be pins
        (0.0075, 9, 2, None),
        (0.0075, 0, 0, None),
    ],
)
def test_a_bed_of_caps_of_impossible_size_is_told_of_once(
    diameter: float, n: int, unknown: int, told: str | None, caplog: pytest.LogCaptureFixture
) -> None:
    stage, caps = MakePicks(), of_size(diameter, n, unknown)
    for _ in range(3):
        assert len(stage.process(FRAME, *caps)) == n
    assert len(caplog.messages) == (told is not None)
    assert told is None or told in caplog.messages[0]
