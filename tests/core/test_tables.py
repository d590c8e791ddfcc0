"""The per-mushroom types: shapes, lengths, dtypes, and values that contradict each other."""

import ctypes
import re
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from mushpipe import (
    Circles,
    Columns,
    DepthSource,
    Header,
    Locations,
    PickFlag,
    Picks,
    Poses,
    RgbdFrame,
    column,
)
from mushpipe.core.arrays import locked
from mushpipe.core.truth import Ignore, Instances, Truth
from mushpipe.core.wire import encoder_of

NAN = np.nan


def circles(**changes):
    values = {"center": [[1, 2], [3, 4]], "radius": [5, 6], "score": [0, 1]}
    return Circles(**{**values, **changes})


def locations(**changes):
    values = {
        "position": [[0, 0, 1], [NAN] * 3],
        "distance": [1, NAN],
        "diameter": [0.05, NAN],
        "source": [DepthSource.MEASURED, DepthSource.MISSING],
        "sigma_position": np.full((2, 3), NAN),
        "sigma_diameter": [NAN, NAN],
    }
    return Locations(**{**values, **changes})


def poses(**changes):
    values = {
        "quaternion": [[0, 0, 0, 1], [NAN] * 4],
        "axis": [[0, 0, 1], [NAN] * 3],
        "apex": [[0, 0, 1], [NAN] * 3],
        "sigma_rad": [0.1, NAN],
        "fitness": [1, NAN],
        "valid": [True, False],
    }
    return Poses(**{**values, **changes})


def picks(**changes):
    values = {
        "id": [7, 8],
        "center": np.zeros((2, 2)),
        "radius": [1, 1],
        "position": [[0, 0, 1], [NAN] * 3],
        "surface": [[0, 0, 1], [NAN] * 3],
        "distance": [1, NAN],
        "diameter": [0.1, NAN],
        "quaternion": np.full((2, 4), NAN),
        "axis": np.full((2, 3), NAN),
        "score": [1, 1],
        "sigma_position": np.full((2, 3), NAN),
        "sigma_diameter": [NAN, NAN],
        "sigma_tilt": [NAN, NAN],
        "source": [DepthSource.NEIGHBOURS, DepthSource.MISSING],
        "flags": [PickFlag.DEPTH_ESTIMATED, PickFlag.DEPTH_MISSING],
        "frame_id": "camera",
    }
    return Picks(**{**values, **changes})


def truth(**changes):
    values = {
        "id": [0, 1],
        "center": np.zeros((2, 2)),
        "radius": [5, 5],
        "visible": [0, NAN],
        "apex": np.full((2, 3), NAN),
        "surface": np.full((2, 3), NAN),
        "axis": [[1, 0, 0], [NAN] * 3],
        "diameter": [NAN, NAN],
        "diameter_max": [NAN, NAN],
        "ignore": [Ignore.COUNTS, Ignore.HIDDEN],
    }
    return Truth(**{**values, **changes})


@pytest.mark.parametrize("make", [circles, locations, poses, picks, truth])
def test_good_rows_are_kept_and_locked(make):
    table = make()
    assert len(table) == 2
    for name, value in vars(table).items():
        if isinstance(value, np.ndarray):
            assert value.flags.c_contiguous
            with pytest.raises(ValueError, match="read-only"):
                value[0] = 0
            with pytest.raises(AttributeError):
                setattr(table, name, value)


def test_dtypes_are_converted():
    table = picks()
    assert (table.id.dtype, table.flags.dtype, table.source.dtype) == ("int64", "uint32", "uint8")
    assert poses().valid.dtype == bool
    assert circles().radius.dtype == np.float64


