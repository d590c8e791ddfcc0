"""Frames and masks: what they check, what they compute."""

import copy
import pickle
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import pytest

from mushpipe import Camera, Header, Mask, RgbdFrame, Trace
from tests.core.lab import make_frame

COLOR = np.zeros((4, 6, 3), np.uint8)
HEADER = Header(5, 0, "camera")


def test_arrival_is_the_stamp_where_it_is_not_known():
    assert Header(5, 0, "c").arrival_ns == 5
    assert Header(5, 0, "c", 9).arrival_ns == 9


def test_numbers_of_numpy_become_plain_ones():
    header = Header(np.int64(5), np.uint8(1), "c")
    assert [type(n) for n in (header.stamp_ns, header.sequence, header.arrival_ns)] == [int] * 3


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"stamp_ns": 1.5}, "stamp_ns of a frame's header is 1.5, expected an integer"),
        ({"sequence": "1"}, "sequence of a frame's header is '1', expected an integer"),
        ({"arrival_ns": None}, "arrival_ns of a frame's header is None, expected an integer"),
        ({"frame_id": None}, "frame_id of a header is None, expected text"),
    ],
)
def test_a_header_of_other_types_is_refused(changes: dict, message: str):
    with pytest.raises(TypeError) as caught:
        Header(**{"stamp_ns": 1, "sequence": 0, "frame_id": "c", **changes})
    assert str(caught.value) == message


def test_no_sink_can_change_what_the_others_see():
    frame = RgbdFrame(HEADER, COLOR, attached={"/truth": 1})
    trace = Trace(frame, {"a": (frame,)}, {"a": 5})
    for mapping in (trace.outputs, trace.durations_ns, trace.frame.attached):
        with pytest.raises(TypeError, match="does not support item assignment"):
            mapping["a"] = ()
    assert replace(trace, left_ns=7).outputs == {"a": (frame,)}
    assert replace(frame, depth_scale=0.5).attached == {"/truth": 1}


def test_frames_and_traces_can_be_pickled_and_copied():
    frame = RgbdFrame(HEADER, COLOR, np.ones((4, 6), np.uint16), 0.5, attached={"/truth": 1})
    trace = Trace(frame, {"a": (COLOR,)}, {"a": 5}, 7)
    for again in (pickle.loads(pickle.dumps(trace)), copy.deepcopy(trace)):
        assert again.frame.attached == {"/truth": 1}
        assert again.frame.depth_scale == 0.5
        assert np.array_equal(again.frame.depth, frame.depth)
        assert (again.durations_ns, again.left_ns) == ({"a": 5}, 7)
        assert np.array_equal(again.outputs["a"][0], COLOR)


@dataclass(frozen=True, eq=False)
class Thermal(RgbdFrame):
    """As a plugin may have it."""

    kelvin: float = 0.0


def test_a_copied_frame_of_a_plugin_is_still_one():
    again = copy.deepcopy(Thermal(HEADER, COLOR, kelvin=291.0))
    assert (type(again), again.kelvin) == (Thermal, 291.0)
    assert not again.color.flags.writeable


def test_a_frame_is_locked():
    frame = RgbdFrame(HEADER, COLOR.copy(), np.ones((4, 6), np.uint16))
    for array in (frame.color, frame.depth, frame.gray, frame.depth_m):
        with pytest.raises(ValueError, match="read-only"):
            array[0, 0] = 1
    with pytest.raises(AttributeError):
        frame.depth = None


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"color": COLOR[..., 0]}, "color is uint8(4, 6), expected uint8 (H, W, 3)"),
        ({"color": COLOR.astype(float)}, "color is float64(4, 6, 3), expected uint8 (H, W, 3)"),
        (
            {"color": np.zeros((4, 6, 4), np.uint8)},
            "color is uint8(4, 6, 4), expected uint8 (H, W, 3)",
        ),
        ({"color": COLOR[:0]}, "color is uint8(0, 6, 3), expected uint8 (H, W, 3)"),
        ({"depth": np.zeros((4, 6))}, "depth is float64, expected uint16 or float32"),
        (
            {"depth": np.zeros((2, 3), np.uint16)},
            "depth has shape (2, 3), colour (4, 6): depth must be aligned to colour",
        ),
        (
            {"depth": np.zeros((4, 6, 3), np.uint16)},
            "depth has shape (4, 6, 3), expected one channel: (H, W)",
        ),
        (
            {"depth": np.zeros((4, 6), np.uint16), "depth_scale": 0},
            "depth_scale is 0, expected metres per unit > 0",
        ),
        (
            {"camera": Camera(64, 48, 1, 1, 0, 0)},
            "the image is 6x4, its calibration is for 64x48",
        ),
    ],
)
def test_a_frame_that_cannot_be(changes, message):
    with pytest.raises(ValueError) as caught:  # noqa: PT011 - the whole message is compared
        RgbdFrame(**{"header": HEADER, "color": COLOR, **changes})
    assert str(caught.value) == message


