"""Ages and states on clocks that jump."""

from __future__ import annotations

import json
import socket
from dataclasses import replace
from math import inf

import pytest
from hypothesis import given
from hypothesis import strategies as st

from mushpipe.robot.clock import MEMORY_S, PACED_S, TOLERANCE_S, Clock, Lateness, Placer
from mushpipe.robot.connection import Connection, Limits
from mushpipe.robot.hub import Ending, Hub, Result, Settings
from mushpipe.robot.ledger import Ledger
from mushpipe.robot.messages import Refusal
from mushpipe.robot.session import JsonSession, Outgoing
from tests.robot.scene import FRAME, FakeClock, choice


def hidden(ledger: Ledger) -> set[int]:
    return {target for target in range(10) if ledger.hides(target)}


def test_a_stamp_is_placed_where_it_was_taken() -> None:
    clock = FakeClock()
    placer = Placer(clock)
    stamp = clock.wall_ns()
    clock.now += 0.3
    assert placer.place(stamp) == pytest.approx(clock.now - 0.3, abs=1e-5)


@pytest.mark.parametrize("jump", [-3600.0, -30.0, 0.5, 3600.0])
def test_a_jump_of_the_wall_clock_makes_nothing_younger(jump: float) -> None:
    clock = FakeClock()
    placer = Placer(clock)
    clock.now += 60
    placer.place(0)
    before = clock.wall_ns()
    clock.now += 0.1
    clock.offset_s += jump
    # Reckoned back after the jump, the same stamp would be of an earlier moment.
    assert placer.place(before) == pytest.approx(clock.now - 0.1 - max(jump, 0), abs=1e-5)
    clock.now += 0.1
    after = clock.wall_ns()
    clock.now += 0.2
    assert placer.place(after) == pytest.approx(clock.now - 0.2, abs=1e-5)


@pytest.mark.parametrize("jump", [-0.3, 0.3, 0.6])
def test_a_driver_may_reckon_a_stamp_back_from_now_after_the_clock_was_set(jump: float) -> None:
    clock = FakeClock()
    placer = Placer(clock)
    clock.now += 60
    placer.place(0)
    clock.offset_s += jump
    placed = placer.place(clock.wall_ns() - 700_000_000)
    assert placed is not None
    assert placed <= clock.now - 0.7 + 1e-5


def test_an_hour_that_the_clock_showed_twice_counts_as_the_first_one() -> None:
    clock = FakeClock()
    placer = Placer(clock)
    clock.now += 60
    placer.place(0)
    clock.offset_s -= 2
    stamp = clock.wall_ns()
    clock.now += 0.1
    assert placer.place(stamp) == pytest.approx(clock.now - 2.1, abs=1e-5)
    clock.now += 2.2
    stamp = clock.wall_ns()
    assert placer.place(stamp) == pytest.approx(clock.now, abs=1e-5)


@pytest.mark.parametrize("seconds", [1.0, 1e9, -20.0, -1e9])
def test_stamps_of_another_clock_have_no_place(seconds: float) -> None:
    clock = FakeClock()
    assert Placer(clock).place(clock.wall_ns() + round(seconds * 1e9)) is None


@given(
    steps=st.lists(st.tuples(st.floats(0, 3), st.floats(-5, 5)), min_size=1, max_size=30),
    delay=st.floats(0, 5),
)
def test_no_stamp_is_ever_placed_later_than_it_was_taken(
    steps: list[tuple[float, float]], delay: float
) -> None:
    clock = FakeClock()
    placer = Placer(clock)
    taken: list[tuple[int, float]] = []
    for pause, jump in steps:
        taken.append((clock.wall_ns(), clock.now))
        clock.now += pause
        clock.offset_s += jump
        placer.place(0)
    clock.now += delay
    for stamp, moment in taken:
        placed = placer.place(stamp)
        if clock.now - moment < MEMORY_S:
            assert placed is None or placed <= moment + TOLERANCE_S + 1e-5


def test_the_real_clocks_tick() -> None:
    clock = Clock()
    first = clock.monotonic()
    assert clock.monotonic() >= first
    placed = Placer(clock).place(clock.wall_ns())
    assert placed is not None
    assert placed >= first - TOLERANCE_S


