"""What the sink `rerun` shows of a frame, read back by Rerun's own reader."""

from __future__ import annotations

import logging
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import cv2
import numpy as np
import pytest
import rerun as rr
from rerun.chunk import RrdReader
from scipy.spatial.transform import Rotation

from mushpipe import Circles, Mask, Picks, RunInfo
from mushpipe.core.recorder import RecordingError
from mushpipe.sinks import rerun as module
from mushpipe.sinks import rerun_layout as at
from mushpipe.sinks.rerun import ROOM_BYTES, RerunSink
from tests.io.bags import FX, FY, OPTICAL, PERIOD, T0, depth_pixels
from tests.io.rerun_file import IMAGE, read, show, unpack, values
from tests.io.values import SIZE, make_circles, make_frame, make_picks, no_picks, trace_of


def test_frames_stand_on_two_timelines(tmp_path: Path) -> None:
    found = show(tmp_path, [trace_of(make_frame(i)) for i in range(3)])
    color = found[f"{IMAGE}/color"]
    assert color["frame"] == [10, 11, 12]
    assert color["capture"] == [T0 + i * PERIOD for i in range(3)]


def test_runs_of_one_recording_are_told_apart_by_viewers(tmp_path: Path) -> None:
    for name in ("pick", "classic"):
        sink = RerunSink(save=tmp_path / f"{name}.rrd")
        sink.open(RunInfo("bed", {"graph_file": f"graphs/{name}.yaml"}))
        sink.consume(trace_of(make_frame(0)))
        sink.close()
    files = [tmp_path / "pick.rrd", tmp_path / "classic.rrd"]
    runs = [entry for file in files for entry in RrdReader(file).recordings()]
    assert len({entry.recording_id for entry in runs}) == 2
    names = [values(read(file), "/__properties", "name") for file in files]
    assert names == [[["bed pick"]], [["bed classic"]]]


