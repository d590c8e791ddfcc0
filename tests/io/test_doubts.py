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
from mushpipe.core.arrays import Floats
from mushpipe.core.doubts import (
    STILL,
    bow,
    doubts,
    doubts_of_camera,
    doubts_of_points,
    doubts_of_view,
    judged,
)
from tests.core.lab import Frames, Lab
from tests.stages.frames import SIMULATED, first, recorded

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
        assert not every_doubt(frame)


@pytest.mark.parametrize("path", sorted(SIMULATED.glob("*.mcap")), ids=lambda path: path.stem)
def test_simulated_depth_is_not_doubted(path: Path) -> None:
    assert not every_doubt(first(path.stem))


def every_doubt(frame: RgbdFrame, scale: float = 1) -> list[str]:
    depth = scale * frame.depth_m[np.isfinite(frame.depth_m)]
    assert frame.camera is not None
    view, points = doubts_of_view(depth, frame.camera), doubts_of_points(points_of(frame, scale))
    return [*doubts(depth), *view, *points, *doubts_of_camera(frame.camera)]


def points_of(frame: RgbdFrame, scale: float = 1) -> Floats:
    """Return every eighth point each way, m."""
    assert frame.camera is not None
    depth = np.full_like(frame.depth_m, np.nan)
    depth[::8, ::8] = scale * frame.depth_m[::8, ::8]
    rows, columns = np.nonzero(np.isfinite(depth))
    pixels = np.column_stack([columns, rows]).astype(float)
    return frame.camera.deproject(pixels, depth[rows, columns].astype(float))


def as_ranges(points: Floats) -> Floats:
    """Return what points become if their distance from the camera is taken for their z."""
    away = np.linalg.norm(points, axis=1)
    return points / points[:, 2:] * away[:, None]


BEDS = ["first-bed", "sparse", "tilted", "brown", "dense", "harsh-light", "gaps", "moving", "lab"]


@pytest.mark.parametrize("name", BEDS)
def test_ranges_of_a_bed_are_doubted(name: str) -> None:
    points = points_of(first(name))
    assert not list(doubts_of_points(points))
    (told,) = doubts_of_points(as_ranges(points))
    assert "depth looks like the distance from the camera (range), not along its axis" in told
    off = np.linalg.norm(as_ranges(points), axis=1) - np.linalg.norm(points, axis=1)
    (most,) = re.findall(r"up to (\d+) mm too far", told)
    assert int(most) == pytest.approx(1000 * np.percentile(off, 98), rel=0.15)


@pytest.mark.parametrize("name", ["desk-july", "desk-june", "white-bed-0"])
def test_ranges_of_a_real_bed_are_doubted(name: str) -> None:
    for frame in recorded(name):
        assert list(doubts_of_points(as_ranges(points_of(frame))))


@given(st.integers(0, 2**32), st.floats(-0.5, 0.5), st.floats(-0.5, 0.5), st.floats(0.2, 2))
def test_a_plane_is_not_bowed_and_its_ranges_are(
    seed: int, across: float, along: float, away: float
) -> None:
    """Seen at any slant up to 35 degrees, with caps on half of it and a little noise."""
    rng = np.random.default_rng(seed)
    rays = rng.uniform((-0.52, -0.39), (0.52, 0.39), (3000, 2))
    z = away / (1 + rays @ [across, along])
    z *= 1 - np.where(rng.random(3000) < 0.3, rng.uniform(0, 0.06, 3000), 0)
    points = np.column_stack([rays, np.ones(3000)]) * (z * rng.normal(1, 1e-3, 3000))[:, None]
    assert abs(bow(points)) < 0.3
    assert bow(as_ranges(points)) > 0.6


def test_ranges_in_a_narrow_view_or_of_few_points_are_not_judged() -> None:
    points = points_of(first("sparse"))
    assert not list(doubts_of_points(as_ranges(points)[::20]))
    narrow = np.linalg.norm(points[:, :2], axis=1) < 0.2 * points[:, 2]
    assert not list(doubts_of_points(as_ranges(points[narrow])))


@pytest.mark.parametrize("name", ["first-bed", "sparse", "tilted", "brown", "dense"])
@pytest.mark.parametrize("scale", [0.1, 1 / 8, 8, 10])
def test_a_unit_of_another_driver_is_doubted(name: str, scale: float) -> None:
    """An SR300 counts eighths of a millimetre; said to be others, none of its caps are found."""
    (told,) = every_doubt(first(name), scale)
    assert ("nearer" if scale < 1 else "farther") in told
    assert "set source.depth_scale" in told


@pytest.mark.parametrize(
    ("camera", "told"),
    [
        (Camera(640, 480, 617, 617, 319.5, 239.5), None),
        (Camera(640, 480, 617, 600, 300, 260), None),
        (Camera(640, 480, 617, 617, 320, 90), None),  # a strip that was cut out
        (Camera(640, 480, 308, 308, 159.5, 119.5), "images of about 319x239, and these are"),
        (Camera(1280, 720, 617, 617, 320, 180), "images of about 640x360, and these are"),
        (Camera(640, 480, 450, 450, 480, 360), "images of about 960x720, and these are"),
        (Camera(640, 480, 1234, 617, 320, 240), "pixels that are not square"),
        (Camera(640, 480, 617, 6170, 320, 240), "pixels that are not square"),
    ],
)
def test_calibrations_of_other_images_are_doubted(camera: Camera, told: str | None) -> None:
    found = list(doubts_of_camera(camera))
    assert len(found) == (told is not None)
    assert told is None or told in found[0]


GOOD = Camera(64, 48, 250, 250, 32, 24)


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
        (np.full((48, 64), 1, np.uint16), 8, GOOD, "a cap of 40 mm is 1 px wide"),
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
@pytest.mark.parametrize("kind", ["16UC1", "32FC1", "nothing known", "all beyond reach"])
def test_depth_that_stands_still_is_told_of_once(
    kind: str, still: bool, color_moves: bool, live: bool, said: str | None,
    caplog: pytest.LogCaptureFixture,
) -> None:  # fmt: skip
    rng = np.random.default_rng(0)
    first = rng.integers(3000, 3200, (48, 64), np.uint16)
    if kind != "16UC1":  # missing is NaN there
        first = first.astype(np.float32)
        first[::2] = np.nan
        first[:, :] = {"nothing known": np.nan, "all beyond reach": np.inf}.get(kind, first)

    def frames() -> Iterator[RgbdFrame]:
        for number in range(100):
            color = np.full_like(COLOR, number if color_moves else 0)
            depth = first.copy()
            if not still:
                depth[7, 9] += number % 2
            yield RgbdFrame(Header(number, number, "camera"), color, depth, 0.000125)

    assert len(list(judged(frames(), "bed.mcap", live))) == 100
    told = [text for text in caplog.messages if "depth has been the same" in text]
    if said is None or kind in ("nothing known", "all beyond reach"):
        assert not told
    else:
        (text,) = told
        assert text.startswith(f"bed.mcap, frame {STILL}: ")
        assert said in text
