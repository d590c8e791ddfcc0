"""Where edges of caps lie in depth, beside those in colour."""

from __future__ import annotations

import re
from dataclasses import replace
from functools import cache

import cv2
import numpy as np
import pytest

from mushpipe import Camera, Circles, Header, Mask, RgbdFrame
from mushpipe.evaluate.truth import read_truth
from mushpipe.sources.mcap import McapSource
from mushpipe.stages.cap.gap import AGAIN, LEAST_RADIUS, MOST, EdgeWatch, edge_gaps, usual
from mushpipe.stages.cap_fit import CapFit
from mushpipe.stages.phase_hough import PhaseHough
from tests.stages.frames import SIMULATED


def disc(x: float, y: float, radius: float) -> np.ndarray:
    """Return how much of each pixel (240, 320) lies within a circle, 0..1."""
    v, u = np.mgrid[:240, :320]
    return np.clip(radius + 0.5 - np.hypot(u - x, v - y), 0, 1)


@pytest.mark.parametrize("wider", [-2.0, 0.0, 1.0, 3.0])
@pytest.mark.parametrize("shift", [(0.0, 0.0), (3.0, -2.0)])
def test_gaps_tell_what_depth_is_wider_by_and_where_it_lies(
    wider: float, shift: tuple[float, float]
) -> None:
    x, y = 161.3, 118.6
    luma = 40 + 170 * disc(x, y, 40)
    near = disc(x + shift[0], y + shift[1], 40 + wider) > 0.5
    color = np.repeat(luma[..., None], 3, axis=2).astype(np.uint8)
    depth = np.where(near, 0.47, 0.5).astype(np.float32)
    camera = Camera(320, 240, 617, 617, 160, 120)
    frame = RgbdFrame(Header(0, 0, "camera"), color, depth, 1.0, camera)
    gaps, places = edge_gaps(frame, Circles(np.array([[x, y]]), np.array([40.4]), np.ones(1)))
    assert len(gaps) == places == 32
    found = usual(gaps)
    assert found == pytest.approx([wider, *shift], abs=0.35)  # pixels of depth are in or out


def widened(frame: RgbdFrame, by: int) -> RgbdFrame:
    """Return the frame as a stereo camera sees it: what is nearer reaches so many px further."""
    if not by:
        return frame
    assert frame.depth is not None
    depth = np.where(frame.depth > 0, frame.depth, 65535)
    around = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * by + 1, 2 * by + 1))
    near = cv2.erode(depth.astype(np.float32), around)
    return replace(frame, depth=np.where(near < 65535, near, 0).astype(np.uint16))


def told(
    stage: CapFit, by: int, caplog: pytest.LogCaptureFixture, right: int = 0
) -> tuple[list[str], float]:
    """Return what `cap-fit` warns of on a recording so widened, and the diameters' bias, mm.

    Depth may be moved to the right by some px, too.
    """
    caplog.clear()
    detect, bias = PhaseHough(radius_px=(8, 80), min_score=0.5), []
    stage.open()
    path = SIMULATED / "moving.mcap"
    known = read_truth(path)
    for frame in McapSource(path=path).frames():
        seen = widened(frame, by)
        assert seen.depth is not None
        seen = replace(seen, depth=np.roll(seen.depth, right, axis=1))
        truth = known.frames[known.place(frame.header)].caps
        circles = detect.process(seen, Mask(np.ones(seen.color.shape[:2], np.bool_)))
        sure = circles.take(circles.radius > 15)
        found, _, circles = stage.process(seen, sure)
        away = np.linalg.norm(truth.center[:, None] - circles.center, axis=2)
        near = (away.min(axis=1) < 3) & (truth.visible > 0.8)
        bias.extend((found.diameter[away.argmin(axis=1)] - truth.diameter)[near])
    said = [record.getMessage() for record in caplog.records]
    return [text for text in said if text.startswith("cap-fit")], 1e3 * float(np.nanmedian(bias))


def test_a_camera_that_shows_caps_wider_is_told_of_with_what_puts_it_right(
    caplog: pytest.LogCaptureFixture,
) -> None:
    said, right = told(CapFit(), 0, caplog)
    assert said == []
    (message,), wide = told(CapFit(), 3, caplog)
    assert "px outside of those in colour" in message
    assert "diameters are too large" in message
    found = re.search(r"set edge_offset_px: (-?[\d.]+)", message)
    assert found is not None
    said, mended = told(CapFit(edge_offset_px=float(found[1])), 3, caplog)
    assert said == []
    assert wide - right > 1.5
    assert abs(mended) < 0.6


