"""Slow, stuck, dead and hostile clients: each costs itself, and nobody else."""

from __future__ import annotations

import errno
import json
import socket
import ssl
import struct
import time
from contextlib import suppress
from itertools import pairwise
from pathlib import Path
from typing import Any

import pytest

from mushpipe.robot.connection import Limits
from mushpipe.robot.hub import Hub, Settings
from mushpipe.robot.messages import MAX_LINE
from mushpipe.robot.server import THROTTLED_S, Listener, Options, RobotServer
from mushpipe.robot.session import JsonSession
from tests.robot.peer import Peer, read_line
from tests.robot.scene import FakeClock, bench, choice

BIG = choice(200)
MANY = Limits(lines_per_s=1e9)


def fill(sock: socket.socket, data: bytes) -> None:
    """Write until the server, which takes no more questions than it gives answers, pushes back."""
    sock.setblocking(False)
    with suppress(BlockingIOError):
        while True:
            sock.send(data)


def test_a_stuck_client_slows_nobody_and_is_cut_off_before_its_targets_are_old() -> None:
    with bench() as b, Peer(b.port, receive_buffer=4096) as stuck, Peer(b.port) as healthy:
        stuck.greet("stream")
        healthy.greet("stream")
        for seq in range(1, 61):
            b.publish(BIG)
            assert healthy.skim() == seq
        b.advance(0.51)
        assert b.until("event", b"disconnected") == (
            b"disconnected: too slow: its targets grew old on their way"
        )
        b.publish(BIG)
        assert healthy.wait("targets")["seq"] == 61


# Short lines would all 200 come where they wait in the server's kernel.
@pytest.mark.parametrize(("targets", "results"), [(200, 60), (2, 200)])
def test_a_slow_client_gets_fewer_and_newer_results(targets: int, results: int) -> None:
    found = choice(targets)
    with bench() as b, Peer(b.port, receive_buffer=4096) as slow, Peer(b.port) as healthy:
        slow.greet("stream")
        healthy.greet("stream")
        for _ in range(results):
            b.publish(found)
            healthy.skim()
        seqs = [slow.skim()]
        while seqs[-1] < results:
            seqs.append(slow.skim())
        assert seqs == sorted(set(seqs))
        assert len(seqs) < 30


def test_a_client_that_asks_and_never_reads_is_not_kept() -> None:
    with bench() as b, Peer(b.port, receive_buffer=4096) as dead, Peer(b.port) as healthy:
        b.publish(BIG)
        dead.greet()
        healthy.greet()
        fill(dead.sock, b'{"op":"get_targets","id":1}\n' * 1000)
        assert healthy.ask("ping", id=1)["op"] == "pong"
        assert b"too slow" in b.advance_until_disconnected(0.6)
        assert healthy.ask("ping", id=2)["op"] == "pong"


def test_a_client_that_floods_bad_lines_and_never_reads_is_not_kept() -> None:
    with bench(MANY) as b, Peer(b.port, receive_buffer=4096) as dead:
        dead.greet()
        fill(dead.sock, b"x\n" * 10_000)
        assert b"it does not read" in b.advance_until_disconnected(2.1)


def test_a_server_that_never_served_gives_its_port_back() -> None:
    hub = Hub(Settings(), FakeClock())
    options = Options([Listener("127.0.0.1", 0, JsonSession)])
    server = RobotServer(hub, options, lambda *_: None)
    server.stop()
    with pytest.raises(ConnectionRefusedError):
        socket.create_connection(("127.0.0.1", server.ports[0]))


def test_nothing_waits_for_an_absent_robot() -> None:
    with bench() as b:
        for _ in range(5):
            b.publish()
        with Peer(b.port) as peer:
            peer.greet("stream")
            assert peer.wait("targets")["seq"] == 5
            assert peer.ask("ping", id=1)["op"] == "pong"


