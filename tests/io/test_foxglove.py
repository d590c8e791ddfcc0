"""What Foxglove shows: drawings in recordings read by mcap's own decoder, and a live connection."""

from __future__ import annotations

import json
import re
import struct
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml
from mcap.reader import make_reader
from mcap_protobuf.decoder import DecoderFactory
from scipy.spatial.transform import Rotation
from typer.testing import CliRunner
from websockets.sync.client import ClientConnection, connect

from mushpipe import PickFlag, Picks, RgbdFrame, RunInfo, Trace
from mushpipe.cli import app
from mushpipe.core import wire
from mushpipe.core.errors import UsageError
from mushpipe.sinks import foxglove as module
from mushpipe.sinks.foxglove import FoxgloveSink
from tests.io.values import make_circles, make_frame, make_picks, no_picks, record, trace_of

NAN = np.nan


def decoded(path: Path) -> dict[str, list[Any]]:
    """Return the protobuf messages of a file by topic, decoded by what the file itself says."""
    found: dict[str, list[Any]] = {}
    with path.open("rb") as file:
        reader = make_reader(file, decoder_factories=[DecoderFactory()])
        for schema, channel, message in reader.iter_messages():
            if schema is not None and schema.encoding == "protobuf":
                decoder = DecoderFactory().decoder_for(channel.message_encoding, schema)
                assert decoder is not None
                found.setdefault(channel.topic, []).append(decoder(message.data))
    return found


def leaning() -> Picks:
    """Three picks: one leans by 30 degrees, one is upright, one has no pose."""
    axes = np.array([[0.5, 0, -np.sqrt(0.75)], [0, 0, -1.0], [NAN] * 3])
    turns = [Rotation.align_vectors(axis[None], [[0, 0, 1.0]])[0] for axis in axes[:2]]
    position = np.array([[0.1, 0.2, 0.5], [0, 0, 0.6], [0.05, 0, 0.6]])
    return Picks(
        id=np.array([4, 5, 6]),
        center=np.array([[10.0, 5.0], [20.0, 12.0], [3.0, 3.0]]),
        radius=np.array([3.0, 4.0, 5.0]),
        position=position,
        surface=position,
        distance=np.linalg.norm(position, axis=1),
        diameter=np.array([0.04, 0.05, 0.03]),
        quaternion=np.array([*(turn.as_quat() for turn in turns), [NAN] * 4]),
        axis=axes,
        score=np.array([0.5, 0.9, 0.2]),
        sigma_position=np.full((3, 3), NAN),
        sigma_diameter=np.full(3, NAN),
        sigma_tilt=np.array([np.radians(20), 0.0, NAN]),
        source=np.ones(3, np.uint8),
        flags=np.array([0, 0, PickFlag.POSE_UNKNOWN]),
        frame_id="optical",
    )


def xyz(vector: Any) -> list[float]:
    return [vector.x, vector.y, vector.z]


def turn(quaternion: Any) -> Rotation:
    return Rotation.from_quat([quaternion.x, quaternion.y, quaternion.z, quaternion.w])


def test_circles_are_drawn_where_foxglove_counts_pixels_from(tmp_path: Path) -> None:
    trace = trace_of(make_frame(), detect=make_circles(), pick=leaning())
    topics = decoded(record(tmp_path / "out.mcap", [trace]))
    (message,) = topics["/mushpipe/pick/annotations"]
    # The centre of the first pixel is (0, 0) here and (0.5, 0.5) in Foxglove.
    centers = [(c.position.x, c.position.y) for c in message.circles]
    assert centers == [(10.5, 5.5), (20.5, 12.5), (3.5, 3.5)]
    assert [c.diameter for c in message.circles] == [6, 8, 10]
    assert [t.text for t in message.texts] == ["4: 40 mm", "5: 50 mm", "6: 30 mm"]
    (plain,) = topics["/mushpipe/detect/annotations"]
    assert len(plain.circles) == 2
    assert not plain.texts


def test_an_axis_without_its_quaternion_is_no_pose_to_draw(tmp_path: Path) -> None:
    picks = replace(leaning(), quaternion=np.full((3, 4), NAN))
    topics = decoded(record(tmp_path / "out.mcap", [trace_of(make_frame(), pick=picks)]))
    (entity,) = topics["/mushpipe/pick/scene"][0].entities
    assert (len(entity.spheres), len(entity.arrows), len(entity.texts)) == (0, 0, 3)