WRONG = [
    (circles, {"center": [1, 2]}, "Circles.center has shape (2,), expected (N, 2)"),
    (circles, {"center": np.zeros((2, 3))}, "Circles.center has shape (2, 3), expected (N, 2)"),
    (circles, {"radius": [[5], [6]]}, "Circles.radius has shape (2, 1), expected (N,)"),
    (circles, {"radius": [5]}, "Circles.radius has 1 rows, expected 2"),
    (circles, {"radius": ["a", "b"]}, "Circles.radius: could not convert string to float: 'a'"),
    (
        circles,
        {"radius": np.ma.masked_equal([5, 0], 0)},
        "Circles.radius: it is a masked array; unknown is NaN: array.filled(np.nan)",
    ),
    (
        locations,
        {"source": ["measured", ""]},
        "Locations.source: invalid literal for int() with base 10: 'measured'",
    ),
    (picks, {"id": [2**64, 0]}, "Picks.id: Python int too large to convert to C long"),
    (picks, {"flags": [-1, 0]}, "Picks.flags: Python integer -1 out of bounds for uint32"),
    (circles, {"center": [[1, 2], [NAN, 0]]}, "Circles: the centre must be finite (row 1)"),
    (circles, {"radius": [0, 1]}, "Circles: the radius must be positive (row 0)"),
    (circles, {"radius": [1, np.inf]}, "Circles: the radius must be positive (row 1)"),
    (circles, {"score": [1.1, 1]}, "Circles: the score must be within 0..1 (row 0)"),
    (circles, {"score": [1, NAN]}, "Circles: the score must be within 0..1 (row 1)"),
    (
        locations,
        {"position": np.ones((2, 3))},
        "Locations: position must be finite exactly where its source is not MISSING (row 1)",
    ),
    (
        locations,
        {"distance": [NAN, NAN]},
        "Locations: distance must be finite exactly where its source is not MISSING (row 0)",
    ),
    (locations, {"source": [3, 0]}, "Locations: the source must be a DepthSource (row 0)"),
    (locations, {"distance": [-1, NAN]}, "Locations: the distance must not be negative (row 0)"),
    (locations, {"sigma_diameter": [0, -1]}, "Locations: a sigma must not be negative (row 1)"),
    (
        locations,
        {"sigma_position": [[1, -1, NAN], [NAN] * 3]},
        "Locations: a sigma must not be negative (row 0)",
    ),
    (poses, {"sigma_rad": [-0.1, NAN]}, "Poses: a sigma must not be negative (row 0)"),
    (locations, {"diameter": [0, NAN]}, "Locations: the diameter must be positive or NaN (row 0)"),
    (
        poses,
        {"valid": [True, True]},
        "Poses: quaternion must be finite exactly where valid (row 1)",
    ),
    (
        poses,
        {"axis": [[0, 0, 1], [0, 0, 1]]},
        "Poses: axis must be finite exactly where valid (row 1)",
    ),
    (
        poses,
        {"quaternion": [[0, 0, 0, 2], [NAN] * 4]},
        "Poses: quaternion must have length 1 (row 0)",
    ),
    (poses, {"axis": [[0, 1, 1], [NAN] * 3]}, "Poses: axis must have length 1 (row 0)"),
    (
        poses,
        {"quaternion": [[1, 0, 0, 0], [NAN] * 4]},  # w x y z
        "Poses: the quaternion, x y z w, must turn +z to the axis, out of the cap (row 0)",
    ),
    (
        poses,
        {"quaternion": [[0.005, 0, 0, 0.9999875], [NAN] * 4]},  # half a degree off
        "Poses: the quaternion, x y z w, must turn +z to the axis, out of the cap (row 0)",
    ),
    (picks, {"source": [3, 0]}, "Picks: the source must be a DepthSource (row 0)"),
    (picks, {"id": [7, 7]}, "Picks: ids must be unique (row 1)"),
    (
        picks,
        {"position": np.ones((2, 3))},
        "Picks: position must be finite exactly where its source is not MISSING (row 1)",
    ),
    (
        picks,
        {"surface": np.ones((2, 3))},
        "Picks: surface must be finite exactly where its source is not MISSING (row 1)",
    ),
    (picks, {"flags": [0, 0]}, "Picks: DEPTH_MISSING must be set exactly where missing (row 1)"),
    (picks, {"flags": [1, 1]}, "Picks: DEPTH_MISSING must be set exactly where missing (row 0)"),
    (truth, {"id": [1, 1]}, "Truth: ids must be unique (row 1)"),
    (truth, {"center": np.full((2, 2), NAN)}, "Truth: the centre must be finite (row 0)"),
    (truth, {"radius": [1, NAN]}, "Truth: the radius must be positive (row 1)"),
    (truth, {"visible": [2, 0]}, "Truth: visible must be within 0..1 (row 0)"),
    (truth, {"axis": [[1, 1, 0], [NAN] * 3]}, "Truth: axis must have length 1 (row 0)"),
]


