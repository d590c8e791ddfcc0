"""The sink: what it refuses, and how ages count."""

from __future__ import annotations

import ssl
from collections.abc import Iterator
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from pydantic import ValidationError

from mushpipe import Header, RgbdFrame, RunInfo, Trace
from mushpipe.core import wire
from mushpipe.core.errors import UsageError
from mushpipe.robot.client import RobotClient
from mushpipe.robot.clock import STEP_S, Placer
from mushpipe.robot.hub import Hub, Settings
from mushpipe.robot.messages import Refusal
from mushpipe.sinks import robot_json
from mushpipe.sinks.robot_json import RobotJsonSink
from mushpipe.sources.realsense_frames import CLOCK_TOPIC, Domain, clock_of
from mushpipe.sources.realsense_frames import Clock as SensorClock
from tests.robot.peer import Peer
from tests.robot.scene import EPOCH_NS, FakeClock, choice, make_picks

LIVE = RunInfo("test", {}, live=True)


def frame_at(stamp_ns: int, arrival_ns: int = 0) -> RgbdFrame:
    header = Header(stamp_ns, 5, "camera_color_optical_frame", arrival_ns)
    return RgbdFrame(header, np.zeros((4, 4, 3), np.uint8))


NOW_NS = 10**15  # of the clock that tells when frames left their source


