"""What is recorded is played back unchanged; running twice gives the same bytes."""

from __future__ import annotations

import json
import signal
import subprocess
import sys
from dataclasses import fields, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from mcap.reader import make_reader
from mcap.writer import Writer

from mushpipe import Camera, Circles, DepthSource, Header, Locations, Picks, Poses, RgbdFrame
from mushpipe.core import wire
from mushpipe.core.columns import Columns
from mushpipe.core.document import Document
from mushpipe.core.graph import compile_document
from mushpipe.core.plugins import load_registry
from mushpipe.core.recorder import RecordingWriter
from mushpipe.core.recording import MANIFEST, RecordingReader
from mushpipe.core.run import run
from mushpipe.core.truth import Truth
from mushpipe.core.wire import decode_table
from mushpipe.sources.mcap import McapSource
from mushpipe.sources.realsense_frames import Clock
from tests.io.bags import OPTICAL, PERIOD, T0, drain, play, rgbd, write_bag
from tests.io.values import make_circles, make_frame, make_picks, no_picks, record, trace_of

finite = st.floats(allow_nan=False, allow_infinity=False)
positive = st.floats(1e-3, 1e5)
lenses = st.tuples(*[st.floats(-1, 1)] * 5).filter(any)


@st.composite
def recordings(draw: st.DrawFn) -> list[RgbdFrame]:
    """Draw up to four frames of one size, as a source would deliver them."""
    height, width = draw(st.integers(1, 9)), draw(st.integers(1, 9))
    model = draw(st.sampled_from(["none", "brown_conrady", "inverse_brown_conrady"]))
    coefficients = () if model == "none" else draw(lenses)
    intrinsics = draw(st.tuples(positive, positive, finite, finite))
    camera = Camera(width, height, *intrinsics, model, coefficients)
    dtype = draw(st.sampled_from([np.uint16, np.float32]))
    scale = draw(st.sampled_from([0.001, 0.000125, 1.0]) | st.floats(1e-7, 10))
    times = st.integers(1, 2**61) | st.just(T0)  # which may stand still
    stamps = sorted(draw(st.lists(times, min_size=1, max_size=5)))
    rng = np.random.default_rng(draw(st.integers(0, 2**32)))
    sequence, frames = draw(st.integers(0, 1000)), []
    for stamp in stamps:
        depth = rng.integers(0, 65536, (height, width)).astype(dtype)
        if dtype is np.float32:
            depth[rng.random(depth.shape) < 0.2] = np.nan
        sequence += draw(st.integers(1, 3))
        header = Header(stamp, sequence, draw(st.text(max_size=5)), stamp + 7)
        color = rng.integers(0, 256, (height, width, 3), np.uint8)
        depth = draw(st.sampled_from([depth, None]))
        known = draw(st.sampled_from([camera, None]))  # a calibration may come and go
        frames.append(RgbdFrame(header, color, depth, scale, known))
    return frames


def check_same(frames: list[RgbdFrame], expected: list[RgbdFrame]) -> None:
    assert [frame.header for frame in frames] == [frame.header for frame in expected]
    for found, wanted in zip(frames, expected, strict=True):
        assert found.camera == wanted.camera
        np.testing.assert_array_equal(found.color, wanted.color)
        assert (found.depth is None) == (wanted.depth is None)
        if found.depth is not None and wanted.depth is not None:
            assert found.depth.dtype == wanted.depth.dtype
            assert found.depth_scale == wanted.depth_scale
            np.testing.assert_array_equal(found.depth, wanted.depth)


@settings(max_examples=60, deadline=None)
@given(frames=recordings())
def test_frames_round_trip(
    frames: list[RgbdFrame], tmp_path_factory: pytest.TempPathFactory
) -> None:
    path = record(tmp_path_factory.getbasetemp() / "frames.mcap", list(map(trace_of, frames)))
    for tolerance in (0, 15):
        check_same(play(path, pair_tolerance_ms=tolerance), frames)


