from __future__ import annotations

import hashlib
import json
import shutil
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from click.testing import Result
from mcap.writer import Writer
from typer.testing import CliRunner

from mushpipe import Locations, Picks
from mushpipe.cli import app
from mushpipe.core.errors import EXIT_DAMAGED, EXIT_DIFFERS, InputError, UsageError
from mushpipe.core.recorder import RecordingWriter
from mushpipe.core.wire import table_schema
from mushpipe.evaluate.results import read_results
from mushpipe.evaluate.running import Alternative, plans, result_path, unique_names
from tests.evaluate.scenes import (
    bed,
    header,
    picks_of,
    write_recording,
    write_results,
)

FAST = ["--resamples", "20"]


def run(*arguments: Any) -> Result:
    return CliRunner().invoke(app, ["eval", *FAST, *map(str, arguments)])


def judged(*arguments: Any) -> dict[str, Any]:
    result = run(*arguments, "--format", "json")
    assert result.exception is None or result.exit_code == EXIT_DIFFERS, result.exception
    content: dict[str, Any] = json.loads(result.stdout)
    return content


def metrics(content: dict[str, Any], number: int = 0) -> dict[str, float]:
    overall = content["alternatives"][number]["overall"]["metrics"]
    return {name: value["value"] for name, value in overall.items()}


def test_truth_against_itself(perfect: Path, truths: dict[int, Any]) -> None:
    content = judged(perfect)
    values = metrics(content)
    assert values["f"] == 1
    assert values["surface_p95_mm"] == pytest.approx(0, abs=1e-6)
    assert values["apex_p95_mm"] == pytest.approx(0, abs=1e-6)
    assert values["calibration_tilt"] is None
    tilts = [np.degrees(np.arccos(-truth.axis[:, 2])) for truth in truths.values()]  # from up, -z
    assert values["upright_mean_deg"] == pytest.approx(np.concatenate(tilts).mean())
    (only,) = content["alternatives"]
    assert only["overall"]["frames"] == 3
    assert only["speed"]["pick"]["p95_ms"] == 2.5
    assert content["exit_code"] == 0


def test_text_says_the_same(perfect: Path) -> None:
    result = run(perfect, "--threshold", "f>=0.99", "--threshold", "speed_total_p95_ms<3")
    assert result.exit_code == 0
    for word in ("recording", "perfect", "1.000", "apex", "Coverage", "kept", "2.50"):
        assert word in result.stdout


@pytest.mark.parametrize(
    ("threshold", "code"),
    [
        ("f>=0.99", 0),
        ("|diameter_bias_mm|<0.1", 0),
        ("upright_mean_deg<5", EXIT_DIFFERS),
        ("calibration_tilt<2", EXIT_DIFFERS),
        ("speed_pick_p50_ms<1", EXIT_DIFFERS),
    ],
)
def test_thresholds_set_the_exit_code(perfect: Path, threshold: str, code: int) -> None:
    assert run(perfect, "--threshold", threshold).exit_code == code


@pytest.mark.parametrize("name", ["axis_mean", "speed_pik_p50_ms", "F"])
def test_a_misspelt_metric_is_found(perfect: Path, name: str) -> None:
    result = run(perfect, "--threshold", f"{name}<1")
    assert isinstance(result.exception, UsageError)
    assert "did you mean" in str(result.exception)


def manifest_of(recording: Path, path: str) -> str:
    """Return the manifest of a run that read `recording` by `path`."""
    sha256 = hashlib.sha256(recording.read_bytes()).hexdigest()
    return json.dumps(
        {
            "graph": {"source": {"use": "mcap", "path": path}},
            "recordings": [{"file": recording.name, "sha256": sha256}],
        }
    )


def test_truth_is_found_in_the_recording_the_results_name(
    tmp_path: Path, truths: dict[int, Any]
) -> None:
    recording = write_recording(tmp_path / "bed.mcap", truths)
    manifest = manifest_of(recording, "elsewhere/bed.mcap")
    answers = {i: picks_of(truth) for i, truth in truths.items()}
    results = write_results(tmp_path / "r.mcap", answers, manifest=manifest)
    assert metrics(judged(results))["f"] == 1
    write_recording(recording, {0: bed(7)})  # no longer the one it was
    result = run(results)
    assert isinstance(result.exception, InputError)
    assert "--truth" in str(result.exception)
    assert metrics(judged(results, "--truth", write_recording(recording, truths)))["f"] == 1
    said = str(run(write_results(tmp_path / "bare.mcap", answers)).exception)
    assert said.endswith("bare.mcap: the truth is not to be found; give it with --truth")


