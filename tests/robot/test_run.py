"""The sink in a run: what robots are told when it ends, stalls or breaks."""

from __future__ import annotations

import threading
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any, ClassVar

import pytest

from mushpipe import Picks, RgbdFrame, RunInfo, Source, Stage
from mushpipe.core.document import Document, read_document
from mushpipe.core.errors import DeviceError
from mushpipe.core.graph import compile_document
from mushpipe.core.plan import Plan
from mushpipe.core.plugins import load_registry
from mushpipe.core.report import RunReport
from mushpipe.core.run import run
from mushpipe.robot.transcript import read_transcript
from mushpipe.sinks.robot_json import RobotJsonSink
from tests.robot.peer import Peer
from tests.robot.scene import make_picks
from tests.robot.test_sink import frame_at, port

ROOT = Path(__file__).parents[2]


class Camera(Source):
    """Delivers frames when told, and then goes on, hangs or breaks."""

    live: ClassVar[bool] = True
    steps: ClassVar[list[threading.Event]] = []
    breaks: bool = False

    def frames(self) -> Iterator[RgbdFrame]:
        clock = RobotJsonSink()._clock
        for number, step in enumerate(self.steps):
            step.wait(20)
            now = clock.wall_ns()
            frame = frame_at(now, now)
            yield replace(frame, header=replace(frame.header, sequence=number))
        if self.breaks:
            raise DeviceError("the camera was unplugged")


class Find(Stage):
    """Finds the same three mushrooms in every frame, or fails."""

    fails_at: int | None = None

    def process(self, frame: RgbdFrame) -> Picks:
        """Return three picks."""
        if frame.header.sequence == self.fails_at:
            raise ValueError("it fails")
        return make_picks()


def plan_of(**settings: Any) -> Plan:
    graph = {
        "mushpipe": 1,
        "on_error": "fail",
        "source": {"use": "camera", **settings.pop("source", {})},
        "stages": {"find": {"use": "find", **settings.pop("find", {})}},
        "sinks": {"robot": {"use": "robot-json", "port": 0, "max_age_ms": 10_000, **settings}},
    }
    registry = load_registry()
    registry.source("camera", Camera)
    registry.stage("find", Find)
    return compile_document(Document("graph.yaml", Path.cwd(), graph), registry)


class Running:
    """A run in a thread of its own."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch, plan: Plan, frames: int) -> None:
        self.steps = [threading.Event() for _ in range(frames)]
        monkeypatch.setattr(Camera, "steps", self.steps)
        self.opened = threading.Event()
        self.port = 0
        begin = RobotJsonSink.open

        def opened(sink: RobotJsonSink, info: RunInfo) -> None:
            begin(sink, info)
            self.port = port(sink)
            self.opened.set()

        monkeypatch.setattr(RobotJsonSink, "open", opened)
        self.report: RunReport | None = None
        self.stop = threading.Event()
        self.thread = threading.Thread(target=self._run, args=(plan,))
        self.thread.start()
        assert self.opened.wait(20)

    def _run(self, plan: Plan) -> None:
        self.report = run(plan, self.stop)

    def end(self) -> RunReport:
        for step in self.steps:
            step.set()
        self.thread.join(20)
        assert self.report
        return self.report


@pytest.mark.parametrize(
    ("settings", "reason", "code"),
    [
        ({}, "end", 0),
        ({"source": {"breaks": True}}, "no_camera", 5),
        ({"find": {"fails_at": 1}}, "failed", 1),
    ],
)
def test_the_last_word_says_how_it_ended(
    monkeypatch: pytest.MonkeyPatch, settings: dict[str, Any], reason: str, code: int
) -> None:
    running = Running(monkeypatch, plan_of(**settings), 2)
    with Peer(running.port) as peer:
        assert not peer.greet("stream")["replay"]
        running.steps[0].set()
        assert peer.wait("targets")["count"] == 3
        running.steps[1].set()
        assert peer.wait("bye")["reason"] == reason
        assert peer.rest() == []
    assert running.end().exit_code == code


def test_an_operator_who_stops_the_run_is_no_failure(monkeypatch: pytest.MonkeyPatch) -> None:
    running = Running(monkeypatch, plan_of(), 2)
    with Peer(running.port) as peer:
        peer.greet("stream")
        running.steps[0].set()
        peer.wait("targets")
        running.stop.set()
        assert peer.wait("bye")["reason"] == "end"
    assert running.end().exit_code == 130


def test_a_camera_that_falls_silent_is_told_of(monkeypatch: pytest.MonkeyPatch) -> None:
    running = Running(monkeypatch, plan_of(stall_ms=100), 2)
    with Peer(running.port) as peer:
        peer.greet("stream")
        running.steps[0].set()
        peer.wait("targets")
        while peer.wait("heartbeat")["state"] != "no_camera":
            pass
    assert running.end().exit_code == 0


def test_the_demo_graph_serves_its_recording(tmp_path: Path) -> None:
    overrides = [
        *("source.speed=0", "source.loop=1", "sinks.robot.port=0"),
        f"sinks.robot.transcript={tmp_path / 'robot.mcap'}",
    ]
    document = read_document(ROOT / "graphs/robot.yaml")
    report = run(compile_document(document, load_registry(), overrides))
    assert report.exit_code == 0, report.error
    assert report.sinks["robot"].consumed == report.processed > 0
    overrides.append("sinks.robot.replay=false")
    refused = run(compile_document(document, load_registry(), overrides))
    assert refused.exit_code == 2


def test_a_run_leaves_a_transcript(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    path = tmp_path / "robot.mcap"
    running = Running(monkeypatch, plan_of(transcript=str(path)), 2)
    with Peer(running.port) as peer:
        peer.greet("stream")
        running.steps[0].set()
        peer.wait("targets")
    running.end()
    assert {line.kind for line in read_transcript(path)[0]} == {"tx", "rx", "event"}
