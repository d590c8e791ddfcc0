"""What is written, read back by MCAP's own library, protobuf, json and jsonschema."""

import json
from dataclasses import dataclass
from pathlib import Path

import cv2
import jsonschema
import numpy as np
import pytest
from mcap.reader import make_reader
from mcap_protobuf.decoder import DecoderFactory
from numpy.typing import NDArray

from mushpipe import Camera, Columns, Header, Mask, RgbdFrame, column
from mushpipe.core import wire
from mushpipe.core.recorder import RecordingWriter
from mushpipe.core.recording import RecordingReader
from mushpipe.core.truth import Instances
from tests.core.test_tables import circles, locations, picks, poses, truth

HEADER = Header(1_700_000_000_123_456_789, 7, "camera", 1_700_000_000_200_000_000)
RNG = np.random.default_rng(0)
COLOR = RNG.integers(0, 256, (6, 8, 3), np.uint8)
DEPTH = RNG.integers(0, 65536, (6, 8), np.uint16)
CAMERA = Camera(8, 6, 10.0, 11.0, 3.5, 2.5, "brown_conrady", (0.1, 0.2, 0.3, 0.4, 0.5))


def frame(**changes) -> RgbdFrame:
    return RgbdFrame(**{"header": HEADER, "color": COLOR, "camera": CAMERA, **changes})


@pytest.fixture
def written(tmp_path):
    """Write something with a RecordingWriter, and read it with the MCAP library."""

    def write(act) -> list[tuple]:
        writer = RecordingWriter(tmp_path / "x.mcap", {"note": {"a": "b"}})
        act(writer)
        writer.close()
        with (tmp_path / "x.mcap").open("rb") as file:
            reader = make_reader(file, validate_crcs=True, decoder_factories=[DecoderFactory()])
            found = []
            for schema, channel, message in reader.iter_messages():
                body = json.loads(message.data) if channel.message_encoding == "json" else None
                if body is None:
                    body = DecoderFactory().decoder_for("protobuf", schema)(message.data)
                found.append((channel, schema, message, body))
            return found

    write.path = tmp_path / "x.mcap"
    return write


def test_a_frame_becomes_calibration_colour_and_depth(written):
    rows = written(lambda w: w.frame(frame(depth=DEPTH, depth_scale=0.000125)))
    topics = [(channel.topic, schema.name) for channel, schema, _, _ in rows]
    assert topics == [
        ("/camera/color/camera_info", "foxglove.CameraCalibration"),
        ("/camera/color/image_raw", "foxglove.RawImage"),
        ("/camera/aligned_depth_to_color/image_raw", "foxglove.RawImage"),
    ]
    for _, _, message, body in rows:
        assert (message.publish_time, message.log_time) == (HEADER.stamp_ns, HEADER.arrival_ns)
        assert message.sequence == 7
        assert (body.timestamp.seconds, body.timestamp.nanos) == (1_700_000_000, 123_456_789)
        assert body.frame_id == "camera"
        assert (body.width, body.height) == (8, 6)
    color, depth = rows[1][3], rows[2][3]
    assert (color.encoding, color.step, color.data) == ("rgb8", 24, COLOR.tobytes())
    assert (depth.encoding, depth.step, depth.data) == ("mono16", 16, DEPTH.tobytes())
    assert rows[2][0].metadata == {"depth_scale": "0.000125"}


def test_the_calibration_is_the_camera(written):
    body = written(lambda w: w.frame(frame()))[0][3]
    assert list(body.K) == [10, 0, 3.5, 0, 11, 2.5, 0, 0, 1]
    assert list(body.P) == [10, 0, 3.5, 0, 0, 11, 2.5, 0, 0, 0, 1, 0]
    assert np.array_equal(np.reshape(body.R, (3, 3)), np.eye(3))
    assert (body.distortion_model, list(body.D)) == ("plumb_bob", [0.1, 0.2, 0.3, 0.4, 0.5])


@pytest.mark.parametrize(
    ("model", "lens", "name"),
    [("none", (), ""), ("inverse_brown_conrady", (1.0,) * 5, "inverse_brown_conrady")],
)
def test_names_of_distortion_models(written, model, lens, name):
    camera = Camera(8, 6, 10, 11, 3, 2, model, lens)
    assert written(lambda w: w.frame(frame(camera=camera)))[0][3].distortion_model == name


def test_the_calibration_is_written_again_when_it_changes(written):
    other = Camera(8, 6, 20, 20, 3, 2)

    def act(writer: RecordingWriter) -> None:
        for camera in (None, CAMERA, CAMERA, other, None, None):
            writer.frame(frame(camera=camera))

    rows = written(act)
    focal = [body.K[0] for channel, *_, body in rows if channel.topic == wire.CAMERA_TOPIC]
    assert focal == [0, 10, 20, 0]  # zeros, as in ROS, say that there is none
    assert sum(channel.topic == wire.COLOR_TOPIC for channel, *_ in rows) == 6