def test_truth_of_another_recording_is_told_of(tmp_path: Path, truths: dict[int, Any]) -> None:
    recording = write_recording(tmp_path / "bed.mcap", truths)
    answers = {i: picks_of(truth) for i, truth in truths.items()}
    manifest = manifest_of(recording, "bed.mcap")
    results = write_results(tmp_path / "r.mcap", answers, manifest=manifest)
    other = write_recording(tmp_path / "other.mcap", {i: bed(7) for i in truths})
    said = "the truth is that of other.mcap; what was played is bed.mcap"
    assert said in run(results, "--truth", other).stdout
    assert "what was played" not in run(results, "--truth", recording).stdout


def test_recordings_of_one_name_are_told_apart(tmp_path: Path, truths: dict[int, Any]) -> None:
    answers = {i: picks_of(truth) for i, truth in truths.items()}
    paths = [tmp_path / name for name in ("a/bed.mcap", "b/bed.mcap", "bed-1.mcap")]
    for path in paths:
        path.parent.mkdir(exist_ok=True)
        write_results(path, answers, truths)
    assert unique_names(paths) == ["bed-0", "bed-1-", "bed-1"]
    names = [r["name"] for r in judged(*paths)["alternatives"][0]["recordings"]]
    assert names == ["bed-0", "bed-1-", "bed-1"]


def test_a_frame_is_judged_once(tmp_path: Path, truths: dict[int, Any]) -> None:
    path = tmp_path / "r.mcap"
    writer = RecordingWriter(path, {})
    for number, at in [
        (0, header(0)),
        (0, replace(header(0), sequence=9)),
        *((i, header(i)) for i in (1, 2)),
    ]:
        writer.value("/mushpipe/pick", picks_of(truths[number]), at)
    writer.close()
    labels = write_recording(tmp_path / "truth.mcap", truths)
    content = judged(path, "--truth", labels)["alternatives"][0]
    assert content["overall"]["frames"] == 3
    (recording,) = content["recordings"]
    assert "1 frames repeat the stamp of another and are not judged" in recording["notes"]


def test_a_frame_that_failed_is_missed_though_the_results_copy_no_truth_of_it(
    tmp_path: Path, truths: dict[int, Any]
) -> None:
    recording = write_recording(tmp_path / "bed.mcap", truths)
    manifest = manifest_of(recording, "bed.mcap")
    kept = {i: truths[i] for i in (0, 2)}
    answers = {i: picks_of(truth) for i, truth in kept.items()}
    results = write_results(tmp_path / "r.mcap", answers, kept, manifest=manifest)
    assert metrics(judged(results))["recall"] == pytest.approx(2 / 3)
    recording.unlink()  # what the results hold is better than nothing
    assert metrics(judged(results))["recall"] == 1


def test_what_is_played_is_what_is_judged(graph: Path, tmp_path: Path) -> None:
    for change in (["--set", "source.path=x.mcap"], ["--matrix", "source.path=x.mcap,y.mcap"]):
        result = run(graph, "--recordings", tmp_path / "bed.mcap", *change)
        assert isinstance(result.exception, UsageError)
        assert "source.path and source.use cannot be changed" in str(result.exception)


def test_labels_judge_the_frames_they_name(tmp_path: Path, truths: dict[int, Any]) -> None:
    answers = {i: picks_of(truth) for i, truth in truths.items()}
    results = write_results(tmp_path / "r.mcap", answers)
    caps = [
        {"u": u, "v": v, "radius_px": r}
        for (u, v), r in zip(truths[1].center.tolist(), truths[1].radius.tolist(), strict=True)
    ]
    labels = tmp_path / "labels.json"
    frames = [{"stamp_ns": header(1).stamp_ns, "caps": caps}]
    labels.write_text(json.dumps({"mushpipe_labels": 1, "frames": frames}))
    content = judged(results, "--truth", labels)
    assert content["alternatives"][0]["overall"]["frames"] == 1
    assert metrics(content)["f"] == 1
    assert metrics(content)["apex_mean_mm"] is None
    assert "2 frames have no truth" in content["alternatives"][0]["recordings"][0]["notes"][0]
    labels.write_text(json.dumps({"mushpipe_labels": 1, "frames": [{"index": 99, "caps": []}]}))
    assert isinstance(run(results, "--truth", labels).exception, InputError)