def hub_on(clock: FakeClock, **settings: float | bool) -> tuple[Hub, list[int]]:
    frames = [0]
    return Hub(Settings(**settings), clock, lambda: frames[0]), frames  # type: ignore[arg-type]


def test_nothing_older_than_allowed_is_fresh() -> None:
    clock = FakeClock()
    hub, _ = hub_on(clock, max_age_s=0.5)
    with pytest.raises(Refusal, match="no result yet"):
        hub.fresh(clock.now, 10)
    hub.publish(choice(), 0, 0, clock.now - 0.3)
    assert hub.fresh(clock.now, 10).seq == 1
    assert hub.fresh(clock.now + 0.19, 10).seq == 1
    for age_limit, later in ((10, 0.21), (0.29, 0.0)):
        with pytest.raises(Refusal, match="too old") as caught:
            hub.fresh(clock.now + later, age_limit)
        assert caught.value.code == "stale"


def test_a_result_of_unknown_age_is_never_fresh() -> None:
    clock = FakeClock()
    hub, _ = hub_on(clock)
    hub.publish(choice(), 0, 0, float("-inf"))
    with pytest.raises(Refusal, match="too old"):
        hub.fresh(clock.now, 1e9)
    assert hub.age_ms(clock.now) is None


def test_a_result_from_the_future_is_one_of_now() -> None:
    clock = FakeClock()
    hub, _ = hub_on(clock, max_age_s=0.5)
    hub.publish(choice(), 0, 0, clock.now + 100)
    with pytest.raises(Refusal, match="too old"):
        hub.fresh(clock.now + 1, 10)


def test_the_state_tells_a_stalled_pipeline_from_a_lost_camera() -> None:
    clock = FakeClock()
    hub, frames = hub_on(clock, stall_s=1.0)
    assert hub.state(clock.now) == "no_camera"
    frames[0] = 1
    hub.tick(clock.now)
    assert hub.state(clock.now) == "stalled"
    hub.publish(choice(), 0, 0, clock.now)
    assert hub.state(clock.now) == "running"
    clock.now += 1.1
    frames[0] = 30
    hub.tick(clock.now)
    assert hub.state(clock.now) == "stalled"
    clock.now += 1.1
    hub.tick(clock.now)
    assert hub.state(clock.now) == "no_camera"


def test_a_recording_has_no_camera_to_lose() -> None:
    clock = FakeClock()
    hub, _ = hub_on(clock, replay=True)
    assert hub.state(clock.now) == "stalled"


@pytest.mark.parametrize(
    ("ending", "state"), [("end", "stalled"), ("failed", "stalled"), ("no_camera", "no_camera")]
)
def test_once_the_run_has_ended_nothing_is_fresh(ending: Ending, state: str) -> None:
    clock = FakeClock()
    hub, _ = hub_on(clock)
    hub.publish(choice(), 0, 0, clock.now)
    assert hub.state(clock.now) == "running"
    hub.ending = ending
    assert hub.state(clock.now) == state
    with pytest.raises(Refusal) as caught:
        hub.fresh(clock.now, 10)
    assert (caught.value.code, caught.value.extra["state"]) == ("stale", state)


def test_an_accepted_target_comes_back_when_nothing_is_heard() -> None:
    ledger = Ledger(claim_s=60)
    assert ledger.apply("a", 1, "accepted", 0, visible=True, now=0) == "removed"
    ledger.settle(59)
    assert hidden(ledger) == {1}
    assert ledger.apply("a", 1, "accepted", 0, visible=True, now=59) == "removed"
    ledger.settle(100)
    assert hidden(ledger) == {1}
    version = ledger.version
    ledger.settle(119)
    assert hidden(ledger) == set()
    assert ledger.version != version


def test_what_is_done_stays_away_for_good() -> None:
    ledger = Ledger()
    ledger.apply("a", 1, "done", 0, visible=True, now=0)
    ledger.settle(1e9)
    assert hidden(ledger) == {1}
    assert ledger.apply("a", 1, "failed", 0, visible=True, now=1e9) == "removed"
    with pytest.raises(Refusal, match="held, or done, by another robot"):
        ledger.apply("b", 1, "accepted", 0, visible=True, now=1e9)


