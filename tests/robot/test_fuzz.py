"""Whatever bytes come, in whatever pieces: the server stays up, small, and true to its schema."""

from __future__ import annotations

import json
import tracemalloc
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from mushpipe.robot.abb import AbbSession
from mushpipe.robot.hub import Hub, Settings
from mushpipe.robot.session import JsonSession
from tests.robot.peer import CLIENT, Peer, read_line
from tests.robot.scene import FakeClock, bench, choice

SCALAR = st.one_of(
    st.none(), st.booleans(), st.integers(), st.floats(), st.text(max_size=70), st.just("m1")
)
FIELDS = {
    "op": ["hello", "get_targets", "ack", "ping", "heartbeat", "bye", "targets"],
    "id": [0, 1, "x"],
    "version": ["1.0", "1.9", "2.0"],
    "mode": ["request", "stream"],
    "target": ["m0", "m1", "m2", "m99"],
    "result": ["accepted", "rejected", "done", "failed"],
    "hold_ms": [0, 10, 1000],
    "max": [1, 2, 1000],
    "max_age_ms": [1, 100, 10_000],
    "frame": ["camera_color_optical_frame", "robot_base"],
    "name": ["a", "b"],
    "accept_replay": [True, False],
}
LIKELY = st.fixed_dictionaries(
    {"op": st.sampled_from(FIELDS["op"])},
    optional={
        name: st.one_of(st.sampled_from(values), st.sampled_from(values), SCALAR)  # type: ignore[arg-type]
        for name, values in FIELDS.items()
        if name != "op"
    },
)
JSON = st.recursive(
    SCALAR,
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(st.text(max_size=5), inner),
    max_leaves=5,
)
LINES = st.one_of(
    LIKELY.map(lambda m: json.dumps(m).encode()),
    JSON.map(lambda m: json.dumps(m).encode()),
    st.binary(max_size=50).map(lambda b: b.replace(b"\n", b"")),
)
HELLO = b'{"op":"hello","version":"1.0","mode":"stream"}'


def to_be_refused(line: bytes) -> bool:
    """Whether a line does not follow the client's schema, or is a second hello."""
    try:
        message = json.loads(line, parse_constant=lambda _: 1 / 0)
    except (ValueError, ZeroDivisionError, RecursionError):
        return True
    return not CLIENT.is_valid(message) or message["op"] == "hello"


def exchange(session: JsonSession, line: bytes, now: float) -> list[dict[str, Any]]:
    """Hand over a line as a connection does; return all that leaves, validated."""
    found = []
    while (outgoing := session.due(now)) is not None and not session.closing:
        found.append(read_line(outgoing.data))
    answer = session.handle(line, now)
    return found + ([read_line(answer.data)] if answer else [])


@given(lines=st.lists(st.tuples(LINES, st.floats(0, 2), st.booleans()), max_size=30))
@settings(max_examples=100, deadline=None)
def test_every_answer_is_valid_and_every_line_that_is_not_gets_an_error(
    lines: list[tuple[bytes, float, bool]],
) -> None:
    clock = FakeClock()
    hub = Hub(Settings(), clock)
    session = JsonSession(hub, 1)
    exchange(session, HELLO, clock.now)
    for line, pause, publish in lines:
        if session.closing or not line:
            continue
        if publish:
            hub.publish(choice(), 1, 0, clock.now)
        clock.now += pause
        hub.tick(clock.now)
        found = exchange(session, line, clock.now)
        codes = [m["code"] for m in found if m["op"] == "error"]
        refused = bool({"bad_json", "bad_request", "unknown_op"} & set(codes))
        assert refused == to_be_refused(line), (line, found)
        for message in found:
            if message["op"] == "targets":
                assert message["age_ms"] <= 500
                assert message["age_ms"] + message["valid_ms"] <= 501


@given(lines=st.lists(st.binary(max_size=60), max_size=20))
@settings(max_examples=100, deadline=None)
def test_every_line_for_abb_is_answered_by_one_short_line(lines: list[bytes]) -> None:
    clock = FakeClock()
    hub = Hub(Settings(), clock)
    hub.publish(choice(), 1, 0, clock.now)
    session = AbbSession(hub, 1)
    session.handle(b"HELLO,1", clock.now)
    for line in lines:
        answer = session.handle(line, clock.now)
        assert answer is not None
        assert len(answer.data) <= 80
        assert answer.data.endswith(b"\n")
        answer.data.decode("ascii")
        session.closing = False


def test_split_packets_and_random_bytes_on_a_socket() -> None:
    """One server for all examples: whatever one client did must not reach the next."""
    with bench() as b:
        b.publish()

        @given(
            data=st.lists(LINES, max_size=10).map(b"\n".join) | st.binary(max_size=300),
            cuts=st.lists(st.integers(1, 40), max_size=8),
            greeted=st.booleans(),
        )
        @settings(max_examples=80, deadline=None)
        def check(data: bytes, cuts: list[int], greeted: bool) -> None:
            with Peer(b.port) as peer:
                if greeted:
                    peer.greet()
                try:
                    for cut in cuts:
                        peer.raw(data[:cut])
                        data = data[cut:]
                    peer.raw(data + b"\n")
                    peer.sock.shutdown(1)
                except OSError:
                    pass  # it was cut off, which is an answer
                peer.rest()

        check()
        with Peer(b.port) as peer:
            peer.greet()
            assert peer.ask("get_targets", id=1)["op"] == "targets"


@given(cuts=st.lists(st.integers(1, 30), min_size=1, max_size=12))
@settings(max_examples=20, deadline=None)
def test_the_pieces_a_line_comes_in_make_no_difference(cuts: list[int]) -> None:
    text = b'{"op":"ping","id":1}\n{"op":"ping","id":2}\n{"op":"get_targets","id":3}\n'
    with bench() as b, Peer(b.port) as peer:
        b.publish()
        peer.greet()
        for cut in cuts:
            peer.raw(text[:cut])
            text = text[cut:]
        peer.raw(text)
        assert [peer.read()["id"] for _ in range(3)] == [1, 2, 3]


def flood(count: int) -> None:
    """Send bad lines of all kinds, reading the answers, and see that memory stays flat."""
    kinds = [b"x" * 200, b"{", b'{"op":1}', b'{"op":"ack","id":1}', b"\xff\x00", b'{"op":"ping"}']
    portion = b"\n".join(kinds * 10) + b"\n"
    with bench(watched=False) as b, Peer(b.port) as peer:
        peer.greet()

        def burst(lines: int) -> None:
            for _ in range(lines // 60):
                peer.raw(portion)
                for _ in range(60):
                    assert b'"op":"error"' in peer.reader.readline()

        burst(1200)
        tracemalloc.start()
        burst(600)
        before, _ = tracemalloc.get_traced_memory()
        burst(count)
        after, peak = tracemalloc.get_traced_memory()
        tracemalloc.stop()
        # The server may just be reading: two buffers of 64 KiB; a leak would grow with the lines.
        assert after - before < 200_000
        assert peak - before < 500_000
        assert peer.ask("ping", id=1)["op"] == "pong"


def test_bad_lines_cost_nothing() -> None:
    flood(3000)


@pytest.mark.slow
def test_a_hundred_thousand_bad_lines_cost_nothing() -> None:
    flood(100_020)