def test_a_recording_of_a_recording_is_the_same(tmp_path: Path) -> None:
    frames = play(write_bag(tmp_path, rgbd(range(3))))
    first = play(record(tmp_path / "1.mcap", list(map(trace_of, frames))))
    check_same(first, frames)
    check_same(play(record(tmp_path / "2.mcap", list(map(trace_of, first)))), frames)


def test_numbers_go_on_in_a_loop_over_part_of_a_recording(tmp_path: Path) -> None:
    path = record(tmp_path / "out.mcap", [trace_of(make_frame(i)) for i in range(5)])
    frames = play(path, start=3 * PERIOD / 1e9, loop=3)
    assert [frame.header.sequence for frame in frames] == [13, 14, 15, 16, 17, 18]


def test_in_a_loop_time_goes_on_where_a_clock_was_set_back(tmp_path: Path) -> None:
    stamps = [T0 + at for at in (0, PERIOD, 2 * PERIOD, -60 * PERIOD, -59 * PERIOD)]
    headers = [Header(stamp, 10 + k, OPTICAL, stamp + 7) for k, stamp in enumerate(stamps)]
    frames = [replace(make_frame(k), header=header) for k, header in enumerate(headers)]
    path = record(tmp_path / "out.mcap", list(map(trace_of, frames)))
    played = [frame.header.stamp_ns for frame in play(path, loop=3)]
    steps = np.diff(played)
    assert np.diff(stamps).tolist() == steps[:4].tolist() == steps[5:9].tolist()
    assert [PERIOD / 2 < step < 2 * PERIOD for step in steps[[4, 9]]] == [True, True]


def unknown(n: int, *shape: int) -> Any:
    """Draw (n, *shape) floats of which some rows are unknown: NaN."""
    size = int(np.prod(shape, dtype=int))
    row = st.lists(finite, min_size=size, max_size=size) | st.just([np.nan] * size)
    rows = st.lists(row, min_size=n, max_size=n)
    return rows.map(lambda values: np.array(values, float).reshape(n, *shape))


def outlines(draw: st.DrawFn, n: int) -> dict[str, Any]:
    radius = draw(st.lists(positive, min_size=n, max_size=n))
    return {"center": draw(unknown(n, 2).map(np.nan_to_num)), "radius": np.array(radius)}


@st.composite
def tables(draw: st.DrawFn) -> Columns:
    n = draw(st.integers(0, 4))
    rows = outlines(draw, n)
    known = np.array(draw(st.lists(st.booleans(), min_size=n, max_size=n)), bool)
    score = np.array(draw(st.lists(st.floats(0, 1), min_size=n, max_size=n)))
    position = np.where(known[:, None], np.nan_to_num(draw(unknown(n, 3))), np.nan)
    axis = np.where(known[:, None], [0.28, 0.0, 0.96], np.nan)
    quaternion = np.where(known[:, None], [0.1, 0.1, 0.7, 0.7], np.nan)
    kind = draw(st.sampled_from([Circles, Locations, Poses, Picks, Truth]))
    source = np.where(known, DepthSource.MEASURED, DepthSource.MISSING)
    diameter = np.where(known, 0.1 + 0.2, np.nan)
    values = rows | {
        "id": np.arange(n) * 2**40,
        "score": score,
        "position": position,
        "distance": np.abs(position[:, 0]),
        "diameter": diameter,
        "diameter_max": diameter,
        "source": source,
        "sigma_position": np.abs(draw(unknown(n, 3))),
        "sigma_diameter": np.abs(draw(unknown(n))),
        "sigma_tilt": draw(unknown(n)),
        "sigma_rad": np.abs(draw(unknown(n))),
        "fitness": draw(unknown(n)),
        "quaternion": quaternion,
        "axis": axis,
        "apex": position,
        "surface": position,
        "valid": known,
        "visible": score,
        "flags": np.where(known, 8, 1),
        "ignore": np.where(known, 0, 7),
        "frame_id": "robot_base",
    }
    return kind(**{item.name: values[item.name] for item in fields(kind)})


