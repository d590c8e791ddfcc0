"""Two result recordings: what is the same, what is not, and by how much."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from foxglove.messages import CompressedImage, RawImage
from hypothesis import given, settings
from hypothesis import strategies as st
from mcap.writer import Writer

from mushpipe import InputError, Mask, Picks, Trace
from mushpipe.core.errors import UsageError
from mushpipe.core.recorder import RecordingWriter
from mushpipe.core.wire import TIMING, Message, Schema, foxglove_schema
from mushpipe.proof.compare import _by_path, _difference, _of_fields, compare
from tests.core.lab import cli
from tests.io.values import SIZE, make_frame, make_picks, record, trace_of

FRAMES = 3


def mask(*pixels: tuple[int, int]) -> Mask:
    foreground = np.zeros(SIZE[::-1], bool)
    for row, column in pixels:
        foreground[row, column] = True
    return Mask(foreground)


def traces(picks: Picks | None = None, segment: Mask | None = None) -> list[Trace]:
    """Three frames; what is given replaces the result of the last one."""
    made = [
        trace_of(make_frame(i), segment=mask((0, 0)), pick=make_picks()) for i in range(FRAMES - 1)
    ]
    last = trace_of(
        make_frame(FRAMES - 1), segment=segment or mask((0, 0)), pick=picks or make_picks()
    )
    return [*made, last]


@pytest.fixture(scope="module")
def base(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return record(tmp_path_factory.mktemp("base") / "base.mcap", traces())


def moved(by_m: float) -> Picks:
    picks = make_picks()
    return replace(picks, position=picks.position + np.array([by_m, 0, 0]))


def test_a_recording_is_the_same_as_itself_recorded_again(base: Path, tmp_path: Path) -> None:
    found = compare(base, record(tmp_path / "again.mcap", traces()))
    assert found.differences == []
    # calibration once; colour, depth, mask and picks of each frame; times are not compared
    assert found.messages == 1 + 4 * FRAMES
    assert "/mushpipe/timing" not in found.topics


@settings(max_examples=30, deadline=None)
@given(st.floats(1e-6, 1e-1), st.floats(1e-6, 1e-1))
def test_numbers_differ_beyond_the_tolerance_only(
    base: Path, tmp_path_factory: pytest.TempPathFactory, by_m: float, tolerance: float
) -> None:
    path = record(tmp_path_factory.mktemp("moved") / "moved.mcap", traces(moved(by_m)))
    changed = make_picks().position[0, 0] + by_m
    beyond = abs(changed - make_picks().position[0, 0]) > tolerance * (1 + abs(changed))
    found = compare(base, path, tolerance).differences
    assert [(d.topic, d.field, d.sequence) for d in found] == (
        [("/mushpipe/pick", "position", 12)] if beyond else []
    )


def test_images_may_differ_in_a_share_of_their_pixels(base: Path, tmp_path: Path) -> None:
    path = record(tmp_path / "m.mcap", traces(segment=mask((0, 0), (3, 4), (5, 6))))
    found = compare(base, path).differences
    assert [(d.topic, d.field) for d in found] == [("/mushpipe/segment", "pixels")]
    assert found[0].text == "2 of 768 pixels"
    assert compare(base, path, 2 / 768).differences == []
    assert len(compare(base, path, 1.9 / 768).differences) == 1


def test_unknown_is_the_same_as_unknown_and_nothing_else(base: Path, tmp_path: Path) -> None:
    picks = make_picks()
    unknown = replace(picks, diameter=np.array([np.nan, np.nan]))
    found = compare(base, record(tmp_path / "u.mcap", traces(unknown)), 1.0).differences
    assert [d.field for d in found] == ["diameter"]
    assert "0.04 against None" in found[0].text


def test_depth_that_is_unknown_in_both_is_the_same(tmp_path: Path) -> None:
    depth = np.full((24, 32), 0.5, np.float32)
    depth[:10] = np.nan
    other = depth.copy()
    other[20, 3] = 0.6
    paths = [
        record(tmp_path / f"{i}.mcap", [trace_of(make_frame(depth=d, depth_scale=1.0))])
        for i, d in enumerate((depth, depth, other))
    ]
    assert compare(paths[0], paths[1]).differences == []
    (found,) = compare(paths[0], paths[2]).differences
    assert (found.field, found.text) == ("pixels", "1 of 768 pixels")


def test_the_same_numbers_in_another_unit_or_frame_differ(tmp_path: Path) -> None:
    plain = make_frame()
    finer = replace(plain, depth_scale=plain.depth_scale / 2, attached={})
    moved = replace(plain, header=replace(plain.header, frame_id="elsewhere"), attached={})
    paths = [
        record(tmp_path / f"{i}.mcap", [trace_of(frame)])
        for i, frame in enumerate((plain, finer, moved))
    ]
    assert [d.field for d in compare(paths[0], paths[1]).differences] == ["metadata.depth_scale"]
    fields = {d.field for d in compare(paths[0], paths[2]).differences}
    assert fields == {"frame_id", "frameId"}  # of images, and of the calibration


def test_another_number_of_mushrooms_is_told_of(base: Path, tmp_path: Path) -> None:
    first = {n: v[:1] if isinstance(v, np.ndarray) else v for n, v in vars(make_picks()).items()}
    found = compare(base, record(tmp_path / "n.mcap", traces(Picks(**first))), 1.0).differences
    assert ("id", "2 values against 1") in [(d.field, d.text) for d in found]


@pytest.mark.parametrize("turned", [False, True])
def test_a_missing_frame_is_named_with_its_file(base: Path, tmp_path: Path, turned: bool) -> None:
    short = record(tmp_path / "short.mcap", traces()[:-1])
    found = compare(*((short, base) if turned else (base, short))).differences
    assert {d.sequence for d in found} == {12}
    assert {d.text for d in found} == {f"only in {base}"}
    assert len({d.topic for d in found}) == 4


def test_recordings_that_have_no_frame_in_common_differ(base: Path, tmp_path: Path) -> None:
    other = record(tmp_path / "o.mcap", [trace_of(make_frame(99), pick=make_picks())])
    found = compare(base, other, topics="/mushpipe/pick")
    assert found.messages == 0
    texts = [difference.text for difference in found.differences]
    assert texts == [f"only in {base}"] * FRAMES + [f"only in {other}"]


def image(encoding: str, size: tuple[int, int], data: bytes, frame_id: str) -> Message:
    width, height = size
    step = len(data) // height if height else 0
    kinds = {"encoding": encoding, "width": width, "height": height, "step": step}
    encoded = RawImage(frame_id=frame_id, data=data, **kinds).encode()
    return Message("", foxglove_schema("RawImage"), encoded)


def compressed(data: bytes, frame_id: str) -> Message:
    encoded = CompressedImage(frame_id=frame_id, data=data, format="jpeg").encode()
    return Message("", foxglove_schema("CompressedImage"), encoded)


CDR = Schema("sensor_msgs/msg/Imu", "ros2msg", b"float64 x", "cdr")


@pytest.mark.parametrize(
    ("ours", "theirs", "fields"),
    [
        (image("bgr8", (2, 1), b"abcdef", "a"), image("bgr8", (2, 1), b"abcdeg", "a"), {"data"}),
        (image("mono8", (0, 0), b"", "a"), image("mono8", (0, 0), b"", "b"), {"frame_id"}),
        (image("mono8", (2, 1), b"ab", "a"), image("mono8", (0, 0), b"", "a"), {"size", "pixels"}),
        (compressed(b"", "a"), compressed(b"", "b"), {"frameId"}),
        (Message("", CDR, b"1234"), Message("", CDR, b"1235"), {"bytes"}),
    ],
    ids=["of a foreign encoding", "empty", "one empty", "compressed to nothing", "of ROS"],
)
def test_messages_of_other_programs_are_compared_as_far_as_they_are_known(
    ours: Message, theirs: Message, fields: set[str], tmp_path: Path
) -> None:
    paths = [tmp_path / "a.mcap", tmp_path / "b.mcap"]
    for path, message in zip(paths, (ours, theirs), strict=True):
        writer = RecordingWriter(path, {})
        writer.write("/other", message, make_frame().header)
        writer.close()
    assert {difference.field for difference in compare(*paths, 0.0).differences} == fields
    assert compare(paths[0], paths[0]).differences == []


def bare(path: Path, *messages: bytes, before: int = 0) -> Path:
    """A recording of another program: JSON without a schema, all of one moment."""
    writer = Writer(str(path))
    writer.start()
    first, channel = (writer.register_channel(topic, "json", 0) for topic in ("/first", "/other"))
    for on, data in [(first, b"{}")] * before + [(channel, data) for data in messages]:
        writer.add_message(on, log_time=5, data=data, publish_time=5, sequence=7)
    writer.finish()
    return path


def test_each_of_several_messages_of_one_moment_is_compared(tmp_path: Path) -> None:
    a = bare(tmp_path / "a.mcap", b'{"x": 1}', b'{"x": 2}')
    b = bare(tmp_path / "b.mcap", b'{"x": 3}', b'{"x": 2}')
    found = compare(a, b)
    assert found.messages == 2
    assert [(d.field, d.sequence, d.text) for d in found.differences] == [("x", 7, "1 against 3")]
    assert compare(a, a).differences == []
    assert len(compare(a, bare(tmp_path / "c.mcap", b'{"x": 1}')).differences) == 1
    late = bare(tmp_path / "d.mcap", b'{"x": 1}', b'{"x": 2}', before=2)
    assert [d.topic for d in compare(a, late).differences] == ["/first", "/first"]


def test_a_field_that_one_message_lacks_is_named_with_the_other() -> None:
    both, one = _by_path({"x": 1.0, "y": 2.0}), _by_path({"x": 1.0})
    assert list(_of_fields(both, one, 1.0)) == [("y", "is only in the first")]
    assert list(_of_fields(one, both, 1.0)) == [("y", "is only in the second")]


def test_only_the_topics_that_were_asked_for(base: Path, tmp_path: Path) -> None:
    path = record(tmp_path / "m.mcap", traces(moved(1.0), mask()))
    found = compare(base, path, topics="/mushpipe/seg*")
    assert {d.topic for d in found.differences} == found.topics == {"/mushpipe/segment"}
    with pytest.raises(UsageError, match="nothing was compared"):
        compare(base, path, topics="/elsewhere")


def test_a_damaged_file_is_no_basis_for_a_verdict(base: Path, tmp_path: Path) -> None:
    cut = tmp_path / "cut.mcap"
    cut.write_bytes(base.read_bytes()[:-200])
    with pytest.raises(InputError, match=r"cut\.mcap is damaged"):
        compare(base, cut)


@pytest.mark.parametrize(
    "broken",
    [
        Message("", TIMING, b'{"score": [0.5, NaN]}'),
        Message("", TIMING, b""),
        Message("", foxglove_schema("CameraCalibration"), b"\xff\xfe\xfd"),
    ],
)
def test_a_message_that_cannot_be_read_is_told_of_with_its_file(
    broken: Message,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    """Chunks and their CRCs are whole: another writer put it there."""
    good = b"{}" if broken.schema is TIMING else b""
    paths = [tmp_path / "good.mcap", tmp_path / "broken.mcap"]
    for path, data in zip(paths, (good, broken.data), strict=True):
        writer = RecordingWriter(path, {})
        writer.write("/other", broken._replace(data=data), make_frame().header)
        writer.close()
    for order in (paths, paths[::-1]):
        assert cli(monkeypatch, "compare", *order) == 4
        said = " ".join(capsys.readouterr().err.split())
        assert "broken.mcap: a message on /other, sequence 10, cannot be read" in said


def test_the_verb_says_what_differs_and_exits_with_3(
    base: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    path = record(tmp_path / "m.mcap", traces(moved(0.25)))
    assert cli(monkeypatch, "compare", base, path) == 3
    summary = capsys.readouterr().out.splitlines()
    assert summary == [
        "/mushpipe/pick  position: 1 frames differ, first frame 12: "
        "1 of 6 values, at worst [0][0]: 0.1 against 0.35",
        "13 messages on 5 topics: 1 differences",
    ]
    assert cli(monkeypatch, "compare", base, path, "--long") == 3
    assert capsys.readouterr().out.startswith("frame    12  /mushpipe/pick  position: 1 of 6")
    assert cli(monkeypatch, "compare", base, path, "--tol", "0.5") == 0
    assert capsys.readouterr().out == "13 messages on 5 topics: the same\n"


def test_the_tolerance_is_for_measured_numbers_not_for_ids_flags_and_kinds(
    base: Path, tmp_path: Path
) -> None:
    picks = make_picks()
    changed = replace(
        picks, id=picks.id + 1, flags=picks.flags ^ np.uint32(8), score=picks.score - 0.01
    )
    found = compare(base, record(tmp_path / "c.mcap", traces(changed)), 0.5).differences
    assert {d.field for d in found} == {"id", "flags"}


@pytest.mark.parametrize(
    ("a", "b"),
    [
        (True, False),
        (True, 1),
        (3, 4),
        ("3", "4"),
        (1.0, None),
        (1.0, "1.0"),
        ([[1.0, 2.0], [3.0]], [[1.0], [2.0, 3.0]]),
        ([[], []], []),
        ([[1.0], []], [[1.0]]),
        ([{"a": 1.0}, {}], [{}, {"a": 1.0}]),
        ({"a": {}}, {"a": []}),
    ],
)
def test_other_values_kinds_and_nestings_differ_at_any_tolerance(a: Any, b: Any) -> None:
    for one, other in ((a, b), (b, a)):
        assert list(_of_fields(_by_path({"x": one}), _by_path({"x": other}), 1e9))
    assert not list(_of_fields(_by_path({"x": a}), _by_path({"x": a}), 0.0))


def test_a_difference_says_where_it_stands() -> None:
    table = {"rows": [{"at": [0.0, 1.0]}, {"at": [2.0, 3.0]}]}
    moved = {"rows": [{"at": [0.0, 1.5]}, {"at": [4.0, 3.0]}]}
    (found,) = _of_fields(_by_path(table), _by_path(moved), 0.1)
    assert found == ("rows.at", "2 of 4 values, at worst [1][0]: 2.0 against 4.0")


def test_a_pixel_differs_however_many_of_its_channels_do() -> None:
    a = np.zeros((100, 3), np.uint8)
    b, c = a.copy(), a.copy()
    b[[3, 7], 0] = 9
    c[3] = 9
    assert _difference(a, b, 0.01) == "2 of 100 pixels"
    assert _difference(a, b, 0.02) is None
    assert _difference(a, c, 0.0) == "1 of 100 pixels"
    assert _difference(a, a[:99], 1.0) == "100 pixels against 99"


@pytest.mark.parametrize("channels", [1, 4])
def test_images_of_another_number_of_channels_differ_at_any_tolerance(channels: int) -> None:
    """As PNG with and without transparency, or JPEG of gray; the format says neither."""
    a, b = np.zeros((100, 3), np.uint8), np.zeros((100, channels), np.uint8)
    assert _difference(a, b, 1.0) == f"3 channels against {channels}"


@pytest.mark.parametrize("number", [2**53, 1_700_000_000_000_000_001])
def test_large_integers_are_compared_exactly(number: int) -> None:
    same, other = ({"x": [each]} for each in (number, number + 1))
    assert not list(_of_fields(_by_path(same), _by_path(same), 0.0))
    assert list(_of_fields(_by_path(same), _by_path(other), 0.0))


def test_compressed_images_are_compared_by_their_pixels(base: Path, tmp_path: Path) -> None:
    """A JPEG of another picture in one block of 16 x 16 px is the same outside of it.

    Schemas have other ids in such recordings than in those that were compared before.
    """
    compare(base, record(tmp_path / "raw.mcap", traces(moved(1.0))))
    frame = make_frame()
    color = frame.color.copy()
    color[:16, :16] = 255 - color[:16, :16]
    frames = {"a": frame, "b": frame, "c": replace(frame, color=color)}
    a, b, c = (
        record(tmp_path / f"{name}.mcap", [trace_of(each)], jpeg_quality=95)
        for name, each in frames.items()
    )
    assert compare(a, b).differences == []
    (found,) = compare(a, c).differences
    assert (found.topic, found.field) == ("/camera/color/image_raw", "pixels")
    # of the block all, and what its colour spills over its border
    assert 16**2 <= int(found.text.removesuffix(" of 768 pixels")) <= 17**2
    assert compare(a, c, 17**2 / 768).differences == []
