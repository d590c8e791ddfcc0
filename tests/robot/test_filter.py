"""What may leave: the safety filter."""

from __future__ import annotations

import json
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp
from pydantic import ValidationError

from mushpipe import PickFlag
from mushpipe.robot.targets import Choice, Filter, Workspace
from tests.robot.peer import SERVER
from tests.robot.scene import make_picks

NAN, INF = float("nan"), float("inf")
TARGET = SERVER.evolve(schema={**SERVER.schema, "oneOf": [{"$ref": "#/$defs/target"}]})


def ids(choice: Choice) -> list[int]:
    return [target.id for target in choice.targets]


def decoded(choice: Choice) -> list[dict[str, Any]]:
    found = [json.loads(target.json) for target in choice.targets]
    for target in found:
        TARGET.validate(target)
    return found


def test_targets_come_in_the_order_of_the_picks() -> None:
    picks = make_picks(4, score=[0.2, 0.9, 0.9, 0.5], id=[4, 7, 3, 1])
    assert ids(Filter()(picks)) == [4, 7, 3, 1]


def test_an_empty_bed_is_an_empty_list() -> None:
    assert Filter()(make_picks(0)).targets == ()


def test_a_guessed_depth_is_withheld_unless_allowed() -> None:
    flags = [0, PickFlag.DEPTH_ESTIMATED, PickFlag.DEPTH_ESTIMATED]
    picks = make_picks(3, flags=flags, source=[1, 2, 1])
    choice = Filter()(picks)
    assert ids(choice) == [0]
    assert choice.withheld["estimated"] == 2
    allowed = Filter(allow_estimated=True)(picks)
    assert [target["flags"] for target in decoded(allowed)] == [
        [],
        ["depth_estimated"],
        ["depth_estimated"],
    ]


def test_a_summary_tells_what_was_withheld_in_all_frames() -> None:
    picked = Filter()
    assert picked.summary() == ""
    picked(make_picks(3))
    assert picked.summary() == ""
    picked(make_picks(3, source=[1, 2, 2]))
    position, flags = [[NAN] * 3, [0, 0, 0.5]], [PickFlag.DEPTH_MISSING, 0]
    picked(make_picks(2, position=position, source=[0, 2], flags=flags))
    assert picked.summary() == (
        "4 of 8 mushrooms in all frames were withheld from robots: 1 'no_depth', 3 'estimated' "
        "('allow_estimated: true' sends those)"
    )


def test_a_guess_whose_flag_was_forgotten_is_still_a_guess() -> None:
    assert ids(Filter()(make_picks(2, source=[2, 1]))) == [1]


def test_a_pick_without_depth_never_leaves() -> None:
    position = [[NAN] * 3, [0, 0, 0.5]]
    picks = make_picks(2, position=position, source=[0, 1], flags=[PickFlag.DEPTH_MISSING, 0])
    choice = Filter(allow_estimated=True)(picks)
    assert ids(choice) == [1]
    assert choice.withheld["no_depth"] == 1


def test_targets_outside_the_workspace_are_withheld() -> None:
    box = Workspace(low=(-0.1, -0.1, 0.4), high=(0.1, 0.1, 0.6))
    position = [[0, 0, 0.5], [0.11, 0, 0.5], [0, 0, 0.39], [0.1, 0.1, 0.6]]
    choice = Filter(workspace=box)(make_picks(4, position=position))
    assert ids(choice) == [0, 3]
    assert choice.withheld["workspace"] == 2
    with pytest.raises(ValidationError, match="less than"):
        Workspace(low=(0, 0, 0), high=(1, 1, 0))
    with pytest.raises(ValidationError, match="was it given in mm"):
        Workspace(low=(-300, -300, 0), high=(300, 300, 800))


