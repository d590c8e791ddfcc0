"""Registrations for the Rerun viewer: model and sample of each mushroom, before and after."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from mushpipe.core.errors import UsageError

if TYPE_CHECKING:
    from mushpipe.stages.registration import Alignment

RED, BLUE, WHITE = (224, 32, 32), (60, 110, 255), (255, 255, 255)
WHEN = ("before", "after")


def write_clouds(path: Path, alignments: list[tuple[str, Alignment]]) -> None:
    """Write the clouds of registered mushrooms, m, in the camera's frame; one view for each.

    Args:
        path: The .rrd file.
        alignments: With the names of the mushrooms.

    Raises:
        UsageError: It cannot be written.
    """
    import rerun as rr
    import rerun.blueprint as rrb

    rows = [[_view(name, each, when) for name, each in alignments] for when in WHEN]
    blueprint = rrb.Blueprint(
        rrb.Vertical(*(rrb.Horizontal(*row) for row in rows)), collapse_panels=True
    )
    recording = rr.RecordingStream("mushpipe")
    try:
        recording.save(path, default_blueprint=blueprint)
    except (OSError, RuntimeError) as error:
        reason = getattr(error, "strerror", None) or error
        raise UsageError(f"{path}: cannot be written: {reason}") from error
    for name, each in alignments:
        _log(recording, name, each)
    recording.disconnect()


def _log(recording: Any, name: str, alignment: Alignment) -> None:
    import rerun as rr

    reach = alignment.reach
    for part, color in (("sample", BLUE), ("before", RED), ("after", RED)):
        points = rr.Points3D(getattr(alignment, part), colors=color, radii=0.015 * reach)
        recording.log([name, part], points, static=True)
    arrow = 0.5 * reach * alignment.axis
    axis = rr.Arrows3D(origins=alignment.apex, vectors=arrow, colors=WHITE)
    recording.log([name, "axis"], axis, static=True)


def _view(name: str, alignment: Alignment, when: str) -> Any:
    import rerun as rr
    import rerun.blueprint as rrb

    middle = alignment.middle
    parts = ["sample", when] + ["axis"] * (when == "after")
    # z of the optical frame points down, onto the bed
    return rrb.Spatial3DView(
        origin="/",
        name=f"{name}, {when}",
        contents=[rr.new_entity_path([name, part]) for part in parts],
        eye_controls=rrb.EyeControls3D(
            position=middle + 2 * alignment.reach * np.array([0.0, 0.8, -0.6]),
            look_target=middle,
            eye_up=(0.0, 0.0, -1.0),
        ),
        line_grid=False,
    )