@pytest.mark.parametrize(
    ("depth", "scale", "encoding"),
    [
        (DEPTH, 0.001, "16UC1"),
        (DEPTH, 0.00025, "mono16"),
        (DEPTH.astype(np.float32), 1.0, "32FC1"),
    ],
)
def test_depth_keeps_the_sensors_numbers_and_its_scale(written, depth, scale, encoding):
    channel, _, _, body = written(lambda w: w.frame(frame(depth=depth, depth_scale=scale)))[-1]
    assert (body.encoding, body.data) == (encoding, depth.tobytes())
    assert float(channel.metadata["depth_scale"]) == scale


def test_a_frame_without_depth_cannot_be_encoded_as_depth():
    with pytest.raises(ValueError, match=r"^the frame has no depth$"):
        wire.encode_depth(frame())


def test_colour_as_jpeg(written):
    smooth = np.zeros((64, 64, 3), np.uint8)
    smooth[..., 0] = np.arange(64)[:, None] * 4
    smooth[..., 2] = 50
    rows = written(lambda w: w.frame(RgbdFrame(HEADER, smooth), jpeg_quality=95))
    _, schema, _, body = rows[-1]
    assert (schema.name, body.format) == ("foxglove.CompressedImage", "jpeg")
    image = cv2.imdecode(np.frombuffer(body.data, np.uint8), cv2.IMREAD_COLOR)[..., ::-1]
    np.testing.assert_allclose(image.astype(int), smooth, atol=12)


@pytest.mark.parametrize(
    "table", [circles(), locations(), poses(), picks(), truth()], ids=lambda t: type(t).__name__
)
def test_a_table_is_json_that_fits_its_schema_and_loses_nothing(written, table):
    _, schema, message, body = written(lambda w: w.value("/t", table, HEADER))[0]
    assert (schema.name, schema.encoding) == (f"mushpipe.{type(table).__name__}", "jsonschema")
    described = json.loads(schema.data)
    jsonschema.Draft7Validator.check_schema(described)
    jsonschema.validate(body, described)
    assert (body["sequence"], body["frame_id"]) == (7, "camera")
    assert body["timestamp"] == {"sec": 1_700_000_000, "nsec": 123_456_789}
    for name, value in vars(table).items():
        expected = np.asarray(value).tolist()
        expected = json.loads(json.dumps(expected).replace("NaN", "null"))
        assert body[name] == expected
    decoded = wire.decode_table(schema.name, message.data, message.log_time)
    assert decoded.header == HEADER
    for name, value in vars(table).items():
        np.testing.assert_array_equal(getattr(decoded.table, name), value)


@dataclass(frozen=True, eq=False)
class Ripeness(Columns):
    stage: NDArray[np.str_] = column(dtype=str)
    spots: NDArray[np.str_] = column(2, dtype=str)
    ripe: NDArray[np.bool_] = column(dtype=bool)
    share: NDArray[np.float16] = column(dtype=np.float16)
    bed: str = "A"
    temperature: float = np.nan
    watered: bool = True
    row: "int" = 3
    limits: tuple[float, float] | None = None


@pytest.mark.parametrize(
    "table",
    [
        Ripeness(["bud", "ripe"], [["", "brown"], ["a", "b"]], [False, True], [np.nan, 0.5]),
        Ripeness.unknown(2, limits=(1.0, 2.0)),
        Ripeness([], [], [], []),
    ],
)
def test_a_table_of_ones_own_fits_its_schema(written, table):
    _, schema, _, body = written(lambda w: w.value("/t", table, HEADER))[0]
    described = json.loads(schema.data)
    jsonschema.validate(body, described)
    for name in ("stage", "spots", "ripe"):
        assert body[name] == getattr(table, name).tolist()
    assert body["temperature"] is None
    assert (body["bed"], body["watered"], body["row"]) == ("A", True, 3)
    kinds = {name: part.get("type") for name, part in described["properties"].items()}
    assert kinds["bed"] == "string"
    assert kinds["temperature"] == ["number", "null"]
    assert kinds["watered"] == "boolean"
    assert kinds["row"] == "integer"
    assert described["properties"]["ripe"]["items"] == {"type": "boolean"}


def test_floats_are_exact_in_json(written):
    radius = np.array([0.1, np.nextafter(1, 2), 1e-300, np.pi])
    table = circles(center=np.zeros((4, 2)), radius=radius, score=np.zeros(4))
    body = written(lambda w: w.value("/t", table, HEADER))[0][3]
    assert body["radius"] == radius.tolist()


def test_an_empty_table_comes_back_empty(written):
    table = circles(center=np.zeros((0, 2)), radius=[], score=[])
    _, schema, message, body = written(lambda w: w.value("/t", table, HEADER))[0]
    assert body["center"] == []
    assert wire.decode_table(schema.name, message.data).table.center.shape == (0, 2)