def test_a_disk_that_is_all_but_full_ends_the_file_and_hangs_nobody(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    free = iter([ROOM_BYTES, ROOM_BYTES, ROOM_BYTES - 1, ROOM_BYTES - 1])
    left = lambda _: SimpleNamespace(free=next(free))  # noqa: E731
    monkeypatch.setattr(module.shutil, "disk_usage", left)
    sink = RerunSink.model_validate({"save": tmp_path / "run.rrd"})
    sink.open(RunInfo("test", {}))
    sink.consume(trace_of(make_frame(0)))
    full = r"run\.rrd: there are less than 64 MB left on its disk"
    with pytest.raises(RecordingError, match=f"{full}; the file ends here and can be opened"):
        sink.consume(trace_of(make_frame(1)))
    sink.close()
    assert read(tmp_path / "run.rrd")[f"{IMAGE}/color"]["frame"] == [10]
    with pytest.raises(RecordingError, match=f"{full}; nothing is written"):
        RerunSink.model_validate({"save": tmp_path / "run.rrd"}).open(RunInfo("test", {}))
    assert read(tmp_path / "run.rrd")[f"{IMAGE}/color"]["frame"] == [10]


def test_color_is_stored_as_jpeg_of_the_stated_quality(tmp_path: Path) -> None:
    red = np.zeros((24, 32, 3), np.uint8)
    red[..., 0] = 200
    found = show(tmp_path, [trace_of(make_frame(color=red))], jpeg_quality=95)
    ((data,),) = values(found, f"{IMAGE}/color", "blob")
    decoded = cv2.imdecode(np.array(data, np.uint8), cv2.IMREAD_COLOR_RGB)
    assert np.abs(decoded.astype(int) - red).max() <= 4


def test_depth_is_stored_native_with_its_unit_and_its_holes_are_marked(tmp_path: Path) -> None:
    found = show(tmp_path, [trace_of(make_frame())])
    ((data,),) = values(found, f"{IMAGE}/depth", "buffer")
    stored = np.array(data, np.uint8).view(np.uint16).reshape(24, 32)
    truth = depth_pixels(0, SIZE)
    np.testing.assert_array_equal(stored, truth)
    assert values(found, f"{IMAGE}/depth", "meter") == [[8000.0]]
    ((holes,),) = values(found, f"{IMAGE}/holes", "buffer")
    np.testing.assert_array_equal(np.reshape(holes, (24, 32)), truth == 0)
    (valid,) = (row for row in values(found, "/plots/depth/valid", "scalars") if row)
    assert valid[0] == pytest.approx(100 * np.count_nonzero(truth) / truth.size)


def test_depth_in_metres_with_gaps_is_shown(tmp_path: Path) -> None:
    metres = np.full((24, 32), 0.5, np.float32)
    metres[0, :3] = np.nan, np.inf, 0
    for i, depth in enumerate((metres, np.zeros_like(metres))):
        folder = tmp_path / str(i)
        folder.mkdir()
        found = show(folder, [trace_of(make_frame(depth=depth, depth_scale=1.0))])
        ((data,),) = values(found, f"{IMAGE}/depth", "buffer")
        stored = np.array(data, np.uint8).view(np.float32).reshape(24, 32)
        np.testing.assert_array_equal(stored, depth)
        assert values(found, f"{IMAGE}/depth", "meter") == [[1.0]]


def test_depth_without_a_calibration_is_an_image_and_no_cloud(tmp_path: Path) -> None:
    found = show(tmp_path, [trace_of(make_frame(camera=None))])
    assert values(found, f"{IMAGE}/depth", "meter") == [[8000.0]]
    assert f"/{at.CLOUD}" not in found


def test_the_pinhole_is_that_of_the_camera(tmp_path: Path) -> None:
    found = show(tmp_path, [trace_of(make_frame())])
    ((matrix,),) = values(found, IMAGE, "image_from_camera")
    expected = np.array([[FX, 0, 15.5], [0, FY, 11.5], [0, 0, 1]])
    np.testing.assert_allclose(np.reshape(matrix, (3, 3)).T, expected)
    assert values(found, IMAGE, "resolution") == [[[32, 24]]]


def test_the_cloud_has_the_place_and_colour_of_its_pixels(tmp_path: Path) -> None:
    frame = make_frame()
    found = show(tmp_path, [trace_of(frame)], cloud_step=5)
    (points,) = values(found, "/camera/cloud", "positions")
    assert frame.camera is not None
    pixels = frame.camera.project(np.array(points))
    u, v = np.rint(pixels).astype(int).T
    # Row by row every fifth pixel that has depth, lifted to its depth; the lens is undone.
    grid = [(x, y) for y in range(0, 24, 5) for x in range(0, 32, 5) if frame.depth[y, x]]  # type: ignore[index]
    assert list(zip(u, v, strict=True)) == grid
    np.testing.assert_allclose(pixels, grid, atol=1e-3)
    np.testing.assert_allclose(np.array(points)[:, 2], frame.depth_m[v, u], rtol=1e-6)
    (packed,) = values(found, "/camera/cloud", "colors")
    np.testing.assert_array_equal([unpack(c) for c in packed], frame.color[v, u])


def test_a_frame_of_colour_alone_is_shown(tmp_path: Path) -> None:
    found = show(tmp_path, [trace_of(make_frame(depth=None, camera=None))])
    assert f"{IMAGE}/color" in found
    assert not {f"{IMAGE}/depth", "/camera/cloud"} & set(found)


def test_every_mask_and_every_contour_has_its_layer(tmp_path: Path) -> None:
    first, second = np.zeros((24, 32), bool), np.zeros((24, 32), bool)
    first[3:5, 4:9] = second[3:5, 4:6] = True
    trace = trace_of(make_frame(), segment=Mask(first, ~first), open=Mask(second, (~first).copy()))
    found = show(tmp_path, [trace])
    layers = {"masks/segment": first, "masks/open": second, "initial/segment": ~first}
    for entity, expected in layers.items():
        ((data,),) = values(found, f"{IMAGE}/{entity}", "buffer")
        np.testing.assert_array_equal(np.reshape(data, (24, 32)), expected)
    assert "buffer" not in str(found.get(f"{IMAGE}/initial/open"))  # the same contour, once


def test_a_frame_that_a_stage_changed_has_its_layer(tmp_path: Path) -> None:
    frame = make_frame()
    flat = make_frame(color=np.full((24, 32, 3), 90, np.uint8))
    found = show(tmp_path, [trace_of(frame, flatten=flat, correct=make_frame(color=frame.color))])
    ((data,),) = values(found, f"{IMAGE}/frames/flatten", "blob")
    decoded = cv2.imdecode(np.array(data, np.uint8), cv2.IMREAD_COLOR)
    assert np.abs(decoded.astype(int) - 90).max() <= 2
    assert f"{IMAGE}/frames/correct" not in found  # only its depth is another


def test_picks_carry_the_place_size_label_and_colour(tmp_path: Path) -> None:
    found = show(tmp_path, [trace_of(make_frame(), detect=make_circles(), pick=make_picks())])
    entity = f"{IMAGE}/picks"
    assert values(found, entity, "centers") == [[[10.75, 6.0], [20.5, 12.5]]]
    (sizes,) = values(found, entity, "half_sizes")
    np.testing.assert_allclose(sizes, [[3.5, 3.5], [1 / 3, 1 / 3]], rtol=1e-6)
    assert values(found, f"{IMAGE}/ids", "labels") == [["7: 40 mm", "8: size unknown"]]
    assert values(found, f"{IMAGE}/ids", "positions") == values(found, entity, "centers")
    (packed,) = values(found, entity, "colors")
    amber, red = (unpack(c) for c in packed)
    assert amber[0] > amber[1] > amber[2]
    assert red[0] > 2 * max(red[1:])
    # Only a pick with a position stands in space.
    np.testing.assert_allclose(
        values(found, "/camera/picks", "positions"), [[[0.1, -0.2, 0.5]]], rtol=1e-6
    )
    assert values(found, "/camera/order", "labels") == [["1"]]


def many(n: int, frame_id: str = OPTICAL) -> Picks:
    """Make picks in a row, 5 cm apart; each leans more."""
    tilt = np.linspace(0, 0.5, n)
    axis = np.column_stack([np.sin(tilt), np.zeros(n), -np.cos(tilt)])
    x = np.arange(n) * 0.05
    half = np.column_stack([np.zeros(n), -np.cos(tilt / 2), np.zeros(n), np.sin(tilt / 2)])
    nan = np.full((n, 3), np.nan)
    return Picks(
        id=np.arange(n) + 100,
        center=np.column_stack([x, x]),
        radius=np.full(n, 3.0),
        position=np.column_stack([x, 0 * x, 0 * x + 0.5]),
        surface=np.column_stack([x, 0 * x, 0 * x + 0.5]),
        distance=np.hypot(x, 0.5),
        diameter=np.full(n, 0.04),
        quaternion=half,
        axis=axis,
        score=np.linspace(0.1, 0.9, n),
        sigma_position=nan,
        sigma_diameter=nan[:, 0],
        sigma_tilt=np.linspace(0, np.radians(20), n),
        source=np.ones(n, np.uint8),
        flags=np.zeros(n, np.uint32),
        frame_id=frame_id,
    )


def test_caps_and_axes_stand_where_the_picks_say(tmp_path: Path) -> None:
    picks = many(5)
    found = show(tmp_path, [trace_of(make_frame(), pick=picks)])
    (origins,), (vectors,) = (values(found, "/camera/axes", n) for n in ("origins", "vectors"))
    np.testing.assert_allclose(origins, picks.position, atol=1e-6)
    np.testing.assert_allclose(vectors, 0.02 * picks.axis, atol=1e-6)
    (centers,), (sizes,) = (values(found, "/camera/caps", n) for n in ("centers", "half_sizes"))
    # The top of each ellipsoid along its own axis is the apex, its width the diameter.
    tops = np.array(centers) + np.array(sizes)[:, 2:] * picks.axis
    np.testing.assert_allclose(tops, picks.position, atol=1e-6)
    np.testing.assert_allclose(np.array(sizes)[:, :2], 0.02, rtol=1e-6)
    colors = np.array([unpack(c) for c in values(found, "/camera/axes", "colors")[0]])
    assert (np.diff(colors[:, 0]) > 0).all()  # the more uncertain, the redder
    assert (np.diff(colors[:, 1]) < 0).all()
    assert all(c & 255 < 128 for c in values(found, "/camera/caps", "colors")[0])  # translucent
    assert values(found, "/camera/order", "labels") == [["1", "2", "3", "4", "5"]]


def test_labels_of_a_crowd_are_ids_alone(tmp_path: Path) -> None:
    found = show(tmp_path, [trace_of(make_frame(), pick=many(150))])
    (labels,) = values(found, f"{IMAGE}/ids", "labels")
    assert labels == [str(100 + i) for i in range(150)]
    assert len(values(found, "/camera/order", "labels")[0]) == 20


def test_circles_without_picks_are_shown(tmp_path: Path) -> None:
    found = show(tmp_path, [trace_of(make_frame(), detect=make_circles())])
    assert len(values(found, f"{IMAGE}/circles/detect", "centers")[0]) == 2


def test_nothing_found_clears_what_was_shown(tmp_path: Path) -> None:
    none = Circles(np.zeros((0, 2)), np.zeros(0), np.zeros(0))
    full = trace_of(make_frame(0), detect=make_circles(), pick=make_picks())
    empty = trace_of(make_frame(1), detect=none, pick=no_picks())
    found = show(tmp_path, [full, empty])
    for entity in (f"{IMAGE}/circles/detect", f"{IMAGE}/picks"):
        assert [len(row) for row in values(found, entity, "centers")] == [2, 0]
    assert [len(row) for row in values(found, "/camera/picks", "positions")] == [1, 0]


def test_a_frame_without_depth_or_answer_does_not_show_those_of_the_one_before(
    tmp_path: Path,
) -> None:
    mask = Mask(np.ones((24, 32), bool))
    full = trace_of(make_frame(0), segment=mask, detect=make_circles(), pick=make_picks())
    bare = trace_of(make_frame(1, depth=None))
    found = show(tmp_path, [full, bare])
    shown = ("depth", "holes", "masks/segment", "circles/detect", "picks", "ids")
    in_space = ("cloud", "picks", "order", "caps", "axes")
    for entity in (*(f"{IMAGE}/{e}" for e in shown), *(f"/camera/{e}" for e in in_space)):
        cleared = [value for value in values(found, entity, "is_recursive") if value]
        assert (cleared, sorted(found[entity]["frame"])) == ([[False]], [10, 11]), entity
    assert not any("Clear" in name for name in found[f"{IMAGE}/color"])


def test_counts_and_times_are_plotted(tmp_path: Path) -> None:
    traces = [trace_of(make_frame(i), detect=make_circles(), pick=make_picks()) for i in range(2)]
    found = show(tmp_path, traces)
    lines = {
        "/plots/count": (["found", "located", "oriented"], [2.0, 1.0, 1.0]),
        "/plots/time": (["detect", "pick"], [0.001, 0.002]),
    }
    for plot, (names, expected) in lines.items():
        assert [row for row in values(found, plot, "scalars") if row] == [expected] * 2
        for style in ("SeriesLines", "SeriesPoints"):
            assert [row for row in found[plot][f"{style}:names"] if row] == [names]


def test_a_stage_without_a_time_leaves_a_gap_in_its_own_line(tmp_path: Path) -> None:
    both = trace_of(make_frame(0), detect=make_circles(), pick=make_picks())
    second = trace_of(make_frame(1), pick=make_picks())
    found = show(tmp_path, [both, second])
    times = [row for row in values(found, "/plots/time", "scalars") if row]
    np.testing.assert_array_equal(times, [[0.001, 0.002], [np.nan, 0.001]])


def test_warnings_stand_in_the_log_at_their_frame(tmp_path: Path) -> None:
    sink = RerunSink(save=tmp_path / "out.rrd")
    sink.open(RunInfo("bed", {}))
    sink.consume(trace_of(make_frame(0), pick=make_picks()))
    logging.getLogger("mushpipe.somewhere").warning("the lamp flickers")
    sink.consume(trace_of(make_frame(1)))
    logging.getLogger("mushpipe").warning("late")
    sink.close()
    logging.getLogger("mushpipe").warning("after the end")
    log = read(tmp_path / "out.rrd")["/log"]
    levels, texts = ([row[0] for row in log[f"TextLog:{n}"]] for n in ("level", "text"))
    summary = "2 picks, 1 without depth, 1 with estimated depth, 1 without pose, 1 at the border"
    assert sorted(zip(log["frame"], levels, texts, strict=True)) == [
        (10, "WARN", summary),
        (11, "WARN", "late"),
        (11, "WARN", "the lamp flickers"),
    ]


@pytest.mark.parametrize(
    "settings", [{"live": True}, {"live": True, "image_hz": 5}, {"image_hz": 5}], ids=str
)
def test_few_images_and_all_results(tmp_path: Path, settings: dict[str, Any]) -> None:
    traces = [trace_of(make_frame(i), pick=make_picks()) for i in range(31)]  # one second
    found = show(tmp_path, traces, **settings)
    stamps = np.array(found[f"{IMAGE}/color"]["capture"])
    assert stamps[0] == T0
    assert 4 <= len(stamps) <= 6
    assert (np.diff(stamps) >= 200_000_000).all()
    assert found["/camera/cloud"]["frame"] == found[f"{IMAGE}/color"]["frame"]
    assert len(values(found, f"{IMAGE}/picks", "centers")) == 31


def test_frames_are_shown_whole_where_images_and_results_have_one_pace(tmp_path: Path) -> None:
    traces = [trace_of(make_frame(i), pick=make_picks()) for i in range(31)]  # one second
    found = show(tmp_path, traces, image_hz=5, result_hz=5)
    shown = found[f"{IMAGE}/color"]["frame"]
    assert 4 <= len(shown) <= 6
    assert found[f"{IMAGE}/picks"]["frame"] == found["/log"]["frame"] == shown
    assert len(values(found, f"{IMAGE}/picks", "centers")) == len(shown)


def test_images_go_on_after_a_stamp_that_leaps(tmp_path: Path) -> None:
    shifts = [0, 0, 0, 100, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0]  # s
    traces = []
    for i, shift in enumerate(shifts):
        frame = make_frame(i)
        header = replace(frame.header, stamp_ns=frame.header.stamp_ns + shift * 10**9)
        traces.append(trace_of(replace(frame, header=header, attached={}), pick=make_picks()))
    found = show(tmp_path, traces, image_hz=5)
    assert 4 <= len(found[f"{IMAGE}/color"]["frame"]) <= 6
    assert found[f"{IMAGE}/color"]["frame"][-1] >= traces[-6].frame.header.sequence


def test_the_workspace_of_a_robot_in_the_cameras_frame_is_drawn(tmp_path: Path) -> None:
    box = {"low": [-0.2, -0.1, 0.3], "high": [0.2, 0.1, 0.7]}
    sinks = {"other": {"workspace": "cell 5"}, "next": {"workspace": {"low": 1, "high": 2}}}
    graph = {"stages": {}, "sinks": {**sinks, "robot": {"workspace": box}}}
    found = show(tmp_path, [trace_of(make_frame())], graph=graph)
    np.testing.assert_allclose(values(found, "/camera/workspace", "centers"), [[[0, 0, 0.5]]])
    sizes = values(found, "/camera/workspace", "half_sizes")
    np.testing.assert_allclose(sizes, [[[0.2, 0.1, 0.2]]], rtol=1e-6)
    wires = rr.components.FillMode.MajorWireframe
    assert values(found, "/camera/workspace", "fill_mode") == [[wires.value]]


def test_picks_in_the_robots_frame_stand_below_its_base(tmp_path: Path) -> None:
    """What Rerun makes of the transform is p_base = T_base_camera p_camera."""
    turn = Rotation.from_euler("xyz", [180, 10, 30], degrees=True)
    stated = {"frame": "base", "translation": [0.4, -0.1, 0.9], "quaternion": [*turn.as_quat()]}
    box = {"low": [-0.2, -0.1, 0.3], "high": [0.2, 0.1, 0.7]}
    graph = {
        "stages": {"pick": {"T_base_camera": stated}},
        "sinks": {"robot": {"workspace": box}},
    }
    found = show(tmp_path, [trace_of(make_frame(), pick=many(3, "base"))], graph=graph)
    for name in ("picks", "order", "caps", "axes", "workspace"):
        assert f"/camera/base/{name}" in found
        assert f"/camera/{name}" not in found
    assert values(found, "/camera/base", "relation") == [[2]]  # child from parent
    (((qx, qy, qz, qw),),) = values(found, "/camera/base", "quaternion")
    np.testing.assert_allclose(
        Rotation.from_quat([qx, qy, qz, qw]).as_matrix(), turn.as_matrix(), atol=1e-6
    )
    np.testing.assert_allclose(values(found, "/camera/base", "translation"), [[[0.4, -0.1, 0.9]]])


def test_picks_in_a_frame_that_nobody_placed_are_not_drawn_in_space(tmp_path: Path) -> None:
    found = show(tmp_path, [trace_of(make_frame(), pick=many(3, "elsewhere"))])
    assert len(values(found, f"{IMAGE}/picks", "centers")[0]) == 3
    for name in ("picks", "order", "caps", "axes"):  # how they would look stands there, no more
        assert not [column for column in found[f"/camera/{name}"] if column in ("frame", "capture")]