def test_labels_of_another_recording_are_doubted(perfect: Path, tmp_path: Path) -> None:
    """A number of a frame fits any recording."""
    labels = tmp_path / "labels.json"
    caps = [{"u": 20.0, "v": 20.0, "radius_px": 15.0}]
    for frame, doubted in (({"caps": caps}, True), ({"caps": []}, False)):
        frames = [{"index": 0, **frame}]
        labels.write_text(json.dumps({"mushpipe_labels": 1, "frames": frames}))
        (notes,) = (
            recording["notes"]
            for recording in judged(perfect, "--truth", labels)["alternatives"][0]["recordings"]
        )
        question = "nothing was found where labels.json has a mushroom: is it of this"
        assert any(note.startswith(question) for note in notes) == doubted


@pytest.mark.parametrize(
    "rounded",
    [
        lambda stamp: int(np.float64(stamp)),
        lambda stamp: round(stamp / 1000) * 1000,
        lambda stamp: stamp // 10**6 * 10**6,
    ],
    ids=["float", "us", "ms"],
)
def test_stamps_that_were_rounded_are_no_other_frames(
    tmp_path: Path, truths: dict[int, Any], rounded: Any
) -> None:
    stamp = 1_700_000_000_033_456_789
    results = tmp_path / "r.mcap"
    writer = RecordingWriter(results, {})
    at = replace(header(1), stamp_ns=stamp, arrival_ns=stamp)
    writer.value("/mushpipe/pick", picks_of(truths[1]), at)
    writer.close()
    labels, wrong = tmp_path / "labels.json", int(rounded(stamp))
    for written in (wrong, wrong + 7):  # the second is that of another camera, say
        frames = [{"stamp_ns": written, "caps": []}, {"stamp_ns": stamp, "caps": []}]
        labels.write_text(json.dumps({"mushpipe_labels": 1, "frames": frames}))
        error = run(results, "--truth", labels).exception
        if written == wrong:
            assert isinstance(error, InputError)
            assert f"labels.json: no frame has the stamp_ns {wrong}: it is {stamp}" in str(error)
        else:
            assert not isinstance(error, InputError)


def test_a_frame_labelled_by_stamp_and_by_number_is_refused(
    tmp_path: Path, truths: dict[int, Any]
) -> None:
    results = write_results(tmp_path / "r.mcap", {i: picks_of(t) for i, t in truths.items()})
    stamp_ns = header(1).stamp_ns
    frames = [{"stamp_ns": stamp_ns, "caps": []}, {"index": 1, "caps": []}]
    labels = tmp_path / "labels.json"
    labels.write_text(json.dumps({"mushpipe_labels": 1, "frames": frames}))
    error = run(results, "--truth", labels).exception
    assert isinstance(error, InputError)
    assert f"labels.json: stamp_ns={stamp_ns} and index=1 are the same frame" in str(error)


def test_a_frame_without_an_answer_is_missed(tmp_path: Path, truths: dict[int, Any]) -> None:
    answers = {i: picks_of(truths[i]) for i in (0, 1)}
    results = write_results(tmp_path / "r.mcap", answers, truths)
    content = judged(results)
    assert metrics(content)["recall"] == pytest.approx(2 / 3)
    assert content["alternatives"][0]["frames"][2]["answered"] is False
    gap = write_results(tmp_path / "g.mcap", {i: picks_of(truths[i]) for i in (0, 2)}, truths)
    frames = judged(gap)["alternatives"][0]["frames"]
    assert [frame["answered"] for frame in frames] == [True, False, True]
    manifest = json.dumps({"graph": {"source": {"max_frames": 2}}})
    partial = write_results(tmp_path / "p.mcap", answers, truths, manifest=manifest)
    content = judged(partial)
    assert metrics(content)["recall"] == 1
    assert content["alternatives"][0]["recordings"][0]["notes"] == []