def test_what_is_unknown_and_not_needed_is_null() -> None:
    picks = make_picks(
        1,
        quaternion=[[NAN] * 4],
        axis=[[NAN] * 3],
        diameter=[NAN],
        sigma_position=[[NAN, 0.001, 0.001]],
        sigma_diameter=[NAN],
        sigma_tilt=[NAN],
        flags=[PickFlag.POSE_UNKNOWN | PickFlag.AT_BORDER],
    )
    (target,) = decoded(Filter()(picks))
    assert target["orientation"] is None
    assert target["approach"] is None
    assert target["diameter"] is None
    assert target["sigma"] == {"position": None, "diameter": None, "tilt": None}
    assert target["flags"] == ["pose_unknown", "at_border"]


def test_an_orientation_that_is_flagged_unknown_does_not_leave() -> None:
    (target,) = decoded(Filter()(make_picks(1, flags=[PickFlag.POSE_UNKNOWN])))
    assert target["orientation"] is None


def test_an_orientation_that_is_missing_without_a_flag_is_flagged() -> None:
    (target,) = decoded(Filter()(make_picks(1, quaternion=[[NAN] * 4])))
    assert target["flags"] == ["pose_unknown"]


def test_directions_of_nearly_length_1_leave_with_it_and_others_not_at_all() -> None:
    turn, up = np.array([0, 0, 0.6, 0.8]), np.array([0, 0, 1.0])
    near = make_picks(1, quaternion=[1.0009 * turn], axis=[0.9991 * up])
    (target,) = decoded(Filter()(near))
    assert target["orientation"] == [0, 0, 0.6, 0.8]
    assert target["approach"] == [0, 0, -1]
    for quaternion, axis in ((1.0011 * turn, up), (turn, 0.9989 * up)):
        off = Filter()(make_picks(1, quaternion=[quaternion], axis=[axis]))
        assert (ids(off), off.withheld["invalid"]) == ([], 1)


@pytest.mark.parametrize(
    "change",
    [
        {"score": [INF, 0.5]},
        {"score": [NAN, 0.5]},
        {"score": [1.5, 0.5]},
        {"diameter": [INF, 0.04]},
        {"diameter": [-0.04, 0.04]},
        {"diameter": [4, 0.04]},  # in cm
        {"quaternion": [[2, 0, 0, 0], [1, 0, 0, 0]]},
        {"axis": [[0, 0, -3], [0, 0, -1]]},
        {"axis": [[0, 0, 1], [0, 0, -1]]},  # not where the quaternion turns +z to
        {"sigma_position": [[INF, 0, 0], [0, 0, 0]]},
        {"sigma_tilt": [-1, 0]},
        {"position": [[1e9, 0, 0.5], [0, 0, 0.5]]},
        {"id": [-1, 1]},
        {"id": [10**15, 1]},  # a hash, which no acknowledgement could name
    ],
    ids=str,
)
def test_nonsense_is_withheld(change: dict[str, Any]) -> None:
    choice = Filter()(make_picks(2, **change))
    assert ids(choice) == [1]
    assert choice.withheld["invalid"] == 1


ANY = st.floats(width=64)


@given(
    numbers=hnp.arrays(np.float64, (4, 10), elements=ANY),
    vectors=hnp.arrays(np.float64, (4, 3), elements=st.floats(-1, 1)),
    flags=hnp.arrays(np.uint32, 4, elements=st.integers(0, 127)),
    source=hnp.arrays(np.uint8, 4, elements=st.integers(1, 2)),
    allowed=st.booleans(),
)
def test_whatever_comes_every_target_is_finite_and_fits_the_schema(
    numbers: Any, vectors: Any, flags: Any, source: Any, allowed: bool
) -> None:
    picks = make_picks(
        4,
        axis=numbers[:, :3],
        quaternion=np.column_stack([numbers[:, 3], vectors]),
        diameter=numbers[:, 4],
        score=numbers[:, 5],
        sigma_position=numbers[:, 6:9],
        sigma_tilt=numbers[:, 9],
        source=source,
        flags=flags & ~np.uint32(PickFlag.DEPTH_MISSING),
    )
    choice = Filter(allow_estimated=allowed)(picks)
    decoded(choice)
    assert len(choice.targets) + sum(choice.withheld.values()) == 4
    assert all(np.isfinite(target.row).all() for target in choice.targets)