def test_a_reset_in_the_middle_of_a_line() -> None:
    with bench() as b, Peer(b.port) as healthy:
        healthy.greet("stream")
        rude = socket.create_connection(("127.0.0.1", b.port))
        rude.sendall(b'{"op":"hel')
        rude.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, struct.pack("ii", 1, 0))
        rude.close()
        b.until("event", b"disconnected: lost")
        b.publish()
        assert healthy.wait("targets")["seq"] == 1


def test_a_half_closed_client_gets_its_answers() -> None:
    with bench() as b, Peer(b.port) as peer:
        b.publish()
        peer.greet()
        peer.say("get_targets", id=1)
        peer.say("ping", id=2)
        peer.sock.shutdown(socket.SHUT_WR)
        assert [m["op"] for m in peer.rest()] == ["targets", "pong"]


def test_a_half_closed_client_that_said_too_much_at_once_gets_all_its_answers() -> None:
    with bench(Limits(lines_per_s=10)) as b, Peer(b.port) as peer:
        peer.greet()
        for i in range(15):
            peer.say("ping", id=i)
        peer.sock.shutdown(socket.SHUT_WR)
        for i in range(9):  # one was the hello
            assert peer.read()["id"] == i
        b.advance(1.0)
        assert [m["id"] for m in peer.rest() if m["op"] == "pong"] == list(range(9, 15))


def test_a_line_that_never_ends() -> None:
    with bench() as b, Peer(b.port) as loris, Peer(b.port) as healthy:
        loris.greet()
        healthy.greet()
        loris.raw(b'{"op":"ping","id":1}\n{"op":"pi')
        assert loris.read()["op"] == "pong"
        for _ in range(6):  # a byte now and then does not help
            b.advance(0.9)
            assert healthy.ask("ping", id=1)["op"] == "pong"
            loris.raw(b"x")
        assert loris.wait("error")["code"] == "timeout"
        assert loris.rest() == []


def test_no_hello() -> None:
    with bench() as b, Peer(b.port) as peer:
        peer.read()
        b.advance(5.1)
        assert [(m["code"], m["fatal"]) for m in peer.rest()] == [("timeout", True)]


def test_silence() -> None:
    with bench() as b, Peer(b.port) as peer, Peer(b.port) as alive:
        peer.greet()
        alive.greet("stream")
        b.advance(9)
        alive.say("heartbeat")
        assert alive.ask("ping", id=1)["op"] == "pong"
        b.advance(1.1)
        assert [m["op"] for m in peer.rest()] == ["heartbeat", "heartbeat", "error"]
        assert alive.ask("ping", id=2)["op"] == "pong"


@pytest.mark.parametrize("end", [b"", b"\n"])
def test_a_line_that_is_too_long(end: bytes) -> None:
    with bench() as b, Peer(b.port) as peer:
        peer.greet()
        peer.raw(b"x" * (MAX_LINE + 1) + end)
        assert [m["code"] for m in peer.rest()] == ["line_too_long"]


def test_the_longest_line_is_taken() -> None:
    with bench() as b, Peer(b.port) as peer:
        peer.greet()
        line = b'{"op":"ping","id":1}'
        peer.raw(line + b" " * (MAX_LINE - len(line)) + b"\n")
        assert peer.read()["op"] == "pong"


def test_too_many_clients() -> None:
    with bench(max_clients=2) as b, Peer(b.port) as one:
        one.greet()
        with Peer(b.port) as two:
            two.greet()
            with Peer(b.port) as three:
                assert [m["code"] for m in three.rest()] == ["too_many_clients"]
        b.until("event", b"disconnected: the client closed")
        with Peer(b.port) as again:
            again.greet()


def test_who_says_nothing_keeps_nobody_out() -> None:
    with bench(max_clients=2) as b, Peer(b.port) as one, Peer(b.port) as silent:
        one.greet()
        b.advance(1.5)
        with Peer(b.port) as two:
            two.greet()
            assert silent.rest()[-1]["code"] == "too_many_clients"
            assert one.ask("ping", id=1)["op"] == "pong"


