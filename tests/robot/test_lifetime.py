"""Deaths without a last word, each followed by a clean new beginning."""

from __future__ import annotations

import json
import os
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

import pytest

from mushpipe.robot.client import RobotClient
from tests.cli.shell import MAIN
from tests.robot.peer import Peer
from tests.robot.scene import bench

ROOT = Path(__file__).parents[2]
ENVIRONMENT = {**os.environ, "PYTHONPATH": os.pathsep.join([str(ROOT), *sys.path])}


@contextmanager
def process(*arguments: str) -> Iterator[subprocess.Popen[str]]:
    with subprocess.Popen(
        arguments,
        env=ENVIRONMENT,
        text=True,
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
    ) as child:
        try:
            yield child
        finally:
            child.kill()


@contextmanager
def served(port: int = 0) -> Iterator[tuple[subprocess.Popen[str], int]]:
    with process(sys.executable, "-m", "tests.robot.serve", str(port)) as child:
        assert child.stdout
        yield child, int(child.stdout.readline())


def test_the_server_is_killed_and_comes_back() -> None:
    with served() as (child, port), Peer(port) as peer:
        first = peer.greet("stream")["session"]
        while peer.wait("targets")["seq"] < 20:
            pass
        child.kill()
        assert all(m["op"] in ("targets", "heartbeat") for m in peer.rest())
    with served(port) as (_, again), Peer(again) as peer:
        assert again == port
        assert peer.greet("stream")["session"] != first
        message = peer.wait("targets")
        assert message["age_ms"] <= 500


def test_the_reference_client_is_killed_and_comes_back() -> None:
    with bench() as b:
        b.publish()
        command = [*MAIN, "robot", "client", f"127.0.0.1:{b.port}", "--raw", "--mode", "stream"]
        with process(*command) as child:
            assert child.stdout
            while json.loads(child.stdout.readline())["op"] != "targets":
                pass
            child.kill()
            b.until("event", b"disconnected")
        b.publish()
        b.publish()
        with process(*command) as child:
            assert child.stdout
            message = json.loads(child.stdout.readline())
            while message["op"] != "targets":
                message = json.loads(child.stdout.readline())
            assert message["seq"] == 3


def serve_lines(listening: socket.socket, lines: list[dict[str, Any]], heard: int = 1) -> None:
    connection, _ = listening.accept()
    with connection:
        connection.sendall(b"".join(json.dumps(line).encode() + b"\n" for line in lines))
        for _ in range(heard):
            connection.recv(65536)


class Cable:
    """A wire that can be cut without either end being told."""

    def __init__(self, port: int) -> None:
        self.cut = threading.Event()
        self.far = socket.create_connection(("127.0.0.1", port))
        self.listening = socket.create_server(("127.0.0.1", 0))
        self.port = self.listening.getsockname()[1]
        threading.Thread(target=self._run, daemon=True).start()

    def _run(self) -> None:
        self.near, _ = self.listening.accept()
        threading.Thread(target=self._carry, args=(self.near, self.far), daemon=True).start()
        self._carry(self.far, self.near)

    def _carry(self, source: socket.socket, target: socket.socket) -> None:
        with suppress(OSError):
            while data := source.recv(65536):
                if not self.cut.is_set():
                    target.sendall(data)

    def close(self) -> None:
        for sock in (self.far, self.near, self.listening):
            sock.close()


def test_the_network_is_cut() -> None:
    with bench() as b:
        b.publish()
        cable = Cable(b.port)
        with RobotClient(port=cable.port, timeout_s=1.0) as robot:
            assert len(robot.targets()) == 3
            cable.cut.set()
            with pytest.raises(TimeoutError):
                robot.targets()
        # The server notices by itself that nothing is heard, or that nothing is taken.
        b.advance_until_disconnected(5)
        cable.close()
        b.publish()
        with RobotClient(port=b.port) as robot:
            answer = robot.ask("get_targets")
            assert (answer["seq"], answer["age_ms"]) == (2, 0)


def test_the_reference_client() -> None:
    with bench(token="t" * 16) as b:
        b.publish()
        with pytest.raises(PermissionError, match="unauthorised"):
            RobotClient(port=b.port)
        with RobotClient(port=b.port, token="t" * 16, name="irb") as robot:
            assert [t["id"] for t in robot.targets(max=2)] == ["m0", "m1"]
            assert robot.ack("m0", "accepted")
            assert not robot.ack("m9", "accepted")
            assert [t["id"] for t in robot.targets(max=2)] == ["m1", "m2"]
            b.advance(0.6)
            assert robot.targets() == []
            b.server.stop("failed")
            while robot.receive()["op"] != "bye":
                pass
            with pytest.raises(OSError, match="gone"):
                robot.receive()


def test_the_reference_client_sees_what_a_slow_network_held_back() -> None:
    """Two lines that the server wrote 600 ms apart arrive together."""
    lines: list[dict[str, Any]] = [
        {"op": "hello", "version": "1.0", "t_ms": 1000},
        {"op": "heartbeat", "t_ms": 1000},
        {"op": "targets", "t_ms": 1000},
        {"op": "targets", "t_ms": 400},
    ]
    with socket.create_server(("127.0.0.1", 0)) as listening:
        threading.Thread(target=serve_lines, args=(listening, lines), daemon=True).start()
        with RobotClient(port=listening.getsockname()[1]) as robot:
            fresh, late = [robot.receive() and robot.late_ms for _ in range(2)]
    assert late - fresh >= 600