@pytest.mark.parametrize("failing", [[0], [2], [0, 2], [1]])
def test_a_frame_that_failed_is_missed_wherever_it_stands_in_the_part_that_was_played(
    graph: Path, tmp_path: Path, truths: dict[int, Any], failing: list[int]
) -> None:
    write_recording(tmp_path / "bed.mcap", {**truths, 3: bed(3)})
    (tmp_path / "fussy.py").write_text(
        "from mushpipe import Mask, RgbdFrame, Stage\n"
        "class Fussy(Stage):\n"
        "    def process(self, frame: RgbdFrame, mask: Mask) -> Mask:\n"
        f"        if frame.header.sequence in {failing}:\n"
        "            raise RuntimeError('I do not like it')\n"
        "        return mask\n"
    )
    text = graph.read_text().replace("  detect:", "  fussy: {use: './fussy.py:Fussy'}\n  detect:")
    graph.write_text(text + "on_error: skip\n")
    out = tmp_path / "kept"
    arguments = (graph, "--recordings", tmp_path / "bed.mcap", "--frames", 3, "--out", out)
    content = judged(*arguments)
    assert content["alternatives"][0]["overall"]["frames"] == 3  # the fourth was not asked for
    assert metrics(content)["recall"] == pytest.approx(1 - len(failing) / 3, abs=0.02)
    (recording,) = content["alternatives"][0]["recordings"]
    failed = f"{len(failing)} frames failed when the graph ran"
    assert failed in recording["notes"]
    again = judged(out / "bed.mcap", "--truth", tmp_path / "bed.mcap")
    assert metrics(again)["recall"] == metrics(content)["recall"]


def test_a_recording_whose_only_label_is_of_a_frame_that_failed_counts(
    tmp_path: Path, truths: dict[int, Any]
) -> None:
    whole = write_results(tmp_path / "a.mcap", {0: picks_of(truths[0])}, {0: truths[0]})
    span = {"span": {"stamp_ns": [header(0).stamp_ns, header(1).stamp_ns], "sequence": [0, 1]}}
    other = write_results(tmp_path / "b.mcap", {0: picks_of(truths[0])}, summary=span)
    labels = write_recording(tmp_path / "truth.mcap", {1: truths[1]})
    content = judged(whole, other, "--truth", tmp_path / "a.mcap", "--truth", labels)
    assert metrics(content)["recall"] == 0.5


def test_labels_of_other_frames_are_told_apart_from_those_of_the_results(
    perfect: Path, tmp_path: Path
) -> None:
    labels = tmp_path / "other.json"
    frame = {"caps": [{"u": 1.0, "v": 1.0, "radius_px": 9.0}]}
    for place, first, known in (
        ("index", 77, "0 to 2"),
        ("stamp_ns", 5, f"{header(0).stamp_ns} to {header(2).stamp_ns}"),
    ):
        labels.write_text(json.dumps({"mushpipe_labels": 1, "frames": [{place: first, **frame}]}))
        assert str(run(perfect, "--truth", labels).exception) == (
            "no frame of the results is labelled in other.json: "
            f"there {place} {first} comes first, results have {known}"
        )


def test_results_that_lost_all_their_picks_say_so(tmp_path: Path, truths: dict[int, Any]) -> None:
    """The channel is there, its messages are not, and neither is word of how the run went."""
    schema = table_schema(Picks)
    with (tmp_path / "r.mcap").open("wb") as file:
        writer = Writer(file)
        writer.start(profile="mushpipe", library="a test")
        number = writer.register_schema(schema.name, schema.encoding, schema.data)
        writer.register_channel("/mushpipe/pick", "json", number)
        writer.finish()
    truth = write_recording(tmp_path / "truth.mcap", truths)
    result = run(tmp_path / "r.mcap", "--truth", truth)
    assert isinstance(result.exception, InputError)
    assert str(result.exception) == "no frame of the results is labelled in truth.mcap"


def test_several_results_are_judged_each_and_together(
    tmp_path: Path, truths: dict[int, Any]
) -> None:
    files = []
    for name, kept in (("a", 20), ("b", 10)):
        answers = {i: picks_of(t.take(slice(0, kept))) for i, t in truths.items()}
        files.append(write_results(tmp_path / f"{name}.mcap", answers, truths))
    (only,) = judged(*files)["alternatives"]
    assert [r["metrics"]["recall"]["value"] for r in only["recordings"]] == [1, 0.5]
    assert only["overall"]["metrics"]["recall"]["value"] == 0.75
    counts = [only["overall"][name] for name in ("truths", "found", "missed", "false")]
    assert counts == [120, 90, 30, 0]


