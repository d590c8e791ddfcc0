"""What is said of odd depth."""

from __future__ import annotations

import logging
import re
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from mushpipe import Camera, Header, RgbdFrame
from mushpipe.core.doubts import STILL, doubts, judged
from tests.core.lab import Frames, Lab
from tests.stages.frames import recorded

COLOR = np.zeros((48, 64, 3), np.uint8)
RELIEF = np.random.default_rng(0).uniform(0.4, 0.5, 4800)  # m, a bed and its caps


@given(st.floats(0.1, 30))
def test_depth_in_coarse_steps_is_doubted_and_no_other(step_mm: float) -> None:
    step = step_mm / 1000
    found = list(doubts(np.rint(RELIEF / step) * step))
    levels = round(0.1 / step)
    if step_mm < 2.9:
        assert not found
    elif step_mm > 3.1 and levels >= 7:
        assert len(found) == 1
        told = re.search(r"in steps of (\d+) mm", found[0])
        assert told
        assert int(told[1]) == pytest.approx(step_mm, abs=0.5 + 1e-6)


def test_disparities_without_fractions_are_doubted() -> None:
    """A base of 75 mm and 441 px of focal length, half a metre away."""
    product = 0.075 * 441
    assert list(doubts(product / np.rint(product / RELIEF)))
    assert not list(doubts(product / (np.rint(32 * product / RELIEF) / 32)))


@pytest.mark.parametrize("depth", [np.zeros(0), np.full(100, 0.4), np.repeat([0.4, 0.5], 50)])
def test_what_has_few_levels_is_not_doubted(depth: np.ndarray) -> None:
    assert not list(doubts(depth))


@given(st.integers(0, 2**32), st.integers(6, 300))
def test_depths_that_are_few_and_far_apart_by_chance_are_not_doubted(seed: int, n: int) -> None:
    assert not list(doubts(np.random.default_rng(seed).uniform(0.1, 8, n)))


@pytest.mark.parametrize("name", ["desk-july", "desk-june", "white-bed-0"])
def test_real_depth_is_not_doubted(name: str) -> None:
    for frame in recorded(name):
        assert not list(doubts(frame.depth_m[np.isfinite(frame.depth_m)]))


GOOD = Camera(64, 48, 60, 60, 32, 24)


@pytest.mark.parametrize(
    ("depth", "scale", "camera", "message"),
    [
        (np.full((48, 64), 500, np.float32), 1, GOOD, "half of the depth is beyond 500 m"),
        (
            np.full((48, 64), 0.4, np.float32),
            0.001,
            GOOD,
            "half of the depth is nearer than 0.4 mm",
        ),
        (np.full((48, 64), 500, np.uint16), 0.001, Camera(64, 48, 2, 2, 32, 24), "view of 173 deg"),
        (np.full((48, 64), 500, np.uint16), 0.001, GOOD, ""),
        (np.zeros((48, 64), np.uint16), 0.001, GOOD, ""),
        (None, 0.001, GOOD, ""),
    ],
)
def test_any_source_is_told_once_of_units_that_cannot_be(
    depth: np.ndarray | None,
    scale: float,
    camera: Camera,
    message: str,
    tmp_path: Path,
    caplog: pytest.LogCaptureFixture,
) -> None:
    class Own(Frames):
        def frames(self) -> Iterator[RgbdFrame]:
            for k in range(3):
                yield RgbdFrame(Header(k, k, "camera"), COLOR, depth, scale, camera)

    lab = Lab(tmp_path)
    lab.registry.source("own", Own)
    with caplog.at_level(logging.WARNING, "mushpipe"):
        assert lab.run(lab.chain("threshold", source="own")).error is None
    assert caplog.text.count("frame 0: ") == len(caplog.messages) == (1 if message else 0)
    assert message in caplog.text


@pytest.mark.parametrize(
    ("still", "color_moves", "live", "said"),
    [
        (True, True, False, "for 30 frames in which colour changed: "),
        (True, True, True, "for 30 frames in which colour changed: "),
        (True, False, True, "for 30 frames, and so has colour: "),
        (True, False, False, None),
        (False, True, True, None),
    ],
)
@pytest.mark.parametrize("kind", ["16UC1", "32FC1", "nothing known"])
def test_depth_that_stands_still_is_told_of_once(
    kind: str, still: bool, color_moves: bool, live: bool, said: str | None,
    caplog: pytest.LogCaptureFixture,
) -> None:  # fmt: skip
    rng = np.random.default_rng(0)
    first = rng.integers(3000, 3200, (48, 64), np.uint16)
    if kind != "16UC1":  # missing is NaN there
        first = first.astype(np.float32)
        first[::2] = np.nan
        first[:, :] = np.nan if kind == "nothing known" else first

    def frames() -> Iterator[RgbdFrame]:
        for number in range(100):
            color = np.full_like(COLOR, number if color_moves else 0)
            depth = first.copy()
            if not still:
                depth[7, 9] += number % 2
            yield RgbdFrame(Header(number, number, "camera"), color, depth, 0.000125)

    assert len(list(judged(frames(), "bed.mcap", live))) == 100
    told = [text for text in caplog.messages if "depth has been the same" in text]
    if said is None or kind == "nothing known":
        assert not told
    else:
        (text,) = told
        assert text.startswith(f"bed.mcap, frame {STILL}: ")
        assert said in text