def test_sigmas_hold_where_edges_are_told_to_be_amiss() -> None:
    """From the frame on that tells it; depth widened by 3 px makes diameters too large by more."""
    watching, blind = CapFit(), CapFit()
    blind._edges._told = True  # as if it had judged, and found nothing
    diameter, tilt = {True: list[float](), False: list[float]()}, list[float]()
    for frame, circles in beds("moving"):
        seen = widened(frame, 3)
        truth = read_truth(SIMULATED / "moving.mcap")
        caps = truth.frames[truth.place(frame.header)].caps
        sigmas = []
        for stage in (watching, blind):
            found, poses, kept = stage.process(seen, circles)
            away = np.linalg.norm(caps.center[:, None] - kept.center, axis=2)
            row, near = away.argmin(axis=0), away.min(axis=0) < 3
            error = found.diameter[near] - caps.diameter[row[near]]
            diameter[stage is watching].extend((error / found.sigma_diameter[near]) ** 2)
            sigmas.append(poses.sigma_rad)
        if watching._edges.amiss_px:
            tilt.extend(sigmas[0] - sigmas[1])
    assert watching._edges.amiss_px > 1.5
    assert np.nanmean(diameter[False]) > 1.5 * np.nanmean(diameter[True])
    assert np.nanmean(diameter[True]) < 1.4  # as of every sigma
    assert np.nanmin(tilt) > 0


def test_a_setting_for_another_camera_is_told_of(caplog: pytest.LogCaptureFixture) -> None:
    (message,), bias = told(CapFit(edge_offset_px=-2.5), 1, caplog)
    assert "edge_offset_px: -2.5 takes them for 2.5 px outside" in message
    assert "diameters are too small" in message
    assert bias < -0.5


def test_depth_that_is_not_aligned_to_colour_is_told_of(caplog: pytest.LogCaptureFixture) -> None:
    (message,), _ = told(CapFit(), 1, caplog, right=4)
    found = re.search(r"depth shows caps ([\d.]+) px to the right and ([\d.]+) px", message)
    assert found is not None
    assert float(found[1]) == pytest.approx(4, abs=0.7)
    assert float(found[2]) < 0.5
    assert "not aligned to colour" in message
    (message,), _ = told(CapFit(), 1, caplog, right=-3)
    assert "px to the left" in message


BEDS = ("dense", "first-bed", "moving", "tilted", "harsh-light", "brown", "sparse")


@cache
def beds(name: str) -> list[tuple[RgbdFrame, Circles]]:
    """The frames of a recording, and the mushrooms in them that count."""
    known, found = read_truth(SIMULATED / f"{name}.mcap"), []
    for frame in McapSource(path=SIMULATED / f"{name}.mcap").frames():
        caps = known.frames[known.place(frame.header)].caps
        caps = caps.take(caps.ignore == 0)
        found.append((frame, Circles(caps.center, caps.radius, np.ones(len(caps)))))
    return found


def moved(frame: RgbdFrame, right: int, down: int = 0) -> RgbdFrame:
    """The frame with its depth so many px to the right and below of colour."""
    assert frame.depth is not None
    return replace(frame, depth=np.roll(frame.depth, (down, right), axis=(0, 1)))


def look_at_beds(right: int) -> None:
    """Let a watch look at all beds, with depth so many px to the right of colour."""
    watch = EdgeWatch()
    for name in BEDS:
        for frame, circles in beds(name):
            watch.look(moved(frame, right), circles, 0.7)


@pytest.mark.parametrize("right", [0, -3, -5, 5])
def test_shadows_beside_all_caps_keep_nobody_from_telling(
    right: int, caplog: pytest.LogCaptureFixture
) -> None:
    look_at_beds(right)
    found = [re.search(r"([\d.]+) px to the (left|right)", text) for text in caplog.messages]
    told = [float(f[1]) * (1 if f[2] == "right" else -1) for f in found if f]
    assert len(told) == len(found) == (right != 0)
    assert told == pytest.approx([right] * len(told), abs=1.3)


@pytest.mark.parametrize("right", [-25, -14, 14, 25])
def test_depth_far_beside_colour_is_told_of_as_well(
    right: int, caplog: pytest.LogCaptureFixture
) -> None:
    """Farther than edges are looked for."""
    look_at_beds(right)
    (message,) = caplog.messages
    assert "not aligned to colour" in message


@pytest.mark.parametrize("shift", [(0, 0), (5, 0), (0, 5), (0, -5)])
def test_a_camera_that_stands_still_is_told_of_after_a_while_and_only_once(
    shift: tuple[int, int], caplog: pytest.LogCaptureFixture
) -> None:
    for name in BEDS[:2]:
        frame, circles = beds(name)[0]
        seen, watch = moved(frame, *shift), EdgeWatch()
        caplog.clear()
        for _ in range(59):
            watch.look(seen, circles, 0.7)
        assert caplog.messages == []
        for _ in range(150):
            watch.look(seen, circles, 0.7)
        assert len(caplog.messages) == (shift != (0, 0))
        for text in caplog.messages:
            side = {(5, 0): "right", (0, 5): "below", (0, -5): "above"}[shift]
            found = re.search(rf"([\d.]+) px (?:to the )?{side}", text)
            assert found is not None
            assert float(found[1]) == pytest.approx(5, abs=1.3)