def test_results_of_one_recording_are_compared_and_not_pooled(
    tmp_path: Path, truths: dict[int, Any]
) -> None:
    manifest = manifest_of(write_recording(tmp_path / "bed.mcap", truths), "bed.mcap")
    files = []
    for name, kept in (("before", 20), ("after", 10)):
        answers = {i: picks_of(t.take(slice(0, kept))) for i, t in truths.items()}
        files.append(write_results(tmp_path / f"{name}.mcap", answers, truths, manifest))
    content = judged(*files, "--threshold", "recall>=0.9")
    assert [a["label"] for a in content["alternatives"]] == ["before", "after"]
    assert [a["overall"]["frames"] for a in content["alternatives"]] == [3, 3]
    (difference,) = content["differences"]
    assert (difference["label"], difference["base"], difference["frames"]) == ("after", "before", 3)
    assert difference["metrics"]["recall"]["value"] == pytest.approx(-0.5)
    assert [t["kept"] for t in content["thresholds"]] == [True, False]
    other = manifest_of(write_recording(tmp_path / "other.mcap", {0: bed(9)}), "other.mcap")
    files.append(write_results(tmp_path / "c.mcap", {0: picks_of(bed(9))}, {0: bed(9)}, other))
    error = run(*files).exception
    assert isinstance(error, UsageError)
    assert "before and after answer the same frames of bed.mcap" in str(error)


def test_parts_of_one_recording_are_judged_together(tmp_path: Path, truths: dict[int, Any]) -> None:
    manifest = json.loads(manifest_of(write_recording(tmp_path / "bed.mcap", truths), "bed.mcap"))
    manifest["graph"]["source"]["max_frames"] = 2  # each is a part
    parts = [
        write_results(
            tmp_path / f"{name}.mcap",
            {i: picks_of(truths[i]) for i in numbers},
            manifest=json.dumps(manifest),
        )
        for name, numbers in (("a", [0, 1]), ("b", [2]))
    ]
    (only,) = judged(*parts, "--truth", tmp_path / "bed.mcap")["alternatives"]
    assert only["overall"]["frames"] == 3


def test_one_file_of_labels_serves_several_recordings(
    graph: Path, tmp_path: Path, truths: dict[int, Any]
) -> None:
    """A day's labels: each recording is judged on its own frames, and on none of the others'."""
    day = {**truths, 3: bed(3)}
    recordings = [tmp_path / "morning.mcap", tmp_path / "noon.mcap"]
    for recording, numbers in zip(recordings, ([0, 1], [2, 3]), strict=True):
        write_recording(recording, {number: day[number] for number in numbers})
    circles = {
        number: np.column_stack([truth.center, truth.radius]) for number, truth in day.items()
    }
    frames = [
        {
            "stamp_ns": header(number).stamp_ns,
            "caps": [dict(zip(("u", "v", "radius_px"), c, strict=True)) for c in rows.tolist()],
        }
        for number, rows in circles.items()
    ]
    labels = tmp_path / "day.json"
    labels.write_text(json.dumps({"mushpipe_labels": 1, "frames": frames}))
    content = judged(graph, "--recordings", *recordings, "--truth", labels)
    assert content["alternatives"][0]["overall"]["frames"] == 4
    assert (
        metrics(content)["recall"] == metrics(judged(graph, "--recordings", *recordings))["recall"]
    )
    noted = "2 frames of day.json lie before or after what was played and are not judged"
    assert [noted in r["notes"] for r in content["alternatives"][0]["recordings"]] == [True, True]


def test_files_of_a_split_run_are_judged_each_on_its_frames(
    graph: Path, tmp_path: Path, truths: dict[int, Any]
) -> None:
    write_recording(tmp_path / "bed.mcap", {**truths, 3: bed(3)})
    text = graph.read_text()
    graph.write_text(text.replace("must-not-be-written.mcap", "s.mcap, split_size: 20KB"))
    assert CliRunner().invoke(app, ["run", str(graph)]).exit_code == 0
    (tmp_path / "whole.yaml").write_text(text.replace("must-not-be-written.mcap", "w.mcap"))
    assert CliRunner().invoke(app, ["run", str(tmp_path / "whole.yaml")]).exit_code == 0
    whole = judged(tmp_path / "w.mcap")["alternatives"][0]
    parts = sorted(tmp_path.glob("s_*.mcap"))
    assert len(parts) > 1
    (together,) = judged(*parts)["alternatives"]
    counts = ("frames", "found", "missed", "false", "ignored")
    assert [together["overall"][c] for c in counts] == [whole["overall"][c] for c in counts]
    alone = [judged(part)["alternatives"][0] for part in parts]
    frames = [frame for each in alone for frame in each["frames"]]
    assert [[f[c] for c in counts[1:]] for f in frames] == [
        [f[c] for c in counts[1:]] for f in whole["frames"]
    ]


