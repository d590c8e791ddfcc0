"""`mushpipe robot` and the examples, as an integrator would use them."""

from __future__ import annotations

import shlex
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from queue import SimpleQueue
from typing import Any, ClassVar

import pytest
from typer.testing import CliRunner

from mushpipe.cli import app
from mushpipe.core.errors import EXIT_USAGE, InputError
from mushpipe.robot import commands
from mushpipe.robot.client import RobotClient
from mushpipe.robot.replay import as_server, lines_of
from tests.cli.shell import MAIN
from tests.robot.peer import Peer
from tests.robot.scene import bench
from tests.robot.test_transcript import record

ROOT = Path(__file__).parents[2]


def robot(*arguments: object) -> Any:
    return CliRunner().invoke(app, ["robot", *map(str, arguments)])


def test_targets_are_printed_and_acknowledged() -> None:
    with bench(replay=True) as b:
        b.publish()
        address = f"127.0.0.1:{b.port}"
        arguments = ("--count", 2, "--every", 0, "--max", 1, "--ack", "accepted", "--ack", "done")
        done = robot("client", address, *arguments, "--accept-replay")
        assert done.exit_code == 0, done.output
        assert "targets REPLAY seq=1 age=0 ms" in done.output
        assert "target=m0 result=done effect=removed" in done.output
        assert "1 claimed" in done.output
        refused = robot("client", address, "--count", 1)
        assert refused.exit_code == 1
        assert "replay_refused" in refused.output


def test_what_is_stale_is_shown_as_such() -> None:
    with bench() as b:
        done = robot("client", f"127.0.0.1:{b.port}", "--count", 1)
        assert "code=stale" in done.output


