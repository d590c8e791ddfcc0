"""What the sink `mcap` writes, read back by readers that are not ours."""

from __future__ import annotations

import json
from collections import Counter
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import zstandard
from mcap.reader import make_reader
from mcap.records import Channel, Chunk, Message, Metadata
from mcap.stream_reader import StreamReader
from mcap_protobuf.decoder import DecoderFactory

from mushpipe import Header, Mask, RunInfo
from mushpipe.core.errors import UsageError
from mushpipe.sinks.mcap import McapSink
from mushpipe.traces import read_traces
from tests.io.bags import FX, FY, OPTICAL, PERIOD, T0, color_pixels, depth_pixels
from tests.io.values import (
    LENS,
    MANIFEST,
    SIZE,
    feed,
    make_circles,
    make_frame,
    make_picks,
    record,
    trace_of,
)

COLOR = "/camera/color/image_raw"
DEPTH = "/camera/aligned_depth_to_color/image_raw"
INFO = "/camera/color/camera_info"


def by_topic(path: Path) -> dict[str, list[Any]]:
    """Return (schema, channel, message, decoded) by topic, as mcap's own reader gives them."""
    found: dict[str, list[Any]] = {}
    with path.open("rb") as file:
        reader = make_reader(file, validate_crcs=True)
        factory = DecoderFactory()
        for schema, channel, message in reader.iter_messages():
            decode = factory.decoder_for(channel.message_encoding, schema) or json.loads
            row = (schema, channel, message, decode(message.data))
            found.setdefault(channel.topic, []).append(row)
    return found


def metadata(path: Path) -> dict[str, dict[str, Any]]:
    with path.open("rb") as file:
        records = list(make_reader(file).iter_metadata())
    return {record.name: json.loads(record.metadata["json"]) for record in records}


def pixels(image: Any, dtype: type, *channels: int) -> np.ndarray[Any, Any]:
    return np.frombuffer(image.data, dtype).reshape(image.height, image.width, *channels)


def test_images_are_foxglove_images_with_the_times_of_the_frame(tmp_path: Path) -> None:
    traces = [trace_of(make_frame(i)) for i in range(3)]
    topics = by_topic(record(tmp_path / "out.mcap", traces))
    assert {t: (rows[0][0].name, len(rows)) for t, rows in topics.items()} == {
        COLOR: ("foxglove.RawImage", 3),
        DEPTH: ("foxglove.RawImage", 3),
        INFO: ("foxglove.CameraCalibration", 1),
    }
    for topic, encoding, step in ((COLOR, "rgb8", 96), (DEPTH, "mono16", 64)):
        for i, (_, channel, message, image) in enumerate(topics[topic]):
            assert message.publish_time == T0 + i * PERIOD
            assert message.log_time == T0 + i * PERIOD + 5_000_000
            assert message.sequence == 10 + i
            assert image.timestamp.seconds * 10**9 + image.timestamp.nanos == T0 + i * PERIOD
            assert (image.encoding, image.step, image.frame_id) == (encoding, step, OPTICAL)
            assert channel.message_encoding == "protobuf"
    for i in range(3):
        color, depth = topics[COLOR][i][3], topics[DEPTH][i][3]
        np.testing.assert_array_equal(pixels(color, np.uint8, 3), color_pixels(i, SIZE))
        np.testing.assert_array_equal(pixels(depth, np.uint16), depth_pixels(i, SIZE))


@pytest.mark.parametrize(
    ("scale", "dtype", "encoding"),
    [
        (0.001, np.uint16, "16UC1"),
        (float(np.float32(0.001)), np.uint16, "16UC1"),  # as librealsense states it
        (0.000125, np.uint16, "mono16"),
        (1.0, np.float32, "32FC1"),
    ],
)
def test_only_millimetres_are_called_16uc1(
    scale: float, dtype: type, encoding: str, tmp_path: Path
) -> None:
    frame = make_frame(depth=depth_pixels(0, SIZE).astype(dtype), depth_scale=scale)
    _, channel, _, image = by_topic(record(tmp_path / "out.mcap", [trace_of(frame)]))[DEPTH][0]
    assert image.encoding == encoding
    assert float(channel.metadata["depth_scale"]) == scale


