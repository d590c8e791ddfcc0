from __future__ import annotations

import json
import math
import os
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from mushpipe import Header
from mushpipe.core.errors import InputError, UsageError
from mushpipe.core.recorder import RecordingWriter
from mushpipe.core.recording import MANIFEST
from mushpipe.core.truth import TRUTH_TOPIC, Ignore
from mushpipe.core.wire import json_message, json_schema
from mushpipe.evaluate.judging import Rules, judge_results
from mushpipe.evaluate.labels import EXAMPLE, convert, parse_labels
from mushpipe.evaluate.results import Results, of_picks
from mushpipe.evaluate.running import recordings_in
from mushpipe.evaluate.truth import FrameTruth, TruthSet, has_truth, read_truth
from mushpipe.sources.mcap import McapSource
from tests.evaluate.scenes import FRAME, bed, header, picks_of, write_recording, write_results

FULL = {
    "mushpipe_labels": 1,
    "note": "by hand",
    "frame_id": "camera",
    "frames": [
        {
            "stamp_ns": 17,
            "caps": [
                {
                    "u": 10.5, "v": 20, "radius_px": 5, "id": 7, "visible": 0.5,
                    "surface_m": [0, 0, 0.5], "apex_m": [0.01, 0, 0.49], "axis": [0, 0, -2],
                    "diameter_m": 0.04, "diameter_max_m": 0.042,
                },
                {"u": 1, "v": 2, "radius_px": 3, "ignore": "cut-stump", "id": 8},
            ],
            "may_find": [{"u": 5, "v": 6, "radius_px": 7}],
        },
        {"index": 3, "caps": []},
    ],
}  # fmt: skip


def written(folder: Path, document: Any) -> Path:
    path = folder / "labels.json"
    path.write_text(json.dumps(document))
    return path


def test_own_format_is_read_in_full(tmp_path: Path) -> None:
    truth = read_truth(written(tmp_path, FULL))
    first = truth.frames["stamp_ns", 17]
    assert first.frame_id == "camera"
    assert first.caps.id.tolist() == [7, 8]
    assert first.caps.center.tolist() == [[10.5, 20], [1, 2]]
    assert first.caps.axis[0].tolist() == [0, 0, -1]
    assert np.isnan(first.caps.axis[1]).all()
    assert math.isnan(first.caps.diameter[1])
    assert first.caps.ignore.tolist() == [Ignore.COUNTS, Ignore.CUT_STUMP]
    assert first.may_find.tolist() == [[5, 6, 7]]
    assert truth.place(Header(17, 0, "")) == ("stamp_ns", 17)
    assert truth.place(Header(99, 3, "")) == ("index", 3)
    assert truth.place(Header(99, 4, "")) is None


def test_ellipses_with_may_find_circles(tmp_path: Path) -> None:
    document = {
        "rule": "recall over must_find",
        "must_find": [
            {"cx": 50, "cy": 60, "ellipse_px": [40, 90, 30.0], "diam_silhouette": 36.0},
            {"cx": 150, "cy": 60, "ellipse_px": [20, 20, 0]},
        ],
        "may_find": [{"cx": 1, "cy": 2, "r": 3}],
    }
    frame = read_truth(written(tmp_path, document)).frames["index", 0]
    assert frame.caps.radius.tolist() == pytest.approx([30, 10])
    assert frame.caps.diameter[0] == pytest.approx(0.036)
    assert math.isnan(frame.caps.diameter[1])
    assert frame.may_find.tolist() == [[1, 2, 3]]


def test_circles_with_ignore(tmp_path: Path) -> None:
    caps = [
        {"u": 1, "v": 2, "radius_px": 3, "ignore": False},
        {"u": 4, "v": 5, "radius_px": 6, "ignore": True},
    ]
    frame = read_truth(written(tmp_path, {"stamp_ns": 5, "caps": caps})).frames["stamp_ns", 5]
    assert frame.caps.ignore.tolist() == [Ignore.COUNTS, Ignore.AMBIGUOUS]