@settings(max_examples=80, deadline=None)
@given(table=tables())
def test_tables_round_trip_exactly(
    table: Columns, tmp_path_factory: pytest.TempPathFactory
) -> None:
    trace = trace_of(make_frame(), stage=table)
    path = record(tmp_path_factory.getbasetemp() / "table.mcap", [trace])
    (raw,) = RecordingReader(path).messages({"/mushpipe/stage"})
    decoded = decode_table(f"mushpipe.{type(table).__name__}", raw.message.data, 5)
    assert decoded is not None
    assert type(decoded.table) is type(table)
    for item in fields(table):  # type: ignore[arg-type]
        found, wanted = getattr(decoded.table, item.name), getattr(table, item.name)
        np.testing.assert_array_equal(found, wanted)
        assert getattr(found, "dtype", str) == getattr(wanted, "dtype", str)
    assert (decoded.header.stamp_ns, decoded.header.sequence) == (T0, 10)
    assert decoded.header.arrival_ns == 5


def test_results_can_be_played_again(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    frames = [make_frame(i) for i in range(3)]
    traces = [
        trace_of(f, clean=f, detect=make_circles(), pick=(no_picks(), make_picks())) for f in frames
    ]
    path = record(tmp_path / "out.mcap", traces)
    check_same(play(path), frames)
    assert caplog.messages == []


def test_results_without_images_cannot_be_played_and_say_so(tmp_path: Path) -> None:
    path = record(tmp_path / "o.mcap", [trace_of(make_frame(), a=make_circles())], frames=False)
    frames, error = drain(McapSource(path=path))
    assert frames == []
    held = "/mushpipe/a, /mushpipe/a/annotations, /mushpipe/timing"
    assert f"it holds no colour images (it holds {held})" in str(error)


GRAPH = {
    "mushpipe": 1,
    "stages": {
        "segment": {"use": "otsu"},
        "open": {"use": "opening", "size": 3},
        "detect": {"use": "hough", "radius_px": [4, 30]},
        "locate": {"use": "nearest-depth"},
        "pick": {"use": "picks"},
    },
}


def bed_frames() -> list[RgbdFrame]:
    """Return frames of white discs on a dark ground."""
    y, x = np.mgrid[:120, :160]
    frames = []
    for i in range(4):
        disc = np.hypot(x - 40 - i, y - 60) < 15
        disc |= np.hypot(x - 110, y - 50 + i) < 20
        color = np.where(disc[..., None], 220, 40).astype(np.uint8) + np.zeros(3, np.uint8)
        depth = np.where(disc, 3800, 4000).astype(np.uint16)
        depth[40:45] = 0
        camera = Camera(160, 120, 200.0, 200.0, 79.5, 59.5)
        # A millisecond a frame: real time is over before it is noticed.
        header = Header(T0 + i * 1_000_000, i, OPTICAL)
        frames.append(RgbdFrame(header, color, depth, 0.000125, camera))
    return frames


def run_graph(source: Path, out: Path, speed: float) -> dict[str, list[Any]]:
    """Run the graph and return all messages by topic, as mcap's own reader gives them."""
    data = GRAPH | {
        "source": {"use": "mcap", "path": str(source), "speed": speed},
        "sinks": {"log": {"use": "mcap", "path": str(out)}},
    }
    report = run(compile_document(Document("test.yaml", out.parent, data), load_registry()))
    assert (report.exit_code, report.processed) == (0, 4)
    topics: dict[str, list[Any]] = {}
    with out.open("rb") as file:
        for _, channel, message in make_reader(file).iter_messages(log_time_order=False):
            times = (message.log_time, message.publish_time, message.sequence)
            topics.setdefault(channel.topic, []).append((*times, message.data))
    return topics


def test_running_twice_gives_the_same_bytes_at_any_speed(tmp_path: Path) -> None:
    source = record(tmp_path / "bed.mcap", list(map(trace_of, bed_frames())))
    first, second, paced = (
        run_graph(source, tmp_path / f"{i}.mcap", speed) for i, speed in enumerate((0, 0, 1))
    )
    assert set(first) == {
        "/camera/color/image_raw",
        "/camera/color/camera_info",
        "/camera/aligned_depth_to_color/image_raw",
        "/mushpipe/segment",
        "/mushpipe/segment/initial",
        "/mushpipe/open",
        "/mushpipe/open/initial",
        "/mushpipe/detect",
        "/mushpipe/detect/annotations",
        "/mushpipe/locate",
        "/mushpipe/pick",
        "/mushpipe/pick/annotations",
        "/mushpipe/pick/scene",
        "/mushpipe/timing",
    }
    for other in (second, paced):
        assert set(other) == set(first)
        for topic in set(first) - {"/mushpipe/timing"}:
            assert other[topic] == first[topic], topic
    assert [len(json.loads(row[3])["id"]) for row in first["/mushpipe/pick"]] == [2] * 4


WRITER = """
import sys
from pathlib import Path
from tests.io.values import *
from mushpipe.sinks.mcap import McapSink
sink = McapSink(path=Path(sys.argv[1]))
sink.open(RunInfo("bed", MANIFEST))
for i in range(int(sys.argv[2])):
    sink.consume(trace_of(make_frame(i, (640, 480), camera=Camera(640, 480, 617, 617, 320, 240))))
print("written", flush=True)
sys.stdin.read()
"""


def test_a_killed_writer_loses_at_most_its_open_chunk(tmp_path: Path) -> None:
    path, count = tmp_path / "killed.mcap", 6
    root = Path(__file__).parents[2]
    command = [sys.executable, "-c", WRITER, str(path), str(count)]
    with subprocess.Popen(
        command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, cwd=root
    ) as process:
        assert process.stdout is not None
        assert process.stdout.readline() == b"written\n"
        process.send_signal(signal.SIGKILL)
    assert process.returncode == -signal.SIGKILL
    source = McapSource(path=path)
    frames, error = drain(source)
    assert len(frames) >= count - 1
    assert [frame.header.sequence for frame in frames] == [10 + i for i in range(len(frames))]
    for i, frame in enumerate(frames):
        np.testing.assert_array_equal(frame.color, make_frame(i, (640, 480)).color)
        assert frame.camera == Camera(640, 480, 617, 617, 320, 240)
    assert "it breaks off: the recorder did not close it" in str(error)
    assert "mushpipe.manifest" in RecordingReader(path).index().metadata


@pytest.mark.parametrize("missing", ["schemas", "counts"])
def test_a_summary_may_leave_things_out(tmp_path: Path, missing: str) -> None:
    """As the specification of MCAP allows: then the file itself is read for them."""
    path = tmp_path / "a.mcap"
    with path.open("wb") as file:
        writer = Writer(file, repeat_schemas=missing != "schemas")
        writer.start()
        channels: dict[str, int] = {}
        for number in range(3):
            frame = make_frame(number)
            for topic, message in (
                (wire.COLOR_TOPIC, wire.encode_color(frame)),
                (wire.DEPTH_TOPIC, wire.encode_depth(frame)),
            ):
                if topic not in channels:
                    known = message.schema
                    schema = writer.register_schema(known.name, known.encoding, known.data)
                    encoding, metadata = known.message_encoding, dict(message.metadata)
                    channels[topic] = writer.register_channel(topic, encoding, schema, metadata)
                stamp = frame.header.stamp_ns
                writer.add_message(channels[topic], stamp, message.data, stamp, number)
        if missing == "counts":
            writer._Writer__statistics.channel_message_counts.clear()
        writer.finish()
    frames = list(McapSource(path=path).frames())
    assert [frame.depth is not None for frame in frames] == [True] * 3


def rewritten(path: Path, out: Path, prefix: str = "", by_topic: bool = False) -> Path:
    """Return a recording as another program writes it: topics renamed, or one in each chunk."""
    with path.open("rb") as file, out.open("wb") as copy:
        reader, writer = make_reader(file), Writer(copy, chunk_size=1000)
        writer.start()
        for metadata in reader.iter_metadata():
            writer.add_metadata(metadata.name, metadata.metadata)
        messages = list(reader.iter_messages(log_time_order=False))
        if by_topic:
            messages.sort(key=lambda each: each[1].topic, reverse=True)
        channels: dict[str, int] = {}
        for schema, channel, message in messages:
            topic = channel.topic.replace("/camera", prefix or "/camera", 1)
            if topic not in channels:
                known = schema and writer.register_schema(schema.name, schema.encoding, schema.data)
                made = (topic, channel.message_encoding, known or 0, channel.metadata)
                channels[topic] = writer.register_channel(*made)
            times = (message.log_time, message.data, message.publish_time, message.sequence)
            writer.add_message(channels[topic], *times)
        writer.finish()
    return out


def numbered_frames(count: int) -> list[RgbdFrame]:
    """Return frames with their number beside them."""
    clocks = [Clock(np.array([i]), np.array([1.0]), np.array([0])) for i in range(count)]
    return [replace(make_frame(i), attached={"/clock": clocks[i]}) for i in range(count)]


@pytest.mark.parametrize("prefix", ["/bed1", "/left/camera"])
def test_topics_of_ones_own_recording_may_be_renamed(tmp_path: Path, prefix: str) -> None:
    frames = numbered_frames(3)
    path = record(tmp_path / "a.mcap", list(map(trace_of, frames)))
    found = play(rewritten(path, tmp_path / "b.mcap", prefix))
    check_same(found, frames)
    assert [list(frame.attached) for frame in found] == [["/clock"]] * 3


def test_ones_own_recording_may_be_written_anew_topic_by_topic(tmp_path: Path) -> None:
    frames = numbered_frames(50)
    path = record(tmp_path / "a.mcap", list(map(trace_of, frames)))
    found = play(rewritten(path, tmp_path / "b.mcap", by_topic=True))
    check_same(found, frames)
    numbers = [json.loads(f.attached["/clock"].data)["number"] for f in found]
    assert numbers == [[i] for i in range(50)]


def test_stamps_that_go_back_neither_turn_frames_round_nor_lose_what_is_beside_them(
    tmp_path: Path,
) -> None:
    path = tmp_path / "a.mcap"
    writer = RecordingWriter(path, {MANIFEST: {"json": "{}"}})
    for number, shift in enumerate([0, 0, 0, -30, -30, -30]):
        frame = make_frame(number)
        stamp = frame.header.stamp_ns + shift * 33_000_000
        header = replace(frame.header, stamp_ns=stamp, arrival_ns=stamp)
        clock = Clock(np.array([number]), np.array([1.0]), np.array([0]))
        writer.frame(replace(frame, header=header, attached={"/clock": clock}))
    writer.close()
    frames = list(McapSource(path=path).frames())
    assert [frame.header.sequence for frame in frames] == [10, 11, 12, 13, 14, 15]
    numbers = [json.loads(f.attached["/clock"].data)["number"] for f in frames]
    assert numbers == [[i] for i in range(6)]


def test_a_depth_scale_that_the_recording_states_is_kept_and_the_setting_told_of(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    path = record(tmp_path / "a.mcap", [trace_of(make_frame())])
    (plain,) = McapSource(path=path).frames()
    (asked,) = McapSource(path=path, depth_scale=0.005).frames()
    assert asked.depth_scale == plain.depth_scale
    assert f"states a depth scale of {plain.depth_scale:g} m" in caplog.text
    assert "source.depth_scale (0.005) does not change" in caplog.text


def test_a_depth_scale_that_is_the_recordings_but_for_rounding_is_not_told_of(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    frame = replace(make_frame(), depth_scale=float(np.float32(0.001)))  # as RealSense states it
    (asked,) = McapSource(
        path=record(tmp_path / "a.mcap", [trace_of(frame)]), depth_scale=0.001
    ).frames()
    assert asked.depth_scale == frame.depth_scale
    assert "does not change" not in caplog.text