def test_caps_axes_and_order_stand_in_the_scene(tmp_path: Path) -> None:
    picks = leaning()
    topics = decoded(record(tmp_path / "out.mcap", [trace_of(make_frame(), pick=picks)]))
    (entity,) = topics["/mushpipe/pick/scene"][0].entities
    assert (entity.frame_id, entity.id) == ("optical", "picks")
    for row, sphere, arrow in zip([0, 1], entity.spheres, entity.arrows, strict=True):
        half = np.array(xyz(sphere.size)) / 2
        top = np.array(xyz(sphere.pose.position)) + turn(sphere.pose.orientation).apply(
            [0, 0, half[2]]
        )
        np.testing.assert_allclose(top, picks.position[row], atol=1e-12)
        np.testing.assert_allclose(half[:2], picks.diameter[row] / 2)
        assert 0 < sphere.color.a < 1
        np.testing.assert_allclose(xyz(arrow.pose.position), picks.position[row])
        # An arrow of Foxglove's points along +x.
        pointing = turn(arrow.pose.orientation).apply([1, 0, 0])
        np.testing.assert_allclose(pointing, picks.axis[row], atol=1e-12)
    uncertain, certain = (arrow.color for arrow in entity.arrows)
    assert certain.g > certain.r
    assert uncertain.r > uncertain.g
    places = {text.text: xyz(text.pose.position) for text in entity.texts}
    assert {rank: places[rank] for rank in "123"} == {
        "1": list(picks.position[0]),
        "2": list(picks.position[1]),
        "3": list(picks.position[2]),
    }


def test_nothing_found_clears_the_scene(tmp_path: Path) -> None:
    traces = [trace_of(make_frame(0), pick=make_picks()), trace_of(make_frame(1), pick=no_picks())]
    topics = decoded(record(tmp_path / "out.mcap", traces))
    first, second = (message.entities[0] for message in topics["/mushpipe/pick/scene"])
    assert first.id == second.id
    assert len(first.texts) == 1
    assert not [*second.texts, *second.spheres, *second.arrows]
    assert not topics["/mushpipe/pick/annotations"][1].circles


def advertised(client: ClientConnection, wanted: set[str]) -> dict[str, dict[str, Any]]:
    """Return the channels by topic, once all that are wanted are known."""
    channels: dict[str, dict[str, Any]] = {}
    while not wanted <= set(channels):
        message = json.loads(client.recv(timeout=10))
        if message["op"] == "advertise":
            channels |= {c["topic"]: c for c in message["channels"]}
    return channels


def test_a_client_of_the_websocket_protocol_gets_frames_and_picks() -> None:
    sink = FoxgloveSink(port=0)
    sink.open(RunInfo("bed", {}))
    try:
        trace = trace_of(make_frame(), detect=make_circles(), pick=make_picks())
        sink.consume(trace)
        port = sink._server.port
        with connect(
            f"ws://127.0.0.1:{port}", subprotocols=["foxglove.sdk.v1"], max_size=None
        ) as client:
            wanted = {"/camera/color/image_raw", "/mushpipe/pick", "/mushpipe/pick/scene"}
            channels = advertised(client, wanted)
            assert channels["/mushpipe/pick/scene"]["schemaName"] == "foxglove.SceneUpdate"
            ask = [{"id": 1, "channelId": channels["/mushpipe/pick"]["id"]}]
            client.send(json.dumps({"op": "subscribe", "subscriptions": ask}))
            data = None
            for _ in range(100):  # the subscription takes effect when it does
                sink.consume(trace)
                try:
                    data = client.recv(timeout=0.1)
                except TimeoutError:
                    continue
                if isinstance(data, bytes):
                    break
            assert isinstance(data, bytes)
            opcode, subscription, stamp = struct.unpack_from("<BIQ", data)
            assert (opcode, subscription) == (1, 1)
            assert stamp == trace.frame.header.stamp_ns
            assert json.loads(data[13:])["id"] == [7, 8]
    finally:
        sink.close()
        sink.close()


