"""The figures of the paper: what they show, against what was recorded."""

from __future__ import annotations

import warnings
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from typer.testing import CliRunner

from mushpipe import Camera, Circles, DepthSource, Locations, Mask, Trace
from mushpipe.cli import app
from mushpipe.core.errors import DependencyError, UsageError
from mushpipe.core.libraries import import_open3d
from mushpipe.figure import BLUE, RED, draw_diameter, draw_localization, draw_stages
from mushpipe.figure_pose import aligned, draw_pose
from mushpipe.stages.nearest_depth import NearestDepth
from tests.io.values import make_frame, make_picks, record, trace_of

NAN, ONES = float("nan"), np.ones(3)

try:
    import_open3d()
    reason = ""
except DependencyError as error:
    reason = str(error)
needs_open3d = pytest.mark.skipif(bool(reason), reason=reason)


def scene() -> Trace:
    """Two mushrooms, the second with a hole in the depth at its centre."""
    depth = np.full((24, 32), 4000, np.uint16)  # 0.5 m
    depth[11:14, 19:22] = 0
    frame = make_frame(0, depth=depth)
    camera = frame.camera
    assert camera is not None
    circles = Circles(np.array([[10.0, 5.0], [20.0, 12.0]]), np.array([4.0, 5.0]), np.ones(2))
    position = camera.deproject(circles.center, np.array([0.5, 0.5]))
    locations = Locations(
        position=position,
        distance=np.linalg.norm(position, axis=1),
        diameter=np.array([0.0412, NAN]),
        source=np.array([DepthSource.MEASURED, DepthSource.NEIGHBOURS]),
        sigma_position=np.full((2, 3), NAN),
        sigma_diameter=np.full(2, NAN),
    )
    mask = np.zeros((24, 32), bool)
    mask[4:9, 4:14] = True
    return trace_of(
        frame, segment=Mask(mask, ~mask), open=Mask(mask), detect=circles, locate=locations
    )


def texts(axes: object, color: str) -> list[str]:
    return [t.get_text() for t in axes.texts if t.get_color() == color]  # type: ignore[attr-defined]


def test_stages_show_each_step_and_a_cross_at_each_centre() -> None:
    figure = draw_stages(scene())
    titles = [axes.get_title() for axes in figure.axes if axes.get_title()]
    assert titles == [
        "(a) original",
        "(b) initial contour",
        "(c) mask of segment",
        "(d) mask of open",
        "(e) circles",
    ]
    circles = figure.axes[4]
    (crosses,) = (line for line in circles.lines if line.get_marker() == "+")
    np.testing.assert_array_equal(crosses.get_xydata(), [[10, 5], [20, 12]])
    assert figure.axes[2].images[0].get_array().sum() == 50
    # Nothing upside down: row 0 is at the top, and no circle widens the panel.
    assert circles.get_ylim() == (23.5, -0.5)


@pytest.mark.parametrize("shape", [(1, 1), (1, 9), (24, 32)])
@pytest.mark.parametrize("value", [False, True])
def test_a_mask_without_a_border_has_no_contour(shape: tuple[int, int], value: bool) -> None:
    mask = np.full(shape, value)
    frame = make_frame(color=np.zeros((*shape, 3), np.uint8), depth=None, camera=None)
    trace = trace_of(frame, segment=Mask(mask, mask), detect=Circles.unknown(0))
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        draw_stages(trace).canvas.draw()


def test_localization_shows_nan_before_and_the_estimate_after() -> None:
    before, after = draw_localization(scene()).axes
    d = [f"{v:.3f}" for v in scene().outputs["locate"][0].distance]
    assert texts(before, BLUE) == ["0.500", "NaN"]
    assert texts(before, RED) == [d[0], "NaN"]
    assert texts(after, BLUE) == ["0.500", "0.500"]
    assert texts(after, RED) == d


def test_locations_are_drawn_with_the_circles_they_are_of() -> None:
    trace = scene()
    more = Circles(np.full((3, 2), 9.0), np.ones(3), np.ones(3))
    # a detector below the localizer
    trace = replace(trace, outputs={**trace.outputs, "second": (more,)})
    diameters = draw_diameter(trace).axes[0]
    assert texts(diameters, RED) == ["41", "NaN"]
    with pytest.raises(UsageError, match="has 2 locations, and 3 circles above them"):
        draw_diameter(replace(trace, outputs={"d": (more,), "l": trace.outputs["locate"]}))


