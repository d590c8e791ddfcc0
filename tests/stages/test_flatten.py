from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from mushpipe import RgbdFrame
from mushpipe.stages import flatten
from mushpipe.stages.chan_vese import ChanVese
from mushpipe.stages.flatten import Flatten, apply_gain, light_field
from tests.stages.frames import iou, recorded, simulated, truth_of
from tests.stages.scenes import HEADER

V, U = np.mgrid[:240, :320]
CIRCLES = np.random.default_rng(4).uniform((10, 10, 10), (310, 230, 26), (25, 3))
CAPS = np.any([(U - x) ** 2 + (V - y) ** 2 < r * r for x, y, r in CIRCLES], axis=0)


def lit(light: np.ndarray) -> RgbdFrame:
    color = np.where(CAPS[..., None], (210, 205, 195), (62, 50, 44)) * light[..., None]
    color += np.random.default_rng(0).normal(0, 3, color.shape)
    return RgbdFrame(HEADER, np.clip(np.rint(color), 0, 255).astype(np.uint8))


def found(frame: RgbdFrame) -> np.ndarray:
    return ChanVese().process(Flatten().process(frame)).foreground


@pytest.mark.parametrize("strength", [0.5, 0.75, 0.95])
@pytest.mark.parametrize("angle", [0.0, 0.7, 2.0])
def test_a_gradient_of_light_costs_next_to_nothing(strength: float, angle: float) -> None:
    along = np.cos(angle) * U / 319 + np.sin(angle) * V / 239
    along = (along - along.min()) / np.ptp(along)
    even = iou(found(lit(np.ones((240, 320)))), CAPS)
    graded = iou(found(lit(1 - strength * along)), CAPS)
    assert even > 0.98
    assert graded >= even - 0.02


@pytest.mark.parametrize("seed", [205, 206])
def test_a_gradient_on_simulated_beds(seed: int) -> None:
    beds = [
        simulated(seed, width=640, height=480, count=60, light=light, light_strength=0.95)
        for light in ("even", "gradient")
    ]
    even, graded = (iou(found(frame), truth_of(frame)) for frame in beds)
    assert graded >= even - 0.02


def test_the_thumbnail_of_a_strip_is_not_larger_than_that_of_an_image(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    seen = []
    monkeypatch.setattr(flatten, "light_field", lambda gray, _: seen.append(gray.shape) or gray * 0)
    for height, width in ((3000, 1), (640, 64), (1, 3000), (480, 640)):
        strip = RgbdFrame(HEADER, np.full((height, width, 3), 9, np.uint8))
        assert (Flatten(width=160).process(strip).color == strip.color).all()
    assert seen == [(1600, 160), (1600, 160), (8, 160), (120, 160)]


def test_depth_and_calibration_are_handed_on() -> None:
    frame = simulated(205, width=640, height=480, count=60)
    flat = Flatten().process(frame)
    assert flat.camera == frame.camera
    assert flat.depth is not None
    assert (flat.depth == frame.depth).all()
    assert flat.attached == frame.attached
    # Brightness changes, not hue: the three channels share one gain.
    ratio = flat.color[240, 320] / np.maximum(frame.color[240, 320], 1)
    assert np.ptp(ratio) < 0.05


def test_black_gaps_are_not_taken_for_a_lack_of_light() -> None:
    frame = lit(np.ones((240, 320)))
    color = frame.color.copy()
    color[:, 200:][~CAPS[:, 200:]] = 0
    gapped = RgbdFrame(HEADER, color)
    assert iou(found(gapped), CAPS) > 0.98
    gain = Flatten().process(gapped).gray[CAPS].mean() / gapped.gray[CAPS].mean()
    assert gain == pytest.approx(1, abs=0.1)


@pytest.mark.parametrize("name", ["white-bed-0", "beds-colour-only"])
def test_real_beds_in_even_light_stay_as_they_are(name: str) -> None:
    for frame in recorded(name):
        assert iou(found(frame), ChanVese().process(frame).foreground) > 0.9


@pytest.mark.parametrize("level", [0, 100, 255])
def test_an_image_of_one_level_is_handed_on_as_it_is(level: int) -> None:
    frame = RgbdFrame(HEADER, np.full((120, 160, 3), level, np.uint8))
    assert (Flatten().process(frame).color == level).all()


def test_the_field_is_that_which_was_put_in() -> None:
    y, x = np.mgrid[-1:1:60j, -1:1:80j]
    truth = 0.4 * x - 0.2 * y + 0.15 * x * y - 0.2 * x * x
    caps = np.any([(x - a) ** 2 + (y - b) ** 2 < 0.05 for a, b in ((-0.5, 0.2), (0.4, -0.3))], 0)
    gray = np.exp(truth + np.where(caps, np.log(206), np.log(56))) - 2
    field = light_field(gray.astype(np.float32), 6)
    np.testing.assert_allclose(field, truth - truth.mean(), atol=0.01)


@given(
    arrays(np.uint8, (3, 4, 3)),
    arrays(np.float32, (3, 4), elements=st.floats(0.125, 8, width=32)),
)
def test_gain_is_rounded_and_clipped(color: np.ndarray, gain: np.ndarray) -> None:
    exact = color * gain[..., None].astype(float)
    found = apply_gain(color, gain)
    assert (np.abs(found - np.minimum(exact, 255)) <= 0.501).all()
