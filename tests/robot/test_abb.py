"""The line protocol, as docs/robot.md has it."""

from __future__ import annotations

import socket
from collections.abc import Iterator
from contextlib import contextmanager

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from mushpipe import PickFlag
from mushpipe.robot.abb import LONGEST, target_line
from mushpipe.robot.targets import Target
from tests.robot.peer import Peer
from tests.robot.scene import Bench, bench, choice

NAN = float("nan")


class Arm:
    """A controller: a string out, a string in."""

    def __init__(self, sock: socket.socket) -> None:
        self.sock = sock
        self.reader = sock.makefile("rb")

    def ask(self, text: str, end: str = "\n") -> str:
        self.sock.sendall((text + end).encode())
        answer = self.reader.readline()
        assert len(answer) <= 80
        return answer.decode("ascii").removesuffix("\n")


@contextmanager
def arm(b: Bench, hello: str | None = "HELLO,1") -> Iterator[Arm]:
    with socket.create_connection(("127.0.0.1", b.server.ports[1]), 20) as sock:
        found = Arm(sock)
        if hello:
            assert found.ask(hello).startswith("HELLO,1,")
        yield found
        found.reader.close()


def test_a_conversation() -> None:
    with bench() as b, arm(b) as robot:
        b.publish()
        b.advance(0.063)
        assert robot.ask("NEXT") == "T,0,0.0,0.0,500.0,0.0000,1.0000,0.0000,0.0000,40.0,0,63"
        assert robot.ask("ACK,0,ACCEPTED") == "A,0,REMOVED"
        assert robot.ask("NEXT,200").startswith("T,1,1.0,")
        assert robot.ask("ACK,0,DONE") == "A,0,REMOVED"
        assert robot.ask("ACK,1,REJECTED") == "A,1,RESTORED"
        assert robot.ask("ACK,9,DONE") == "E,UNKNOWN_TARGET"
        assert robot.ask("STATE") == "S,RUNNING,1,LIVE"
        assert robot.ask("PING") == "PONG"
        b.publish(choice(0))
        assert robot.ask("NEXT") == "NONE,0"
        assert robot.ask("BYE") == "BYE"
        assert robot.ask("PING") == ""


def test_nothing_old_is_sent_and_the_state_is_told() -> None:
    with bench() as b, arm(b) as robot:
        assert robot.ask("NEXT") == "E,STALE,NO_CAMERA"
        b.publish()
        b.advance(0.3)
        assert robot.ask("NEXT,200") == "E,STALE,RUNNING"
        assert robot.ask("NEXT,99999") != "E,STALE,RUNNING"
        b.advance(0.3)
        assert robot.ask("NEXT,99999") == "E,STALE,RUNNING"
        b.advance(1)
        assert robot.ask("STATE") == "S,NO_CAMERA,1,LIVE"


@pytest.mark.parametrize("end", ["\r", "\r\n", "\n"])
def test_line_ends(end: str) -> None:
    with bench() as b, arm(b) as robot:
        assert robot.ask("PING", end) == "PONG"
        assert robot.ask("STATE", end) == "S,NO_CAMERA,0,LIVE"


@pytest.mark.parametrize(
    ("line", "answer"),
    [
        ("NEXT,-1", "E,BAD_REQUEST"),
        ("NEXT,1e9", "E,BAD_REQUEST"),
        ("NEXT,²", "E,BAD_REQUEST"),
        ("ACK,1", "E,UNKNOWN_OP"),
        ("ACK,x,DONE", "E,BAD_REQUEST"),
        ("ACK,1,EATEN", "E,UNKNOWN_OP"),
        ("{}", "E,UNKNOWN_OP"),
    ],
)
def test_what_is_not_understood_costs_nothing(line: str, answer: str) -> None:
    with bench() as b, arm(b) as robot:
        assert robot.ask(line) == answer
        assert robot.ask("PING") == "PONG"


@pytest.mark.parametrize(
    ("settings", "hello", "answer"),
    [
        ({}, "HELLO,2", "E,UNSUPPORTED_VERSION"),
        ({}, "NEXT", "E,HELLO_EXPECTED"),
        ({}, "HELLO,1,NAME=a b", "E,BAD_REQUEST"),
        ({"replay": True}, "HELLO,1", "E,REPLAY_REFUSED"),
        ({"replay": True}, "HELLO,1,REPLAY", "HELLO,1,REPLAY,{session}"),
        ({"token": "x" * 16}, "HELLO,1", "E,UNAUTHORISED"),
        ({"token": "x" * 16}, "HELLO,1,TOKEN=" + "x" * 16, "HELLO,1,LIVE,{session}"),
    ],
)
def test_beginnings(settings: dict[str, object], hello: str, answer: str) -> None:
    with bench(**settings) as b, arm(b, None) as robot:
        assert robot.ask(hello) == answer.format(session=b.hub.session[:8])
        assert (robot.ask("PING") == "PONG") == answer.startswith("HELLO")