def test_the_last_file_of_a_split_run_knows_of_frames_that_failed_at_the_end(
    tmp_path: Path, truths: dict[int, Any]
) -> None:
    manifest = json.loads(manifest_of(write_recording(tmp_path / "bed.mcap", truths), "bed.mcap"))
    manifest["graph"]["sinks"] = {"log": {"use": "mcap", "split_size": 1000}}
    ends = {"stamp_ns": [header(0).stamp_ns, header(2).stamp_ns], "sequence": [0, 2]}
    summary = {"span": ends, "frames": {"processed": 2, "failed": 1}}
    answers = {1: picks_of(truths[1])}
    last = write_results(
        tmp_path / "s_001.mcap", answers, None, json.dumps(manifest), None, summary
    )
    (only,) = judged(last, "--truth", tmp_path / "bed.mcap")["alternatives"]
    assert [frame["answered"] for frame in only["frames"]] == [True, False]


def test_damage_is_judged_as_far_as_it_goes(perfect: Path) -> None:
    perfect.write_bytes(perfect.read_bytes()[:-200])
    result = run(perfect)
    assert result.exit_code == EXIT_DAMAGED
    assert "note: perfect.mcap" in result.stdout


def test_a_graph_is_run_and_judged(graph: Path, tmp_path: Path) -> None:
    out = tmp_path / "kept"
    content = judged(graph, "--recordings", tmp_path / "bed.mcap", "--out", out)
    assert metrics(content)["f"] > 0.95
    assert metrics(content)["coverage_position"] == 0
    assert {"segment", "detect", "total"} <= content["alternatives"][0]["speed"].keys()
    assert [path.name for path in out.iterdir()] == ["bed.mcap"]
    assert not (tmp_path / "must-not-be-written.mcap").exists()


def test_a_source_that_knows_the_truth_needs_no_recording(graph: Path, tmp_path: Path) -> None:
    (tmp_path / "beds.py").write_text(
        "from mushpipe import ReplaySource\n"
        "from tests.evaluate.scenes import bed, frame\n"
        "class Beds(ReplaySource):\n"
        "    def frames(self):\n"
        "        yield from (frame(i, bed(i)) for i in range(2))\n"
    )
    graph.write_text(
        graph.read_text().replace("{use: mcap, path: bed.mcap}", "{use: './beds.py:Beds'}")
    )
    content = judged(graph, "--report", tmp_path / "report")
    assert content["alternatives"][0]["overall"]["frames"] == 2
    assert [r["name"] for r in content["alternatives"][0]["recordings"]] == ["beds"]
    assert metrics(content)["f"] > 0.95
    assert (tmp_path / "report" / "index.html").read_text().count("data:image/jpeg") == 2


def test_recordings_may_follow_the_graph_and_folders_are_opened(
    graph: Path, tmp_path: Path, truths: dict[int, Any]
) -> None:
    folder = tmp_path / "set"
    folder.mkdir()
    write_recording(folder / "x.mcap", {0: truths[0]})
    write_recording(folder / "y.mcap", {0: truths[1]})
    write_recording(folder / "without.mcap", {})
    content = judged(graph, "--recordings", tmp_path / "bed.mcap", folder, "--frames", 1)
    (only,) = content["alternatives"]
    assert [r["name"] for r in only["recordings"]] == ["bed", "x", "y"]
    assert only["overall"]["frames"] == 3


@pytest.mark.parametrize("given", [False, True])
def test_a_recording_that_its_folder_names_as_well_counts_once(
    given: bool, graph: Path, tmp_path: Path
) -> None:
    bed = tmp_path / "bed.mcap"
    content = judged(graph, bed, tmp_path, "--frames", 1, *(["--truth", bed] if given else []))
    (only,) = content["alternatives"]
    assert [r["name"] for r in only["recordings"]] == ["bed"]
    assert only["overall"]["frames"] == 1


