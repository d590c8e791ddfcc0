"""A live camera through whole graphs: drops, the recorder, and the same result in every replay."""

from __future__ import annotations

import json
import threading
from collections import defaultdict
from pathlib import Path

import numpy as np
import pytest
import yaml

from mushpipe import Camera, Picks
from mushpipe.core.plugins import load_registry
from mushpipe.core.recorder import RecordingWriter
from mushpipe.core.recording import MANIFEST, RecordingReader
from mushpipe.core.report import RunReport
from mushpipe.core.wire import decode_table
from mushpipe.sources.mcap import McapSource
from mushpipe.sources.synthetic import SyntheticSource
from tests.cli.shell import ROOT
from tests.core.lab import Lab, held, soon
from tests.io import bags
from tests.live.rig import SERIAL, SYSTEM, Rig, acquire

UNSURE = 0.6  # a score that hardly passes
FRAMES = 2
CAMERA = Camera(640, 480, 617.0, 617.0, 319.5, 239.5)
STAGES = yaml.safe_load((ROOT / "graphs/demo.yaml").read_text())["stages"]
DEMO = f"""\
mushpipe: 1
source: SOURCE
stages: {json.dumps(STAGES)}
sinks:
  log: {{use: mcap, path: OUT}}
"""


def graph(rig: Rig, sinks: str, stages: str = "") -> str:
    settings = rig.settings() | {"use": "camera"}
    return f"mushpipe: 1\nsource: {settings}\nstages: {{{stages}}}\nsinks: {{{sinks}}}\n"


def test_of_a_camera_too_fast_for_the_graph_the_newest_frame_is_taken(lab: Lab):
    rig = Rig()
    entered, release = threading.Event(), threading.Event()

    def camera() -> None:
        acquire(rig.started)
        for i in range(5):
            rig.feed(i)
            if i == 0:
                soon(entered)
            acquire(rig.taken)  # it is in the slot, or has pushed another one out
        release.set()

    lab.registry.source("camera", rig.source_class())
    lab.registry.stage("slow", held(entered, release))
    thread = threading.Thread(target=camera)
    thread.start()
    report = lab.run(graph(rig, "out: {use: collect}", "a: {use: slow}"), "source.max_frames=5")
    thread.join()
    assert [trace.frame.header.sequence for trace in lab.seen] == [0, 4]
    assert (report.frames_in, report.processed, report.dropped) == (5, 2, 3)
    assert report.balanced()
    assert report.source == {}


def test_a_recorder_on_a_slow_disk_says_what_it_lost_and_holds_all_else(
    lab: Lab, tmp_path, monkeypatch
):
    """The disk stalls on the first frame: what the queues cannot hold is dropped and counted."""
    rig, n = Rig(), 12
    entered, release = threading.Event(), threading.Event()
    write = RecordingWriter.frame

    def stalled(self, frame, quality=None):
        entered.set()
        soon(release)
        write(self, frame, quality)

    def camera() -> None:
        acquire(rig.started)
        for i in range(n):
            rig.feed(i)
            if i == 0:
                soon(entered)
            acquire(rig.taken)
        release.set()

    monkeypatch.setattr(RecordingWriter, "frame", stalled)
    lab.registry.source("camera", rig.source_class())
    lab.registry.sink("mcap", "mushpipe.sinks.mcap:McapSink")
    thread = threading.Thread(target=camera)
    thread.start()
    report = lab.run(graph(rig, "rec: {use: mcap, path: rec.mcap}"), f"source.max_frames={n}")
    thread.join()
    recorded = [frame.header.sequence for frame in McapSource(path=tmp_path / "rec.mcap").frames()]
    assert report.dropped > 0
    assert report.processed == n - report.dropped == len(recorded)
    assert (recorded[0], recorded[-1]) == (0, n - 1)
    assert report.balanced()
    assert report.sinks["rec"].dropped == 0


@pytest.fixture(scope="module")
def scene() -> list[dict[str, np.ndarray]]:
    """A simulated bed as the camera's two sensors see it."""
    frames = SyntheticSource(max_frames=FRAMES, count=25).frames()
    return [
        {"color": np.array(f.color), "depth": np.array(f.depth)}
        for f, _ in zip(frames, range(FRAMES), strict=False)
    ]


