"""Every line is on record, and a record can be played again."""

from __future__ import annotations

import json
import socket
import threading
from pathlib import Path
from queue import SimpleQueue
from types import SimpleNamespace

import pytest

from mushpipe.core.errors import InputError, UsageError
from mushpipe.core.recorder import RecordingWriter
from mushpipe.core.types import Header
from mushpipe.core.wire import json_message
from mushpipe.robot import transcript as module
from mushpipe.robot.client import RobotClient
from mushpipe.robot.clock import Clock
from mushpipe.robot.replay import as_client, as_server, lines_of
from mushpipe.robot.transcript import SCHEMA, Line, Transcript, read_transcript
from tests.robot.peer import CLIENT, SERVER, Peer
from tests.robot.scene import PATIENCE_S, FakeClock, bench


def record(path: Path) -> None:
    """One robot takes m0; another only connects; then the clock of the host is set back."""
    clock = FakeClock()
    with bench(token="secret-of-the-robot") as b:
        log = Transcript(path, clock, "secret-of-the-robot")
        b.server._observe = log.observe
        b.publish()
        with Peer(b.port), Peer(b.port) as robot:
            robot.greet(token="secret-of-the-robot", name="irb")
            assert robot.targets(max=2) == ["m0", "m1"]
            clock.offset_s -= 3600
            robot.raw(b"\xff\xfe\n")
            assert robot.wait("error")["code"] == "bad_json"
            assert robot.ask("ack", id=2, target="m0", result="accepted")["op"] == "acked"
            robot.say("bye")
            robot.wait("bye")
        b.server.stop()
        log.close()


def test_every_line_in_and_out_is_recorded(tmp_path: Path) -> None:
    path = tmp_path / "robot.mcap"
    record(path)
    lines, damage = read_transcript(path)
    assert not damage
    assert b"secret" not in path.read_bytes()
    told = [line.text for line in lines if line.kind == "event"]
    assert sum(b"disconnected: " in text for text in told) == 2
    robot, _ = lines_of(path)
    said = [line.text for line in robot if line.kind == "rx"]
    assert said[2] == b"\xff\xfe"
    ops = [json.loads(text)["op"] for text in said if text != b"\xff\xfe"]
    assert ops == ["hello", "get_targets", "ack", "bye"]
    for line in robot:
        if line.text != b"\xff\xfe":
            (SERVER if line.kind == "tx" else CLIENT).validate(json.loads(line.text))
    answers = [json.loads(line.text)["op"] for line in robot if line.kind == "tx"]
    assert answers == ["hello", "heartbeat", "targets", "error", "acked", "bye"]


@pytest.mark.parametrize(
    ("said", "kept"),
    [
        (b'{"op":"hello","token":"secret-of-another"}', b'{"op":"hello","token":"***"}'),
        (b'{"token" : "an \\"escaped\\" one","id":1}', b'{"token" : "***","id":1}'),
        (b'{"token":"cut sho', b'{"token":"***'),
        (b"HELLO,1,TOKEN=secret-of-another,NAME=irb", b"HELLO,1,TOKEN=***,NAME=irb"),
        (b'{"op":"hello","name":"irb"}', b'{"op":"hello","name":"irb"}'),
    ],
)
def test_no_token_that_a_client_tries_is_recorded(tmp_path: Path, said: bytes, kept: bytes) -> None:
    path = tmp_path / "robot.mcap"
    log = Transcript(path, Clock(), "secret-of-the-robot")
    log.observe("rx", 1, said)
    log.close()
    (line,), damage = read_transcript(path)
    assert not damage
    assert line.text == kept


def test_a_client_is_replayed_to_a_server(tmp_path: Path) -> None:
    path = tmp_path / "robot.mcap"
    record(path)
    heard: list[bytes] = []
    # The token is blotted out, so the server must not ask for one.
    with bench() as b:
        b.publish()
        as_client(
            lines_of(path)[0],
            "127.0.0.1",
            b.port,
            lambda s, t: heard.append((s + " ").encode() + t),
        )
    ops = [json.loads(text[2:])["op"] for text in heard if text[:1] == b"<"]
    assert ops == ["hello", "heartbeat", "targets", "error", "acked", "bye"]


def test_a_server_is_replayed_to_a_client_and_never_taken_for_live(tmp_path: Path) -> None:
    path = tmp_path / "robot.mcap"
    record(path)
    port: SimpleQueue[int] = SimpleQueue()
    thread = threading.Thread(
        target=as_server, args=(lines_of(path)[0], 0, lambda *_: None, port.put), daemon=True
    )
    thread.start()
    with RobotClient(port=port.get(timeout=PATIENCE_S), accept_replay=True) as robot:
        assert robot.hello["replay"]
        robot.send("heartbeat")  # is no request, and gets no answer
        answer = robot.ask("get_targets", max=2)
        assert answer["replay"]
        assert answer["id"] == 1
        assert [t["id"] for t in answer["targets"]] == ["m0", "m1"]
        assert robot.ack("m0", "accepted")
        assert robot.receive()["op"] == "bye"
    thread.join(PATIENCE_S)