def test_boxes(tmp_path: Path) -> None:
    caps = [
        {"bbox": [100, 200, 41, 41]},
        {"bbox": [0, 0, 90, 40], "near_border": True},
        {"bbox": [50, 50, 9, 9], "ignore": True},
    ]
    frames = [{"stamp_ns": 1, "caps": []}, {"stamp_ns": 2, "caps": caps}]
    truth = read_truth(written(tmp_path, {"frames": frames}))
    assert len(truth.frames["stamp_ns", 1].caps) == 0
    found = truth.frames["stamp_ns", 2].caps
    assert found.center[0].tolist() == [120, 220]
    assert found.radius.tolist() == pytest.approx([20.5, 30, 4.5])
    assert found.ignore.tolist() == [Ignore.COUNTS, Ignore.AT_BORDER, Ignore.AMBIGUOUS]


def test_conversion_leaves_the_own_format_alone() -> None:
    assert convert(FULL) is FULL
    assert convert(convert({"caps": [], "stamp_ns": 1}))["mushpipe_labels"] == 1


@pytest.mark.parametrize(
    ("document", "message"),
    [
        ([], "expected a JSON object"),
        ({"boxes": []}, "none of mushpipe_labels"),
        ({"must_find": [{"cx": 1}]}, "must_find"),
        ({"frames": [{"caps": []}]}, "stamp_ns"),
        ({"frames": [{"index": 0, "caps": []}]}, "without mushpipe_labels .*'stamp_ns' is missing"),
        ({"mushpipe_labels": 1, "frames": [{"index": 0, "caps": [{"u": 1}]}]}, "frames.0.caps.0.v"),
        ({"mushpipe_labels": 1, "frames": [{"caps": []}]}, "either stamp_ns or index"),
        ({"mushpipe_labels": 2, "frames": []}, "mushpipe_labels"),
        (
            {"mushpipe_labels": 1, "frames": [{"index": 0, "caps": []}, {"index": 0, "caps": []}]},
            "the frame of index 0 is labelled 2 times",
        ),
        (
            {
                "mushpipe_labels": 1,
                "frames": [
                    {
                        "index": 0,
                        "caps": [{"u": 1, "v": 1, "radius_px": 9, "diameter_m": 41}],
                    }
                ],
            },
            "caps.0.diameter_m: a cap of 41 m: are lengths in metres?",
        ),
        (
            {
                "mushpipe_labels": 1,
                "frames": [
                    {
                        "index": 0,
                        "caps": [{"u": 1, "v": 1, "radius_px": 9, "apex_m": [10, 20, 500]}],
                    }
                ],
            },
            "caps.0.apex_m: a cap 500.5 m away: are lengths in metres?",
        ),
        (
            {
                "mushpipe_labels": 1,
                "frames": [{"index": 0, "caps": [{"u": 1, "v": 1, "radius_px": -1}]}],
            },
            "radius_px",
        ),
        (
            {
                "mushpipe_labels": 1,
                "frames": [
                    {"index": 0, "caps": [{"u": 1, "v": 1, "radius_px": 1, "axis": [0, 0, 0]}]}
                ],
            },
            "an axis needs a length",
        ),
        (
            {
                "mushpipe_labels": 1,
                "frames": [
                    {"index": 0, "caps": [{"u": 1, "v": 1, "radius_px": 1, "axis": [1e-200, 0, 0]}]}
                ],
            },
            "an axis needs a length",
        ),
        (
            {
                "mushpipe_labels": 1,
                "frames": [{"index": 0, "caps": [{"u": 1, "v": 1, "radius_px": 1, "id": 2**63}]}],
            },
            "frames.0.caps.0.id",
        ),
        (
            {"frames": [{"stamp_ns": 1, "caps": [{"bbox": [1, 2, -3, -3]}]}]},
            "expected a size above 0, got -3",
        ),
        (
            {"must_find": [{"cx": 1, "cy": 2, "ellipse_px": [-3, -3, 0]}]},
            "expected a size above 0, got -3",
        ),
        ({"stamp_ns": 1, "caps": [5]}, "labels with 'caps'"),
        (
            {"frames": [{"stamp_ns": 1, "caps": [{"bbox": [True, 2, 3, 4]}]}]},
            "labels with 'frames'.*expected a number, got True",
        ),
        (
            {"must_find": [{"cx": 1, "cy": 2, "ellipse_px": ["40", 90, 0]}]},
            "labels with 'must_find'.*expected a number, got '40'",
        ),
        ({"stamp_ns": "1", "caps": []}, "frames.0.stamp_ns"),
        ({"stamp_ns": 1, "caps": [{"u": True, "v": 1, "radius_px": 1}]}, "frames.0.caps.0.u"),
        ({"stamp_ns": 1, "caps": [{"u": 1, "v": "1", "radius_px": 1}]}, "frames.0.caps.0.v"),
        (
            {"stamp_ns": 1, "caps": [{"u": 1, "v": 1, "radius_px": 1, "ignore": "yes"}]},
            "frames.0.caps.0.ignore",
        ),
        (
            {"mushpipe_labels": 1, "frames": [{"index": 0, "caps": [{"apex": [0, 0, 1]}]}]},
            "frames.0.caps.0.apex: this is not known here; did you mean 'apex_m'",
        ),
        (
            {
                "mushpipe_labels": 1,
                "frames": [{"index": 4, "caps": [{"u": 1, "v": 1, "radius_px": 1, "id": 3}] * 2}],
            },
            "index=4: Truth: ids must be unique",
        ),
    ],
)
def test_wrong_labels_are_refused_with_their_place(
    tmp_path: Path, document: Any, message: str
) -> None:
    with pytest.raises(InputError, match=message) as error:
        read_truth(written(tmp_path, document))
    assert "labels.json" in str(error.value)


