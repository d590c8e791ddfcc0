"""What is written to Rerun once: how what frames show looks, and what holds for the whole run."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from contextlib import suppress
from itertools import cycle
from typing import Any

import numpy as np
from pydantic import ValidationError

from mushpipe.core.scene import CYAN, GREEN
from mushpipe.core.transform import Transform
from mushpipe.robot.targets import Workspace
from mushpipe.sinks import rerun_layout as at

_WHEEL = ((230, 159, 0), (86, 180, 233), (0, 158, 115), (240, 228, 66), (213, 94, 0),
          (204, 121, 167), (150, 150, 255), (190, 190, 190))  # fmt: skip
_COUNTS = {"found": (200, 200, 200), "located": GREEN, "oriented": (80, 160, 255)}
_WHITE = (255, 255, 255)
_CLASSES = {
    at.MASKS: ("mushroom", (70, 150, 255, 255)),
    at.INITIAL: ("initial", (255, 150, 30, 255)),
    at.HOLES: ("no depth", (255, 40, 40, 255)),
}


def log_start(rec: Any, box: tuple[Any, Any] | None, base: Transform | None) -> None:
    """Log what holds for the whole run: directions, looks, workspace (m), T_base_camera."""
    import rerun as rr

    # Seen from above: x to the right, y (down in the image) towards the viewer, z down.
    rec.log(at.CAMERA, rr.ViewCoordinates.RBD, static=True)
    _draw_series(rec, at.COUNTS, _COUNTS)
    _draw_series(rec, f"{at.VALIDITY}/valid", {"valid": (255, 120, 200)})
    place = at.CAMERA if base is None else at.BASE  # where picks will be
    if base is not None:  # T_base_camera takes what is below the camera to what is below the base
        pose = rr.Transform3D(
            translation=base.translation,
            quaternion=rr.Quaternion(xyzw=base.quaternion),
            relation=rr.TransformRelation.ChildFromParent,
        )
        rec.log(place, pose, static=True)
    _draw_space(rec, place)
    if box is not None:
        low, high = np.array(box)
        shown = rr.Boxes3D(
            mins=[low],
            sizes=[high - low],
            colors=_WHITE,
            labels=["workspace"],
            fill_mode="majorwireframe",  # a filled box would lie over the cloud
        )
        rec.log(f"{place}/{at.WORKSPACE}", shown, static=True)


def workspace_of(graph: Mapping[str, Any]) -> tuple[Any, Any] | None:
    """Return the corners of a robot's workspace, which is in the frame of the picks."""
    for sink in graph.get("sinks", {}).values():
        with suppress(ValidationError):  # another plugin's setting of that name, or None
            box = Workspace.model_validate(sink.get("workspace"))
            return box.low, box.high
    return None


def log_layers(rec: Any, layers: Sequence[str], stages: Sequence[str]) -> None:
    """Log how layers of the image look, and the names and colours of the stages in the plot."""
    import rerun as rr

    if stages:
        _draw_series(rec, at.TIMES, dict(zip(stages, cycle(_WHEEL), strict=False)))
    for entity in (*layers, at.HOLES):
        for prefix, style in _CLASSES.items():
            if entity.startswith(prefix):
                context = rr.AnnotationContext([(0, "", (0, 0, 0, 0)), (1, *style)])
                rec.log(entity, context, static=True)
        if entity.startswith(at.CIRCLES):
            rec.log(entity, rr.Ellipses2D.from_fields(colors=CYAN, draw_order=30), static=True)
    rec.log(at.PICKS, rr.Ellipses2D.from_fields(draw_order=30), static=True)
    ids = rr.Points2D.from_fields(radii=0.5, colors=_WHITE, show_labels=True, draw_order=40)
    rec.log(at.IDS, ids, static=True)


def _draw_series(rec: Any, entity: str, lines: Mapping[str, tuple[int, int, int]]) -> None:
    """Draw series as lines with dots, so that a single frame shows as well."""
    import rerun as rr

    style: dict[str, Any] = {"names": [*lines], "colors": [*lines.values()]}
    rec.log(entity, rr.SeriesLines(**style), static=True)
    rec.log(entity, rr.SeriesPoints(**style, marker_sizes=[3] * len(lines)), static=True)


def _draw_space(rec: Any, place: str) -> None:
    """Log how picks, their order and their caps look below an entity."""
    import rerun as rr

    looks = {
        at.TARGETS: rr.Points3D.from_fields(radii=0.002),
        at.ORDER: rr.Points3D.from_fields(radii=0.003, colors=_WHITE),
        at.CAPS: rr.Ellipsoids3D.from_fields(fill_mode="solid"),
        at.AXES: rr.Arrows3D.from_fields(radii=0.0012),
    }
    for name, look in looks.items():
        rec.log(f"{place}/{name}", look, static=True)