def run_demo(folder: Path, source: str, out: str, rig: Rig | None = None, **options) -> RunReport:
    from mushpipe.core.document import parse_document
    from mushpipe.core.graph import compile_document
    from mushpipe.core.run import run

    registry = load_registry()
    if rig is not None:
        registry.source("camera", rig.source_class())
    text = DEMO.replace("SOURCE", source).replace("OUT", out)
    report = run(compile_document(parse_document(text, "demo.yaml", folder), registry), **options)
    assert report.error is None
    assert (report.processed, report.dropped) == (FRAMES, 0)
    return report


def results(path: Path) -> dict[str, list[tuple[int, bytes]]]:
    """Return every message of a recording by topic, timing aside."""
    found = defaultdict(list)
    for raw in RecordingReader(path).messages():
        if raw.channel.topic != "/mushpipe/timing":
            found[raw.channel.topic].append((raw.message.publish_time, raw.message.data))
    return found


def test_live_and_every_kind_of_recording_of_a_scene_give_the_same_picks(tmp_path, scene):
    rig = Rig(CAMERA, CAMERA, shift=(0, 0, 0))
    done = threading.Semaphore(0)

    def camera() -> None:
        acquire(rig.started)
        for number, images in enumerate(scene):
            rig.feed(number, images, 1.7e12 + number * 1000 / 30, SYSTEM)
            acquire(done)

    thread = threading.Thread(target=camera)
    thread.start()
    live = str(rig.settings() | {"use": "camera", "max_frames": FRAMES}).replace("None", "null")
    run_demo(tmp_path, live, "live.mcap", rig, progress=lambda _: done.release())
    thread.join()
    rig.record(tmp_path / "scene.bag", scene)
    run_demo(tmp_path, "{use: mcap, path: live.mcap}", "replay.mcap")
    run_demo(tmp_path, "{use: realsense, file: scene.bag}", "bag.mcap")
    first, replay, bag = (results(tmp_path / f"{n}.mcap") for n in ("live", "replay", "bag"))
    assert len(first["/mushpipe/pick"]) == FRAMES
    assert len(json.loads(first["/mushpipe/pick"][0][1])["id"]) > 1
    assert bag == first
    manifest = RecordingReader(tmp_path / "live.mcap").index().metadata[MANIFEST]["json"]
    assert json.loads(manifest)["device"]["serial_number"] == SERIAL
    assert replay == first
    ros_bag = as_ros_bag(tmp_path, tmp_path / "live.mcap")
    run_demo(tmp_path, f"{{use: mcap, path: {ros_bag}}}", "ros.mcap")
    for ours, ros in zip(picks(first), picks(results(tmp_path / "ros.mcap")), strict=True):
        # ROS has whole millimetres, cut off. By that they may change places, what is hardly a
        # mushroom may be one or not, and an outline that is half hidden, which depth completes,
        # move by part of a pixel.
        apart = np.linalg.norm(ours.center[:, None] - ros.center, axis=-1)
        row, column = np.nonzero(apart < 0.5)
        assert np.median(apart[row, column]) < 0.01
        assert (apart[row, column] < 0.2).mean() > 0.9
        assert len(set(row)) == len(set(column)) == len(row) > 0.9 * len(ours)
        for table, matched in ((ours, row), (ros, column)):
            assert (np.delete(table.score, matched) < UNSURE).all()
        positions = ours.position[row], ros.position[column]
        assert np.nanmax(np.abs(positions[0] - positions[1])) < 0.0015
        assert np.array_equal(*map(np.isnan, positions))


def as_ros_bag(folder: Path, recording: Path) -> Path:
    """Write a recording as realsense2_camera does: depth in whole millimetres."""
    entries: list[bags.Entry] = []
    for frame in McapSource(path=recording).frames():
        stamp, camera, depth = frame.header.stamp_ns, frame.camera, frame.depth_m
        assert camera is not None
        k = (camera.fx, 0, camera.cx, 0, camera.fy, camera.cy, 0, 0, 1)
        millimetres = np.nan_to_num(depth * 1000).astype(np.uint16)
        entries += [
            (bags.COLOR_INFO, stamp, bags.camera_info(stamp, (camera.width, camera.height), k)),
            (bags.COLOR, stamp, bags.raw_image(frame.color, "rgb8", stamp)),
            (bags.ALIGNED, stamp, bags.raw_image(millimetres, "16UC1", stamp)),
        ]
    return bags.write_bag(folder, entries)


def picks(found: dict[str, list[tuple[int, bytes]]]) -> list[Picks]:
    tables = [decode_table("mushpipe.Picks", data) for _, data in found["/mushpipe/pick"]]
    return [decoded.table for decoded in tables if decoded and isinstance(decoded.table, Picks)]