def test_a_server_that_was_restarted_greets_with_another_session() -> None:
    def greeting(b: Bench) -> str:
        with arm(b, None) as robot:
            return robot.ask("HELLO,1,NAME=irb")

    with bench() as b, bench() as restarted:
        assert greeting(b) == greeting(b)
        assert greeting(restarted) != greeting(b)


def test_a_target_can_be_kept_away_for_a_while() -> None:
    with bench() as b, arm(b) as robot:
        b.publish()
        assert robot.ask("ACK,0,REJECTED,700") == "A,0,REMOVED"
        assert robot.ask("NEXT").startswith("T,1,")
        assert robot.ask("ACK,1,FAILED,3600001") == "E,BAD_REQUEST"
        b.advance(0.7)
        b.publish()
        assert robot.ask("NEXT").startswith("T,0,")


def test_two_robots_of_one_name_are_never_served_at_once() -> None:
    with bench() as b, arm(b, "HELLO,1,NAME=irb") as one, arm(b, "HELLO,1,NAME=irb") as two:
        b.publish()
        assert two.ask("NEXT").startswith("T,0,")
        assert one.reader.readline() == b""
        assert two.ask("ACK,0,ACCEPTED") == "A,0,REMOVED"


def test_a_target_that_may_be_gone_cannot_be_accepted_any_more() -> None:
    with bench(max_age_s=0.5) as b, arm(b) as robot:
        b.publish()
        assert robot.ask("NEXT").startswith("T,0,")
        assert robot.ask("ACK,1,ACCEPTED") == "A,1,REMOVED"
        b.advance(0.6)
        assert robot.ask("ACK,0,ACCEPTED").startswith("E,STALE,")
        assert robot.ask("ACK,1,ACCEPTED") == "A,1,REMOVED"  # it has this one already
        assert robot.ask("ACK,1,DONE") == "A,1,REMOVED"
        assert robot.ask("ACK,2,DONE") == "A,2,REMOVED"  # what was picked is told at any time


def test_it_shares_its_targets_with_json() -> None:
    with bench() as b, arm(b, "HELLO,1,NAME=irb") as robot, Peer(b.port) as peer:
        b.publish()
        peer.greet()
        assert robot.ask("ACK,0,ACCEPTED") == "A,0,REMOVED"
        assert peer.targets() == ["m1", "m2"]
        assert peer.ask("ack", id=1, target="m0", result="done")["code"] == "conflict"
        assert robot.ask("ACK,0,FAILED") == "A,0,RESTORED"


def test_what_is_unknown_is_zero_and_flagged() -> None:
    with bench() as b, arm(b) as robot:
        flags = [PickFlag.POSE_UNKNOWN]
        b.publish(choice(1, quaternion=[[NAN] * 4], axis=[[NAN] * 3], diameter=[NAN], flags=flags))
        assert robot.ask("NEXT") == "T,0,0.0,0.0,500.0,0.0000,0.0000,0.0000,0.0000,0.0,4,0"


@given(
    place=st.tuples(*[st.floats(-100, 100)] * 3),
    turn=st.tuples(*[st.floats(-1, 1)] * 4),
    size=st.floats(0, 100),
    number=st.integers(0, 2**62),
    flags=st.integers(0, 15),
    age=st.integers(0, 10_000),
)
def test_no_line_is_too_long(
    place: tuple[float, ...],
    turn: tuple[float, ...],
    size: float,
    number: int,
    flags: int,
    age: int,
) -> None:
    line = target_line(Target(number, b"", (*place, *turn, size), flags), age)
    if line is None:
        assert number > 9999 or np.abs(place).max() >= 9.9995 or size >= 0.9995
    else:
        assert len(line) <= LONGEST


def test_who_says_nothing_for_too_long_hears_nothing_that_could_pass_for_an_answer() -> None:
    with bench() as b, arm(b, "HELLO,1,NAME=irb") as robot:
        b.publish()
        assert robot.ask("ACK,0,ACCEPTED") == "A,0,REMOVED"
        b.advance(10.1)
        assert robot.reader.read() == b""
        with arm(b, "HELLO,1,NAME=irb") as again:
            assert again.ask("ACK,0,DONE") == "A,0,REMOVED"