def test_a_target_can_be_kept_away_for_a_while() -> None:
    ledger = Ledger()
    assert ledger.apply("a", 1, "rejected", 5, visible=True, now=0) == "removed"
    assert ledger.apply("a", 2, "failed", 1200, visible=True, now=0) == "removed"
    ledger.settle(5)
    assert hidden(ledger) == {2}
    ledger.settle(1200 - 1)  # out of sight all the time
    assert hidden(ledger) == {2}
    ledger.settle(1200)
    assert hidden(ledger) == set()


@given(
    st.lists(st.tuples(st.floats(0, 100), st.floats(0, 3)), min_size=1, max_size=40),
    st.floats(-1e-4, 1e-4),
)
def test_a_camera_whose_clock_drifts_is_late_by_its_queue_alone(
    steps: list[tuple[float, float]], drift: float
) -> None:
    lateness, now, own = Lateness(), PACED_S, PACED_S
    for moment in (0.0, PACED_S):
        known = lateness.of(1e3 * moment, 10**18 + round(1e9 * moment), moment)
    assert known == 0
    for pause, queue in steps:
        now, own = now + pause, own + pause * (1 + drift)
        late = lateness.of(1e3 * own, 10**18 + round(1e9 * own), now + queue)
        assert queue - 1e-6 <= late + 3.1e-4 * now
        assert late <= queue + 1e-6 or late == inf
    # Lost and found again: nothing is known of how its clock relates to ours.
    assert lateness.of(0.0, 2 * 10**18, now + 500) == inf


@pytest.mark.parametrize("ppm", [-150, -50, 20, 50, 150])
def test_a_camera_whose_clock_is_quick_or_slow_is_on_time_all_day(ppm: float) -> None:
    lateness, late = Lateness(), []
    for number in range(2 * 3600 * 5):  # five frames a second, with up to 4 ms of jitter
        moment = number / 5
        own = moment * (1 + ppm * 1e-6)
        late.append(lateness.of(1e3 * own, round(1e9 * own), 50 + moment + number % 5 / 1000))
    assert max(late[3 * 5 :]) <= 0.005


@given(
    jump=st.floats(0.6, 10) | st.floats(-10, 0),
    queue=st.floats(0, 10),
    rate=st.floats(1.1, 30),
    began=st.booleans(),
)
def test_what_waits_while_a_clock_is_set_or_at_the_start_is_never_called_fresh(
    jump: float, queue: float, rate: float, began: bool
) -> None:
    """A queue of that many seconds empties at `rate` times the camera's pace."""
    lateness, late = Lateness(), inf
    emptied = queue * rate / (rate - 1)
    for number in range(-60 if began else 0, 900):
        taken = number / 30
        arrived = taken if number < 0 else max(taken, queue + taken / rate)
        stamp = taken + (jump if number > 0 else 0.0)
        late = lateness.of(1e3 * stamp, round(1e9 * stamp), arrived)
        assert arrived - taken <= late + 0.05
    assert late <= 0.1 or emptied > 28


def test_a_camera_that_was_lost_is_not_late_for_what_its_clock_shows_now() -> None:
    """It goes on, but 400 s further behind ours; that its stamps have another zero says so."""
    lateness = Lateness()
    for moment in (100, 101, 102):
        assert lateness.of(1e3 * moment, 10**9 * moment, moment) == (inf if moment < 101 else 0)
    found = [lateness.of(1e3 * own, 10**18 + 10**9 * own, own + 400) for own in (103, 104, 105)]
    assert found == [inf, 0, 0]


class Ageing(FakeClock):
    """A clock of a computer on which looking at it takes a millisecond."""

    def monotonic(self) -> float:
        self.now += 0.001
        return self.now


class LastMoment:
    """A session whose line may leave at this moment, and not after it."""

    ready, closing, terminators = True, False, b"\n"

    def handle(self, line: bytes, now: float) -> Outgoing | None:
        return Outgoing(b"targets\n", expires=now)

    def due(self, now: float) -> Outgoing | None:
        return None

    def refuse(self, refusal: Refusal, now: float) -> Outgoing:
        raise refusal

    def leave(self, reason: Ending) -> None:
        pass