def test_a_folder_without_recordings_may_be_one_of_images(graph: Path, tmp_path: Path) -> None:
    (tmp_path / "photos").mkdir()
    told = str(run(graph, "--recordings", tmp_path / "photos").exception)
    assert "photos: the folder holds no recordings (*.mcap); one of images is played by" in told


def test_results_of_alternatives_never_share_a_file(graph: Path, tmp_path: Path) -> None:
    options = [Alternative(f"net.model={value}") for value in ("a/b.onnx", "a_b.onnx", "c.onnx")]
    runs = plans(graph, [tmp_path / "bed.mcap"], (), options, tmp_path / "out")
    files = [result_path(plan).name for *_, plan in runs]
    ways = ("a_b.onnx-0", "a_b.onnx-1", "c.onnx")
    assert files == [f"bed.net.model={way}.mcap" for way in ways]


def test_results_of_recordings_never_share_a_file(graph: Path, tmp_path: Path) -> None:
    recordings = [tmp_path / name for name in ("a{1}.mcap", "a(1).mcap", "b.mcap")]
    for each in recordings:
        shutil.copy(tmp_path / "bed.mcap", each)
    runs = plans(graph, recordings, (), [Alternative("")], tmp_path / "out")
    files = [result_path(plan).name for *_, plan in runs]
    assert files == ["a(1)-0.mcap", "a(1)-1.mcap", "b.mcap"]


def test_matrix_compares_on_the_same_frames(graph: Path, tmp_path: Path) -> None:
    arguments = (graph, "--recordings", tmp_path / "bed.mcap", "--matrix")
    content = judged(*arguments, "detect.radius_px=[8,45],[8,20]", "--threshold", "f>=0.95")
    first, second = (metrics(content, i) for i in (0, 1))
    (difference,) = content["differences"]
    assert difference["label"] == "detect.radius_px=[8,20]"
    assert difference["metrics"]["recall"]["value"] == pytest.approx(
        second["recall"] - first["recall"]
    )
    assert difference["metrics"]["recall"]["high"] < 0
    assert [t["kept"] for t in content["thresholds"]] == [True, False]
    assert content["exit_code"] == EXIT_DIFFERS
    assert "did you mean 'otsu'" in str(run(*arguments, "segment.use=otsu,otsuu").exception)
    shown = run(*arguments, "detect.radius_px=[8,45],[8,44]").stdout
    assert "minus detect.radius_px=[8,45], on the same 3 frames" in shown


def test_a_fault_is_told_with_the_option_it_comes_from(graph: Path, tmp_path: Path) -> None:
    bed = tmp_path / "bed.mcap"
    told = str(run(graph, "--recordings", bed, "--frames", "0").exception)
    assert told.startswith("--frames 0: max_frames of 'mcap': ")
    told = str(run(graph, "--recordings", bed, "--matrix", "segmen.use=otsu,height").exception)
    assert told.startswith("--matrix segmen.use=otsu: unknown path 'segmen.use'")


def test_options_that_need_a_graph_say_so(perfect: Path) -> None:
    result = run(perfect, "--matrix", "a.b=1,2")
    assert isinstance(result.exception, UsageError)
    for gravity in ("0,0,0", "inf,0,1", "nan,0,1"):
        assert isinstance(run(perfect, "--gravity", gravity).exception, UsageError)
    assert isinstance(run(perfect, "--topic", "/mushpipe/pik").exception, UsageError)


def test_a_recording_is_not_a_result(tmp_path: Path, truths: dict[int, Any]) -> None:
    result = run(write_recording(tmp_path / "bed.mcap", truths))
    assert isinstance(result.exception, InputError)
    assert "no picks or circles" in str(result.exception)


def test_what_else_stands_on_a_topic_of_picks_is_no_empty_bed(
    tmp_path: Path, truths: dict[int, Any]
) -> None:
    truth, writer = truths[0], RecordingWriter(path := tmp_path / "out.mcap", {})
    for value in (Locations.unknown(len(truth)), picks_of(truth), Locations.unknown(0)):
        writer.value("/mushpipe/pick", value, header(0))
    writer.close()
    with pytest.raises(InputError, match=r"/mushpipe/pick holds mushpipe\.Locations as well"):
        read_results(path, "/mushpipe/pick")


def test_gravity_changes_what_upright_means(perfect: Path) -> None:
    plain = metrics(judged(perfect))["upright_mean_deg"]
    assert metrics(judged(perfect, "--gravity", "0,1,1"))["upright_mean_deg"] > plain + 10