def test_every_panel_is_drawn() -> None:
    trace, mask = scene(), Mask(np.ones((24, 32), bool))
    masks = {f"m{i}": (mask,) for i in range(28)}
    figure = draw_stages(replace(trace, outputs={**masks, **trace.outputs}))
    titles = [axes.get_title() for axes in figure.axes if axes.get_title()]
    assert titles[25].startswith("(z) ")
    assert titles[-1] == f"({len(titles)}) circles"


def test_diameters_stand_at_the_centres_and_unknown_ones_say_so() -> None:
    (axes,) = draw_diameter(scene()).axes
    assert texts(axes, RED) == ["41", "NaN"]
    assert [t.xy for t in axes.texts] == [(10, 5), (20, 12)]


@pytest.mark.parametrize(("width", "height"), [(640, 480), (1920, 1080)])
def test_depth_and_distance_can_both_be_read(width: int, height: int) -> None:
    camera = Camera(width, height, 900.0, 900.0, width / 2, height / 2)
    depth = np.full((height, width), 500, np.uint16)
    frame = make_frame(
        color=np.zeros((height, width, 3), np.uint8), depth=depth, depth_scale=1e-3, camera=camera
    )
    # the last one's centre lies over the border
    circles = Circles(np.array([[300.0, 200], [90, 90], [500, -3]]), np.array([60.0, 8, 30]), ONES)
    locations = NearestDepth().process(frame, circles)
    figure = draw_localization(trace_of(frame, detect=circles, locate=locations))
    figure.canvas.draw()
    for axes in figure.axes:
        depths, distances = (
            [t.get_window_extent() for t in axes.texts if t.get_color() == color]
            for color in (BLUE, RED)
        )
        for upper, lower in zip(depths, distances, strict=True):
            assert upper.y0 >= lower.y1 - 1


def dome() -> Trace:
    """One mushroom, a half ball of 20 mm, in the middle of a small image at half a metre."""
    camera = Camera(96, 72, 600.0, 600.0, 47.5, 35.5)
    v, u = np.mgrid[:72, :96]
    square = ((u - 47.5) / 600 * 0.5) ** 2 + ((v - 35.5) / 600 * 0.5) ** 2
    depth = 0.5 - np.sqrt(np.maximum(0, 0.02**2 - square))
    frame = make_frame(
        color=np.full((72, 96, 3), 90, np.uint8),
        depth=depth.astype(np.float32),
        depth_scale=1.0,
        camera=camera,
    )
    circles = Circles(np.array([[47.5, 35.5]]), np.array([24.0]), np.ones(1))
    locations = Locations(
        position=np.array([[0, 0, 0.48]]),
        distance=np.array([0.48]),
        diameter=np.array([0.04]),
        source=np.array([DepthSource.MEASURED]),
        sigma_position=np.full((1, 3), NAN),
        sigma_diameter=np.full(1, NAN),
    )
    return trace_of(frame, detect=circles, locate=locations)


@needs_open3d
def test_pose_shows_the_model_before_and_after_beside_the_same_sample() -> None:
    before, after = draw_pose(
        aligned(dome(), {"model": "cap", "global": "none", "up": (0, 0, -1)})
    ).axes
    (model, sample), (moved, same) = before.collections, after.collections
    for a, b in zip(sample._offsets3d, same._offsets3d, strict=True):
        np.testing.assert_array_equal(a, b)
    assert any((a != b).any() for a, b in zip(model._offsets3d, moved._offsets3d, strict=True))
    # Up in the picture is towards the camera: the smaller z.
    low, high = before.get_zlim()
    assert low > high
    # The sample is the half ball, 40 mm across and at most 20 mm high.
    x, y, z = (np.ptp(np.asarray(offsets)) for offsets in sample._offsets3d)
    assert 35 < x < 41
    assert 35 < y < 41
    assert 10 < z < 21
    with pytest.raises(UsageError, match="no mushroom has enough depth"):
        aligned(dome(), {"min_points": 10_000})


