from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from pydantic import ValidationError
from scipy.spatial import cKDTree

from mushpipe import RgbdFrame
from mushpipe.core.errors import UsageError
from mushpipe.core.recording import RecordingReader
from mushpipe.core.truth import INSTANCES_TOPIC, TRUTH_TOPIC, Truth
from mushpipe.core.wire import decode_table
from mushpipe.stages.cap_net import KIND, CapNet
from tests.stages.frames import SIMULATED, first, iou, simulated
from tests.stages.networks import answering
from tests.stages.scenes import HEADER
from training.matching import Score, counted


def truth_of(name: str) -> Truth:
    messages = RecordingReader(SIMULATED / f"{name}.mcap").messages({TRUTH_TOPIC})
    raw = next(iter(messages))
    table = decode_table(raw.schema.name, raw.message.data).table
    assert isinstance(table, Truth)
    return table


@pytest.mark.parametrize(
    ("name", "least"),
    [("first-bed", 0.9), ("dense", 0.9), ("brown", 0.85), ("tilted", 0.85), ("harsh-light", 0.85)],
)
def test_caps_of_scenes_it_never_saw_are_found(name: str, least: float) -> None:
    stage, truth, score = CapNet(), truth_of(name), Score()
    score.add(stage.process(first(name))[1], truth, counted(truth, *stage.radius_px))
    assert score.f >= least


def test_the_mask_is_where_the_caps_are() -> None:
    frame = simulated(31, width=640, height=480, count=60)
    truth, labels = frame.attached[TRUTH_TOPIC], frame.attached[INSTANCES_TOPIC].labels
    mask, _ = CapNet().process(frame)
    caps = np.isin(labels, 1 + np.flatnonzero(truth.radius >= 8))
    assert iou(mask.foreground, caps) > 0.75


def test_circles_may_be_a_tenth_beyond_the_range() -> None:
    frame = first("dense")
    _, wide = CapNet(radius_px=(8, 45)).process(frame)
    smallest = float(np.median(wide.radius))
    _, found = CapNet(radius_px=(smallest, 45)).process(frame)
    kept = wide.radius >= 0.9 * smallest
    assert np.array_equal(found.radius, wide.radius[kept])
    assert found.radius.min() < smallest


def test_a_range_of_larger_caps_is_met_by_scaling_the_image() -> None:
    frame = first("first-bed")
    size = (2 * frame.color.shape[1], 2 * frame.color.shape[0])
    twice = RgbdFrame(HEADER, cv2.resize(frame.color, size, interpolation=cv2.INTER_CUBIC))
    stage = CapNet(radius_px=(12, 45))
    assert stage.scaling(frame) == (1, 45)
    large = CapNet(radius_px=(24, 90))
    assert large.scaling(twice)[0] < 1
    (_, circles), (mask, found) = stage.process(frame), large.process(twice)
    assert mask.foreground.shape == (960, 1280)
    # near the ends of the range a circle may be in one answer and not in the other
    sure = (circles.score > 0.8) & (circles.radius > 14) & (circles.radius < 40)
    center, radius = 2 * circles.center[sure] + 0.5, 2 * circles.radius[sure]
    away = np.linalg.norm(center[:, None] - found.center[None], axis=2)
    near = away.min(axis=1) < 5
    assert near.mean() > 0.9
    ratio = found.radius[away.argmin(axis=1)[near]] / radius[near]
    assert np.median(ratio) == pytest.approx(1, rel=0.04)


@pytest.mark.parametrize(
    ("depth", "scale", "largest"),
    [(0.6, 0.8, 60.0), (0.4, 0.8, 69.4), (0.3, 0.64, 92.6), (0.15, 0.8**6, 185.1), (0.01, 0, 2777)],
)
def test_depth_tells_how_large_caps_are_in_the_image(
    depth: float, scale: float, largest: float
) -> None:
    stage = CapNet(radius_px=(8, None), beside_depth=0.8)
    frame = first("first-bed")
    assert frame.camera is not None
    assert frame.camera.fx == pytest.approx(617, abs=1)
    near = replace(frame, depth=np.full(frame.color.shape[:2], depth, np.float32), depth_scale=1.0)
    found, radius = stage.scaling(near)
    assert radius == pytest.approx(largest, rel=1e-3)  # fx 90 mm / 2 / depth
    if scale:
        assert found == pytest.approx(scale)
        assert found * radius <= 60
    else:
        assert found >= 0.16  # whatever the depth: a smaller image shows no cap
    assert stage.scaling(replace(near, camera=None)) == (0.8, None)
    assert stage.scaling(replace(near, depth=None)) == (1, None)