def test_where_the_camera_hangs_is_told_where_the_graph_says_it() -> None:
    base = {"frame": "base", "translation": [0.4, -0.1, 0.9], "quaternion": [0.6, 0.0, 0.0, 0.8]}
    stages = {"pick": {"use": "picks", "T_base_camera": base}}
    sink = FoxgloveSink(port=0)
    sink.open(RunInfo("bed", {"graph": {"stages": stages}}))
    try:
        sink.consume(trace_of(make_frame(), pick=make_picks()))
        address = f"ws://127.0.0.1:{sink._server.port}"
        with connect(address, subprotocols=["foxglove.sdk.v1"], max_size=None) as client:
            told = advertised(client, {wire.TIMING_TOPIC})[wire.BASE_TOPIC]
            assert told["schemaName"] == "foxglove.FrameTransform"
    finally:
        sink.close()


def test_a_frame_without_depth_and_calibration_is_sent() -> None:
    sink = FoxgloveSink(port=0)
    sink.open(RunInfo("bed", {}))
    try:
        sink.consume(trace_of(make_frame(depth=None, camera=None), detect=make_circles()))
        address = f"ws://127.0.0.1:{sink._server.port}"
        with connect(address, subprotocols=["foxglove.sdk.v1"], max_size=None) as client:
            assert set(advertised(client, {wire.TIMING_TOPIC})) == {
                wire.COLOR_TOPIC,
                "/mushpipe/detect",
                "/mushpipe/detect/annotations",
                wire.TIMING_TOPIC,
            }
    finally:
        sink.close()


def test_frames_that_nobody_asked_for_are_not_made(monkeypatch: pytest.MonkeyPatch) -> None:
    sink, made = FoxgloveSink(port=0), list[str]()
    sink.open(RunInfo("bed", {}))
    encode_color = module.wire.encode_color

    def counted(frame: RgbdFrame, jpeg_quality: int | None) -> wire.Message:
        made.append("color")
        return encode_color(frame, jpeg_quality)

    monkeypatch.setattr(module.wire, "encode_color", counted)
    for _ in range(5):
        sink.consume(trace_of(make_frame(), pick=make_picks()))
    assert made == ["color"]
    sink.close()


def test_it_listens_on_this_machine_only_and_a_taken_port_is_named() -> None:
    sink = FoxgloveSink(port=0)
    sink.open(RunInfo("bed", {}))
    try:
        port = sink._server.port
        listening = Path("/proc/net/tcp").read_text()
        assert f"0100007F:{port:04X} 00000000:0000 0A" in listening
        assert f"00000000:{port:04X}" not in listening
        second = FoxgloveSink(port=port)
        with pytest.raises(UsageError, match=f"{port} cannot be served"):
            second.open(RunInfo("bed", {}))
        second.close()
    finally:
        sink.close()


def test_the_layout_is_what_the_sdk_makes_and_names_topics_of_the_demo() -> None:
    from examples.foxglove_layout import STAGES, layout

    text = Path("graphs/foxglove-layout.json").read_text()
    assert text == layout().to_json() + "\n"
    stages = yaml.safe_load(Path("graphs/demo.yaml").read_text())["stages"]
    assert list(STAGES) == list(stages)
    ends = ("", "/annotations", "/scene")
    topics = {f"/mushpipe/{stage}{end}" for stage in stages for end in ends}
    topics |= {wire.COLOR_TOPIC, wire.CAMERA_TOPIC, wire.TIMING_TOPIC}
    named = set(re.findall(r'"(/[a-z/_-]+)', text))
    assert named <= topics


def test_any_graph_can_be_served(tmp_path: Path) -> None:
    source = record(tmp_path / "bed.mcap", [Trace(make_frame(), {}, {})])
    graph = tmp_path / "g.yaml"
    graph.write_text(f"mushpipe: 1\nsource: {{use: mcap, path: {source}}}\nsinks:\n")
    command = ["run", str(graph), "--foxglove", "--set", "foxglove.port=0"]
    command += ["--manifest", str(tmp_path / "run.json")]
    assert CliRunner().invoke(app, command).exit_code == 0
    manifest = json.loads((tmp_path / "run.json").read_text())
    assert manifest["graph"]["sinks"]["foxglove"]["host"] == "127.0.0.1"
    assert manifest["result"]["sinks"]["foxglove"]["consumed"] == 1