def test_a_client_that_reads_is_not_cut_off_for_targets_that_age_while_they_are_sent() -> None:
    ours, theirs = socket.socketpair()
    with ours, theirs:
        ours.setblocking(False)
        theirs.sendall(b"ask\n")
        connection = Connection(ours, LastMoment(), 1, Limits(), lambda *_: None, Ageing())
        connection.serve()
        assert theirs.recv(100) == b"targets\n"
        assert not connection.gone


def test_what_was_put_off_is_accepted_only_where_it_is_seen() -> None:
    ledger = Ledger()
    assert ledger.apply("a", 1, "failed", 3600, visible=True, now=0) == "removed"
    with pytest.raises(Refusal, match="neither visible"):
        ledger.apply("a", 1, "accepted", 0, visible=False, now=1800)
    assert ledger.apply("a", 1, "accepted", 0, visible=True, now=1801) == "removed"
    assert ledger.apply("a", 1, "accepted", 0, visible=False, now=1802) == "removed"  # its own


def test_only_so_many_targets_are_held_at_once(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("mushpipe.robot.ledger.MOST_ENTRIES", 3)
    ledger = Ledger()
    for target, outcome in ((1, "accepted"), (2, "rejected"), (3, "accepted")):
        assert ledger.apply("a", target, outcome, 9, visible=True, now=0) == "removed"  # type: ignore[arg-type]
    with pytest.raises(Refusal) as caught:
        ledger.apply("b", 4, "accepted", 0, visible=True, now=0)
    assert caught.value.code == "busy"
    assert hidden(ledger) == {1, 2, 3}
    # neither what is held already nor what leaves the list counts as one more
    assert ledger.apply("a", 1, "accepted", 0, visible=True, now=0) == "removed"
    assert ledger.apply("b", 5, "done", 0, visible=True, now=0) == "removed"
    assert ledger.apply("a", 3, "failed", 0, visible=True, now=0) == "restored"
    assert ledger.apply("b", 4, "accepted", 0, visible=True, now=0) == "removed"


class Hasty(Hub):
    """A hub to which a result in another frame comes as soon as one was looked at."""

    def fresh(self, now: float, max_age_s: float) -> Result:
        result = super().fresh(now, max_age_s)
        self.publish(replace(choice(1), frame="robot_base"), 2, 0, now)
        return result


def test_what_is_sent_is_the_result_that_was_looked_at() -> None:
    clock = FakeClock()
    hub = Hasty(Settings(), clock)
    hub.publish(choice(), 1, 0, clock.now)
    session = JsonSession(hub, 1)
    session.handle(b'{"op":"hello","version":"1.0","mode":"stream"}', clock.now)
    asked = b'{"op":"get_targets","id":1,"frame":"%s"}' % FRAME.encode()
    answer = session.handle(asked, clock.now)
    assert answer is not None
    assert json.loads(answer.data)["frame"] == FRAME
    outgoing = iter(lambda: session.due(clock.now), None)
    lines = [json.loads(next(outgoing).data) for _ in range(4)]
    assert [line.get("seq") for line in lines if line["op"] == "targets"] == [2, 3]


def test_a_client_whose_name_another_took_says_nothing_more_in_that_name(
    caplog: pytest.LogCaptureFixture,
) -> None:
    """Its bye may wait for a kernel that takes no line, while lines of it are read."""
    clock = FakeClock()
    hub = Hub(Settings(), clock)
    hub.publish(choice(), 1, 0, clock.now)
    before, after = JsonSession(hub, 1), JsonSession(hub, 2)
    for session in (before, after):
        session.handle(b'{"op":"hello","version":"1.0","mode":"request","name":"r"}', clock.now)
    assert caplog.text.count("a robot calls itself 'r' as another connection does") == 1
    accept = b'{"op":"ack","id":1,"target":"m0","result":"accepted"}'
    assert before.handle(accept, clock.now) is None
    assert not hub.ledger.hides(0)
    assert after.handle(accept, clock.now) is not None
    assert hub.ledger.hides(0)
