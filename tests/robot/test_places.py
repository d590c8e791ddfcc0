"""What a robot works on is offered to nobody else, also where it comes back under another id."""

from __future__ import annotations

import sys

import numpy as np
import pytest

from mushpipe.robot.hub import Hub, Settings
from mushpipe.robot.messages import Refusal
from mushpipe.robot.targets import Choice
from tests.robot.scene import FakeClock, choice

POSITIONS = np.array([[0.0, 0.0, 0.5], [0.06, 0.0, 0.5], [0.12, 0.0, 0.5]])


def bed(first_id: int, shift: tuple[float, float, float] = (0, 0, 0)) -> Choice:
    """Three mushrooms of 40 mm, 60 mm apart, with ids from the first on."""
    return choice(3, id=np.arange(first_id, first_id + 3), position=POSITIONS + shift)


class Scene:
    """A hub, and what it offers."""

    def __init__(self, replay: bool = False) -> None:
        self.clock = FakeClock()
        self.hub = Hub(Settings(replay=replay), self.clock)

    def show(self, what: Choice) -> list[int]:
        result = self.hub.publish(what, 0, 0, self.clock.now)
        return [target.id for target in self.hub.free(result)]

    def say(self, robot: str, target: int, outcome: str, hold_s: float = 0) -> str:
        return self.hub.acknowledge(robot, target, outcome, hold_s, self.clock.now)  # type: ignore[arg-type]


def test_a_claim_outlives_the_ids_that_a_pause_ends() -> None:
    scene = Scene()
    assert scene.show(bed(0)) == [0, 1, 2]
    scene.say("a", 1, "accepted")
    assert scene.show(bed(0)) == [0, 2]
    assert scene.show(bed(3, (0.002, -0.003, 0.001))) == [3, 5]
    with pytest.raises(Refusal, match="m4 is neither visible"):
        scene.say("b", 4, "accepted")
    assert scene.say("a", 1, "failed") == "restored"
    assert scene.show(bed(3)) == [3, 4, 5]
    assert scene.say("b", 4, "accepted") == "removed"


def test_a_claim_on_a_mushroom_of_unknown_size_outlives_its_id_as_well() -> None:
    scene, size = Scene(), np.full(3, np.nan)
    scene.show(choice(3, id=np.arange(3), position=POSITIONS, diameter=size))
    scene.say("a", 1, "accepted")
    moved = POSITIONS + np.array([0.002, -0.003, 0.001])
    assert scene.show(choice(3, id=np.arange(3, 6), position=moved, diameter=size)) == [3, 5]


@pytest.mark.parametrize(
    ("before_m", "after_m", "reach_m"),
    [(0.08, 0.08, 0.04), (0.08, np.nan, 0.04), (np.nan, 0.08, 0.04), (0.02, 0.02, 0.01)],
)
def test_a_claim_reaches_half_the_diameter_of_its_mushroom(
    before_m: float, after_m: float, reach_m: float
) -> None:
    scene = Scene()
    scene.show(choice(1, diameter=[before_m]))
    scene.say("a", 0, "accepted")
    for number, (way_m, offered) in enumerate(((0.9 * reach_m, []), (1.1 * reach_m, [2])), 1):
        moved = choice(1, id=[number], position=[[0, way_m, 0.5]], diameter=[after_m])
        assert scene.show(moved) == offered


def test_a_claim_that_lapses_hides_nothing_any_more() -> None:
    scene = Scene()
    scene.show(bed(0))
    scene.say("a", 0, "accepted")
    assert scene.show(bed(3)) == [4, 5]
    scene.clock.now += 60
    scene.hub.tick(scene.clock.now)
    assert scene.show(bed(3)) == [3, 4, 5]


def test_what_was_put_off_hides_no_other_from_a_camera_that_moved_on() -> None:
    scene = Scene()
    scene.show(bed(0))
    scene.say("a", 0, "rejected", hold_s=3600)
    assert scene.show(bed(3)) == [3, 4, 5]