def test_files_that_are_not_there_or_no_json(tmp_path: Path) -> None:
    with pytest.raises(UsageError, match="no such"):
        read_truth(tmp_path / "none.json")
    with pytest.raises(UsageError, match="it is a folder"):
        read_truth(tmp_path)
    (tmp_path / "bad.json").write_text("{")
    with pytest.raises(InputError, match="no labels"):
        read_truth(tmp_path / "bad.json")
    (tmp_path / "hand.csv").write_text("file,x,y,r\n0.png,320.5,201,24.5\n")
    with pytest.raises(InputError, match=r"hand\.csv: no labels: not JSON .*; expected is {"):
        read_truth(tmp_path / "hand.csv")


def test_the_example_in_messages_is_labels() -> None:
    assert parse_labels(json.loads(EXAMPLE)).frames[0].caps[0].u == 320.5


def test_truth_of_a_recording(tmp_path: Path) -> None:
    path = write_recording(tmp_path / "bed.mcap", {0: bed(0), 1: bed(1)})
    assert has_truth(path)
    truth = read_truth(path)
    assert len(truth.frames) == 2
    frame = truth.frames["stamp_ns", header(1).stamp_ns]
    assert frame.frame_id == FRAME
    assert (frame.caps.apex == bed(1).apex).all()


@pytest.mark.parametrize("name", ["BED.MCAP", "bed"])
def test_a_recording_is_none_of_labels_whatever_its_name(tmp_path: Path, name: str) -> None:
    path = write_recording(tmp_path / name, {0: bed(0)})
    assert read_truth(path).recording == path
    assert name == "bed" or recordings_in([tmp_path]) == [path]