def test_the_calibration_is_complete_and_written_when_it_changes(tmp_path: Path) -> None:
    other = type(LENS)(*SIZE, 99.0, 98.0, 1.0, 2.0)
    frames = [make_frame(0), make_frame(1), make_frame(2, camera=other)]
    rows = by_topic(record(tmp_path / "out.mcap", list(map(trace_of, frames))))[INFO]
    first, second = (row[3] for row in rows)
    assert list(first.K) == [FX, 0, 15.5, 0, FY, 11.5, 0, 0, 1]
    assert list(first.P) == [FX, 0, 15.5, 0, 0, FY, 11.5, 0, 0, 0, 1, 0]
    assert list(first.D) == [0.1, -0.2, 0.001, 0.002, 0.05]
    assert (first.width, first.height, first.distortion_model) == (*SIZE, "plumb_bob")
    assert (second.K[0], list(second.D), second.distortion_model) == (99, [], "")


def test_the_manifest_and_the_calibration_stand_before_the_first_image(tmp_path: Path) -> None:
    path = record(tmp_path / "out.mcap", [trace_of(make_frame())])
    topics: dict[int, str] = {}
    order = []
    with path.open("rb") as file:
        for item in StreamReader(file).records:
            if isinstance(item, Channel):
                topics[item.id] = item.topic
            elif isinstance(item, Message | Metadata):
                named = item.name if isinstance(item, Metadata) else topics[item.channel_id]
                order.append(named)
    assert order[0] == "mushpipe.manifest"
    assert [name for name in order if name in (INFO, COLOR, DEPTH)] == [INFO, COLOR, DEPTH]
    assert metadata(path) == {"mushpipe.manifest": MANIFEST, "mushpipe.summary": {"exit_code": 0}}