def test_the_largest_cap_is_that_of_the_setting_at_the_depth_in_metres() -> None:
    stage, frame = CapNet(radius_px=(8, None), largest_mm=60), first("first-bed")
    assert frame.camera is not None
    native = np.full(frame.color.shape[:2], 1600, np.uint16)
    found, radius = stage.scaling(replace(frame, depth=native, depth_scale=1.25e-4))
    assert radius == pytest.approx(0.03 * frame.camera.fx / 0.2)
    assert found == pytest.approx(0.64)  # 92.6 px; a step of 0.8 is not enough


def test_beside_depth_the_image_is_scaled_and_the_answer_scaled_back() -> None:
    """Caps stay where they are; without depth the whole image is looked at."""
    frame = first("first-bed")
    whole, scaled = CapNet(), CapNet(beside_depth=0.8)
    bare = replace(frame, depth=None)
    (mask, circles), (same, others) = whole.process(frame), scaled.process(bare)
    assert np.array_equal(mask.foreground, same.foreground)
    assert np.array_equal(circles.center, others.center)
    smaller, found = scaled.process(frame)
    assert not np.array_equal(found.score, circles.score)
    alike = iou(smaller.foreground, mask.foreground)
    assert alike > 0.94
    for shift, axis in ((1, 0), (-1, 0), (1, 1), (-1, 1)):  # a pixel off is worse
        assert iou(np.roll(smaller.foreground, shift, axis), mask.foreground) < alike
    off, share = [], []
    for name in ("first-bed", "dense", "tilted", "brown"):
        truth, found = truth_of(name), scaled.process(first(name))[1]
        nearest = cKDTree(truth.center).query(found.center)[1]
        off.append(found.center - truth.center[nearest])
        share.append(found.radius / truth.radius[nearest])
    assert np.abs(np.median(np.concatenate(off), axis=0)).max() < 0.3  # px; no shift
    assert np.median(np.concatenate(share)) == pytest.approx(1, abs=0.03)


def test_where_hardly_any_depth_is_known_the_whole_image_is_looked_at() -> None:
    frame = first("first-bed")
    alone = CapNet().process(replace(frame, depth=None))[1]
    assert frame.depth is not None
    for kept in (0, 60):  # of 640 columns
        poor = frame.depth.copy()
        poor[:, kept:] = 0
        found = CapNet(beside_depth=0.8).process(replace(frame, depth=poor))[1]
        assert np.array_equal(found.score, alone.score)


@pytest.mark.parametrize("shape", [(1, 1), (5, 70), (33, 65), (130, 31), (240, 320)])
def test_an_image_of_any_size_gives_a_mask_of_its_size(shape: tuple[int, int]) -> None:
    noise = np.random.default_rng(1).integers(0, 256, (*shape, 3), np.uint8)
    frame = RgbdFrame(HEADER, noise)
    deep = replace(frame, depth=np.full(shape, 4000, np.uint16), depth_scale=1.25e-4)
    for seen in (frame, deep):
        mask, circles = CapNet(min_score=0.0, beside_depth=0.7).process(seen)
        assert mask.foreground.shape == shape
        assert (circles.center >= -0.5).all()
        assert (circles.center < np.array(shape[::-1]) - 0.5).all()


def test_an_empty_bed_has_no_caps() -> None:
    frame = simulated(21, count=0, pins=0, mycelium=0.3)
    assert len(CapNet().process(frame)[1]) == 0


def test_the_same_image_gives_the_same_bytes() -> None:
    frame = first("dense")
    (mask, circles), (again, others) = CapNet().process(frame), CapNet().process(frame)
    assert np.array_equal(mask.foreground, again.foreground)
    assert circles.center.tobytes() == others.center.tobytes()
    assert circles.radius.tobytes() == others.radius.tobytes()


def test_a_wrong_model_is_named(tmp_path: Path) -> None:
    frame = RgbdFrame(HEADER, np.zeros((64, 64, 3), np.uint8))
    with pytest.raises(UsageError, match=r"gone\.onnx: there is no such file"):
        CapNet(model=tmp_path / "gone.onnx").open()
    foreign = answering(tmp_path / "foreign.onnx", np.zeros((1, 5, 16, 16)))
    with pytest.raises(UsageError, match=r"foreign\.onnx: it calls itself None.*stage `onnx`"):
        CapNet(model=foreign).open()
    odd = answering(tmp_path / "odd.onnx", np.zeros((1, 3, 16, 16)), kind=KIND)
    with pytest.raises(UsageError, match=r"odd\.onnx: its output has shape \(1, 3, 16, 16\)"):
        CapNet(model=odd).process(frame)


def test_a_radius_range_the_wrong_way_round_is_refused() -> None:
    with pytest.raises(ValidationError, match=r"radius_px must be \[smallest, largest\]"):
        CapNet(radius_px=(38, 8))