def test_labels_that_name_no_frame_are_in_that_of_the_camera(tmp_path: Path) -> None:
    there, robot = bed(0), "robot_base"
    picks = replace(picks_of(there), frame_id=robot)
    transform = {"frame": robot, "translation": [0, 0, 1], "quaternion": [1, 0, 0, 0]}
    manifest = {"graph": {"stages": {"pick": {"use": "picks", "T_base_camera": transform}}}}
    frames = [(header(0), of_picks(picks))]
    results = Results(tmp_path / "r.mcap", "/mushpipe/pick", frames, manifest=manifest)
    for place in (("index", 0), ("stamp_ns", header(0).stamp_ns)):
        truth = TruthSet("labels.json", {place: FrameTruth(there)})
        judged = judge_results(results, truth, Rules())
        assert judged.notes == ["truth and results are in different frames: 3D errors are unknown"]
    named = TruthSet("labels.json", {("index", 0): FrameTruth(there, frame_id=robot)})
    assert judge_results(results, named, Rules()).notes == []


@pytest.mark.parametrize(
    ("carried", "exit_code", "missed"),
    [(False, 0, 0), (False, 1, 1), (False, None, 1), (True, 0, 1)],
)
def test_frames_beyond_the_end_of_a_whole_run_may_be_of_another_recording(
    tmp_path: Path, carried: bool, exit_code: int | None, missed: int
) -> None:
    stamps = [header(number).stamp_ns for number in range(3)]
    span = {"stamp_ns": stamps[:2], "sequence": [0, 1]}
    summary = {} if exit_code is None else {"exit_code": exit_code, "span": span}
    frames = [(header(number), of_picks(picks_of(bed(number)))) for number in range(2)]
    results = Results(tmp_path / "r.mcap", "/mushpipe/pick", frames, summary=summary)
    recording = tmp_path / "truth.mcap" if carried else None
    known = {("stamp_ns", stamps[number]): FrameTruth(bed(number)) for number in range(3)}
    judged = judge_results(results, TruthSet("truth", known, recording=recording), Rules())
    assert [len(verdict.matching.missed) for verdict in judged.verdicts] == [0, 0, 20][: 2 + missed]
    assert judged.notes == [
        "1 frames have no answer: all in them is missed"
        if missed
        else "1 frames of truth lie before or after what was played and are not judged"
    ]


def test_a_run_that_ended_early_is_told_of(tmp_path: Path) -> None:
    summary = {"error": "the disk is full", "exit_code": 1}
    frames = [(header(0), of_picks(picks_of(bed(0))))]
    results = Results(tmp_path / "r.mcap", "/mushpipe/pick", frames, summary=summary)
    truth = TruthSet("labels.json", {("index", 0): FrameTruth(bed(0))})
    assert judge_results(results, truth, Rules()).notes == ["the run ended early: the disk is full"]


def test_only_labels_may_be_of_another_recording(tmp_path: Path) -> None:
    elsewhere = replace(picks_of(bed(0)), center=bed(0).center + np.array([0, 400]))
    results = Results(tmp_path / "r.mcap", "/mushpipe/pick", [(header(0), of_picks(elsewhere))])
    known = {("stamp_ns", header(0).stamp_ns): FrameTruth(bed(0))}
    carried = TruthSet("bed.mcap", known, recording=tmp_path / "bed.mcap")
    assert judge_results(results, carried, Rules()).notes == []
    doubted = judge_results(results, TruthSet("labels.json", known), Rules()).notes
    assert [note.partition(":")[0] for note in doubted] == [
        "nothing was found where labels.json has a mushroom"
    ]
    labels = TruthSet("labels.json", known)
    moved = np.where(np.arange(20)[:, None] == 0, bed(0).center, elsewhere.center)
    for picks in (replace(elsewhere, center=moved), elsewhere.take(slice(0, 0))):  # one; nothing
        results.frames[:] = [(header(0), of_picks(picks))]
        assert judge_results(results, labels, Rules()).notes == []