@pytest.mark.skipif(not hasattr(time, "CLOCK_BOOTTIME"), reason="no clock tells of sleep here")
def test_what_waited_while_the_robots_computer_slept_is_late(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    slept_s, clock_gettime = 0.0, time.clock_gettime
    monkeypatch.setattr(
        "mushpipe.robot.client.time.clock_gettime",
        lambda clock: clock_gettime(clock) + (slept_s if clock == time.CLOCK_BOOTTIME else 0),
    )
    lines: list[dict[str, Any]] = [
        {"op": "hello", "version": "1.0", "t_ms": 0},
        {"op": "heartbeat", "t_ms": 0},
        {"op": "targets", "t_ms": 0, "valid_ms": 60_000},
    ]
    with socket.create_server(("127.0.0.1", 0)) as listening:
        threading.Thread(target=serve_lines, args=(listening, lines), daemon=True).start()
        with RobotClient(port=listening.getsockname()[1], mode="stream") as robot:
            slept_s = 120.0
            assert robot.too_late(robot.receive())


@pytest.mark.parametrize(("after_ms", "still"), [(399, True), (401, False)])
def test_the_reference_client_takes_no_targets_from_an_answer_that_was_too_long_on_the_way(
    after_ms: float, still: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    answer = {"op": "targets", "id": 1, "t_ms": 0, "valid_ms": 400, "targets": [{"id": "m1"}]}
    lines: list[dict[str, Any]] = [
        {"op": "hello", "version": "1.0", "t_ms": 0},
        {"op": "heartbeat", "t_ms": 0},
        answer,
    ]
    moments = iter([0.0, 0.0, 0.0, 0.0])  # of the connection, both greetings, and the request
    monkeypatch.setattr("mushpipe.robot.client.now_ms", lambda: next(moments, after_ms))
    with socket.create_server(("127.0.0.1", 0)) as listening:
        threading.Thread(target=serve_lines, args=(listening, lines), daemon=True).start()
        with RobotClient(port=listening.getsockname()[1]) as robot:
            assert robot.targets() == ([{"id": "m1"}] if still else [])


def test_the_reference_client_speaks_to_no_server_of_another_version() -> None:
    lines: list[dict[str, Any]] = [
        {"op": "hello", "version": "2.0", "t_ms": 0},
        {"op": "heartbeat", "t_ms": 0},
    ]
    with socket.create_server(("127.0.0.1", 0)) as listening:
        threading.Thread(target=serve_lines, args=(listening, lines), daemon=True).start()
        with pytest.raises(PermissionError, match=r"speaks version 2\.0, this client 1\.0"):
            RobotClient(port=listening.getsockname()[1])


def test_a_client_that_is_not_greeted_closes_its_connection() -> None:
    with socket.create_server(("127.0.0.1", 0)) as listening:
        nonsense: list[dict[str, Any]] = [{"no": "op"}]
        server = threading.Thread(target=serve_lines, args=(listening, nonsense), daemon=True)
        server.start()
        with pytest.raises(ConnectionError, match="no robot socket") as caught:
            RobotClient(port=listening.getsockname()[1])
        server.join(10)  # until it hears the end
    assert not server.is_alive()
    assert caught.tb is not None  # which holds the client: nobody else closed it


def test_a_stream_of_hours_over_clocks_that_drift_is_not_taken_for_late(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """The robot's clock gains 180 ms in an hour; a line takes 2 ms, in the end 302."""
    hours = 3_600_000
    lines: list[dict[str, Any]] = [
        {"op": "hello", "version": "1.0", "t_ms": 0},
        {"op": "heartbeat", "t_ms": 0},
        {"op": "targets", "t_ms": hours},
        {"op": "pong", "id": 1, "t_ms": hours},
        {"op": "targets", "t_ms": hours + 100},
        {"op": "pong", "id": 2, "t_ms": hours + 200},
        {"op": "targets", "t_ms": hours + 300},
    ]
    now_ms = 0.0
    monkeypatch.setattr("mushpipe.robot.client.now_ms", lambda: 7000 + now_ms * (1 + 50e-6))
    with socket.create_server(("127.0.0.1", 0)) as listening:
        threading.Thread(target=serve_lines, args=(listening, lines, 9), daemon=True).start()
        with RobotClient(port=listening.getsockname()[1], mode="stream") as robot:
            now_ms = hours + 2
            assert robot.receive()["op"] == "targets"
            assert robot.late_ms == pytest.approx(182, abs=1)  # who knows: it may have waited
            now_ms = hours - 1
            robot.ping()
            now_ms = hours + 2
            assert robot.receive()["op"] == "pong"
            now_ms = hours + 102
            assert robot.receive()["op"] == "targets"
            assert robot.late_ms == pytest.approx(2, abs=2)
            now_ms = hours + 199
            robot.ping()
            now_ms = hours + 502
            assert robot.receive()["op"] == "pong"
            now_ms = hours + 602
            assert robot.receive()["op"] == "targets"
            assert robot.late_ms == pytest.approx(302, abs=2)  # though no line was quicker
