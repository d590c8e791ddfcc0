"""Picks as NDJSON and CSV, read back by json and csv."""

from __future__ import annotations

import csv
import json
from pathlib import Path

import numpy as np
import pytest

from mushpipe.core.errors import InputError, UsageError
from mushpipe.export import csv_lines, ndjson_lines, read_picks
from tests.io.bags import OPTICAL, PERIOD, T0, rgbd, write_bag
from tests.io.values import make_circles, make_frame, make_picks, no_picks, record, trace_of

COLUMNS = [
    *("stamp_ns", "sequence", "frame_id", "id", "u", "v", "radius_px", "x_m", "y_m", "z_m"),
    *("distance_m", "diameter_m", "qx", "qy", "qz", "qw", "axis_x", "axis_y", "axis_z", "score"),
    *("sigma_x_m", "sigma_y_m", "sigma_z_m", "sigma_diameter_m", "sigma_tilt_rad"),
    *("depth_source", "flags"),
]


@pytest.fixture
def results(tmp_path: Path) -> Path:
    """Two frames: one with two picks, one with none."""
    traces = [
        trace_of(make_frame(0), detect=make_circles(), pick=make_picks()),
        trace_of(make_frame(1), detect=make_circles(), pick=no_picks()),
    ]
    return record(tmp_path / "out.mcap", traces)


def test_ndjson_is_one_line_per_frame_with_null_where_unknown(results: Path) -> None:
    lines = list(ndjson_lines(results))
    assert not any("\n" in line or "NaN" in line for line in lines)
    first, second = map(json.loads, lines)
    assert second == {
        "stamp_ns": T0 + PERIOD,
        "sequence": 11,
        "frame_id": OPTICAL,
        "picks": [],
    }
    assert (first["stamp_ns"], first["sequence"], first["frame_id"]) == (T0, 10, OPTICAL)
    assert first["picks"] == [
        {
            "id": 7,
            "u": 10.25,
            "v": 5.5,
            "radius_px": 3.5,
            "position_m": [0.1, -0.2, 0.5],
            "distance_m": 0.55,
            "diameter_m": 0.04,
            "quaternion_xyzw": [0.0, 0.0, 0.6, 0.8],
            "axis": [0.0, 0.0, 1.0],
            "score": 0.9,
            "sigma_position_m": [0.001, 0.002, 0.003],
            "sigma_diameter_m": 0.0015,
            "sigma_tilt_rad": 0.1,
            "depth_source": "neighbours",
            "flags": ["depth_estimated"],
        },
        {
            "id": 8,
            "u": 20.0,
            "v": 12.0,
            "radius_px": 1 / 3,
            "position_m": None,
            "distance_m": None,
            "diameter_m": None,
            "quaternion_xyzw": None,
            "axis": None,
            "score": 0.25,
            "sigma_position_m": None,
            "sigma_diameter_m": None,
            "sigma_tilt_rad": None,
            "depth_source": "missing",
            "flags": ["depth_missing", "pose_unknown", "at_border"],
        },
    ]


def test_csv_is_one_line_per_pick_with_empty_fields_where_unknown(results: Path) -> None:
    first, second = csv.DictReader(csv_lines(results))
    assert list(first) == COLUMNS
    assert (first["x_m"], first["y_m"], first["z_m"]) == ("0.1", "-0.2", "0.5")
    assert (first["qx"], first["qw"], first["axis_z"]) == ("0.0", "0.8", "1.0")
    assert (first["stamp_ns"], first["id"], first["flags"]) == (str(T0), "7", "depth_estimated")
    assert float(second["radius_px"]) == 1 / 3
    assert {k for k, v in second.items() if v == ""} == {
        *("x_m", "y_m", "z_m", "distance_m", "diameter_m", "qx", "qy", "qz", "qw"),
        *("axis_x", "axis_y", "axis_z", "sigma_x_m", "sigma_y_m", "sigma_z_m"),
        *("sigma_diameter_m", "sigma_tilt_rad"),
    }
    assert second["flags"] == "depth_missing|pose_unknown|at_border"


def test_csv_without_any_pick_still_has_its_heading(tmp_path: Path) -> None:
    path = record(tmp_path / "out.mcap", [trace_of(make_frame(), pick=no_picks())])
    assert list(csv.reader(csv_lines(path))) == [COLUMNS]


def test_a_frame_id_with_a_comma_stays_one_field(tmp_path: Path) -> None:
    picks = make_picks()
    columns = vars(picks) | {"frame_id": 'a,"b"'}
    path = record(tmp_path / "o.mcap", [trace_of(make_frame(), pick=type(picks)(**columns))])
    assert [row["frame_id"] for row in csv.DictReader(csv_lines(path))] == ['a,"b"'] * 2


def test_picks_come_back_as_they_were(results: Path) -> None:
    (header, picks), (_, none) = read_picks(results)
    assert header.stamp_ns == T0
    assert len(none) == 0
    for name, value in vars(make_picks()).items():
        np.testing.assert_array_equal(getattr(picks, name), value)


@pytest.fixture
def two(tmp_path: Path) -> Path:
    trace = trace_of(make_frame(), a=make_picks(), b=no_picks())
    return record(tmp_path / "two.mcap", [trace])


def test_of_several_topics_one_must_be_chosen(two: Path) -> None:
    with pytest.raises(UsageError) as error:
        list(ndjson_lines(two))
    assert "several topics hold picks: choose with --topic /mushpipe/a" in str(error.value)
    assert error.value.exit_code == 2
    chosen = [json.loads(line)["picks"] for line in ndjson_lines(two, "/mushpipe/b")]
    assert chosen == [[]]


def test_a_topic_without_picks_is_refused(two: Path) -> None:
    with pytest.raises(UsageError, match=r"no picks on /mushpipe/c; they are on /mushpipe/a, /"):
        list(csv_lines(two, "/mushpipe/c"))


def test_a_recording_without_picks_is_refused_with_what_it_holds(tmp_path: Path) -> None:
    path = write_bag(tmp_path, rgbd([0]))
    with pytest.raises(InputError) as error:
        list(ndjson_lines(path))
    assert str(error.value).startswith(f"{path}: no picks on any topic (it holds /camera/camera/")
    assert error.value.exit_code == 4


def test_of_a_damaged_file_what_can_be_read_comes_first(results: Path) -> None:
    data = results.read_bytes()
    results.write_bytes(data[:-30])
    lines = ndjson_lines(results)
    assert [json.loads(next(lines))["sequence"] for _ in range(2)] == [10, 11]
    with pytest.raises(InputError, match="is damaged"):
        next(lines)


@pytest.mark.parametrize("text", [b"[]", b"{}", b"{", b'{"id": 3}'])
def test_a_message_that_is_no_table_is_refused(text: bytes, tmp_path: Path) -> None:
    from mcap.writer import Writer

    path = tmp_path / "x.mcap"
    with path.open("wb") as file:
        writer = Writer(file)
        writer.start()
        schema = writer.register_schema("mushpipe.Picks", "jsonschema", b"{}")
        channel = writer.register_channel("/mushpipe/pick", "json", schema)
        writer.add_message(channel, T0, text, T0)
        writer.finish()
    with pytest.raises(InputError, match="a pick message cannot be read"):
        list(ndjson_lines(path))


def test_of_a_file_that_breaks_off_it_says_so(results: Path) -> None:
    results.write_bytes(results.read_bytes()[:200])
    with pytest.raises(InputError, match="it holds nothing; it breaks off"):
        list(csv_lines(results))
