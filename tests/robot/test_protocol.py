"""The conversation, by an independent client; every line is checked against the schemas."""

from __future__ import annotations

import json

import pytest

from tests.robot.peer import CLIENT, Peer, read_line
from tests.robot.scene import FRAME, bench, choice


def test_a_conversation() -> None:
    with bench() as b, Peer(b.port) as peer:
        b.publish()
        hello = peer.greet()
        assert hello["max_age_ms"] == 500
        b.advance(0.1)
        answer = peer.ask("get_targets", id=7, max=2)
        assert answer["op"] == "targets"
        assert [t["id"] for t in answer["targets"]] == ["m0", "m1"]
        assert answer["more"]
        assert answer["frame"] == FRAME
        assert (answer["age_ms"], answer["valid_ms"]) == (100, 400)
        assert answer["stamp"] == {"sec": 1_800_001_000, "nsec": 0}
        assert not answer["replay"]
        assert peer.ask("ping", id="p")["op"] == "pong"
        peer.say("bye")
        assert peer.wait("bye")["reason"] == "client"
        assert peer.rest() == []


def test_answers_in_the_order_of_the_requests() -> None:
    with bench() as b, Peer(b.port) as peer:
        b.publish()
        peer.greet()
        for i in range(50):
            peer.say("ping" if i % 2 else "get_targets", id=i)
        got = [peer.read() for _ in range(50)]
        assert [m["id"] for m in got] == list(range(50))


def test_numbers_of_a_controller_that_knows_only_floats() -> None:
    with bench() as b, Peer(b.port) as peer:
        b.publish()
        peer.greet()
        answer = peer.ask("get_targets", id=7.0, max=1.0)
        assert answer["count"] == 1


def test_an_empty_bed_is_an_empty_list() -> None:
    with bench() as b, Peer(b.port) as peer:
        b.publish(choice(0))
        peer.greet()
        assert peer.targets() == []


def test_nothing_old_is_sent() -> None:
    with bench(max_age_s=0.5) as b, Peer(b.port) as peer:
        peer.greet()
        answer = peer.ask("get_targets", id=1)
        assert (answer["code"], answer["age_ms"], answer["state"]) == ("stale", None, "no_camera")
        b.publish()
        b.advance(0.5)
        assert peer.targets() == ["m0", "m1", "m2"]
        assert peer.ask("get_targets", id=2, max_age_ms=499)["code"] == "stale"
        b.advance(0.002)
        answer = peer.ask("get_targets", id=3, max_age_ms=60_000)
        assert (answer["code"], answer["age_ms"]) == ("stale", 502)
        assert not answer["fatal"]


def test_another_frame_than_the_one_expected_is_refused() -> None:
    with bench() as b, Peer(b.port) as peer:
        b.publish()
        peer.greet()
        assert peer.ask("get_targets", id=1, frame="robot_base")["code"] == "unknown_frame"
        assert peer.ask("get_targets", id=2, frame=FRAME)["op"] == "targets"


def test_a_stream_sends_each_new_result_and_nothing_else() -> None:
    with bench() as b, Peer(b.port) as peer:
        b.publish()
        peer.greet("stream")
        for seq in (1, 2, 3):
            message = peer.wait("targets")
            assert (message["seq"], message["id"]) == (seq, None)
            b.publish()
        assert peer.ask("get_targets", id=1)["seq"] == 4


def test_results_that_grew_old_unsent_are_not_streamed() -> None:
    with bench() as b, Peer(b.port) as peer:
        peer.greet("stream")
        b.hub.publish(choice(), 1, 0, b.clock.now - 9)
        b.server.wake()
        # The state changes with the result, and the heartbeat is all that comes of it.
        assert peer.read()["op"] == "heartbeat"
        assert peer.ask("ping", id=1)["op"] == "pong"


def test_a_heartbeat_each_second_and_at_once_when_the_state_changes() -> None:
    with bench() as b, Peer(b.port) as peer:
        b.publish()
        peer.greet()
        for _ in range(5):
            b.clock.now += 1.0
            b.publish()
            assert peer.read()["state"] == "running"
        b.advance(0.5)
        b.frames[0] += 1
        assert peer.ask("ping", id=1)["op"] == "pong"  # by now the server has seen that frame
        b.advance(0.51)
        assert peer.read()["state"] == "stalled"
        b.advance(0.99)  # less than two seconds after the last result
        beat = peer.read()
        assert (beat["state"], beat["age_ms"]) == ("no_camera", 2000)
        b.publish()
        assert peer.read()["state"] == "running"