def test_a_client_that_talks_too_fast_waits_and_nobody_else() -> None:
    with bench(Limits(lines_per_s=10)) as b, Peer(b.port) as fast, Peer(b.port) as calm:
        fast.greet()
        for i in range(20):
            fast.say("ping", id=i)
        for i in range(9):  # one was the hello
            assert fast.read()["id"] == i
        calm.greet()
        assert calm.ask("ping", id=1)["op"] == "pong"
        heard = [line for kind, client, line in list_of(b.seen) if (kind, client) == ("rx", 1)]
        assert len(heard) == 10
        b.advance(1.0)
        assert fast.wait("pong")["id"] == 9


def list_of(seen: object) -> list[tuple[str, int, bytes]]:
    found = []
    while not seen.empty():  # type: ignore[attr-defined]
        found.append(seen.get())  # type: ignore[attr-defined]
    return found


def test_a_fault_of_ours_costs_one_client(monkeypatch: pytest.MonkeyPatch) -> None:
    with bench() as b, Peer(b.port) as one, Peer(b.port) as two:
        one.greet()
        two.greet("stream")

        def broken(*_: object) -> None:
            raise ZeroDivisionError

        monkeypatch.setattr(b.hub, "acknowledge", broken)
        one.say("ack", id=1, target="m0", result="done")
        assert one.rest() == []
        b.publish()
        assert two.wait("targets")["seq"] == 1


def test_without_a_free_descriptor_the_server_does_not_spin(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    tries = []
    with bench() as b, Peer(b.port) as peer:
        peer.greet()

        def full(self: socket.socket) -> tuple[socket.socket, Any]:
            tries.append(time.monotonic())
            raise OSError(errno.EMFILE, "Too many open files")

        with monkeypatch.context() as patch:
            patch.setattr(socket.socket, "accept", full)
            with socket.create_connection(("127.0.0.1", b.port)):
                while len(tries) < 20:
                    assert peer.ask("ping", id=len(tries))["op"] == "pong"
        assert min(later - early for early, later in pairwise(tries)) >= THROTTLED_S


def test_a_dead_server_is_not_believed_alive(monkeypatch: pytest.MonkeyPatch) -> None:
    with bench() as b, Peer(b.port) as peer:
        peer.greet()

        def broken(now: float) -> None:
            raise ZeroDivisionError

        monkeypatch.setattr(b.hub, "tick", broken)
        b.server.wake()
        assert peer.rest() == []
        b.server._thread.join(20)
        with pytest.raises(RuntimeError, match="the robot server died"):
            b.server.wake()


def test_tls(certificate: Path) -> None:
    context = ssl.create_default_context(ssl.Purpose.CLIENT_AUTH)
    context.load_cert_chain(certificate)
    trusting = ssl.create_default_context(cafile=certificate)
    with bench(tls=context) as b, socket.create_connection(("127.0.0.1", b.port), 20) as plain:
        silent = socket.create_connection(("127.0.0.1", b.port), 20)
        plain.sendall(b'{"op":"hello","version":"1.0","mode":"request"}\n')
        b.until("event", b"disconnected: lost")
        with trusting.wrap_socket(
            socket.create_connection(("127.0.0.1", b.port), 20), server_hostname="127.0.0.1"
        ) as sock:
            reader = sock.makefile("rb")
            assert read_line(reader.readline())["op"] == "hello"
            hello = {"op": "hello", "version": "1.0", "mode": "stream"}
            sock.sendall(json.dumps(hello).encode() + b"\n")
            assert read_line(reader.readline())["op"] == "heartbeat"
            for seq in range(1, 20):
                b.publish(BIG)
                message = read_line(reader.readline())
                while message["op"] == "heartbeat":
                    message = read_line(reader.readline())
                assert (message["seq"], message["count"]) == (seq, 200)
            b.advance(2.1)
            b.until("event", b"disconnected: it does not read")  # who never shook hands
            reader.close()
        silent.close()
