"""Result recordings read back frame by frame, against what was recorded."""

from __future__ import annotations

import json
import shutil
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pytest

from mushpipe import Circles, Locations, Mask, Picks, RunInfo, Trace
from mushpipe.core import wire
from mushpipe.core.errors import InputError, UsageError
from mushpipe.core.manifest import _describe
from mushpipe.core.recorder import RecordingWriter
from mushpipe.core.recording import MANIFEST
from mushpipe.sinks.mcap import McapSink
from mushpipe.sources.folder import ImagesSource
from mushpipe.sources.mcap import McapSource
from mushpipe.traces import read_trace, read_traces
from tests.io.values import make_circles, make_frame, make_picks, no_picks, record, trace_of


def full_trace(i: int) -> Trace:
    frame, circles = make_frame(i), make_circles()
    mask = np.zeros((24, 32), bool)
    mask[i : i + 4, 3:9] = True
    nan = np.full(2, np.nan)
    locations = Locations(
        position=np.array([[0.1, 0.2, 0.5], [np.nan] * 3]),
        distance=np.array([0.55, np.nan]),
        diameter=np.array([0.04, np.nan]),
        source=np.array([1, 0]),
        sigma_position=np.full((2, 3), np.nan),
        sigma_diameter=nan,
    )
    changed = replace(frame, color=np.full_like(frame.color, 40 + i), attached={})
    return trace_of(
        frame,
        flatten=changed,
        segment=Mask(mask, ~mask),
        open=Mask(mask),
        detect=(circles, locations),
        pick=make_picks() if i else no_picks(),
    )


def same(value: object, other: object) -> None:
    assert type(value) is type(other)
    for name, field in vars(value).items():
        if isinstance(field, np.ndarray):
            np.testing.assert_array_equal(field, getattr(other, name), err_msg=name)


def test_a_trace_is_read_back_as_it_was(tmp_path: Path) -> None:
    traces = [full_trace(i) for i in range(3)]
    path = record(tmp_path / "out.mcap", traces)
    found = list(read_traces(path))
    assert len(found) == 3
    for trace, again in zip(traces, found, strict=True):
        same(trace.frame, again.frame)
        assert trace.frame.header == again.frame.header
        assert dict(again.durations_ns) == dict(trace.durations_ns)
        assert set(again.outputs) == set(trace.outputs) - {"source"}
        for stage, values in again.outputs.items():
            assert len(values) == len(trace.outputs[stage])
            for value, other in zip(values, trace.outputs[stage], strict=True):
                same(other, value)
    assert isinstance(found[0].outputs["segment"][0], Mask)
    assert isinstance(found[1].outputs["pick"][0], Picks)
    assert isinstance(found[1].outputs["detect"][0], Circles)


