from __future__ import annotations

import logging
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from numpy.testing import assert_array_equal

from mushpipe import Header, RgbdFrame
from mushpipe.sources.mcap import McapSource
from mushpipe.stages.depth_correct import DepthCorrect
from mushpipe.stages.fuse_depth import FuseDepth

SHAPE = (40, 50)
RECORDINGS = Path(__file__).parents[2] / "recordings"


def frame(depth: np.ndarray | None, scale: float = 0.001) -> RgbdFrame:
    return RgbdFrame(Header(1, 0, "optical"), np.zeros((*SHAPE, 3), np.uint8), depth, scale)


def test_noise_falls_by_the_root_of_the_number_of_frames() -> None:
    rng, stage = np.random.default_rng(0), FuseDepth(frames=5)
    stage.open()
    for _ in range(5):
        native = np.rint(4000 + rng.normal(0, 8, SHAPE)).astype(np.uint16)
        out = stage.process(frame(native, 0.000125))
    assert out.depth_scale == 0.000125
    assert out.depth is not None
    assert out.depth.std() == pytest.approx(8 / np.sqrt(5), rel=0.06)
    assert out.depth.mean() == pytest.approx(4000, abs=0.5)


@pytest.mark.parametrize("z", [0.4, 0.95, 1.5, 3.0])
def test_noise_as_it_is_at_a_distance_starts_no_pixel_anew(z: float) -> None:
    rng, stage = np.random.default_rng(0), FuseDepth(frames=5)
    stage.open()
    noise = 0.0003 + 0.0012 * z
    for _ in range(5):
        out = stage.process(frame((z + rng.normal(0, noise, SHAPE)).astype(np.float32), 1.0))
    assert out.depth is not None
    assert out.depth.std() == pytest.approx(noise / np.sqrt(5), rel=0.06)


@pytest.mark.parametrize(("native", "unit"), [(np.uint16, 0.001), (np.float32, 1.0)])
def test_two_surfaces_are_never_mixed_and_edges_stay(native: type, unit: float) -> None:
    stage = FuseDepth(frames=5)
    left, right = np.full(SHAPE, 0.5 / unit, native), np.full(SHAPE, 0.5 / unit, native)
    left[:, 20:], right[:, 22:] = 0.53 / unit, 0.53 / unit
    for k in range(6):
        out = stage.process(frame(left if k % 2 else right, unit))
        assert set(np.unique(out.depth)) == set(np.unique(left))
    assert (out.depth == left).all()


def test_what_sinks_by_less_than_the_gate_is_mixed_with_where_it_was() -> None:
    stage = FuseDepth(frames=5, gate_mm=4.0)
    for _ in range(5):
        stage.process(frame(np.full(SHAPE, 450, np.uint16)))
    for k in range(1, 6):
        out = stage.process(frame(np.full(SHAPE, 453, np.uint16)))
        assert out.depth is not None
        assert 453 - out.depth == pytest.approx(np.full(SHAPE, 3 * 0.8**k), abs=1e-3)


def test_holes_are_filled_for_a_while() -> None:
    stage = FuseDepth(frames=3)
    whole, hole = np.full(SHAPE, 500, np.uint16), np.full(SHAPE, 500, np.uint16)
    hole[3, 4] = 0
    stage.process(frame(whole))
    assert [stage.process(frame(hole)).depth[3, 4] for _ in range(3)] == [500, 500, 0]