@pytest.mark.parametrize("right", [0, 6, 25])
def test_a_camera_that_is_knocked_later_is_told_of(
    right: int, caplog: pytest.LogCaptureFixture
) -> None:
    """Not at once: it is looked again after a while, and twice."""
    bed = [pair for name in BEDS for pair in beds(name)]
    watch, laps = EdgeWatch(), -(-AGAIN // len(bed)) + 2
    for shift, said in ((0, 0), (right, right != 0)):
        for frame, circles in laps * bed:
            watch.look(moved(frame, shift), circles, 0.7)
        assert len(caplog.messages) == said


@pytest.mark.parametrize(
    ("name", "down", "right"),
    [("dense", 1, -1), ("moving", -1, -1), ("tilted", -1, 1), ("brown", 1, -1), ("brown", -1, 1)],
)
def test_mirrored_depth_is_told_of_by_a_camera_that_stands_still(
    name: str, down: int, right: int, caplog: pytest.LogCaptureFixture
) -> None:
    """Of what is found there by both, few edges are in depth, and these lie anywhere."""
    bed, _ = beds(name)[0]
    assert bed.depth is not None
    for frame in (bed, replace(bed, depth=bed.depth[::down, ::right].copy())):
        every = Mask(np.ones(bed.color.shape[:2], np.bool_))
        found = PhaseHough(radius_px=(8, 80), min_score=0.5).process(frame, every)
        watch, few = EdgeWatch(), name != "dense"  # whose many caps tell it sooner
        for _ in range(59):
            watch.look(frame, found, 0.7)
        assert not (caplog.messages and (few or frame is bed))
        watch.look(frame, found, 0.7)
        assert len(caplog.messages) == (watch.amiss_px >= 8) == (frame is not bed)


def panned(frame: RgbdFrame, circles: Circles, x: int, late: int) -> tuple[RgbdFrame, Circles]:
    """What a camera of 480x360 px sees x px to the right, with depth of so many px before."""
    camera, color, depth = frame.camera, frame.color[60:420, x:][:, :480], frame.depth
    assert camera is not None
    assert depth is not None
    view = replace(camera, width=480, height=360, cx=camera.cx - x, cy=camera.cy - 60)
    seen = RgbdFrame(frame.header, color, depth[60:420, x - late :][:, :480], 0.000125, view)
    center = circles.center - [x, 60]
    inside = ((center > 0) & (center < [480, 360])).all(axis=1)
    return seen, Circles(center, circles.radius, circles.score).take(inside)


@pytest.mark.parametrize("step", [4, 18])
@pytest.mark.parametrize("name", BEDS)
def test_depth_that_is_one_picture_late_is_told_of_while_the_camera_moves(
    name: str, step: int, caplog: pytest.LogCaptureFixture
) -> None:
    bed, circles = beds(name)[0]
    way = [*range(step, 143, step), *range(142, step, -step)]
    for late in (0, step):
        watch = EdgeWatch()
        for turn in range(60):
            ahead = turn % len(way) < len(way) // 2
            x = way[turn % len(way)]
            watch.look(*panned(bed, circles, x, late if ahead else -late), 0.7)
        assert len(caplog.messages) == (late > 0)


def test_edges_that_do_not_move_or_lie_on_one_side_are_no_evidence(
    caplog: pytest.LogCaptureFixture,
) -> None:
    frame = widened(next(iter(McapSource(path=SIMULATED / "lab.mcap").frames())), 3)
    some = PhaseHough(radius_px=(8, 80), min_score=0.5).process(
        frame, Mask(np.ones(frame.color.shape[:2], np.bool_))
    )
    watch = EdgeWatch()
    for _ in range(20):
        watch.look(frame, some.take(np.arange(3)), 0.7)
    assert caplog.messages == []
    side = np.random.default_rng(4).uniform(-0.7, 0.7, 500)
    assert usual(np.column_stack([side, np.cos(side), np.sin(side)])) is None


def test_of_many_caps_all_are_looked_at_in_turn_though_nothing_moves() -> None:
    frame, circles = beds("dense")[0]
    every = circles.take(circles.radius >= LEAST_RADIUS)
    one_by_one = [edge_gaps(frame, every.take(np.array([k]))) for k in range(len(every))]
    assert len(every) > MOST
    watch = EdgeWatch()
    for _ in range(-(-len(every) // MOST) + 2):
        watch.look(frame, circles, 0.7)
    assert watch._places == sum(places for _, places in one_by_one)
    assert len(watch._gaps) == sum(len(gaps) for gaps, _ in one_by_one)