def test_depth_in_metres_from_sensor_units():
    native = np.array([[0, 1, 8000, 65534, 65535]], np.uint16)
    frame = RgbdFrame(HEADER, np.zeros((1, 5, 3), np.uint8), native, 0.000125)
    expected = [np.nan, 0.000125, 1.0, 8.19175, np.nan]  # the last one says that it ran over
    assert frame.depth_m.dtype == np.float32
    np.testing.assert_allclose(frame.depth_m[0], expected, rtol=1e-6)


def test_depth_in_metres_from_floats_keeps_no_nonsense():
    native = np.array([[0, -1, np.nan, np.inf, 1e30, 0.5]], np.float32)
    frame = RgbdFrame(HEADER, np.zeros((1, 6, 3), np.uint8), native, 1.0)
    np.testing.assert_array_equal(frame.depth_m[0], [np.nan] * 5 + [0.5])


def test_a_frame_without_depth_has_none_anywhere():
    depth = make_frame().depth_m
    assert depth.shape == (6, 8)
    assert np.isnan(depth).all()


def test_gray_is_the_luma_of_bt_601():
    color = np.random.default_rng(0).integers(0, 256, (5, 7, 3), np.uint8)
    gray = RgbdFrame(HEADER, color).gray
    assert gray.dtype == np.float32
    # OpenCV rounds to whole gray levels.
    np.testing.assert_allclose(gray * 255, color @ [0.299, 0.587, 0.114], atol=0.51)
    assert RgbdFrame(HEADER, np.full((1, 1, 3), 255, np.uint8)).gray[0, 0] == 1


def test_a_mask_is_locked():
    mask = Mask(np.zeros((2, 3), bool), np.ones((2, 3), bool))
    assert not mask.foreground.flags.writeable
    assert not mask.initial.flags.writeable
    assert Mask(np.zeros((2, 3), bool)).initial is None


@pytest.mark.parametrize(
    ("foreground", "initial", "message"),
    [
        (np.zeros((2, 3), np.uint8), None, "Mask.foreground is uint8(2, 3), expected bool (H, W)"),
        (np.zeros(3, bool), None, "Mask.foreground has 1 dimensions, expected 2"),
        (
            np.zeros((2, 3), bool),
            np.zeros((3, 2), bool),
            "Mask.initial is bool(3, 2), expected bool (H, W)",
        ),
    ],
)
def test_a_mask_that_cannot_be(foreground, initial, message):
    with pytest.raises(ValueError) as caught:  # noqa: PT011 - the whole message is compared
        Mask(foreground, initial)
    assert str(caught.value) == message


@pytest.mark.parametrize(
    ("values", "message"),
    [
        ((-1, 0, "c"), "stamp_ns of a frame's header is -1, expected 0 to 4294967295999999999"),
        ((2**63, 0, "c"), "stamp_ns of a frame's header is 9223372036854775808, expected 0 to"),
        ((5, 2**32, "c"), "sequence of a frame's header is 4294967296, expected 0 to 4294967295"),
        ((5, 0, "c", -2), "arrival_ns of a frame's header is -2, expected 0 to"),
    ],
)
def test_a_header_that_no_recording_could_hold_is_refused(values: Any, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        Header(*values)


@pytest.mark.parametrize(
    ("values", "message"),
    [
        ({"header": None}, "header of a frame is of type NoneType, expected Header"),
        ({"camera": np.eye(3)}, "camera of a frame is of type ndarray, expected Camera"),
        ({"depth_scale": None}, "depth_scale is None, expected metres per unit > 0"),
        ({"depth_scale": np.inf}, "depth_scale is inf, expected metres per unit > 0"),
        ({"depth_scale": np.array(0.001)}, r"depth_scale is array\(0.001\), expected metres"),
        (
            {"depth": np.ma.masked_equal(np.eye(3, dtype="u2")[:2], 0)},
            r"masked array; unknown is 0: array.filled\(0\)",
        ),
    ],
)
def test_a_frame_of_something_else_is_refused_by_name(values: Any, message: str) -> None:
    given = {"header": Header(0, 0, "c"), "color": np.zeros((2, 3, 3), np.uint8)}
    given |= {"depth": np.ones((2, 3), np.uint16)} | values
    with pytest.raises((TypeError, ValueError), match=message):
        RgbdFrame(**given)