def test_only_images_that_a_stage_made_are_recorded(tmp_path: Path) -> None:
    frame = make_frame()
    bright = replace(frame, color=frame.color // 2 + 100)
    deep = replace(bright, depth=frame.depth + np.uint16(1))
    scaled = replace(deep, depth_scale=0.002)
    trace = trace_of(frame, bright=bright, same=replace(bright), deep=deep, scaled=scaled)
    topics = set(by_topic(path := record(tmp_path / "all.mcap", [trace])))
    made = {"/mushpipe/bright/color", "/mushpipe/deep/depth", "/mushpipe/scaled/depth"}
    (again,) = read_traces(path)
    assert again.outputs["scaled"][0].depth_scale == 0.002
    assert topics == {COLOR, DEPTH, INFO, "/mushpipe/timing", *made}
    given = record(tmp_path / "given.mcap", [trace], frames="source")
    assert set(by_topic(given)) == topics - made
    few = record(tmp_path / "few.mcap", [trace], frames=False)
    assert set(by_topic(few)) == {"/mushpipe/timing"}


def test_colour_without_depth_is_recorded_once_though_stages_pass_it_on(tmp_path: Path) -> None:
    frame = make_frame()
    flat = replace(frame, depth=None)
    path = record(tmp_path / "flat.mcap", [trace_of(flat, same=flat, again=replace(flat))])
    assert set(by_topic(path)) == {COLOR, INFO, "/mushpipe/timing"}
    path = record(tmp_path / "lost.mcap", [trace_of(frame, lost=flat, again=replace(flat))])
    assert set(by_topic(path)) == {COLOR, DEPTH, INFO, "/mushpipe/timing", "/mushpipe/lost/color"}


def test_chunks_are_compressed_at_the_fastest_usual_level(tmp_path: Path) -> None:
    """mcap's writer has no setting for it: this fails if it no longer calls what it is given."""
    path = record(tmp_path / "run.mcap", [trace_of(make_frame(i)) for i in range(3)])
    with path.open("rb") as file:
        records = StreamReader(file, emit_chunks=True).records
        chunks = [each for each in records if isinstance(each, Chunk)]
    raw = [zstandard.decompress(chunk.data, chunk.uncompressed_size) for chunk in chunks]
    assert [chunk.data for chunk in chunks] == [zstandard.compress(data, level=1) for data in raw]
    assert [chunk.data for chunk in chunks] != [zstandard.compress(data) for data in raw]


def test_lz4_holds_the_same(tmp_path: Path) -> None:
    traces = [trace_of(make_frame(i), pick=make_picks()) for i in range(3)]
    paths = [record(tmp_path / f"{how}.mcap", traces, compression=how) for how in ("zstd", "lz4")]
    zstd, lz4 = (
        {topic: [row[2].data for row in rows] for topic, rows in by_topic(path).items()}
        for path in paths
    )
    assert zstd == lz4
    with paths[1].open("rb") as file:
        assert {chunk.compression for chunk in make_reader(file).get_summary().chunk_indexes} == {
            "lz4"
        }


def test_every_output_has_a_topic_of_its_own(tmp_path: Path) -> None:
    foreground = np.zeros((24, 32), bool)
    foreground[3:5, 4:9] = True
    stages = {
        "clean": make_frame(0, depth=None),
        "segment": Mask(foreground, ~foreground),
        "detect": (make_circles(), Mask(foreground)),
        "pick": make_picks(),
    }
    trace = trace_of(make_frame(), **stages)
    topics = by_topic(record(tmp_path / "out.mcap", [trace]))
    results = {t: rows[0][0].name for t, rows in topics.items() if t.startswith("/mushpipe/")}
    assert results == {
        "/mushpipe/clean/color": "foxglove.RawImage",
        "/mushpipe/segment": "foxglove.RawImage",
        "/mushpipe/segment/initial": "foxglove.RawImage",
        "/mushpipe/detect": "mushpipe.Circles",
        "/mushpipe/detect/annotations": "foxglove.ImageAnnotations",
        "/mushpipe/detect/mask": "foxglove.RawImage",
        "/mushpipe/pick": "mushpipe.Picks",
        "/mushpipe/pick/annotations": "foxglove.ImageAnnotations",
        "/mushpipe/pick/scene": "foxglove.SceneUpdate",
        "/mushpipe/timing": "mushpipe.Timing",
    }
    mask, initial = (topics[f"/mushpipe/segment{end}"][0][3] for end in ("", "/initial"))
    np.testing.assert_array_equal(pixels(mask, np.uint8), foreground * 255)
    np.testing.assert_array_equal(pixels(initial, np.uint8), ~foreground * 255)
    assert mask.encoding == "mono8"
    timing = topics["/mushpipe/timing"][0][3]
    assert timing["stages_ns"] == {"clean": 1000, "segment": 2000, "detect": 3000, "pick": 4000}


def test_tables_are_plain_json_described_by_a_schema_in_the_file(tmp_path: Path) -> None:
    trace = trace_of(make_frame(), pick=make_picks())
    schema, channel, message, body = by_topic(record(tmp_path / "o.mcap", [trace]))[
        "/mushpipe/pick"
    ][0]
    assert (schema.encoding, channel.message_encoding) == ("jsonschema", "json")
    assert message.publish_time == T0
    described = json.loads(schema.data)["properties"]
    assert set(described) == set(body)
    assert described["position"]["items"]["minItems"] == 3
    assert body["timestamp"] == {"sec": T0 // 10**9, "nsec": 0}
    assert (body["sequence"], body["frame_id"]) == (10, OPTICAL)
    assert body["radius"] == [3.5, 1 / 3]
    assert body["position"] == [[0.1, -0.2, 0.5], [None, None, None]]
    assert body["distance"] == [0.55, None]
    assert (body["id"], body["source"], body["flags"]) == ([7, 8], [2, 0], [2, 13])


def test_images_and_drawings_may_be_left_out(tmp_path: Path) -> None:
    trace = trace_of(make_frame(), detect=make_circles())
    nothing_else = {"frames": False, "timing": False, "drawings": False}
    topics = by_topic(record(tmp_path / "out.mcap", [trace], **nothing_else))
    assert set(topics) == {"/mushpipe/detect"}


def test_color_may_be_jpeg(tmp_path: Path) -> None:
    red = np.zeros((24, 32, 3), np.uint8)
    red[..., 0] = 200
    path = record(tmp_path / "out.mcap", [trace_of(make_frame(color=red))], jpeg_quality=95)
    schema, _, _, image = by_topic(path)[COLOR][0]
    assert (schema.name, image.format) == ("foxglove.CompressedImage", "jpeg")
    decoded = cv2.imdecode(np.frombuffer(image.data, np.uint8), cv2.IMREAD_COLOR_RGB)
    assert np.abs(decoded.astype(int) - red).max() <= 4


@dataclass(frozen=True)
class Opinion:
    text: str


def test_a_value_without_wire_form_is_left_out_and_named_once(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    traces = [trace_of(make_frame(i), judge=Opinion("fine")) for i in range(2)]
    topics = by_topic(record(tmp_path / "out.mcap", traces))
    assert Counter(caplog.messages) == {
        "judge is not recorded: Opinion is not a Columns type": 1,
    }
    assert "/mushpipe/judge" not in topics


def test_the_path_takes_the_name_of_the_recording_and_its_folder_is_made(tmp_path: Path) -> None:
    sink = McapSink(path=tmp_path / "new" / "{recording}.out.mcap")
    feed(sink, [{"trace": trace_of(make_frame())}])
    assert set(by_topic(tmp_path / "new" / "bed.out.mcap")) == {COLOR, DEPTH, INFO}


def test_a_name_that_would_not_be_played_as_what_it_is_is_refused(tmp_path: Path) -> None:
    for name in ("row-7.bag", "ROW-7.BAG"):
        with pytest.raises(ValueError, match=r"name it \.mcap"):
            McapSink(path=tmp_path / name)


def test_a_header_without_arrival_time_is_logged_at_its_stamp(tmp_path: Path) -> None:
    frame = make_frame(header=Header(T0, 0, OPTICAL))
    (row,) = by_topic(record(tmp_path / "out.mcap", [trace_of(frame)]))[COLOR]
    assert row[2].log_time == row[2].publish_time == T0


def test_viewers_are_told_where_the_camera_is_in_the_robots_frame(tmp_path: Path) -> None:
    base = {"frame": "base", "translation": [0.4, -0.1, 0.9], "quaternion": [0.6, 0.0, 0.0, 0.8]}
    stages = {
        "pick": {"use": "picks", "T_base_camera": base},
        "own": {"use": "mine.py:Mine", "T_base_camera": [1, 2, 3]},  # means something else there
    }
    manifest = {"graph": {"stages": stages}}
    sink = McapSink(path=tmp_path / "a.mcap")
    sink.open(RunInfo("bed", manifest))
    sink.consume(trace_of(make_frame(), pick=replace(make_picks(), frame_id="base")))
    sink.close()
    ((schema, _, _, told),) = by_topic(tmp_path / "a.mcap")["/mushpipe/T_base_camera"]
    assert schema.name == "foxglove.FrameTransform"
    assert (told.parent_frame_id, told.child_frame_id) == ("base", OPTICAL)
    assert [told.translation.x, told.translation.y, told.translation.z] == base["translation"]
    rotation = told.rotation
    assert [rotation.x, rotation.y, rotation.z, rotation.w] == base["quaternion"]
    (trace,) = read_traces(tmp_path / "a.mcap")
    assert set(trace.outputs) == {"pick"}


def test_a_part_that_cannot_be_begun_is_why_nothing_more_is_recorded(tmp_path: Path) -> None:
    (tmp_path / "row_001.mcap").write_bytes(b"another recording")
    sink = McapSink(path=tmp_path / "row.mcap", split_size=1, overwrite=False)
    sink.open(RunInfo("", {}))
    for number in (0, 1, 2):
        with pytest.raises(UsageError, match=r"row_001\.mcap exists"):
            sink.consume(trace_of(make_frame(number)))
    sink.close()


def test_a_later_part_without_the_first_is_not_deleted(tmp_path: Path) -> None:
    other = tmp_path / "bed_001.mcap"
    other.write_bytes(b"another recording")
    with pytest.raises(UsageError, match=r"bed_001.mcap is there, but no bed_000.mcap"):
        McapSink(path=tmp_path / "bed.mcap", split_size=1).open(RunInfo("", {}))
    assert other.read_bytes() == b"another recording"


def test_a_shorter_run_leaves_no_parts_of_the_one_before_and_touches_nothing_else(
    tmp_path: Path,
) -> None:
    path = tmp_path / "row.mcap"
    others = [tmp_path / f"row_{name}.mcap" for name in ("7", "20261126", "b_001", "left")]
    for other in others:
        other.write_bytes(b"another recording")
    lengths = []
    for frames in (6, 2):
        record(path, [trace_of(make_frame(k)) for k in range(frames)], split_size=1)
        parts = sorted(set(tmp_path.iterdir()) - set(others))
        assert [each.name for each in parts] == [f"row_{k:03d}.mcap" for k in range(len(parts))]
        lengths.append(len(parts))
    assert lengths[0] > lengths[1] > 0
    assert {other.read_bytes() for other in others} == {b"another recording"}
    sink = McapSink(path=path, split_size=1)
    assert set(sink.files(RunInfo("", {}))) == set(parts)