def test_what_stands_beside_a_claim_is_offered() -> None:
    scene = Scene()
    scene.show(bed(0))
    scene.say("a", 1, "accepted")
    # more than half a diameter away, or seen when the claim was
    assert scene.show(bed(3, (0.021, 0, 0))) == [3, 4, 5]
    close = choice(2, position=np.array([[0.06, 0.0, 0.5], [0.07, 0.0, 0.5]]))
    scene = Scene()
    scene.show(close)
    scene.say("a", 1, "accepted")
    assert scene.show(close) == [0]


def test_a_claim_is_where_its_mushroom_was_last_seen() -> None:
    scene = Scene()
    scene.show(bed(0))
    scene.say("a", 1, "accepted")
    scene.show(bed(0, (0.03, 0, 0)))  # the camera moves
    assert scene.show(bed(3, (0.03, 0, 0))) == [3, 5]
    assert scene.show(bed(6)) == [6, 7, 8]


def test_a_claim_follows_its_mushroom_also_through_results_that_nobody_asks_for() -> None:
    scene = Scene()
    scene.show(bed(0))
    scene.say("a", 1, "accepted")
    scene.hub.publish(bed(0, (0.03, 0, 0)), 0, 0, scene.clock.now)
    scene.hub.tick(scene.clock.now)
    assert scene.show(bed(3, (0.03, 0, 0))) == [3, 5]


def test_what_is_done_hides_nothing_that_comes_to_light_there() -> None:
    scene = Scene()
    scene.show(bed(0))
    scene.say("a", 1, "accepted")
    scene.say("a", 1, "done")
    assert scene.show(bed(3)) == [3, 4, 5]


def test_what_still_stands_long_after_it_was_done_is_told_once(
    caplog: pytest.LogCaptureFixture,
) -> None:
    scene = Scene()

    def told(seconds: float, what: Choice | None = None) -> int:
        scene.clock.now += seconds
        if what is not None:
            scene.show(what)
        scene.hub.tick(scene.clock.now)
        return caplog.text.count("though robot 'a' said 'done'")

    scene.show(bed(0))
    scene.say("a", 1, "done")
    assert told(9.9, bed(0)) == 0
    assert told(60) == 0  # without a result nobody knows whether it still stands
    assert told(1, bed(3)) == 0  # out of sight
    assert [told(1, bed(0)) for _ in range(3)] == [1, 1, 1]
    assert "m1 still stands where it was" in caplog.text


def test_in_a_recording_what_is_done_stands_on(caplog: pytest.LogCaptureFixture) -> None:
    scene = Scene(replay=True)
    scene.show(bed(0))
    scene.say("a", 1, "done")
    scene.clock.now += 60
    scene.show(bed(0))
    scene.hub.tick(scene.clock.now)
    assert "still stands" not in caplog.text


def test_a_claim_in_another_frame_hides_nothing() -> None:
    scene = Scene()
    scene.show(bed(0))
    scene.say("a", 1, "accepted")
    moved = bed(3)
    assert scene.show(Choice("robot_base", moved.targets, moved.withheld)) == [3, 4, 5]


def test_a_robot_that_accepts_all_it_sees_keeps_the_server_from_nobody() -> None:
    """Each new target was held against each claimed one, in Python: longer than a frame takes."""
    scene, steps = Scene(), 0

    def count(*_: object) -> None:
        nonlocal steps
        steps += 1

    for block in range(12):  # each elsewhere, and gone when the next one comes
        ids = np.arange(100 * block, 100 * block + 100)
        scene.show(choice(100, id=ids, position=np.tile([block, 0.0, 0.5], (100, 1))))
        for target in ids.tolist() if block < 11 else ():
            scene.say("a", target, "accepted")
    assert scene.hub.newest is not None
    sys.setprofile(count)
    free = scene.hub.free(scene.hub.newest)
    sys.setprofile(None)
    assert len(free) == 100
    assert steps < 10_000  # calls and returns
