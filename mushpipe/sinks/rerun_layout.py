"""How the Rerun viewer shows a run: one tab with switchable layers, space, plots and the log."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

CAMERA = "camera"
IMAGE = f"{CAMERA}/image"
# layers of the image by what a stage puts out, in the order in which they are drawn
FRAMES, INITIAL, MASKS = f"{IMAGE}/frames", f"{IMAGE}/initial", f"{IMAGE}/masks"
CIRCLES, PICKS, IDS = f"{IMAGE}/circles", f"{IMAGE}/picks", f"{IMAGE}/ids"
COLOR, DEPTH, HOLES = f"{IMAGE}/color", f"{IMAGE}/depth", f"{IMAGE}/holes"
CLOUD, BASE = f"{CAMERA}/cloud", f"{CAMERA}/base"
# in space, below the camera or below the robot's base, by the frame of the picks
SPACE = CAPS, AXES, TARGETS, ORDER, WORKSPACE = "caps", "axes", "picks", "order", "workspace"
COUNTS, TIMES, VALIDITY, LOG = "plots/count", "plots/time", "plots/depth", "log"
MOMENTS = ("plots/", LOG)  # what stands at a frame alone
HIDDEN_AT_FIRST = (FRAMES, INITIAL, CIRCLES)
NARROW = 0.55  # half the width of a bed, in distances, that is seen whole from 0.94 distances away


def layout(
    layers: Sequence[str], stages: Sequence[str], distance: float | None, spread: float
) -> Any:
    """Return the blueprint of a run.

    Args:
        layers: Entities of the image that the run's stages fill, in drawing order. Of the masks
            the last is shown; every layer can be switched in the panel at the left.
        stages: Whose time is plotted; none for a recording that is only looked at.
        distance: From the camera to the bed, m, for the first look from the side; None where
            there is no depth, and so nothing to show in space.
        spread: Half the width that the camera sees, in distances.
    """
    import rerun.blueprint as rrb

    plots = []
    if PICKS in layers:
        plots.append(rrb.TimeSeriesView(origin=COUNTS, name="Mushrooms"))
    if stages:
        plots.append(rrb.TimeSeriesView(origin=TIMES, name="Time per stage, ms"))
    right = [rrb.TextLogView(origin=LOG, name="Log")]
    if distance is not None:
        plots.append(rrb.TimeSeriesView(origin=VALIDITY, name="Depth valid, %"))
        holes = rrb.Spatial2DView(origin=IMAGE, name="Depth, holes red", contents=[DEPTH, HOLES])
        right = [_space_view(distance, spread), holes, *right]
    left = _image_view(layers)
    if plots:
        left = rrb.Vertical(left, rrb.Horizontal(*plots), row_shares=[3, 1])
    return rrb.Blueprint(
        rrb.Horizontal(
            left, rrb.Vertical(*right, row_shares=[3, 2, 1][: len(right)]), column_shares=[3, 2]
        ),
        rrb.TimePanel(state="collapsed", timeline="frame"),
        rrb.SelectionPanel(state="collapsed"),
        rrb.BlueprintPanel(state="expanded"),
    )


def _image_view(layers: Sequence[str]) -> Any:
    import rerun.blueprint as rrb

    masks = [layer for layer in layers if layer.startswith(MASKS)]
    hidden = [layer for layer in layers if layer.startswith(HIDDEN_AT_FIRST)] + masks[:-1]
    if PICKS not in layers:  # the circles are all there is
        hidden = [layer for layer in hidden if not layer.startswith(CIRCLES)]
    return rrb.Spatial2DView(
        origin=IMAGE,
        name="Image",
        contents=[COLOR, *layers],
        overrides={layer: rrb.EntityBehavior(visible=False) for layer in hidden},
    )


def _space_view(distance: float, spread: float) -> Any:
    import rerun.blueprint as rrb

    middle = np.array([0.0, 0.04, 1.0])
    eye = middle + np.array([0.0, 0.56, -0.75]) * max(1.0, spread / NARROW)
    return rrb.Spatial3DView(
        origin=CAMERA,
        name="Bed",
        contents=[IMAGE, CLOUD, *(f"{CAMERA}/{name}" for name in SPACE), f"{BASE}/**"],
        eye_controls=rrb.EyeControls3D(
            position=distance * eye,
            look_target=distance * middle,
            eye_up=(0.0, 0.0, -1.0),
        ),
        line_grid=False,
        background=(24, 26, 30),
    )
