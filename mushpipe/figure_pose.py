"""The paper's figures before and after a registration, of mushrooms of a result recording."""

from __future__ import annotations

from collections.abc import Mapping
from itertools import islice
from typing import TYPE_CHECKING, Any

import numpy as np

from mushpipe.core.errors import UsageError
from mushpipe.core.tables import Circles, Picks
from mushpipe.core.types import RgbdFrame, Trace
from mushpipe.figure import BLUE, DPI, PANEL_IN, RED, depth_m_of, located

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from mushpipe.stages.registration import Alignment

POSES = 3  # mushrooms


def aligned(
    trace: Trace, settings: Mapping[str, Any], chosen: int | None = None
) -> list[tuple[str, Alignment]]:
    """Register mushrooms of a frame anew; return them with their names.

    Args:
        trace: The frame.
        settings: Of the stage `registration`.
        chosen: Id of the mushroom's pick; without picks its row among the circles. None takes
            those of the best circles, up to `POSES`.

    Raises:
        UsageError: The frame has no depth, no circles, no locations, no such mushroom, or none that
            can be registered.
        DependencyError: open3d or a library of the system is missing.
    """
    from mushpipe.stages.registration import Registration

    circles, locations = located(trace)
    stage = Registration.model_validate(dict(settings))
    # the frame that the stage got, where the recording has it: its depth may have been corrected
    frame = ([trace.frame] + [value for _, value in trace.of(RgbdFrame)])[-1]
    depth_m_of(frame)
    kind, rows = _by_number(trace, circles)
    best = np.argsort(-circles.score, kind="stable").tolist()
    tried = best if chosen is None else [_row(frame, kind, rows, chosen)]
    names = {row: f"row {row}" for row in tried} | {row: f"{kind} {n}" for n, row in rows.items()}
    tries = ((names[row], stage.align(frame, circles, locations, row, 0)) for row in tried)
    found = list(islice(((name, each) for name, each in tries if each is not None), POSES))
    if not found:
        number = trace.frame.header.sequence
        if not len(circles):
            raise UsageError(f"frame {number}: no mushroom was found there; choose another frame")
        which = "no mushroom has" if chosen is None else f"{kind} {chosen} has not"
        raise UsageError(f"frame {number}: {which} enough depth, or the model ran away")
    return found


def draw_pose(alignments: list[tuple[str, Alignment]]) -> Figure:
    """Draw model (red) and sample (blue) before and after registration, seen from the side."""
    from matplotlib.figure import Figure

    n = len(alignments)
    figure = Figure(figsize=(0.75 * PANEL_IN * n, 1.5 * PANEL_IN), dpi=DPI, layout="constrained")
    panels = figure.subplots(2, n, subplot_kw={"projection": "3d"}, squeeze=False)
    for column, (name, alignment) in enumerate(alignments):
        clouds = (alignment.before, alignment.after)
        middle, reach = alignment.middle, 1e3 * alignment.reach
        for row, (model, when) in enumerate(zip(clouds, ("before", "after"), strict=True)):
            axes = panels[row, column]
            for cloud, color, size, alpha in (
                (model, RED, 2, 0.35),
                (alignment.sample, BLUE, 5, 1.0),
            ):
                x, y, z = 1e3 * (cloud - middle).T
                axes.scatter(x, y, z, s=size, color=color, alpha=alpha, depthshade=False)
            # z of the optical frame points down, onto the bed
            axes.set(xlim=(-reach, reach), ylim=(-reach, reach), zlim=(reach, -reach))
            for letter in "xyz":
                getattr(axes, f"set_{letter}label")(f"{letter}, mm", fontsize=7, labelpad=-6)
            axes.view_init(elev=12, azim=-60)
            axes.tick_params(labelsize=6, pad=-3)
            axes.set_box_aspect((1, 1, 1), zoom=0.95)
            axes.set_title(f"({'ab'[row]}{column + 1}) {name}, {when}", fontsize=9)
    return figure


def _by_number(trace: Trace, circles: Circles) -> tuple[str, dict[int, int]]:
    """Return what mushrooms are known by, ids of picks or else rows, and each one's row by that."""
    picks = [value for _, value in trace.of(Picks)]
    if not picks:
        return "row", {row: row for row in range(len(circles))}
    same = (circles.center[:, None] == picks[-1].center).all(axis=2)
    rows, places = np.nonzero(same & (circles.radius[:, None] == picks[-1].radius))
    return "pick", dict(zip(picks[-1].id[places].tolist(), rows.tolist(), strict=True))


def _row(frame: RgbdFrame, kind: str, rows: Mapping[int, int], chosen: int) -> int:
    if chosen not in rows:
        known = ", ".join(map(str, sorted(rows))) or "none"
        there = f"frame {frame.header.sequence} has no {kind} {chosen}; those it has: {known}"
        raise UsageError(f"--id {chosen}: {there}")
    return rows[chosen]