@pytest.mark.parametrize(("make", "changes", "message"), WRONG)
def test_what_cannot_be_is_refused(make, changes, message):
    with pytest.raises(ValueError) as caught:  # noqa: PT011 - the whole message is compared
        make(**changes)
    assert str(caught.value) == message


def test_flags_have_the_numbers_that_robots_are_told():
    """Programs of robots and old recordings hold the numbers."""
    docs = (Path(__file__).parents[2] / "docs/robot.md").read_text()
    table = re.findall(r"^\| `(\w+)` \| (\d+) \|", docs, re.MULTILINE)
    stated = {name.upper(): int(number) for name, number in table}
    assert {**stated, "DEPTH_MISSING": 1} == {flag.name: flag.value for flag in PickFlag}


@pytest.mark.parametrize("cls", [Circles, Locations, Poses, Picks, Truth])
def test_a_table_may_have_no_rows(cls):
    from dataclasses import fields

    empty = {f.name: np.zeros((0, *f.metadata["shape"])) for f in fields(cls) if f.metadata}
    assert len(cls(**empty)) == 0


def test_rows_of_which_little_is_known():
    table = Locations.unknown(2, diameter=[0.05, NAN])
    assert table.diameter[0] == 0.05
    assert np.isnan(table.position).all()
    assert table.source.tolist() == [DepthSource.MISSING] * 2
    assert not Poses.unknown(3).valid.any()
    assert len(Picks.unknown(0)) == 0


def test_rows_are_taken_in_the_order_asked_for():
    table = picks().take(np.array([1, 0]))
    assert (table.id.tolist(), table.frame_id) == ([8, 7], "camera")
    assert len(picks().take(np.array([False, False]))) == 0


@pytest.mark.parametrize("rows", [1, np.int64(0), np.array([[0], [1]]), True])
def test_what_is_no_list_of_rows_is_not_taken(rows: Any):
    with pytest.raises(ValueError, match=r"^Picks\.take needs indices \(N,\) or a mask, not "):
        picks().take(rows)


def test_every_other_row_can_be_recorded():
    rows: Any = slice(None, None, -1)
    taken = picks().take(rows)
    assert taken.id.tolist() == [8, 7]
    assert len(list(encoder_of(Picks)(taken, Header(0, 0, "camera")))) == 1


def test_rows_taken_or_joined_are_locked_and_no_id_comes_twice():
    taken = picks().take(np.array([0]))
    assert not taken.center.flags.writeable
    with pytest.raises(ValueError, match="Picks: ids must be unique"):
        picks().take(np.array([0, 0]))
    with pytest.raises(ValueError, match="Picks: ids must be unique"):
        taken.joined(taken)


def test_what_a_type_of_ones_own_derives_follows_the_rows():
    @dataclass(frozen=True, eq=False)
    class Weights(Columns):
        grams: np.ndarray = column()

        def __post_init__(self):
            super().__post_init__()
            object.__setattr__(self, "total", self.grams.sum())

    weights = Weights(np.array([1.0, 2.0, 4.0]))
    assert weights.take(np.array([0, 2])).total == 5
    assert weights.joined(weights).total == 14


def test_columns_of_ones_own():
    @dataclass(frozen=True, eq=False)
    class Sizes(Columns):
        note: str
        box: np.ndarray = column(2, 2, dtype=np.float32)

    sizes = Sizes("x", np.zeros((3, 2, 2)))
    assert (len(sizes), sizes.box.dtype) == (3, np.float32)
    with pytest.raises(ValueError, match=r"^Sizes\.box has shape \(2, 2\), expected \(N, 2, 2\)$"):
        Sizes("x", np.zeros((2, 2)))