def test_missed_heartbeats_are_not_made_up_for() -> None:
    with bench() as b, Peer(b.port) as peer:
        b.publish()
        peer.greet()
        b.advance(9)
        assert peer.read()["op"] == "heartbeat"
        assert peer.ask("ping", id=1)["op"] == "pong"


def test_acknowledgements_remove_and_restore() -> None:
    with bench() as b, Peer(b.port) as peer:
        b.publish()
        peer.greet()
        for result, effect, left in (
            ("accepted", "removed", ["m1", "m2"]),
            ("failed", "restored", ["m0", "m1", "m2"]),
            ("accepted", "removed", ["m1", "m2"]),
            ("rejected", "restored", ["m0", "m1", "m2"]),
            ("accepted", "removed", ["m1", "m2"]),
            ("done", "removed", ["m1", "m2"]),
        ):
            answer = peer.ask("ack", id=1, target="m0", result=result)
            assert (answer["op"], answer["effect"]) == ("acked", effect)
            assert peer.targets() == left
        b.publish()
        assert peer.targets() == ["m1", "m2"]
        assert peer.ask("get_targets", id=2)["withheld"]["claimed"] == 1
        peer.ask("ack", id=3, target="m1", result="rejected", hold_ms=300)
        assert peer.targets() == ["m2"]
        b.advance(0.3)
        assert peer.targets() == ["m1", "m2"]
        assert peer.ask("ack", id=4, target="m77", result="accepted")["code"] == "unknown_target"


def test_a_picked_target_is_done_even_when_it_is_gone_from_sight() -> None:
    with bench() as b, Peer(b.port) as peer:
        b.publish()
        peer.greet()
        peer.ask("ack", id=1, target="m0", result="accepted")
        b.publish(choice(0))
        assert peer.ask("ack", id=2, target="m0", result="done")["op"] == "acked"


def test_what_is_done_is_removed_for_good_whatever_is_said_later() -> None:
    with bench(claim_s=5) as b, Peer(b.port) as peer:
        b.publish()
        peer.greet()
        for number, result in enumerate(("done", "failed", "done")):
            answer = peer.ask("ack", id=number, target="m0", result=result)
            assert answer["effect"] == "removed"
        again = peer.ask("ack", id=3, target="m0", result="accepted")
        assert (again["code"], again["message"]) == ("unknown_target", "m0 is done")
        b.advance(6)
        b.publish()
        assert peer.targets() == ["m1", "m2"]


def test_where_only_some_may_be_sent_the_next_ones_follow_those_that_are_claimed() -> None:
    with bench(max_targets=2) as b, Peer(b.port) as peer:
        b.publish()
        peer.greet()
        answer = peer.ask("get_targets", id=1)
        assert [target["id"] for target in answer["targets"]] == ["m0", "m1"]
        assert (answer["withheld"]["limit"], answer["more"]) == (1, False)
        peer.ask("ack", id=2, target="m0", result="accepted")
        answer = peer.ask("get_targets", id=3)
        assert [target["id"] for target in answer["targets"]] == ["m1", "m2"]
        assert (answer["withheld"]["claimed"], answer["withheld"]["limit"]) == (1, 0)


def test_two_robots_never_hold_one_target() -> None:
    with bench() as b, Peer(b.port) as one, Peer(b.port) as two:
        b.publish()
        one.greet(name="left")
        two.greet("stream")
        assert two.wait("targets")["count"] == 3
        assert one.ask("ack", id=1, target="m0", result="accepted")["op"] == "acked"
        for result in ("accepted", "done", "failed"):
            answer = two.ask("ack", id=2, target="m0", result=result)
            assert (answer["code"], answer["target"]) == ("conflict", "m0")
        b.publish()
        assert [t["id"] for t in two.wait("targets")["targets"]] == ["m1", "m2"]
        # The connection is gone, the arm may not be: the target stays the robot's own.
        with Peer(b.port) as again:
            again.greet(name="left")
            assert one.wait("bye")["reason"] == "replaced"
            assert again.targets() == ["m1", "m2"]
            assert again.ask("ack", id=1, target="m0", result="failed")["effect"] == "restored"
            assert again.targets() == ["m0", "m1", "m2"]