def test_numbers_of_frames_do_not_fit_a_run_that_began_later(tmp_path: Path) -> None:
    there = bed(0)
    manifest = {"graph": {"source": {"use": "mcap", "start": 0.2}, "stages": {}}}
    frames = [(header(0), of_picks(picks_of(there)))]
    results = Results(tmp_path / "r.mcap", "/mushpipe/pick", frames, manifest=manifest)
    with pytest.raises(UsageError, match=r"counted from 0\.2 s on: label them by 'stamp_ns'"):
        judge_results(results, TruthSet("labels.json", {("index", 0): FrameTruth(there)}), Rules())
    stamped = TruthSet("labels.json", {("stamp_ns", header(0).stamp_ns): FrameTruth(there)})
    assert len(judge_results(results, stamped, Rules()).verdicts[0].matching.truth) == 20
    # another source may keep the numbers of the recording
    results.frames[:] = [(header(6), of_picks(picks_of(there)))]
    numbered = TruthSet("labels.json", {("index", 6): FrameTruth(there)})
    assert len(judge_results(results, numbered, Rules()).verdicts[0].matching.truth) == 20
    results.frames.clear()
    assert judge_results(results, numbered, Rules()).verdicts == []


def test_what_is_no_truth_on_its_topic_is_refused(tmp_path: Path) -> None:
    foreign = json_message(json_schema("mine.Truth", {}), header(0), {})
    for name, value in (("mushpipe.Picks", picks_of(bed(0))), ("mine.Truth", foreign)):
        path = tmp_path / f"{name}.mcap"
        writer = RecordingWriter(path, {})
        writer.value(TRUTH_TOPIC, value, header(0))
        writer.close()
        with pytest.raises(InputError, match=f"{TRUTH_TOPIC} holds '{name}', expected mushpipe.Tr"):
            read_truth(path)


def test_a_recording_without_truth_says_so(tmp_path: Path) -> None:
    path = write_results(tmp_path / "none.mcap", {})
    assert not has_truth(path)
    with pytest.raises(InputError, match="carries no truth"):
        read_truth(path)


FIELD = os.environ.get("MUSHPIPE_FIELD_DATA")
real = pytest.mark.skipif(not FIELD, reason="MUSHPIPE_FIELD_DATA names no folder of field data")


@real
@pytest.mark.parametrize(
    ("name", "frames", "caps", "ignored", "may_find"),
    [
        ("white-bed-0", 1, 13, 0, 24),
        ("beds-colour-only", 1, 207, 44, 0),
        ("desk-june", 2, 1, 0, 0),
        ("desk-july", 1, 5, 3, 0),
    ],
)
def test_real_labels(name: str, frames: int, caps: int, ignored: int, may_find: int) -> None:
    truth = read_truth(Path(FIELD or "") / f"{name}.labels.json")
    assert len(truth.frames) == frames
    parts = list(truth.frames.values())
    assert sum(len(part.caps) for part in parts) == caps
    assert sum(int((part.caps.ignore != 0).sum()) for part in parts) == ignored
    assert sum(len(part.may_find) for part in parts) == may_find


def test_frames_whose_stamps_stand_still_keep_their_own_truth(tmp_path: Path) -> None:
    moving = McapSource(path=Path(__file__).parents[2] / "recordings/moving.mcap")
    frames, stamp_ns = list(moving.frames()), 1_700_000_000 * 10**9
    writer = RecordingWriter(tmp_path / "still.mcap", {MANIFEST: {"json": "{}"}})
    for frame in frames:
        still = replace(frame.header, stamp_ns=stamp_ns)
        for topic, message in frame.attached.items():
            if topic == TRUTH_TOPIC:
                said = json.loads(message.data) | {"timestamp": {"sec": 1_700_000_000, "nsec": 0}}
                message = message._replace(data=json.dumps(said).encode())
            writer.write(topic, message, still)
        writer.frame(replace(frame, header=still, attached={}))
    writer.close()
    truth = read_truth(tmp_path / "still.mcap")
    again = list(McapSource(path=tmp_path / "still.mcap").frames())
    assert len(truth.frames) == len(again) == len(frames) > 2
    for before, now in zip(frames, again, strict=True):
        wanted = json.loads(before.attached[TRUTH_TOPIC].data)["center"]
        assert json.loads(now.attached[TRUTH_TOPIC].data)["center"] == wanted
        place = truth.place(now.header)
        assert place is not None
        np.testing.assert_allclose(truth.frames[place].caps.center, wanted)