@pytest.mark.parametrize(
    ("hello", "expected"),
    [
        (b"HELLO,1", [b"E,REPLAY_REFUSED"]),
        (
            b"HELLO,1,REPLAY",
            [b"HELLO,1,REPLAY,6f3a92c1", b"T,0,1.0,2.0,3.0", b"S,RUNNING,4,REPLAY"],
        ),
    ],
)
def test_lines_for_abb_are_replayed_to_a_robot_that_asks_for_a_recording(
    hello: bytes, expected: list[bytes]
) -> None:
    said = (b"HELLO,1,LIVE,6f3a92c1", b"T,0,1.0,2.0,3.0", b"S,RUNNING,4,LIVE")
    lines = [Line("tx", 1, text, 0) for text in said]
    port: SimpleQueue[int] = SimpleQueue()
    thread = threading.Thread(
        target=as_server, args=(lines, 0, lambda *_: None, port.put), daemon=True
    )
    thread.start()
    address = "127.0.0.1", port.get(timeout=PATIENCE_S)
    with socket.create_connection(address, PATIENCE_S) as sock, sock.makefile("rb") as answers:
        sock.sendall(hello + b"\r\nNEXT\r\nSTATE\r\n")
        assert [line.rstrip(b"\n") for line in answers] == expected
    thread.join(PATIENCE_S)


def test_a_disk_that_cannot_follow_leaves_a_gap_that_is_told(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    monkeypatch.setattr(module, "MOST_BYTES", 100)
    log = Transcript(tmp_path / "robot.mcap", FakeClock())
    write, slow = log._write, threading.Event()
    monkeypatch.setattr(log, "_write", lambda *a: (slow.wait(PATIENCE_S), write(*a)))
    for i in range(5):
        log.observe("rx", 1, b"%d" % i * 40)
    slow.set()
    while log._waiting:  # until the disk has caught up
        pass
    log.observe("rx", 1, b"again")
    log.close()
    texts = [line.text for line in read_transcript(tmp_path / "robot.mcap")[0]]
    assert texts[-1] == b"again"
    assert b"3 lines are missing here" in texts
    assert "3 lines are missing" in caplog.text


def test_a_process_that_is_killed_leaves_what_was_said(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path, safe = tmp_path / "robot.mcap", threading.Event()
    monkeypatch.setattr(module, "FLUSH_S", 0.01)
    log = Transcript(path, Clock())
    flush = log._writer.flush
    monkeypatch.setattr(log._writer, "flush", lambda: (flush(), safe.set()))
    log.observe("rx", 1, b"hello")
    assert safe.wait(PATIENCE_S)
    (tmp_path / "copy.mcap").write_bytes(path.read_bytes())  # as it stands, without its end
    assert [line.text for line in read_transcript(tmp_path / "copy.mcap")[0]] == [b"hello"]
    log.close()


def test_a_full_disk_ends_the_transcript_and_nothing_else(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    def full(*_: object) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(module, "FLUSH_S", 0.01)
    log = Transcript(tmp_path / "robot.mcap", Clock())
    monkeypatch.setattr(log._writer._output, "_file", SimpleNamespace(write=full, close=bool))
    log.observe("rx", 1, b"lost")
    log._thread.join(PATIENCE_S)
    log.observe("rx", 1, b"lost as well")
    log.close()
    assert log.lost == 1
    assert "No space left on device" in caplog.text


def test_where_no_client_said_anything_one_must_be_named(tmp_path: Path) -> None:
    path = tmp_path / "robot.mcap"
    log = Transcript(path, FakeClock())
    for client in (1, 2):
        log.observe("tx", client, b'{"op":"hello"}')
    log.close()
    with pytest.raises(InputError, match="no client said anything; choose one with --client"):
        lines_of(path)
    assert [(line.client, line.text) for line in lines_of(path, 2)[0]] == [(2, b'{"op":"hello"}')]


def test_a_recording_without_a_transcript(tmp_path: Path) -> None:
    path = Path(__file__).parents[2] / "recordings/first-bed.mcap"
    with pytest.raises(InputError, match="no transcript"):
        lines_of(path)
    record(tmp_path / "robot.mcap")
    writer = RecordingWriter(tmp_path / "edited.mcap", {})
    header = Header(1, 0, "")
    writer.write("/robot/rx", json_message(SCHEMA, header, {"client": 1, "line": "x"}), header)
    writer.close()
    with pytest.raises(InputError, match="message 0 on /robot/rx is no line of a robot"):
        lines_of(tmp_path / "edited.mcap")
    with pytest.raises(UsageError, match=r"no client 77 in this transcript; it has these: 1, 2$"):
        lines_of(tmp_path / "robot.mcap", 77)