@pytest.mark.parametrize(
    ("line", "code", "identity"),
    [
        (b"{", "bad_json", None),
        (b"\xff\xfe", "bad_json", None),
        (b"[1]", "bad_json", None),
        (b'{"op":"get_targets","id":1,"max":NaN}', "bad_json", None),
        (b'{"id":5}', "unknown_op", 5),
        (b'{"op":["hello"],"id":"x"}', "unknown_op", "x"),
        (b'{"op":"get_targets"}', "bad_request", None),
        (b'{"op":"get_targets","id":true}', "bad_request", None),
        (b'{"op":"get_targets","id":6,"max":0}', "bad_request", 6),
        (b'{"op":"get_targets","id":6,"max_age_ms":"1"}', "bad_request", 6),
        (b'{"op":"get_targets","id":99999999999999999999}', "bad_request", None),
        (b'{"op":"ack","id":6,"target":"m-1","result":"done"}', "bad_request", 6),
        (b'{"op":"ack","id":6,"target":"m1","result":"eaten"}', "bad_request", 6),
        (b'{"op":"hello","version":"1.0","mode":"request"}', "bad_request", None),
        (b"[" * 20000, "bad_json", None),
    ],
)
def test_a_bad_line_is_answered_and_costs_nothing(line: bytes, code: str, identity: object) -> None:
    with bench() as b, Peer(b.port) as peer:
        b.publish()
        peer.greet()
        peer.raw(line + b"\n")
        answer = peer.wait("error")
        assert (answer["code"], answer["id"], answer["fatal"]) == (code, identity, False)
        assert peer.targets() == ["m0", "m1", "m2"]


@pytest.mark.parametrize(
    ("hello", "code"),
    [
        ({"op": "hello", "version": "2.0", "mode": "request"}, "unsupported_version"),
        ({"op": "hello", "version": "1.0"}, "hello_expected"),
        ({"op": "hello", "version": "1.0", "mode": "request", "name": "a b"}, "hello_expected"),
        ({"op": "get_targets", "id": 1}, "hello_expected"),
        ({"op": "get_targets", "id": "a", "max": 0}, "hello_expected"),
        ("nonsense", "hello_expected"),
    ],
)
def test_a_wrong_beginning_ends_the_connection(hello: object, code: str) -> None:
    with bench() as b, Peer(b.port) as peer:
        b.publish()
        peer.read()
        peer.raw(json.dumps(hello).encode() + b"\n")
        (error,) = peer.rest()
        assert (error["code"], error["fatal"]) == (code, True)
        assert error["id"] == (hello.get("id") if isinstance(hello, dict) else None)


def test_a_newer_minor_version_and_unknown_fields_are_welcome() -> None:
    with bench() as b, Peer(b.port) as peer:
        b.publish()
        peer.read()
        peer.say("hello", version="1.7", mode="request", colour="blue")
        assert peer.read()["op"] == "heartbeat"
        assert peer.ask("get_targets", id=1, colour="blue")["op"] == "targets"


def test_carriage_returns_and_empty_lines_are_understood() -> None:
    with bench() as b, Peer(b.port) as peer:
        peer.greet()
        peer.raw(b'\r\n\n{"op":"ping","id":1}\r\n')
        assert peer.read()["op"] == "pong"


def test_a_recording_is_served_only_to_who_asks_for_one() -> None:
    with bench(replay=True) as b:
        b.publish()
        with Peer(b.port) as peer:
            assert peer.read()["replay"]
            peer.say("hello", version="1.0", mode="stream")
            (error,) = peer.rest()
            assert (error["code"], error["replay"]) == ("replay_refused", True)
        with Peer(b.port) as peer:
            assert peer.greet("stream", accept_replay=True)["replay"]
            assert peer.wait("targets")["replay"]
            assert peer.ask("ping", id=1)["replay"]


def test_a_token_is_asked_for() -> None:
    token = "correct-horse-battery"
    with bench(token=token) as b:
        for wrong in ("", "correct-horse-batterx", "ü"):
            with Peer(b.port) as peer:
                assert peer.read()["auth"] == "token"
                peer.say("hello", version="1.0", mode="request", token=wrong)
                assert [m["code"] for m in peer.rest()] == ["unauthorised"]
        with Peer(b.port) as peer:
            peer.greet(token=token)


def test_the_server_says_goodbye() -> None:
    with bench() as b, Peer(b.port) as peer:
        b.publish()
        peer.greet()
        b.server.stop("no_camera")
        states = [(m["op"], m.get("reason")) for m in peer.rest()]
        assert states == [("bye", "no_camera")]


def test_the_schemas_speak_of_every_message_and_of_no_other() -> None:
    assert set(CLIENT.schema["$defs"]) == {
        "hello",
        "get_targets",
        "ack",
        "ping",
        "heartbeat",
        "bye",
    }
    with pytest.raises(Exception, match="not valid"):
        read_line(b'{"op":"targets","id":1}\n')