@pytest.mark.parametrize("names", [[None, "a"], [1, 2], [b"a", b"b"]])
def test_texts_are_made_of_nothing_else(names: list[Any]):
    @dataclass(frozen=True, eq=False)
    class Kinds(Columns):
        name: np.ndarray = column(dtype=str)

    assert Kinds(np.array(["a", "longer"])).joined(Kinds(["b"])).name.tolist() == [
        *("a", "longer", "b")
    ]
    with pytest.raises(ValueError, match=r"^Kinds\.name is declared str, and was given what"):
        Kinds(names)


@given(arrays(np.float64, st.integers(1, 5)), st.sampled_from([np.int64, np.uint8, np.bool_]))
@pytest.mark.filterwarnings("ignore:invalid value encountered in cast")
def test_integers_take_whole_numbers_and_nothing_that_they_would_cut(values, dtype):
    @dataclass(frozen=True, eq=False)
    class Counts(Columns):
        count: np.ndarray = column(dtype=dtype)

    low, high = (0, 1) if dtype is np.bool_ else (np.iinfo(dtype).min, np.iinfo(dtype).max)
    whole = [float(value).is_integer() and low <= int(value) <= high for value in values]
    if all(whole):
        assert Counts(values).count.tolist() == [int(value) for value in values]
    else:
        with pytest.raises(ValueError, match=r"^Counts\.count is declared u?(int|bool)"):
            Counts(values)


@given(arrays(np.float64, st.tuples(st.integers(0, 5), st.just(2))))
def test_any_finite_circles_are_taken_and_no_others(center):
    n = len(center)
    if np.isfinite(center).all():
        assert np.array_equal(Circles(center, np.ones(n), np.zeros(n)).center, center)
    else:
        with pytest.raises(ValueError, match="the centre must be finite"):
            Circles(center, np.ones(n), np.zeros(n))


def test_locked_keeps_what_fits_and_copies_what_does_not():
    array = np.arange(6.0).reshape(2, 3)
    assert locked(array, np.float64) is array
    assert not array.flags.writeable
    turned = locked(array.T, np.float64)
    assert turned.flags.c_contiguous
    assert np.array_equal(turned, array.T)
    assert locked([1, 2], np.uint8).dtype == np.uint8


def test_what_a_view_is_of_is_locked_too():
    buffer = np.zeros((3, 4, 5))
    locked(buffer[1], np.float64)
    with pytest.raises(ValueError, match="read-only"):
        buffer[1, 0, 0] = 1


@pytest.mark.parametrize(
    "device", [bytearray(12), (ctypes.c_ubyte * 12)(), memoryview(bytearray(12))]
)
def test_a_buffer_that_is_filled_again_changes_nothing(device: Any):
    """As of a driver that hands over each image in the memory of the one before."""
    image = np.frombuffer(device, np.uint16).reshape(2, 3)
    frame = RgbdFrame(Header(0, 0, "c"), np.zeros((2, 3, 3), np.uint8), image)
    assert not frame.depth.flags.writeable
    image[:] = 7
    assert not frame.depth.any()


def test_memory_that_nobody_can_write_is_not_copied():
    array = np.frombuffer(bytes(12), np.uint8)
    assert locked(array, np.uint8) is array


def test_instances():
    labels = np.zeros((2, 3), np.uint16)
    assert not Instances(labels).labels.flags.writeable
    for bad in (labels.astype(np.int32), labels[0]):
        with pytest.raises(ValueError, match=r"^Instances\.labels is .*, expected uint16$"):
            Instances(bad)


def test_empty_lists_are_tables_without_rows():
    circles = Circles([], [], [])
    assert len(circles) == 0
    assert circles.center.shape == (0, 2)


def test_memory_of_numbas_is_not_copied():
    from numba import njit

    array = njit(lambda: np.zeros(3))()
    assert locked(array, np.float64) is array
