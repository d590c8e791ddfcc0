from __future__ import annotations

from typing import Literal

import numpy as np
import pytest

from mushpipe import RgbdFrame
from mushpipe.stages.chan_vese import ChanVese
from mushpipe.stages.channels import channel_image
from mushpipe.stages.otsu import Otsu
from mushpipe.stages.polarity import rise
from tests.stages.frames import iou, simulated, truth_of
from tests.stages.scenes import HEADER

V, U = np.mgrid[:240, :320]
SOIL, WHITE, WOOD = (60, 45, 40), (220, 215, 205), (176, 128, 84)


def disc(x: float, y: float, r: float) -> np.ndarray:
    return np.asarray((U - x) ** 2 + (V - y) ** 2 < r * r)


LEFT, RIGHT = disc(90, 120, 30), disc(220, 110, 35)


def scene(
    *parts: tuple[np.ndarray | None, tuple[int, int, int]], noise: float = 4, grain: float = 0
) -> RgbdFrame:
    """A frame of regions in colours, later ones over earlier ones, under noise of a sensor.

    Grain is texture of brightness alone.
    """
    color = np.zeros((240, 320, 3))
    for region, value in parts:
        color[np.ones((240, 320), bool) if region is None else region] = value
    rng = np.random.default_rng(0)
    color += rng.normal(0, noise, color.shape) + rng.normal(0, grain, (240, 320, 1))
    return RgbdFrame(HEADER, np.clip(np.rint(color), 0, 255).astype(np.uint8))


@pytest.mark.parametrize("name", ["a", "red-blue"])
def test_channels_are_stretched_to_their_range(name: Literal["a", "red-blue"]) -> None:
    image = channel_image(scene((None, SOIL), (LEFT, (150, 80, 60))), name)
    assert image.dtype == np.float32
    assert (image.min(), image.max()) == (0, 1)
    flat = channel_image(scene((None, SOIL), noise=0), name)
    assert (flat == 0).all()


def test_gray_and_rgb_are_the_frames_own() -> None:
    frame = scene((None, SOIL), (LEFT, WHITE))
    assert (channel_image(frame, "gray") == frame.gray).all()
    np.testing.assert_allclose(channel_image(frame, "rgb") * 255, frame.color, atol=1e-4)


def test_auto_is_gray_on_a_bed_of_white_caps() -> None:
    frame = scene((None, SOIL), (LEFT, WHITE), (RIGHT, WHITE))
    assert (channel_image(frame, "auto") == frame.gray).all()
    assert iou(ChanVese(channel="auto").process(frame).foreground, LEFT | RIGHT) > 0.98


@pytest.mark.parametrize("stage", [Otsu(channel="auto"), ChanVese(channel="auto")])
def test_auto_finds_brown_caps_as_bright_as_the_soil(stage: Otsu | ChanVese) -> None:
    frame = scene((None, (60, 62, 56)), (LEFT, (92, 52, 28)), (RIGHT, (90, 54, 30)))
    assert not ChanVese().process(frame).foreground.any()
    assert iou(stage.process(frame).foreground, LEFT | RIGHT) > 0.95


def test_auto_finds_caps_of_two_colours() -> None:
    cream, brown = (225, 200, 160), (110, 68, 40)
    frame = scene((None, (50, 48, 45)), (LEFT, cream), (RIGHT, brown), grain=20)
    assert iou(ChanVese(channel="auto").process(frame).foreground, LEFT | RIGHT) > 0.95


def test_auto_does_not_take_wood_for_caps() -> None:
    frame = scene((None, WOOD), (LEFT, WHITE), (RIGHT, WHITE))
    assert iou(ChanVese(channel="auto").process(frame).foreground, LEFT | RIGHT) > 0.95
    rim = scene((None, SOIL), (np.asarray(V > 200), WOOD), (LEFT, WHITE), (RIGHT, WHITE))
    assert ChanVese(channel="auto").process(rim).foreground[LEFT | RIGHT].mean() > 0.95


@pytest.mark.parametrize("color", ["brown", "mixed"])
@pytest.mark.parametrize("seed", [201, 202])
def test_auto_finds_simulated_brown_caps(color: str, seed: int) -> None:
    frame = simulated(seed, width=640, height=480, count=60, cap_color=color)
    gray, auto = (
        ChanVese(channel=channel).process(frame).foreground for channel in ("gray", "auto")
    )
    assert iou(auto, truth_of(frame)) > max(0.88, iou(gray, truth_of(frame)))


def test_rgb_needs_the_fast_solver() -> None:
    with pytest.raises(ValueError, match="rgb needs solver fast"):
        ChanVese(channel="rgb", solver="pde")


def with_depth(frame: RgbdFrame, depth: np.ndarray) -> RgbdFrame:
    return RgbdFrame(frame.header, frame.color, depth.astype(np.float32), 1.0)


def test_dark_caps_before_a_light_bed_are_found_with_depth() -> None:
    caps = LEFT | RIGHT
    frame = scene((None, (200, 195, 190)), (caps, (70, 50, 40)))
    tilted = 0.5 + 0.0003 * U - np.where(caps, 0.02, 0)
    lying = with_depth(frame, tilted)
    assert iou(ChanVese().process(lying).foreground, caps) > 0.98
    assert iou(ChanVese(polarity="bright").process(lying).foreground, ~caps) > 0.98
    # Without depth bright is taken for near; who knows better says so.
    assert iou(ChanVese().process(frame).foreground, ~caps) > 0.98
    assert iou(ChanVese(polarity="dark").process(frame).foreground, caps) > 0.98


def test_bright_caps_stay_the_foreground_whatever_depth_knows() -> None:
    caps = LEFT | RIGHT
    frame = scene((None, SOIL), (caps, WHITE))
    flat = np.full((240, 320), 0.5)
    unknown = np.zeros((240, 320))
    for depth in (flat - 0.02 * caps, flat, unknown, np.where(caps, 0, flat)):
        assert iou(ChanVese().process(with_depth(frame, depth)).foreground, caps) > 0.98


def test_rise_is_the_height_above_a_tilted_bed() -> None:
    caps = LEFT | RIGHT
    bed = 1 / (2.0 + 0.002 * U - 0.001 * V)
    frame = with_depth(scene((None, SOIL)), bed - 0.02 * caps)
    assert rise(frame, caps) == pytest.approx(0.02, rel=0.15)
    assert rise(frame, ~caps) == pytest.approx(-0.02, rel=0.15)
    assert np.isnan(rise(frame, np.zeros_like(caps)))
    assert np.isnan(rise(frame, np.ones_like(caps)))


def test_height_beside_gray_finds_caps_of_the_colour_of_soil() -> None:
    frame = scene((None, SOIL))
    depth = np.full((240, 320), 0.5, np.float32)
    depth[LEFT | RIGHT] = 0.47
    raised = RgbdFrame(HEADER, frame.color, depth, 1.0)
    assert not ChanVese().process(raised).foreground.any()
    found = ChanVese(channel="gray+height").process(raised).foreground
    assert iou(found, LEFT | RIGHT) > 0.95


def test_height_beside_gray_is_gray_where_there_is_no_depth() -> None:
    frame = scene((None, SOIL), (LEFT, WHITE))
    expected = ChanVese().process(frame).foreground
    assert (ChanVese(channel="gray+height").process(frame).foreground == expected).all()
    assert expected.any()
