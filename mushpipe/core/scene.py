"""Circles and picks as viewers draw them: foxglove.ImageAnnotations and foxglove.SceneUpdate."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mushpipe.core.tables import Circles, DepthSource, PickFlag, Picks
from mushpipe.core.types import Header
from mushpipe.core.wire import Message, foxglove_schema, timestamp

# A pick does not carry the height of its dome; caps are drawn with this one, in radii.
DOME = 0.6
FULL_SIGMA = np.radians(20)  # tilt uncertainty that is drawn fully red
CROWD = 40  # more mushrooms than this, and only their ids fit
RED, AMBER, GREEN, CYAN = (255, 70, 70), (255, 190, 40), (60, 220, 90), (0, 200, 255)
SOURCE_COLORS = np.array([RED, GREEN, AMBER], np.uint8)  # by DepthSource


def in_order(picks: Picks) -> NDArray[np.intp]:
    """Return the rows of the picks that have a position, in the order in which to pick."""
    return np.flatnonzero(picks.source != DepthSource.MISSING)


def posed(picks: Picks, rows: NDArray[np.intp]) -> NDArray[np.intp]:
    """Return those of the rows that can be drawn as a cap: pose and diameter are known."""
    flagged = (picks.flags[rows] & PickFlag.POSE_UNKNOWN) != 0
    pose = np.column_stack([picks.axis[rows], picks.quaternion[rows], picks.diameter[rows]])
    known = np.isfinite(pose).all(axis=1)
    return np.asarray(rows[known & ~flagged])


def tints(sigma: NDArray[np.float64]) -> NDArray[np.uint8]:
    """Return (N, 3) colours: green is a certain tilt, red an uncertain one, grey an unknown one."""
    share = np.clip(np.nan_to_num(sigma), 0, FULL_SIGMA)[:, None] / FULL_SIGMA
    mixed = (1 - share) * np.array(GREEN) + share * np.array(RED)
    mixed[np.isnan(sigma)] = 160
    return np.asarray(mixed, np.uint8)


def labels(picks: Picks) -> list[str]:
    """Return per pick its id and, where there is room, its diameter."""
    if len(picks) > CROWD:
        return [str(i) for i in picks.id]
    sizes = (f"{1000 * d:.0f} mm" if np.isfinite(d) else "size unknown" for d in picks.diameter)
    return [f"{i}: {size}" for i, size in zip(picks.id, sizes, strict=True)]


def drawings(value: Any, header: Header) -> Iterator[Message]:
    """Yield how viewers draw a stage's output; nothing but circles and picks needs drawing."""
    if isinstance(value, Circles | Picks):
        data = image_annotations(value, header)
        yield Message("/annotations", foxglove_schema("ImageAnnotations"), data)
    if isinstance(value, Picks):
        yield Message("/scene", foxglove_schema("SceneUpdate"), scene_update(value, header))


def _color(rgb: Any, alpha: float = 1.0) -> Any:
    from foxglove.messages import Color

    r, g, b = (float(value) / 255 for value in rgb)
    return Color(r=r, g=g, b=b, a=alpha)


def image_annotations(table: Circles | Picks, header: Header) -> bytes:
    """Encode circles, and the labels of picks, as foxglove.ImageAnnotations.

    Foxglove counts pixels from the corner of the first one, mushpipe from its centre.
    """
    from foxglove.messages import CircleAnnotation, ImageAnnotations, Point2, TextAnnotation

    picks = table if isinstance(table, Picks) else None
    colors = [CYAN] * len(table) if picks is None else SOURCE_COLORS[picks.source]
    places = [Point2(x=float(x) + 0.5, y=float(y) + 0.5) for x, y in table.center]
    circles = [
        CircleAnnotation(
            position=place, diameter=2 * float(radius), thickness=2, outline_color=_color(color)
        )
        for place, radius, color in zip(places, table.radius, colors, strict=True)
    ]
    white, shade = _color((255, 255, 255)), _color((0, 0, 0), 0.5)
    texts = [
        TextAnnotation(
            position=place, text=text, font_size=12, text_color=white, background_color=shade
        )
        for place, text in zip(places, [] if picks is None else labels(picks), strict=False)
    ]
    message = ImageAnnotations(timestamp=timestamp(header.stamp_ns), circles=circles, texts=texts)
    return bytes(message.encode())


def scene_update(picks: Picks, header: Header) -> bytes:
    """Encode caps, their axes and the order of the picks as one entity of a foxglove.SceneUpdate.

    An entity replaces the one before it, so a frame without picks clears the scene.
    """
    from foxglove.messages import SceneEntity, SceneUpdate

    rows = in_order(picks)
    caps = posed(picks, rows)
    entity = SceneEntity(
        timestamp=timestamp(header.stamp_ns),
        frame_id=picks.frame_id or header.frame_id,
        id="picks",
        spheres=_spheres(picks, caps),
        arrows=_arrows(picks, caps),
        texts=_ranks(picks, rows),
    )
    return bytes(SceneUpdate(entities=[entity]).encode())


def _spheres(picks: Picks, rows: NDArray[np.intp]) -> list[Any]:
    from foxglove.messages import SpherePrimitive, Vector3

    centers = picks.position[rows] - DOME / 2 * picks.diameter[rows, None] * picks.axis[rows]
    parts = zip(
        centers, picks.quaternion[rows], picks.diameter[rows], tints(picks.sigma_tilt[rows]),
        strict=True,
    )  # fmt: skip
    return [
        SpherePrimitive(
            pose=_pose(center, quaternion),
            size=Vector3(x=float(d), y=float(d), z=float(DOME * d)),
            color=_color(tint, 0.4),
        )
        for center, quaternion, d, tint in parts
    ]


def _arrows(picks: Picks, rows: NDArray[np.intp]) -> list[Any]:
    from foxglove.messages import ArrowPrimitive
    from scipy.spatial.transform import Rotation

    if not len(rows):
        return []
    # An arrow points along +x of its pose, the axis of a cap along +z.
    turn = Rotation.from_euler("y", -90, degrees=True)
    quaternions = (Rotation.from_quat(picks.quaternion[rows]) * turn).as_quat()
    parts = zip(
        picks.position[rows], quaternions, picks.diameter[rows], tints(picks.sigma_tilt[rows]),
        strict=True,
    )  # fmt: skip
    return [
        ArrowPrimitive(
            pose=_pose(apex, quaternion),
            shaft_length=0.35 * float(d),
            shaft_diameter=0.002,
            head_length=0.15 * float(d),
            head_diameter=0.004,
            color=_color(tint),
        )
        for apex, quaternion, d, tint in parts
    ]


def _ranks(picks: Picks, rows: NDArray[np.intp]) -> list[Any]:
    from foxglove.messages import TextPrimitive

    upright = np.array([0.0, 0.0, 0.0, 1.0])
    return [
        TextPrimitive(
            pose=_pose(picks.position[row], upright),
            billboard=True,
            font_size=12,
            scale_invariant=True,
            color=_color((255, 255, 255)),
            text=str(rank + 1),
        )
        for rank, row in enumerate(rows)
    ]


def _pose(position: Any, quaternion: Any) -> Any:
    from foxglove.messages import Pose, Quaternion, Vector3

    (x, y, z), (qx, qy, qz, qw) = map(float, position), map(float, quaternion)
    return Pose(position=Vector3(x=x, y=y, z=z), orientation=Quaternion(x=qx, y=qy, z=qz, w=qw))