def test_the_schema_refuses_a_table_of_another_shape():
    described = json.loads(wire.table_schema(type(circles())).data)
    assert described["properties"]["radius"] == {
        "type": "array",
        "items": {"type": ["number", "null"]},
    }
    with pytest.raises(jsonschema.ValidationError, match="is too short"):
        jsonschema.validate({"center": [[1]]}, described)


@pytest.mark.parametrize(
    ("schema", "body", "error"),
    [
        ("mushpipe.Circles", {"center": [[1, 2]], "radius": [0], "score": [1]}, "must be positive"),
        ("mushpipe.Circles", {"center": [[1, 2, 3]], "radius": [1], "score": [1]}, "reshape"),
        ("mushpipe.Circles", {"center": [["x", 2]], "radius": [1], "score": [1]}, "convert"),
    ],
)
def test_a_message_that_does_not_fit_its_type(schema, body, error):
    whole = {"timestamp": {"sec": 1, "nsec": 0}, "sequence": 0, "frame_id": "c", **body}
    with pytest.raises(ValueError, match=error):
        wire.decode_table(schema, json.dumps(whole).encode())


def test_foreign_schemas_are_not_ours():
    assert wire.decode_table("foxglove.RawImage", b"") is None


def test_a_mask_is_an_image_of_0_and_255(written):
    foreground = COLOR[..., 0] > 100
    rows = written(lambda w: w.value("/m", Mask(foreground, ~foreground), HEADER))
    assert [channel.topic for channel, *_ in rows] == ["/m", "/m/initial"]
    for expected, (*_, body) in zip((foreground, ~foreground), rows, strict=True):
        assert body.encoding == "mono8"
        assert body.data == (expected * np.uint8(255)).tobytes()
    assert len(written(lambda w: w.value("/m", Mask(foreground), HEADER))) == 1


def test_instances_are_an_image_of_labels(written):
    (row,) = written(lambda w: w.value("/i", Instances(DEPTH), HEADER))
    assert (row[3].encoding, row[3].data) == ("mono16", DEPTH.tobytes())


def test_a_frame_of_a_stage_has_topics_of_its_own(written):
    rows = written(lambda w: w.value("/mushpipe/blur", frame(depth=DEPTH), HEADER))
    assert [c.topic for c, *_ in rows] == ["/mushpipe/blur/color", "/mushpipe/blur/depth"]
    rows = written(lambda w: w.value("/mushpipe/blur", frame(), HEADER))
    assert [c.topic for c, *_ in rows] == ["/mushpipe/blur/color"]


def test_what_is_attached_to_a_frame_is_written_before_its_images(written):
    rows = written(lambda w: w.frame(frame(attached={"/truth/mushrooms": truth()})))
    topics = [row[0].topic for row in rows]
    assert topics[-2:] == ["/truth/mushrooms", "/camera/color/image_raw"]
    assert rows[-2][3]["id"] == [0, 1]


def test_a_value_without_wire_form_is_refused(written):
    with pytest.raises(TypeError, match=r"^dict has no wire form: it is no Columns type$"):
        written(lambda w: w.value("/x", {}, HEADER))


def test_channels_and_schemas_are_written_once_and_metadata_first(written):
    def act(writer: RecordingWriter) -> None:
        for _ in range(5):
            writer.value("/a", circles(), HEADER)
            writer.value("/b", circles(), HEADER)

    assert len({channel.id for channel, *_ in written(act)}) == 2
    with written.path.open("rb") as file:
        reader = make_reader(file)
        assert [m.metadata for m in reader.iter_metadata()] == [{"a": "b"}]
        assert len(reader.get_summary().schemas) == 1
        assert reader.get_header().profile == "mushpipe"


def test_the_reader_delivers_topics_and_times_asked_for(tmp_path: Path):
    path = tmp_path / "x.mcap"
    writer = RecordingWriter(path, {})
    for i in (3, 1, 2, 5, 4):
        writer.value("/a", circles(), Header(i, i, "c"))
        writer.value("/b", circles(), Header(i, i, "c"))
    writer.close()
    reader = RecordingReader(path)

    def times(*arguments) -> list[int]:
        return [raw.message.log_time for raw in reader.messages(*arguments)]

    assert times({"/a"}) == [1, 2, 3, 4, 5]
    assert times({"/a"}, 2, 4) == [2, 3]
    assert times({"/a"}, 6) == times({"/a"}, 0, 1) == times({"/c"}) == []
    assert len(times()) == 10
    index = reader.index()
    assert (index.start_ns, index.end_ns) == (1, 5)
    assert index.counts == {"/a": 5, "/b": 5}
    assert index.schema_name("/a") == "mushpipe.Circles"
    assert reader.damage == []
