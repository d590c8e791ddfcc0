from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest
from pydantic import ValidationError

from mushpipe import RgbdFrame
from mushpipe.core.errors import UsageError
from mushpipe.core.truth import INSTANCES_TOPIC, TRUTH_TOPIC
from mushpipe.sources.mcap import McapSource
from mushpipe.stages.cap_net import KIND, CapNet
from tests.stages.frames import iou, simulated
from tests.stages.networks import answering
from tests.stages.scenes import HEADER
from training.matching import Score, counted

RECORDINGS = Path(__file__).parents[2] / "recordings"


def first(name: str) -> RgbdFrame:
    return next(iter(McapSource(path=RECORDINGS / f"{name}.mcap").frames()))


def score_of(frame: RgbdFrame, stage: CapNet) -> Score:
    truth, score = frame.attached[TRUTH_TOPIC], Score()
    score.add(stage.process(frame)[1], truth, counted(truth, *stage.radius_px))
    return score


@pytest.mark.parametrize(
    ("name", "least"),
    [("first-bed", 0.9), ("dense", 0.9), ("brown", 0.85), ("tilted", 0.85), ("harsh-light", 0.85)],
)
def test_caps_of_scenes_it_never_saw_are_found(name: str, least: float) -> None:
    assert score_of(first(name), CapNet()).f >= least


def test_the_mask_is_where_the_caps_are() -> None:
    frame = first("first-bed")
    truth, labels = frame.attached[TRUTH_TOPIC], frame.attached[INSTANCES_TOPIC].labels
    mask, _ = CapNet().process(frame)
    caps = np.isin(labels, 1 + np.flatnonzero(truth.radius >= 8))
    assert iou(mask.foreground, caps) > 0.75


def test_a_range_of_larger_caps_is_met_by_scaling_the_image() -> None:
    frame = first("first-bed")
    size = (2 * frame.color.shape[1], 2 * frame.color.shape[0])
    twice = RgbdFrame(HEADER, cv2.resize(frame.color, size, interpolation=cv2.INTER_CUBIC))
    stage = CapNet(radius_px=(12, 45))
    assert stage.scale() == 1
    large = CapNet(radius_px=(24, 90))
    assert large.scale() < 1
    (_, circles), (mask, found) = stage.process(frame), large.process(twice)
    assert mask.foreground.shape == (960, 1280)
    away = np.linalg.norm(found.center[:, None] - (2 * circles.center + 0.5)[None], axis=2)
    near = away.min(axis=1) < 4
    assert near.mean() > 0.85
    ratio = found.radius[near] / circles.radius[away.argmin(axis=1)[near]]
    assert np.median(ratio) == pytest.approx(2, rel=0.04)


@pytest.mark.parametrize("shape", [(1, 1), (5, 70), (33, 65), (130, 31), (240, 320)])
def test_an_image_of_any_size_gives_a_mask_of_its_size(shape: tuple[int, int]) -> None:
    noise = np.random.default_rng(1).integers(0, 256, (*shape, 3), np.uint8)
    mask, circles = CapNet(min_score=0.0).process(RgbdFrame(HEADER, noise))
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