@pytest.fixture(autouse=True)
def still(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(robot_json.time, "perf_counter_ns", lambda: NOW_NS)


@pytest.fixture
def sink() -> Iterator[RobotJsonSink]:
    sink = RobotJsonSink(port=0)
    sink._clock = FakeClock()
    yield sink
    sink.close()


def port(sink: RobotJsonSink) -> int:
    assert sink._server
    return sink._server.ports[0]


def consume(sink: RobotJsonSink, stamp_ns: int, arrival_ns: int = 0, spent_s: float = 0) -> None:
    left_ns = NOW_NS - round(spent_s * 1e9)
    sink.consume(make_picks(), Trace(frame_at(stamp_ns, arrival_ns), {}, {}, left_ns))


def live_clock(sink: RobotJsonSink) -> FakeClock:
    """Open the sink for a live run, and return its clock."""
    sink.open(LIVE)
    clock = sink._clock
    assert isinstance(clock, FakeClock)
    return clock


def ages(sink: RobotJsonSink, *frame: Any) -> int | None:
    """Return the age in ms of a frame that was just consumed, None where it is unknown."""
    consume(sink, *frame)
    assert sink._server
    return sink._server.hub.age_ms(sink._clock.monotonic())


def test_the_last_word_of_a_run_is_what_robots_were_not_told_of(
    sink: RobotJsonSink, caplog: pytest.LogCaptureFixture
) -> None:
    sink.open(LIVE)
    picks = make_picks(3, source=[1, 2, 1])
    for _ in range(2):
        sink.consume(picks, Trace(frame_at(EPOCH_NS), {}, {}, NOW_NS))
    sink.close()
    sink.close()
    assert caplog.text.count("2 of 6 mushrooms in all frames were withheld from robots: 2") == 1


def test_a_recording_is_not_served_unless_the_graph_says_so(sink: RobotJsonSink) -> None:
    with pytest.raises(UsageError, match="replay: true"):
        sink.open(RunInfo("test", {}))


@pytest.mark.parametrize("second", ["robot-json", "mcap"])
def test_two_sinks_that_know_nothing_of_each_others_claims_say_so(
    sink: RobotJsonSink, caplog: pytest.LogCaptureFixture, second: str
) -> None:
    """Two robots would go for one mushroom, each with an `acked`."""
    sinks = {"left": {"use": "robot-json"}, "right": {"use": second}}
    sink.open(replace(LIVE, manifest={"graph": {"sinks": sinks}}))
    told = f"what robots at port {port(sink)} accept is offered at the graph's other sink"
    assert (told in caplog.text) == (second == "robot-json")


@pytest.mark.parametrize("address", ["0.0.0.0", "::", "192.0.2.1"])
def test_the_network_is_not_served_without_token_or_tls(address: str) -> None:
    with pytest.raises(UsageError, match="open to the network"):
        RobotJsonSink(port=0, bind=address).open(LIVE)


def test_settings_that_cannot_be_meant(tmp_path: Path) -> None:
    short = tmp_path / "token"
    short.write_text("short\n")
    cases = [
        ({"token_file": short}, "16 to 40 characters"),
        ({"token_file": tmp_path / "none"}, "cannot be read"),
        ({"tls_cert": short}, "TLS cannot be set up"),
    ]
    for chosen, text in cases:
        with pytest.raises(UsageError, match=text):
            RobotJsonSink.model_validate({"port": 0, **chosen}).open(LIVE)


@pytest.mark.parametrize(
    ("chosen", "text"),
    [
        ({"tls_client_ca": "ca.pem"}, "needs 'tls_cert'"),
        ({"bind": "localhost"}, "'localhost' is not an IP address; this computer is 127.0.0.1"),
        ({"port": 5005, "abb_port": 5005}, "port and abb_port are both 5005"),
    ],
)
def test_settings_that_contradict_each_other_are_refused_before_the_run(
    chosen: dict[str, Any], text: str
) -> None:
    with pytest.raises(ValidationError, match=text):
        RobotJsonSink.model_validate(chosen)


def test_with_a_token_and_tls_the_network_is_served(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, certificate: Path
) -> None:
    # Tests stay on loopback; it plays the network.
    monkeypatch.setattr(robot_json, "_is_loopback", lambda _: False)
    (tmp_path / "token").write_text("t" * 16 + "\n")
    trusting = ssl.create_default_context(cafile=certificate)
    with_token = {"token_file": tmp_path / "token"}
    with_tls = {"tls_cert": certificate}
    both_sides = {**with_tls, "tls_client_ca": certificate}
    for chosen in (with_token, with_tls, both_sides, with_token | both_sides):
        sink = RobotJsonSink.model_validate({"port": 0, **chosen})
        sink.open(LIVE)
        hello = {"token": "t" * 16} if "token_file" in chosen else {}
        context = trusting if "tls_cert" in chosen else None
        if context and "tls_client_ca" in chosen:
            with pytest.raises(OSError):  # noqa: PT011 - it has no certificate to show
                RobotClient(port=port(sink), tls=context, **hello)
            context.load_cert_chain(certificate)
        with RobotClient(port=port(sink), tls=context, **hello) as robot:
            assert robot.ask("ping")["op"] == "pong"
        trusting = ssl.create_default_context(cafile=certificate)
        sink.close()


@given(
    steps=st.lists(
        st.tuples(st.floats(0, 0.6), st.floats(-2, 2) | st.just(0), st.booleans()), max_size=25
    ),
    limit_ms=st.integers(1, 2000),
)
@settings(max_examples=100, deadline=None)
def test_however_the_wall_clock_jumps_nothing_too_old_is_fresh(
    steps: list[tuple[float, float, bool]], limit_ms: int
) -> None:
    """The safety rule itself, against the truth that only the test knows."""
    sink = RobotJsonSink(port=0, max_age_ms=limit_ms)
    sink._clock = clock = FakeClock()
    sink._live = True
    sink._placer = Placer(clock)
    hub = Hub(Settings(max_age_s=limit_ms / 1000), clock)
    taken = None
    for pause, jump, publish in steps:
        moment, stamp = clock.now, clock.wall_ns()
        clock.now += pause
        clock.offset_s += jump
        if publish:
            trace = Trace(frame_at(stamp, stamp), {}, {})
            hub.publish(choice(), 1, stamp, sink._taken(trace))
            taken = moment
        with suppress(Refusal):
            hub.fresh(clock.now, 1e9)
            assert taken is not None
            assert clock.now - taken <= limit_ms / 1000 + 2 * STEP_S


def test_a_port_that_is_taken(sink: RobotJsonSink) -> None:
    sink.open(LIVE)
    with pytest.raises(UsageError, match="cannot listen on"):
        RobotJsonSink(port=port(sink)).open(LIVE)


def test_an_age_counts_from_the_camera_on_the_monotonic_clock(sink: RobotJsonSink) -> None:
    clock = live_clock(sink)
    stamp = clock.wall_ns()
    clock.now += 0.1
    assert ages(sink, stamp, stamp + 30_000_000) == 100
    # The camera's clock is not the host's: the arrival counts, once it comes at its pace.
    assert ages(sink, 12345, stamp + 30_000_000) is None
    clock.now += 1
    stamp = clock.wall_ns() - 100_000_000
    assert ages(sink, 10**9 + 12345, stamp + 30_000_000) == pytest.approx(70, abs=1)
    # No stamp makes a frame younger than the time its stages took.
    assert ages(sink, clock.wall_ns(), clock.wall_ns(), 0.25) == 250
    # Set back by an hour while the frame was on its way.
    stamp = clock.wall_ns()
    clock.now += 0.2
    clock.offset_s -= 3600
    assert ages(sink, stamp, stamp) == pytest.approx(200, abs=1)
    assert ages(sink, clock.wall_ns() + 10**10) is None


def age_of(sink: RobotJsonSink, frame: RgbdFrame, attached: dict[str, Any]) -> int | None:
    """Return the age in ms of a frame with what its sensor said, as it has left its source."""
    sink.consume(make_picks(), Trace(replace(frame, attached=attached), {}, {}, NOW_NS))
    assert sink._server
    return sink._server.hub.age_ms(sink._clock.monotonic())


def sensor_at(stamp_ns: int, domain: Domain) -> dict[str, SensorClock]:
    return {CLOCK_TOPIC: SensorClock(np.zeros(1), np.array([stamp_ns / 1e6]), np.array([domain]))}


@pytest.mark.parametrize("domain", Domain)
def test_a_picture_that_waited_in_the_camera_is_old(
    sink: RobotJsonSink, domain: Domain, caplog: pytest.LogCaptureFixture
) -> None:
    clock = live_clock(sink)
    found = []
    late = "frames come later than the quickest did, by more than 'max_age_ms'"
    for waited in (0.0, 0.0, 0.1, 3.0):
        assert late not in caplog.text
        clock.now += 1
        stamp = clock.wall_ns()
        clock.now += waited
        attached = sensor_at(stamp - EPOCH_NS, domain)
        found.append(age_of(sink, frame_at(stamp, clock.wall_ns()), attached))
    assert found[1:] == pytest.approx([0, 100, 3000], abs=2)
    assert found[0] == (None if domain == Domain.HARDWARE else 0)
    # of other clocks their stamps tell it
    assert (late in caplog.text) == (domain == Domain.HARDWARE)


def test_the_cameras_clock_counts_at_the_other_end_of_a_stream(sink: RobotJsonSink) -> None:
    """Slow by a second against the host, which is less than what tells one clock from another."""
    clock = live_clock(sink)
    found = []
    for pause, slow, waited in (
        (1, 0.0, 0.0),
        (1, 0.0, 0.0),
        (5000, 0.5, 0.0),
        (5000, 1.0, 0.0),
        (1, 1.0, 0.3),
    ):
        clock.now += pause
        stamp = clock.wall_ns() - round(slow * 1e9)
        clock.now += waited
        header = frame_at(stamp, clock.wall_ns()).header
        (beside,) = sensor_at(stamp - EPOCH_NS, Domain.HARDWARE).values()
        (sent,) = wire.encoder_of(SensorClock)(beside, header)
        found.append(age_of(sink, frame_at(stamp, clock.wall_ns()), {CLOCK_TOPIC: sent}))
    assert found[0] is None  # nobody knows yet whether it waited
    assert found[1:] == pytest.approx([0, 0, 0, 300], abs=2)


@pytest.mark.parametrize("jump", [-8.0, -2.0, -0.3, 2.0])
def test_a_clock_that_is_set_makes_targets_old_for_seconds_alone(
    sink: RobotJsonSink, jump: float
) -> None:
    clock = live_clock(sink)
    own, ages_ms, first = 0.0, [], clock.wall_ns()
    for number in range(300):  # a minute
        clock.now += 0.2
        own += 0.2
        clock.offset_s = jump if number > 50 else 0.0
        stamp = first + round(own * 1e9)
        attached = sensor_at(round(own * 1e9), Domain.HARDWARE)
        ages_ms.append(age_of(sink, frame_at(stamp, clock.wall_ns()), attached))
    assert max(ages_ms[6:50] + ages_ms[120:]) <= 10


@pytest.mark.parametrize("off_s", [0.0, 3600.0])
def test_a_picture_of_a_camera_that_says_nothing_of_its_clock_is_old_where_it_waited(
    sink: RobotJsonSink, off_s: float
) -> None:
    clock = live_clock(sink)
    found, waits = [], (0.0, 0.0, 0.3, 1.9, 2.5, 6.0, 30.0, 61.0, 300.0)
    for waited in waits:
        clock.now += 10
        stamp = clock.wall_ns() - round(off_s * 1e9)
        clock.now += waited
        found.append(ages(sink, stamp, clock.wall_ns()))
    # against stamps, it may have drifted by 0.2 ms a second since the quickest one
    assert found[1:] == pytest.approx([1000 * waited for waited in waits[1:]], abs=100)
    assert found[0] == (None if off_s else 0)


@pytest.mark.parametrize("jump", [-30.0, 5.0, 30.0, 59.0, 3600.0])
def test_a_clock_that_is_set_costs_a_camera_with_a_clock_of_its_own_nothing(
    sink: RobotJsonSink, jump: float
) -> None:
    """Its stamps began near the host's and go on by themselves."""
    clock = live_clock(sink)
    stamp, found = clock.wall_ns(), []
    for number in range(300):
        clock.now += 0.2
        stamp += 200_000_000
        clock.offset_s = jump if number > 50 else 0.0
        found.append(ages(sink, stamp, clock.wall_ns()))
    assert max(found[:50] + found[250:]) <= 10


def test_what_a_frame_waits_in_a_stream_counts_once(sink: RobotJsonSink) -> None:
    """Between its arrival at the sender's host and this program."""
    clock = live_clock(sink)
    found = []
    for waited in (0.0, 0.0, 0.1, 0.3):
        clock.now += 1
        stamp = clock.wall_ns()
        clock.now += waited
        attached = sensor_at(stamp - EPOCH_NS, Domain.HARDWARE)
        found.append(age_of(sink, frame_at(stamp, stamp), attached))
    assert found[1:] == pytest.approx([0, 100, 300], abs=2)


@pytest.mark.parametrize("ahead_s", [0.0, 0.8, -0.3])
def test_a_queue_on_the_way_from_a_host_whose_clock_is_off_is_seen(
    sink: RobotJsonSink, ahead_s: float
) -> None:
    clock = live_clock(sink)
    clock.now += 10
    waits = [0.0] * 20 + [0.15 * k for k in range(12)]
    found = []
    for waited in waits:
        clock.now += 0.2
        stamp = clock.wall_ns() + round((ahead_s - waited) * 1e9)
        found.append(ages(sink, stamp, stamp))
    told = list(zip(found, waits, strict=True))[20:]
    assert all(age is None or age >= 1000 * waited - 25 for age, waited in told)


@pytest.mark.parametrize("data", [b"{", b"{}", b'{"number":[],"time_ms":[],"domain":[]}',
                                  b'{"number":[1],"time_ms":[null],"domain":[0]}'])  # fmt: skip
def test_a_clock_that_cannot_be_read_is_none(data: bytes) -> None:
    schema = wire.table_schema(SensorClock)
    frame = replace(frame_at(1), attached={CLOCK_TOPIC: wire.Message("", schema, data)})
    assert clock_of(frame) is None


def test_a_frame_whose_age_nobody_knows_is_stale(
    sink: RobotJsonSink, caplog: pytest.LogCaptureFixture
) -> None:
    sink.open(LIVE)
    with Peer(port(sink)) as peer:
        peer.greet()
        consume(sink, 12345)
        answer = peer.ask("get_targets", id=1)
        assert (answer["code"], answer["age_ms"]) == ("stale", None)
    assert "not of this host" in caplog.text


def test_a_chain_that_is_too_slow_says_why_robots_get_nothing(
    sink: RobotJsonSink, caplog: pytest.LogCaptureFixture
) -> None:
    clock = live_clock(sink)
    for spent in (0.7,) * 9 + (0.1,) + (0.7,) * 9:  # a moment, twice
        clock.now += 1
        consume(sink, clock.wall_ns() - round(spent * 1e9), clock.wall_ns(), spent)
    assert "robots get nothing" not in caplog.text
    for _ in range(5):
        clock.now += 1
        consume(sink, clock.wall_ns() - 7 * 10**8, clock.wall_ns(), 0.7)
    told = "results are 700 ms old when they come, 700 ms of it since they left the source"
    assert f"{told}, and 'max_age_ms' is 500" in caplog.text
    for spent in (0.1,) + (0.8,) * 10:  # the same trouble again
        clock.now += 1
        consume(sink, clock.wall_ns() - round(spent * 1e9), clock.wall_ns(), spent)
    assert caplog.text.count("robots get nothing") == 1


def test_frames_that_come_late_are_not_said_to_wait_for_the_stages(
    sink: RobotJsonSink, caplog: pytest.LogCaptureFixture
) -> None:
    """Of a stream over a slow link, say."""
    clock = live_clock(sink)
    for _ in range(10):
        clock.now += 1
        consume(sink, clock.wall_ns() - 16 * 10**8, clock.wall_ns(), 0.13)
    assert "1600 ms old when they come, 130 ms of it since they left the source" in caplog.text


def test_the_latency_of_the_sensor_is_added() -> None:
    sink = RobotJsonSink(port=0, sensor_latency_ms=40)
    sink._clock = clock = FakeClock()
    sink.open(LIVE)
    stamp = clock.wall_ns()
    clock.now += 0.1
    assert ages(sink, stamp, stamp) == 140
    sink.close()


def test_a_recording_ages_from_the_moment_it_is_played() -> None:
    sink = RobotJsonSink(port=0, replay=True)
    sink._clock = FakeClock()
    sink.open(RunInfo("test", {}))
    assert ages(sink, 12345, 12345, 0.02) == 20
    with Peer(port(sink)) as peer:
        peer.greet(accept_replay=True)
        answer = peer.ask("get_targets", id=1)
        assert (answer["replay"], answer["stamp"]) == (True, {"sec": 0, "nsec": 12345})
    sink.close()


def test_a_live_source_is_live_even_where_recordings_are_permitted() -> None:
    sink = RobotJsonSink(port=0, replay=True)
    sink.open(LIVE)
    with Peer(port(sink)) as peer:
        assert not peer.greet()["replay"]
    sink.close()


def test_two_jumps_between_two_looks_make_nothing_younger() -> None:
    clock = FakeClock()
    placer = Placer(clock)
    moment = clock.now
    clock.offset_s += 1.0
    stamp = clock.wall_ns()
    clock.now += 0.375
    clock.offset_s -= 0.375
    placed = placer.place(stamp)
    assert placed is None or placed <= moment