@pytest.mark.parametrize("frames", [2, 5, 100])
@pytest.mark.parametrize("period_ms", [4, 33, 90, 240, 490, 700])
@pytest.mark.parametrize("before", [0, 1, 90])  # frames with later stamps: the clock was set back
def test_nothing_that_fills_a_hole_is_older_than_half_a_second(
    frames: int, period_ms: int, before: int
) -> None:
    stage = FuseDepth(frames=frames)
    whole, hole = np.full(SHAPE, 500, np.uint16), np.full(SHAPE, 500, np.uint16)
    hole[3, 4] = 0
    for k in range(before):
        header = Header(10**12 + k * period_ms * 1_000_000, k, "optical")
        stage.process(replace(frame(whole), header=header))
    stage.process(frame(whole))
    filled = 0
    for k in range(1, 150):
        header = Header(1 + k * period_ms * 1_000_000, k, "optical")
        filled += stage.process(replace(frame(hole), header=header)).depth[3, 4] > 0
    assert filled == min(frames - 1, 500 // period_ms)


def test_stamps_that_come_twice_do_not_count_twice() -> None:
    """The clock was set back by less than half a second: what was seen is 0.8 s old at the end."""
    stage = FuseDepth()
    whole, hole = np.full(SHAPE, 500, np.uint16), np.full(SHAPE, 500, np.uint16)
    hole[3, 4] = 0
    for k, at_ms in enumerate([0, 400, 800, 1200, 900, 1300, 1700]):
        header = Header(at_ms * 1_000_000, k, "optical")
        out = stage.process(replace(frame(whole if k < 5 else hole), header=header))
    assert out.depth[3, 4] == 0


@pytest.mark.parametrize("unit", [0.000125, 0.001, 1.0])
@pytest.mark.parametrize(
    "settings",
    [
        {"gate_mm": 4.0, "depth_noise_mm": 0.0, "depth_noise_per_m": 0.0},
        {"gate_mm": 0.1, "depth_noise_mm": 1.0, "depth_noise_per_m": 0.0},
        {"gate_mm": 0.1, "depth_noise_mm": 0.0, "depth_noise_per_m": 2.0},  # at 0.5 m
        {"gate_mm": 0.1, "depth_noise_mm": 0.6, "depth_noise_per_m": 0.8},
    ],
)
def test_the_gate_is_in_mm_and_four_sigmas_of_the_noise_at_that_depth(
    settings: dict[str, float], unit: float
) -> None:
    """All of these let a step of 4 mm pass, at half a metre."""
    for step, expected in ((0.0039, 0.50195), (0.0041, 0.5041)):
        stage = FuseDepth(**settings, moved=1.0)
        near, far = (np.full(SHAPE, z / unit, np.float32) for z in (0.5, 0.5 + step))
        stage.process(frame(near, unit))
        np.testing.assert_allclose(stage.process(frame(far, unit)).depth_m, expected, rtol=1e-5)


@pytest.mark.parametrize("unit", [0.001, 1.0])
def test_a_scene_that_moved_starts_anew(unit: float) -> None:
    """Also where it is about as far as before, as the columns in the middle are."""
    stage = FuseDepth()
    ramp = (np.linspace(0.45, 0.55, 50) / unit * np.ones(SHAPE)).astype(np.float32)
    stage.process(frame(ramp, unit))
    out = stage.process(frame(ramp[:, ::-1].copy(), unit))
    assert (out.depth == ramp[:, ::-1]).all()


def test_depth_of_another_unit_or_size_starts_anew() -> None:
    stage = FuseDepth()
    stage.process(frame(np.full(SHAPE, 500, np.uint16), 0.001))
    out = stage.process(frame(np.full(SHAPE, 501, np.uint16), 0.00125))
    assert (out.depth == 501).all()
    assert out.depth_scale == 0.00125
    size = (SHAPE[0] - 1, SHAPE[1])
    smaller = RgbdFrame(
        out.header, np.zeros((*size, 3), np.uint8), np.full(size, 502, np.uint16), 0.00125
    )
    assert (stage.process(smaller).depth == np.full(size, 502)).all()


def test_frames_of_a_moving_camera_pass_as_they_are() -> None:
    stage = FuseDepth()
    source = McapSource(path=RECORDINGS / "moving.mcap")
    for each in source.frames():
        assert_array_equal(stage.process(each).depth, each.depth)


@pytest.mark.parametrize("later", [-1, 500_000_001])
def test_nothing_is_filled_from_before_a_pause_or_after_stamps_went_back(later: int) -> None:
    stage = FuseDepth()
    whole, hole = np.full(SHAPE, 500, np.uint16), np.full(SHAPE, 500, np.uint16)
    hole[3, 4] = 0
    stage.process(frame(whole))
    again = replace(frame(hole), header=Header(1 + later, 1, "optical"))
    assert stage.process(again).depth[3, 4] == 0


def test_nan_is_missing_and_no_depth_passes() -> None:
    stage = FuseDepth()
    depth = np.full(SHAPE, np.nan, np.float32)
    assert (stage.process(frame(depth)).depth == 0).all()
    assert stage.process(frame(None)).depth is None
    assert DepthCorrect(offset_mm=3).process(frame(None)).depth is None


@pytest.mark.parametrize("stage", [FuseDepth(), DepthCorrect(offset_mm=2.0)])
def test_depth_at_the_end_of_its_scale_is_missing(stage: FuseDepth | DepthCorrect) -> None:
    depth = np.full(SHAPE, 4000, np.uint16)
    depth[3, 4] = 65535
    out = stage.process(frame(depth, 0.000125)).depth_m
    assert np.isnan(out[3, 4])
    assert np.isfinite(out).sum() == depth.size - 1


def test_correction_takes_the_polynomial_off_and_keeps_the_unit() -> None:
    depth = np.full(SHAPE, 4000, np.uint16)
    depth[0, 0] = 0
    stage = DepthCorrect(offset_mm=2.0, slope_mm_per_m=4.0, curve_mm_per_m2=8.0)
    out = stage.process(frame(depth, 0.000125))
    assert out.depth_m[1, 1] == pytest.approx(0.5 - 0.002 - 0.002 - 0.002, abs=1e-6)
    assert np.isnan(out.depth_m[0, 0])
    assert out.depth_scale == 0.000125


def test_what_is_taken_off_without_a_calibration_is_said(
    caplog: pytest.LogCaptureFixture, tmp_path: Path
) -> None:
    caplog.set_level(logging.INFO, "mushpipe")
    (tmp_path / "depth.yaml").write_text("offset_mm: 1.5\n")
    for quiet in (DepthCorrect(), DepthCorrect(calibration=tmp_path / "depth.yaml")):
        quiet.open()
    assert not caplog.text
    DepthCorrect(offset_mm=2.85).open()
    assert "2.85 mm, 0 mm per m and 0 mm per m^2 are taken off all depth" in caplog.text