def test_frames_of_stages_come_back_however_they_branch(tmp_path: Path) -> None:
    frame = make_frame()
    bright = replace(frame, color=frame.color // 2)
    deep = replace(frame, depth=frame.depth + np.uint16(1))  # of the source, not of `bright`
    both = replace(bright, depth=deep.depth)
    flat = replace(bright, depth=None)
    given = {"bright": bright, "deep": deep, "both": both, "flat": flat, "again": deep}
    path = record(tmp_path / "out.mcap", [trace_of(frame, **given)])
    (trace,) = read_traces(path)
    assert list(trace.outputs) == list(given)
    for stage, expected in given.items():
        same(trace.outputs[stage][0], expected)
        assert (trace.outputs[stage][0].depth is None) == (stage == "flat")


def test_a_frame_that_no_stage_answered_stands_alone(tmp_path: Path) -> None:
    traces = [full_trace(0), Trace(make_frame(1), {}, {}), full_trace(2)]
    path = record(tmp_path / "out.mcap", traces)
    assert [bool(t.outputs) for t in read_traces(path)] == [True, False, True]
    assert read_trace(path, 12).frame.header.sequence == 12
    with pytest.raises(UsageError, match="no frame 3; it holds 10 to 12"):
        read_trace(path, 3)


def test_a_lost_image_costs_the_results_of_its_own_frame_alone(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = record(tmp_path / "out.mcap", [full_trace(i) for i in range(4)])
    whole = McapSource.frames
    monkeypatch.setattr(
        McapSource, "frames", lambda self: (f for f in whole(self) if f.header.sequence != 11)
    )
    found = list(read_traces(path))
    assert [t.frame.header.sequence for t in found] == [10, 12, 13]
    assert all(trace.outputs for trace in found)


def test_a_mask_comes_back_that_is_not_the_first_thing_a_stage_puts_out(tmp_path: Path) -> None:
    mask = np.zeros((24, 32), bool)
    mask[3:9, 4:7] = True
    path = record(
        tmp_path / "out.mcap",
        [trace_of(make_frame(), both=(make_circles(), Mask(mask, ~mask)))],
    )
    (trace,) = read_traces(path)
    (found,) = (value for value in trace.outputs["both"] if isinstance(value, Mask))
    same(found, Mask(mask, ~mask))


@dataclass(frozen=True, eq=False)
class Marked(Mask):
    """A plugin's own kind of mask."""


@pytest.mark.parametrize("kind", [Mask, Marked])
def test_a_mask_and_a_frame_of_one_stage_come_back_both(tmp_path: Path, kind: type[Mask]) -> None:
    frame, pixels = make_frame(), np.zeros((24, 32), bool)
    pixels[3:9, 4:7] = True
    mask = kind(pixels, ~pixels)
    dark, darker = (replace(frame, color=frame.color // k, attached={}) for k in (2, 3))
    outputs = {"one": (mask, dark), "other": (darker, mask)}
    path = record(tmp_path / "out.mcap", [trace_of(frame, **outputs)])
    (trace,) = read_traces(path)
    for found, changed in zip(trace.outputs.values(), (dark, darker), strict=True):
        same(found[0], Mask(pixels, ~pixels))
        same(found[1], changed)


def test_frames_whose_stamp_stands_still_stay_apart(tmp_path: Path) -> None:
    traces = [full_trace(i) for i in range(3)]
    stamp = traces[0].frame.header.stamp_ns
    still = []
    for trace in traces:
        header = replace(trace.frame.header, stamp_ns=stamp)
        frame = replace(trace.frame, header=header, attached={})
        still.append(replace(trace, frame=frame))
    found = list(read_traces(record(tmp_path / "out.mcap", still, frames="source")))
    assert [len(trace.outputs["detect"]) for trace in found] == [2, 2, 2]
    for trace, wanted in zip(found, still, strict=True):
        same(trace.outputs["open"][0], wanted.outputs["open"][0])


def test_images_are_played_as_the_run_played_them(tmp_path: Path) -> None:
    traces = [full_trace(i) for i in range(3)]
    source = record(tmp_path / "bed.mcap", [Trace(t.frame, {}, {}) for t in traces])
    seconds = (traces[1].frame.header.stamp_ns - traces[0].frame.header.stamp_ns) / 1e9
    played = {"use": "mcap", "path": "bed.mcap", "start": seconds / 2, "speed": 1, "loop": 3}
    given = {"camera": {"fx": 5.0, "fy": 6.0, "cx": 7.0, "cy": 8.0}}
    manifest = {
        "graph": {"source": {**played, **given}, "stages": {}},
        "recordings": [_describe(source)],
    }
    sink = McapSink(path=tmp_path / "out.mcap", frames=False)
    sink.open(RunInfo("bed", manifest))
    for trace in traces[1:]:
        sink.consume(trace)
    sink.close()
    found = list(read_traces(tmp_path / "out.mcap"))
    assert [trace.frame.header for trace in found] == [t.frame.header for t in traces[1:]]
    assert [trace.frame.camera.fx for trace in found if trace.frame.camera] == [5, 5]
    assert all(trace.outputs for trace in found)


def test_images_that_another_source_played_are_told_of(tmp_path: Path) -> None:
    image, results = tmp_path / "bed.png", tmp_path / "out.mcap"
    image.write_bytes(b"an image")
    played = ImagesSource(path=image)
    source = {"use": "images", **played.model_dump(mode="json")}
    manifest = {"graph": {"source": source, "stages": {}}, "recordings": [_describe(image)]}
    sink = McapSink(path=results, frames=False)
    sink.open(RunInfo("bed", manifest))
    sink.consume(full_trace(0))
    sink.close()
    text = rf"out\.mcap holds no images, and those of {image} were not played by the source 'mcap'"
    with pytest.raises(UsageError, match=text):
        list(read_traces(results))


def test_images_come_from_the_recording_named_in_the_manifest(tmp_path: Path) -> None:
    traces = [full_trace(i) for i in range(2)]
    source = record(tmp_path / "bed.mcap", [Trace(t.frame, {}, {}) for t in traces])
    manifest = {
        "graph": {"source": {"use": "mcap", "path": "elsewhere/bed.mcap"}, "stages": {}},
        "recordings": [_describe(source)],
    }
    results = tmp_path / "out.mcap"
    sink = McapSink(path=results, frames=False)
    sink.open(RunInfo("bed", manifest))
    for trace in traces:
        sink.consume(trace)
    sink.close()
    found = list(read_traces(results))
    # Of a run that records no images, not those of its stages either.
    assert [set(t.outputs) for t in found] == [{"segment", "open", "detect", "pick"}] * 2
    np.testing.assert_array_equal(found[1].frame.color, traces[1].frame.color)
    # Another recording of that name does not count.
    shutil.copy(results, source)
    with pytest.raises(UsageError, match=r"holds no images, and bed\.mcap is neither"):
        list(read_traces(results))


def test_damage_is_reported_after_the_last_good_frame(tmp_path: Path) -> None:
    path = record(tmp_path / "out.mcap", [full_trace(i) for i in range(3)])
    path.write_bytes(path.read_bytes()[:-400])
    frames = []
    with pytest.raises(InputError, match="damaged"):
        frames.extend(read_traces(path))


def test_a_recording_without_results_is_its_frames(tmp_path: Path) -> None:
    path = record(tmp_path / "bed.mcap", [Trace(make_frame(i), {}, {}) for i in range(2)])
    assert [t.outputs for t in read_traces(path)] == [{}, {}]


@pytest.mark.parametrize("frames", [True, False])
def test_times_that_go_back_cost_no_results(tmp_path: Path, frames: bool) -> None:
    """Small frames share a chunk, whose messages are read by the time they were logged."""
    traces = []
    for i, shift in enumerate([0, 0, 0, -50, -50, -50]):
        trace = full_trace(i)
        past = trace.frame.header.arrival_ns + shift * 33_000_000
        header = replace(trace.frame.header, arrival_ns=past)
        traces.append(replace(trace, frame=replace(trace.frame, header=header, attached={})))
    source = record(tmp_path / "bed.mcap", [Trace(t.frame, {}, {}) for t in traces])
    manifest = {
        "graph": {"source": {"use": "mcap", "path": "bed.mcap"}, "stages": {}},
        "recordings": [_describe(source)],
    }
    sink = McapSink(path=tmp_path / "out.mcap", frames=frames)
    sink.open(RunInfo("bed", manifest))
    for trace in traces:
        sink.consume(trace)
    sink.close()
    found = {t.frame.header.sequence: t for t in read_traces(tmp_path / "out.mcap")}
    assert sorted(found) == [t.frame.header.sequence for t in traces]
    for trace in traces:
        again = found[trace.frame.header.sequence]
        same(trace.outputs["open"][0], again.outputs["open"][0])
        assert {"segment", "open", "detect", "pick"} <= set(again.outputs)


@pytest.mark.parametrize("name", ["pick", "timing"])
def test_what_cannot_be_read_is_named(tmp_path: Path, name: str) -> None:
    path, frame = tmp_path / "out.mcap", make_frame()
    writer = RecordingWriter(path, {MANIFEST: {"json": "{}"}})
    writer.frame(frame)
    if name == "pick":
        (message,) = wire.encoder_of(Picks)(make_picks(), frame.header)
        body = {**json.loads(message.data), "source": [300, 0]}
        message = message._replace(data=json.dumps(body).encode())
    else:
        message = wire.json_message(wire.TIMING, frame.header, {"stages": 5})
    writer.write(f"/mushpipe/{name}", message, frame.header)
    writer.close()
    with pytest.raises(InputError, match=r"the results of frame 10 cannot be read"):
        list(read_traces(path))


def test_a_manifest_that_is_no_json_is_told_of(tmp_path: Path) -> None:
    path = tmp_path / "out.mcap"
    writer = RecordingWriter(path, {MANIFEST: {"json": "{"}})
    writer.frame(make_frame())
    writer.close()
    with pytest.raises(InputError, match=r"'mushpipe\.manifest' hold no JSON object"):
        list(read_traces(path))


def test_numbers_that_begin_anew_cost_no_results(tmp_path: Path) -> None:
    """Of a camera whose counter starts again."""
    numbers, traces = [10, 11, 12, 0, 1, 2], []
    for i, number in enumerate(numbers):
        trace = full_trace(i)
        header = replace(trace.frame.header, sequence=number)
        traces.append(replace(trace, frame=replace(trace.frame, header=header, attached={})))
    found = list(read_traces(record(tmp_path / "out.mcap", traces)))
    assert [trace.frame.header.sequence for trace in found] == numbers
    for trace, again in zip(traces, found, strict=True):
        same(trace.outputs["open"][0], again.outputs["open"][0])