def twice() -> Trace:
    """The mushroom of `dome` by two circles: the better one is smaller, and sees less of it."""
    trace = dome()
    (circles,), (locations,) = trace.outputs["detect"], trace.outputs["locate"]
    both = Circles(circles.center.repeat(2, axis=0), np.array([24.0, 16.0]), np.array([0.8, 0.9]))
    return trace_of(trace.frame, detect=both, locate=locations.take(np.array([0, 0])))


def picked(trace: Trace) -> Trace:
    """The same with picks: 8 is the first circle, 7 the second."""
    circles = trace.outputs["detect"][0].take(np.array([1, 0]))
    picks = replace(make_picks(), center=circles.center, radius=circles.radius)
    return replace(trace, outputs={**trace.outputs, "pick": (picks,)})


def drawn_poses(trace: Trace, chosen: int | None = None) -> dict[str, float]:
    """Return the titles before registration, with the width of the sample below, mm."""
    settings = {"model": "cap", "global": "none", "up": (0, 0, -1)}
    panels = draw_pose(aligned(trace, settings, chosen)).axes
    widths = [float(np.ptp(np.asarray(axes.collections[1]._offsets3d[0]))) for axes in panels]
    found = {axes.get_title(): width for axes, width in zip(panels, widths, strict=True)}
    return {title: width for title, width in found.items() if title.endswith(", before")}


@needs_open3d
def test_a_pose_is_that_of_the_mushroom_that_was_chosen() -> None:
    narrow, wide = drawn_poses(twice()).values()
    assert narrow < wide
    assert [*drawn_poses(twice())] == ["(a1) row 1, before", "(a2) row 0, before"]
    assert [*drawn_poses(picked(twice()))] == ["(a1) pick 7, before", "(a2) pick 8, before"]
    assert drawn_poses(twice(), 0) == {"(a1) row 0, before": wide}
    assert drawn_poses(picked(twice()), 7) == {"(a1) pick 7, before": narrow}
    assert drawn_poses(picked(twice()), 8) == {"(a1) pick 8, before": wide}


@needs_open3d
def test_a_mushroom_that_is_not_there_or_has_no_pose_is_named() -> None:
    trace = picked(twice())
    with pytest.raises(UsageError, match="frame 10 has no row 2; those it has: 0, 1"):
        aligned(twice(), {}, 2)
    with pytest.raises(UsageError, match="frame 10 has no pick 0; those it has: 7, 8"):
        aligned(trace, {}, 0)
    with pytest.raises(UsageError, match="frame 10: pick 8 has not enough depth"):
        aligned(trace, {"min_points": 10_000}, 8)
    empty = {"detect": Circles([], [], []), "locate": Locations.unknown(0)}
    with pytest.raises(UsageError, match="frame 10: no mushroom was found there"):
        aligned(trace_of(trace.frame, **empty), {})


def test_what_is_missing_is_named(tmp_path: Path) -> None:
    trace = trace_of(make_frame(0))
    with pytest.raises(UsageError, match="frame 10 has no Circles"):
        draw_stages(trace)
    results = {name: scene().outputs[name] for name in ("detect", "locate")}
    colour_only = trace_of(make_frame(0, depth=None, camera=None), **results)
    with pytest.raises(UsageError, match="frame 10 has no depth"):
        draw_localization(colour_only)
    with pytest.raises(UsageError, match="frame 10 has no depth"):
        aligned(colour_only, {})


def test_the_command_writes_an_image(tmp_path: Path) -> None:
    results = record(tmp_path / "out.mcap", [scene()])
    for kind in ("stages", "localization", "diameter"):
        out = tmp_path / f"{kind}.png"
        command = ["figure", str(results), "--frame", "10", "--kind", kind, "-o", str(out)]
        assert CliRunner().invoke(app, command).exit_code == 0
        image = cv2.imread(str(out))
        assert image is not None
        assert image.std() > 10
    wrong = CliRunner().invoke(app, [*command, "--id", "0"])
    assert "--id 0: only --kind pose" in str(wrong.exception)
    wrong = CliRunner().invoke(app, ["figure", str(results), "--frame", "10", "-o", "a.xyz"])
    assert isinstance(wrong.exception, UsageError)
    bare = tmp_path / "stages"
    wrong = CliRunner().invoke(app, ["figure", str(results), "--frame", "10", "-o", str(bare)])
    assert isinstance(wrong.exception, UsageError)
    assert str(wrong.exception).endswith(f"expected the kind of image in its name: {bare}.png, say")