def test_targets_that_came_too_late_are_not_acknowledged(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(RobotClient, "too_late", lambda *_: True)
    with bench() as b:
        b.publish()
        done = robot("client", f"127.0.0.1:{b.port}", "--count", 1, "--ack", "accepted")
        assert "late on the way: no longer valid" in done.output
        assert not b.hub.ledger.hides(0)


class Said:
    """A connection on which these lines come."""

    hello: ClassVar[dict[str, str]] = {"software": "mushpipe"}

    def __init__(self, *lines: dict[str, Any]) -> None:
        self.lines, self.pings = iter(lines), 0

    def receive(self) -> dict[str, Any]:
        return next(self.lines)

    def ping(self) -> None:
        self.pings += 1

    def too_late(self, message: dict[str, Any]) -> bool:
        return False


def test_of_a_stream_results_alone_count_and_a_heartbeat_is_answered(
    capsys: pytest.CaptureFixture[str],
) -> None:
    beat = {"op": "heartbeat", "state": "running"}
    error = {"op": "error", "code": "busy"}
    connection = Said(beat, {"op": "pong", "id": 1}, error, beat, error, error)
    talk = commands._Talk(commands.Mode.stream, {}, 0, [], raw=False, count=2)
    commands._converse(connection, talk)  # type: ignore[arg-type]
    assert connection.pings == 2
    assert [line.split()[0] for line in capsys.readouterr().out.splitlines()] == [
        "heartbeat",
        "error",
        "heartbeat",
        "error",
    ]


def test_a_server_that_takes_its_leave_is_tried_again() -> None:
    connection = Said({"op": "bye", "reason": "end"})
    talk = commands._Talk(commands.Mode.stream, {}, 0, [], raw=False, count=2)
    with pytest.raises(ConnectionError, match="the server says bye: end"):
        commands._converse(connection, talk)  # type: ignore[arg-type]


def test_it_tries_again_when_the_server_goes_away(monkeypatch: pytest.MonkeyPatch) -> None:
    with bench() as b:
        b.publish()
        calls = []

        class Once(RobotClient):
            def __init__(self, *arguments: Any, **more: Any) -> None:
                calls.append(1)
                if len(calls) < 4:
                    raise ConnectionRefusedError("nobody there")
                super().__init__(*arguments, **more)

        monkeypatch.setattr("mushpipe.robot.client.RobotClient", Once)
        monkeypatch.setattr(commands.time, "sleep", lambda _: None)
        done = robot("client", f"127.0.0.1:{b.port}", "--mode", "stream", "--count", 1, "--raw")
        assert done.output.count("nobody there; trying again") == 1
        assert '"op": "targets"' in done.output


def test_why_the_server_ended_is_heard_by_who_asks_afterwards() -> None:
    with bench() as b:
        client = RobotClient(port=b.port)
    with client:
        client.ping()  # is answered by a reset, on which the next line cannot be sent
        time.sleep(0.1)
        heard = client.ask("get_targets")
        assert (heard["op"], heard["reason"]) == ("bye", "end")


def test_a_token_and_a_wrong_address(tmp_path: Path) -> None:
    (tmp_path / "token").write_text("t" * 16 + "\n")
    with bench(token="t" * 16) as b:
        b.publish()
        address = f"127.0.0.1:{b.port}"
        done = robot("client", address, "--count", 1, "--token-file", tmp_path / "token")
        assert "m0" in done.output
    assert robot("client", "5005").exit_code == 2
    for bare in ("::1", "fe80::1"):
        done = robot("client", bare)
        assert done.exit_code == EXIT_USAGE
        assert f"write [{bare}]:5005" in done.output


def test_a_transcript_is_replayed(tmp_path: Path) -> None:
    path = tmp_path / "robot.mcap"
    record(path)
    with bench() as b:
        b.publish()
        done = robot("replay", path, "--connect", f"127.0.0.1:{b.port}")
        assert done.exit_code == 0, done.output
        assert "> \\xff\\xfe" in done.output
        assert '"effect":"removed"' in done.output
    assert robot("replay", path, "--connect", f"127.0.0.1:{b.port}").exit_code == 1
    assert robot("replay", path).exit_code == 2


def test_a_transcript_whose_replay_nobody_reads_any_more_ends_quietly(tmp_path: Path) -> None:
    path = tmp_path / "robot.mcap"
    record(path)
    with bench() as b:
        b.publish()
        for lines in ("0", "1", "3"):
            words = [*MAIN, "robot", "replay", str(path), "--connect", f"127.0.0.1:{b.port}"]
            done = subprocess.run(
                f"{shlex.join(words)} | head -n {lines}",
                shell=True, capture_output=True, text=True, check=False,
            )  # fmt: skip
            assert "Traceback" not in done.stderr
            assert "NobodyReads" not in done.stderr


@contextmanager
def replayed(path: Path) -> Iterator[int]:
    """The port at which a transcript is replayed to one client."""
    record(path)
    port: SimpleQueue[int] = SimpleQueue()
    lines, _ = lines_of(path)
    thread = threading.Thread(
        target=as_server, args=(lines, 0, lambda *_: None, port.put), daemon=True
    )
    thread.start()
    yield port.get(timeout=20)
    thread.join(20)


def test_a_recording_is_replayed_to_nobody_who_does_not_accept_it(tmp_path: Path) -> None:
    with (
        replayed(tmp_path / "robot.mcap") as port,
        pytest.raises(PermissionError, match="replay_refused"),
    ):
        RobotClient(port=port)


def test_the_refusal_of_a_replay_follows_the_schema(tmp_path: Path) -> None:
    with replayed(tmp_path / "robot.mcap") as port, Peer(port) as peer:  # which checks every line
        heard = peer.read()
        peer.say("hello", version="1.0", mode="request")
        (refusal,) = peer.rest()
    assert refusal["code"] == "replay_refused"
    assert refusal["t_ms"] >= heard["t_ms"]


def test_a_transcript_is_replayed_to_a_server_of_a_recording_that_wants_a_token(
    tmp_path: Path,
) -> None:
    path = tmp_path / "robot.mcap"
    record(path)
    (tmp_path / "token").write_text("t" * 16)
    with bench(replay=True, token="t" * 16) as b:
        b.publish()
        to = ("--connect", f"127.0.0.1:{b.port}")
        assert robot("replay", path, *to).exit_code == 1
        done = robot("replay", path, *to, "--accept-replay", "--token-file", tmp_path / "token")
    assert done.exit_code == 0, done.output
    assert '"effect":"removed"' in done.output
    assert "tttt" not in done.output


def test_another_program_on_the_port_is_named() -> None:
    with socket.create_server(("127.0.0.1", 0)) as other:

        def speak() -> None:
            connection, _ = other.accept()
            with connection:
                connection.sendall(b"SSH-2.0-OpenSSH\r\n")

        threading.Thread(target=speak, daemon=True).start()
        with pytest.raises(ConnectionError, match="no robot socket of mushpipe"):
            RobotClient(port=other.getsockname()[1])


def test_a_port_for_abb_is_named() -> None:
    with bench() as b, pytest.raises(TimeoutError, match=r"no hello within 0\.05 s.* ABB"):
        RobotClient(port=b.server.ports[1], timeout_s=0.05)


@pytest.mark.parametrize("written", ["[::1]:{}", "::1:{}"])
def test_an_address_may_be_of_ipv6(monkeypatch: pytest.MonkeyPatch, written: str) -> None:
    def give_up(_: float) -> None:
        raise RuntimeError("it would try for ever")

    monkeypatch.setattr(commands.time, "sleep", give_up)
    try:
        other = socket.create_server(("::1", 0), family=socket.AF_INET6)
    except OSError:
        pytest.skip("this computer has no IPv6")
    with other:

        def speak() -> None:
            connection, _ = other.accept()
            with connection:
                connection.sendall(b'{"op":"error","code":"timeout","message":"hello from v6"}\n')
                connection.recv(999)

        threading.Thread(target=speak, daemon=True).start()
        result = robot("client", written.format(other.getsockname()[1]))
    assert result.exit_code == 1
    assert "refused: timeout: hello from v6" in result.output


@pytest.mark.parametrize(
    "arguments",
    [
        ("client", "127.0.0.1:70741"),
        ("client", "--mode", "stream", "--max", 1),
        ("client", "--tls-ca", "nofile.pem"),
        ("replay", "robot.mcap", "--listen", 99999),
        ("replay", "robot.mcap", "--listen", 0, "--accept-replay"),
        ("replay", "robot.mcap", "--listen", 0, "--token-file", "robot.token"),
    ],
)
def test_arguments_that_make_no_sense_are_refused(arguments: tuple[object, ...]) -> None:
    assert robot(*arguments).exit_code == 2


def test_a_damaged_transcript_is_replayed_as_far_as_it_goes(tmp_path: Path) -> None:
    path = tmp_path / "robot.mcap"
    record(path)
    path.write_bytes(path.read_bytes()[:-100])
    with bench() as b:
        b.publish()
        done = robot("replay", path, "--connect", f"127.0.0.1:{b.port}")
    assert "> \\xff\\xfe" in done.output
    assert isinstance(done.exception, InputError)
    assert f"{path} is damaged: it breaks off" in str(done.exception)


def test_a_transcript_answers_a_client(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path / "robot.mcap"
    record(path)
    port: list[int] = []
    ready = threading.Event()

    def note(text: str) -> None:
        if "listening" in text:
            port.append(int(text.rpartition(":")[2]))
            ready.set()

    monkeypatch.setattr(commands, "_note", note)
    thread = threading.Thread(target=commands.replay, args=(path, None, 0))
    monkeypatch.setattr(commands, "_out", lambda _: None)
    thread.start()
    assert ready.wait(20)
    with RobotClient(port=port[0], accept_replay=True) as client:
        assert client.ask("get_targets")["replay"]
    thread.join(20)


def test_the_example_picks() -> None:
    with bench(max_age_s=600, replay=True) as b:
        b.publish()
        command = [sys.executable, ROOT / "examples/robot/client.py", str(b.port)]
        done = subprocess.run(command, capture_output=True, text=True, check=True, timeout=60)
    assert [line.split()[0] for line in done.stdout.splitlines()] == ["m0", "m1", "m2"]


def test_the_example_says_what_it_takes() -> None:
    command = [sys.executable, ROOT / "examples/robot/client.py", "--help"]
    done = subprocess.run(command, capture_output=True, text=True, check=True, timeout=60)
    assert "PORT" in done.stdout


def test_a_token_that_cannot_be_read_is_not_the_servers_fault(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    record(tmp_path / "robot.mcap")
    Path("empty").write_text("\n")
    at = "127.0.0.1:1"
    for verb in (["client", at], ["replay", "robot.mcap", "--connect", at]):
        for file, why in (("none", "No such file or directory"), ("empty", "there is no token")):
            done = robot(*verb, "--token-file", file)
            assert done.exit_code == EXIT_USAGE
            assert f"--token-file {file}: {why}" in done.output


@pytest.mark.parametrize("host", ["a..b", 64 * "a", "\udcff"])
def test_what_can_be_no_host_is_refused(host: str) -> None:
    """It was a traceback of the socket library."""
    done = robot("client", f"{host}:5005")
    assert done.exit_code == EXIT_USAGE
    words = done.output.replace("│", " ").split()  # of a box, in which lines are broken
    assert "cannot be the name of a host" in " ".join(words)
