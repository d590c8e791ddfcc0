"""What the sink `rerun` writes, read back by Rerun's own reader."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pyarrow as pa
import pytest
import rerun as rr
from rerun.chunk import RrdReader

from mushpipe import Circles, Mask, RgbdFrame, RunInfo
from mushpipe.sinks.rerun import RerunSink
from tests.io.bags import FX, FY, PERIOD, T0, depth_pixels
from tests.io.values import SIZE, feed, make_circles, make_frame, make_picks, no_picks

IMAGE = "/camera/image"


def show(tmp_path: Path, inputs: list[dict[str, Any]], **settings: Any) -> dict[str, Any]:
    """Feed the sink and return what the file holds: columns by entity and component."""
    feed(RerunSink(save=tmp_path / "out.rrd", **settings), inputs)
    found: dict[str, dict[str, list[Any]]] = {}
    for chunk in RrdReader(tmp_path / "out.rrd").stream():
        batch = chunk.to_record_batch()
        columns = found.setdefault(chunk.entity_path, {})
        for name in batch.schema.names:
            column = batch.column(name)
            if pa.types.is_timestamp(column.type):
                column = column.cast(pa.int64())
            columns.setdefault(name, []).extend(column.to_pylist())
    return found


def values(found: dict[str, Any], entity: str, component: str) -> list[Any]:
    """Return one value per row of a column, whatever archetype it belongs to."""
    (name,) = (n for n in found[entity] if n.endswith(f":{component}"))
    return found[entity][name]


def test_frames_stand_on_two_timelines(tmp_path: Path) -> None:
    found = show(tmp_path, [{"frame": make_frame(i)} for i in range(3)])
    color = found[f"{IMAGE}/color"]
    assert color["frame"] == [10, 11, 12]
    assert color["capture"] == [T0 + i * PERIOD for i in range(3)]
    assert {entity for entity in found if "frame" in found[entity]} == {
        *(IMAGE, f"{IMAGE}/color", f"{IMAGE}/depth"),
    }


def test_color_is_stored_as_jpeg_of_the_stated_quality(tmp_path: Path) -> None:
    red = np.zeros((24, 32, 3), np.uint8)
    red[..., 0] = 200
    found = show(tmp_path, [{"frame": make_frame(color=red)}], jpeg_quality=95)
    ((data,),) = values(found, f"{IMAGE}/color", "blob")
    decoded = cv2.imdecode(np.array(data, np.uint8), cv2.IMREAD_COLOR_RGB)
    assert np.abs(decoded.astype(int) - red).max() <= 4


def test_depth_is_stored_native_with_its_unit(tmp_path: Path) -> None:
    found = show(tmp_path, [{"frame": make_frame()}])
    ((data,),) = values(found, f"{IMAGE}/depth", "buffer")
    stored = np.array(data, np.uint8).view(np.uint16).reshape(24, 32)
    np.testing.assert_array_equal(stored, depth_pixels(0, SIZE))
    assert values(found, f"{IMAGE}/depth", "meter") == [[8000.0]]


def test_depth_in_metres_with_gaps_is_shown(tmp_path: Path) -> None:
    metres = np.full((24, 32), 0.5, np.float32)
    metres[0, :3] = np.nan, np.inf, 0
    for i, depth in enumerate((metres, np.zeros_like(metres))):
        folder = tmp_path / str(i)
        folder.mkdir()
        found = show(folder, [{"frame": make_frame(depth=depth, depth_scale=1.0)}])
        ((data,),) = values(found, f"{IMAGE}/depth", "buffer")
        stored = np.array(data, np.uint8).view(np.float32).reshape(24, 32)
        np.testing.assert_array_equal(stored, depth)
        assert values(found, f"{IMAGE}/depth", "meter") == [[1.0]]


def test_the_pinhole_is_that_of_the_camera(tmp_path: Path) -> None:
    found = show(tmp_path, [{"frame": make_frame()}])
    ((matrix,),) = values(found, IMAGE, "image_from_camera")
    expected = np.array([[FX, 0, 15.5], [0, FY, 11.5], [0, 0, 1]])
    np.testing.assert_allclose(np.reshape(matrix, (3, 3)).T, expected)
    assert values(found, IMAGE, "resolution") == [[[32, 24]]]


def test_a_frame_of_colour_alone_is_shown(tmp_path: Path) -> None:
    found = show(tmp_path, [{"frame": make_frame(depth=None, camera=None)}])
    assert f"{IMAGE}/color" in found
    assert f"{IMAGE}/depth" not in found
    assert IMAGE not in found


def test_masks(tmp_path: Path) -> None:
    foreground = np.zeros((24, 32), bool)
    foreground[3:5, 4:9] = True
    found = show(tmp_path, [{"frame": make_frame(), "mask": Mask(foreground, ~foreground)}])
    for entity, expected in (("mask", foreground), ("initial", ~foreground)):
        ((data,),) = values(found, f"{IMAGE}/{entity}", "buffer")
        np.testing.assert_array_equal(np.reshape(data, (24, 32)), expected)


def colors_of(found: dict[str, Any]) -> list[tuple[int, int, int]]:
    (packed,) = values(found, f"{IMAGE}/circles", "colors")
    return [(c >> 24 & 255, c >> 16 & 255, c >> 8 & 255) for c in packed]


def test_circles_carry_the_place_size_label_and_colour_of_their_picks(tmp_path: Path) -> None:
    inputs = {"frame": make_frame(), "circles": make_circles(), "picks": make_picks()}
    found = show(tmp_path, [inputs])
    entity = f"{IMAGE}/circles"
    assert values(found, entity, "centers") == [[[10.25, 5.5], [20.0, 12.0]]]
    (sizes,) = values(found, entity, "half_sizes")
    np.testing.assert_allclose(sizes, [[3.5, 3.5], [1 / 3, 1 / 3]], rtol=1e-6)
    assert values(found, entity, "labels") == [["7 40 mm", "8 size unknown"]]
    (amber, red), (points,) = colors_of(found), values(found, "/camera/picks", "positions")
    assert amber[0] > amber[1] > amber[2]
    assert red[0] > 2 * max(red[1:])
    # Only a pick with a position stands in space.
    np.testing.assert_allclose(points, [[0.1, -0.2, 0.5]], rtol=1e-6)
    np.testing.assert_allclose(values(found, "/camera/picks", "radii"), [[0.02]], rtol=1e-6)


def test_circles_without_picks_are_shown(tmp_path: Path) -> None:
    found = show(tmp_path, [{"frame": make_frame(), "circles": make_circles()}])
    assert len(values(found, f"{IMAGE}/circles", "centers")[0]) == 2
    assert len(set(colors_of(found))) == 1


def test_nothing_found_clears_what_was_shown(tmp_path: Path) -> None:
    none = Circles(np.zeros((0, 2)), np.zeros(0), np.zeros(0))
    full = {"frame": make_frame(0), "circles": make_circles(), "picks": make_picks()}
    empty = {"frame": make_frame(1), "circles": none, "picks": no_picks()}
    found = show(tmp_path, [full, empty])
    assert [len(row) for row in values(found, f"{IMAGE}/circles", "centers")] == [2, 0]
    assert [len(row) for row in values(found, "/camera/picks", "positions")] == [1, 0]


def test_the_layout_shows_picks_mask_and_depth(tmp_path: Path) -> None:
    show(tmp_path, [{"frame": make_frame()}])
    reader = RrdReader(tmp_path / "out.rrd")
    assert len(reader.recordings()) == 1
    assert len(reader.blueprints()) == 1


def test_a_viewer_may_be_opened_instead(monkeypatch: pytest.MonkeyPatch) -> None:
    opened = []
    monkeypatch.setattr(rr.RecordingStream, "spawn", lambda self: opened.append(self))
    sink = RerunSink(spawn=True)
    assert sink.files(RunInfo("bed", {})) == ()
    feed(sink, [{"frame": make_frame()}])
    assert len(opened) == 1


def test_without_a_destination_it_refuses_to_start() -> None:
    with pytest.raises(ValueError, match="set 'save' to a file, or 'spawn' to true"):
        feed(RerunSink(), [])


def test_it_takes_only_the_newest_frame_when_live_and_can_be_closed_twice(tmp_path: Path) -> None:
    sink = RerunSink(save=tmp_path / "{recording}.rrd")
    assert sink.delivery == "latest"
    feed(sink, [{"frame": RgbdFrame(make_frame().header, make_frame().color)}])
    sink.close()
    assert (tmp_path / "bed.rrd").stat().st_size > 0
