"""What stages make of lenses that end inside the image, of tiny caps, and of ranges that end."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from pydantic import ValidationError

from mushpipe import (
    Camera,
    Circles,
    DepthSource,
    Header,
    Locations,
    Mask,
    PickFlag,
    Poses,
    RgbdFrame,
)
from mushpipe.sources.mcap import McapSource
from mushpipe.sources.synthetic import SyntheticSource
from mushpipe.stages.cap_fit import CapFit
from mushpipe.stages.cap_net import CapNet
from mushpipe.stages.chan_vese import ChanVese
from mushpipe.stages.height import Height
from mushpipe.stages.nearest_depth import NearestDepth
from mushpipe.stages.phase_hough import PhaseHough
from mushpipe.stages.picks import MakePicks
from mushpipe.stages.surface_fit import SurfaceFit
from tests.stages.caps import cap, draw

RECORDINGS = Path(__file__).parents[2] / "recordings"


def first(name: str) -> RgbdFrame:
    return next(iter(McapSource(path=RECORDINGS / f"{name}.mcap").frames()))


def everything(frame: RgbdFrame) -> Mask:
    return Mask(np.ones(frame.gray.shape, bool))


@pytest.mark.parametrize("localizer", [NearestDepth(), SurfaceFit()])
def test_where_the_lens_has_no_ray_nothing_is_located(localizer: NearestDepth | SurfaceFit) -> None:
    lens = (-0.28, 0.07, 0.0002, 0, -0.01)
    camera = Camera(640, 480, 330, 330, 319.5, 239.5, "brown_conrady", lens)
    v, u = np.mgrid[8:472:16, 8:632:16]
    pixels = np.stack([u, v], axis=-1).reshape(-1, 2).astype(float)
    without = np.isnan(camera.deproject(pixels, np.ones(len(pixels)))).any(axis=1)
    center = np.concatenate([pixels[without], [[320.0, 240.0]]])
    frame = replace(first("first-bed"), camera=camera)
    radius = np.append(np.full(len(center) - 1, 3.0), 15.0)
    found = localizer.process(frame, Circles(center, radius, np.ones(len(center))))
    assert len(center) > 10
    corner = np.abs(center - (319.5, 239.5)).sum(axis=1) > 520  # no ray within the circle either
    assert corner.any()
    assert (found.source[corner] == DepthSource.MISSING).all()
    assert np.isnan(found.position[corner]).all()
    assert np.isfinite(found.position[-1]).all()


def test_many_edges_hide_no_part_of_the_image() -> None:
    frame = replace(first("brown"), depth=None, camera=None)
    found = PhaseHough(radius_px=(8, 80), use_depth=False).process(frame, everything(frame))
    below = replace(frame, color=np.ascontiguousarray(frame.color[240:]))
    alone = PhaseHough(radius_px=(8, 80), use_depth=False).process(below, everything(below))
    seen = (found.center[:, 1] > 240 + 30) & (found.score > 0.5)
    assert seen.sum() >= 0.8 * ((alone.center[:, 1] > 30) & (alone.score > 0.5)).sum() > 5


def test_diameters_are_judged_where_the_circle_is() -> None:
    """Under a camera that leans by 20 degrees a pixel on the near side is a third smaller."""
    drawn = {"camera_tilt_deg": 20, "count": 60, "cluster": 0.3, "tilt_deg": (0, 5)}
    source = SyntheticSource(
        seed=7001, max_frames=1, size_mm=(40, 44), distance=0.4, pins=0, **drawn
    )
    frame = next(iter(source.frames()))
    usual, sized = (
        PhaseHough(radius_px=(8, 80), diameter_mm=limits).process(frame, everything(frame))
        for limits in ((1, 1000), (33, 52))
    )
    assert len(sized) >= 0.9 * (usual.score > 0.5).sum() > 20


def test_a_range_beyond_the_image_finds_nothing() -> None:
    v, u = np.mgrid[:60, :80]
    image = np.where(np.hypot(u - 40, v - 30) < 28, 200, 50).astype(np.uint8)
    frame = RgbdFrame(Header(1, 0, "camera"), np.dstack([image] * 3))
    assert len(PhaseHough(radius_px=(60, 80)).process(frame, Mask(image > 100))) == 0
    assert len(PhaseHough(radius_px=(20, 40)).process(frame, Mask(image > 100))) == 1


@pytest.mark.parametrize("limits", [(8, 38), (15, 20), (20, 22), (10, 12)])
def test_outlines_stay_within_a_tenth_of_the_range(limits: tuple[float, float]) -> None:
    for name in ("first-bed", "dense", "tilted"):
        frame = first(name)
        found = PhaseHough(radius_px=limits, min_score=0.2).process(frame, everything(frame))
        assert len(found)
        assert (found.radius >= 0.9 * limits[0]).all()
        assert (found.radius <= 1.12 * limits[1]).all()  # of equal area: ovals are a little larger


@pytest.mark.parametrize("dark", [False, True])
def test_height_is_not_turned_over_with_the_polarity(dark: bool) -> None:
    v, u = np.mgrid[:480, :640]
    caps = (u % 100 - 50) ** 2 + (v % 100 - 50) ** 2 < 35**2
    image = np.where(caps, 70, 170) if dark else np.where(caps, 170, 70)
    depth = np.where(caps, 475, 500).astype(np.uint16)
    camera = Camera(640, 480, 617, 617, 319.5, 239.5)
    color = np.dstack([image.astype(np.uint8)] * 3)
    frame = RgbdFrame(Header(1, 0, "camera"), color, depth, 0.001, camera)
    polarity = "dark" if dark else "bright"
    found = ChanVese(channel="gray+height", polarity=polarity).process(frame).foreground
    assert (found & caps).sum() / (found | caps).sum() > 0.97


@pytest.mark.parametrize("radius", [1.0, 2.0, 3.0])
def test_two_pixels_are_no_cap(radius: float) -> None:
    frame = first("first-bed")
    depth = np.zeros((480, 640), np.float32)
    depth[240, 320:322] = 0.5
    frame = replace(frame, depth=depth, depth_scale=1.0)
    circles = Circles(np.array([[320.3, 240.2]]), np.array([radius]), np.ones(1))
    located, pose, _ = CapFit().process(frame, circles)
    assert not pose.valid.any()
    assert (located.source == DepthSource.MISSING).all()


def test_a_tilt_that_nobody_knows_is_not_observable() -> None:
    frame = first("first-bed")
    circles = Circles(np.array([[320.0, 240.0]]), np.array([20.0]), np.ones(1))
    located = SurfaceFit().process(frame, circles)
    upright = np.array([[0.0, 0.0, -1.0]])
    for sigma, flagged in ((np.nan, True), (0.01, False), (2.0, True)):
        pose = Poses(
            np.array([[1.0, 0, 0, 0]]), upright, located.position.copy(), np.array([sigma]),
            np.ones(1), np.ones(1, bool),
        )  # fmt: skip
        picks = MakePicks().process(frame, circles, located, pose)
        assert bool(picks.flags[0] & PickFlag.TILT_UNOBSERVABLE) == flagged


def test_without_a_pose_there_is_no_tilt_to_speak_of() -> None:
    frame = first("first-bed")
    circles = Circles(np.array([[320.0, 240.0]]), np.array([20.0]), np.ones(1))
    picks = MakePicks().process(frame, circles, Locations.unknown(1), Poses.unknown(1))
    assert picks.flags[0] & PickFlag.POSE_UNKNOWN
    assert not picks.flags[0] & PickFlag.TILT_UNOBSERVABLE


def test_a_range_of_radii_that_no_image_shows_is_refused() -> None:
    with pytest.raises(ValidationError, match="is it in px"):
        CapNet(radius_px=(0.02, 0.06))
    assert CapNet(radius_px=(2, 10)).scaling(first("first-bed"))[0] == 3.5


def test_a_range_of_heights_has_a_lower_and_an_upper_end() -> None:
    with pytest.raises(ValidationError, match="min_mm must be less than max_mm"):
        Height(min_mm=200, max_mm=150)


@pytest.mark.parametrize(
    "lens",
    [
        ("none", ()),
        ("brown_conrady", (-0.2, 0.05, 0, 0, 0)),
        ("brown_conrady", (0.1, 0, 0, 0, 0)),
        ("inverse_brown_conrady", (0.13, 0.05, 0, 0, 0)),
    ],
)
def test_a_diameter_is_that_behind_the_lens(lens: tuple[str, tuple[float, ...]]) -> None:
    """25 degrees off the axis a lens may show a pixel a tenth larger or smaller."""
    camera = Camera(640, 480, 500, 500, 319.5, 239.5, *lens)
    one = cap(0, 0, (0.19, 0.12, 0.48), 0.022, 0.62)
    depth, luma = draw([one], 0.5, camera)
    v, u = np.nonzero(luma > 0.5)
    radius = np.sqrt(len(u) / np.pi)
    circles = Circles(np.array([[u.mean(), v.mean()]]), np.array([radius]), np.ones(1))
    color = np.dstack([(255 * luma).astype(np.uint8)] * 3)
    frame = RgbdFrame(Header(1, 0, "camera"), color, depth.astype(np.float32), 1.0, camera)
    found = SurfaceFit().process(frame, circles)
    assert 1000 * found.diameter[0] == pytest.approx(44, abs=1.2)
