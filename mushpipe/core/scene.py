"""Circles and picks as viewers draw them: foxglove.ImageAnnotations and foxglove.SceneUpdate."""

from __future__ import annotations

from collections.abc import Iterator
from functools import cache
from typing import Any

import foxglove.messages as fox
import numpy as np

from mushpipe.core.arrays import Bytes, Floats, Rows
from mushpipe.core.tables import Circles, PickFlag, Picks
from mushpipe.core.types import Header
from mushpipe.core.wire import Message, foxglove_schema, timestamp

# A pick does not carry the height of its dome; caps are drawn with this one, in radii.
DOME = 0.6
CORNER = 0.5  # viewers count px from the corner of the first pixel, mushpipe from its centre
FULL_SIGMA = np.radians(20)  # tilt uncertainty that is drawn fully red
CROWD = 40  # more mushrooms than this, and only their ids fit
RED, AMBER, GREEN, CYAN = (255, 70, 70), (255, 190, 40), (60, 220, 90), (0, 200, 255)
SOURCE_COLORS = np.array([RED, GREEN, AMBER], np.uint8)  # by DepthSource


def in_order(picks: Picks) -> Rows:
    """Return the rows of the picks that have a position, in the order in which to pick."""
    return np.flatnonzero(~picks.missing)


def posed(picks: Picks, rows: Rows) -> Rows:
    """Return those of the rows that can be drawn as a cap: pose and diameter are known."""
    flagged = (picks.flags[rows] & PickFlag.POSE_UNKNOWN) != 0
    pose = np.column_stack([picks.axis[rows], picks.quaternion[rows], picks.diameter[rows]])
    known = np.isfinite(pose).all(axis=1)
    return np.asarray(rows[known & ~flagged])


def tints(sigma: Floats) -> Bytes:
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


@cache
def _color(rgb: tuple[int, int, int], alpha: float = 1.0) -> fox.Color:
    r, g, b = rgb
    return fox.Color(r=r / 255, g=g / 255, b=b / 255, a=alpha)


def _colors(table: Bytes, alpha: float = 1.0) -> list[fox.Color]:
    return [_color((r, g, b), alpha) for r, g, b in table.tolist()]


def image_annotations(table: Circles | Picks, header: Header) -> bytes:
    """Encode circles, and the labels of picks, as foxglove.ImageAnnotations."""
    picks = table if isinstance(table, Picks) else None
    plain = [_color(CYAN)] * len(table)
    colors = plain if picks is None else _colors(SOURCE_COLORS[picks.source])
    places = [fox.Point2(x=x, y=y) for x, y in (table.center + CORNER).tolist()]
    circles = [
        fox.CircleAnnotation(position=place, diameter=size, thickness=2, outline_color=color)
        for place, size, color in zip(places, (2 * table.radius).tolist(), colors, strict=True)
    ]
    white, shade = _color((255, 255, 255)), _color((0, 0, 0), 0.5)
    texts = [
        fox.TextAnnotation(
            position=place, text=text, font_size=12, text_color=white, background_color=shade
        )
        for place, text in zip(places, [] if picks is None else labels(picks), strict=False)
    ]
    stamp = timestamp(header.stamp_ns)
    return fox.ImageAnnotations(timestamp=stamp, circles=circles, texts=texts).encode()


def scene_update(picks: Picks, header: Header) -> bytes:
    """Encode caps, their axes and the order of the picks as one entity of a foxglove.SceneUpdate.

    An entity replaces the one before it, so a frame without picks clears the scene.
    """
    rows = in_order(picks)
    caps = posed(picks, rows)
    entity = fox.SceneEntity(
        timestamp=timestamp(header.stamp_ns),
        frame_id=picks.frame_id or header.frame_id,
        id="picks",
        spheres=_spheres(picks, caps),
        arrows=_arrows(picks, caps),
        texts=_ranks(picks, rows),
    )
    return fox.SceneUpdate(entities=[entity]).encode()


def _spheres(picks: Picks, rows: Rows) -> list[fox.SpherePrimitive]:
    centers = picks.position[rows] - DOME / 2 * picks.diameter[rows, None] * picks.axis[rows]
    parts = zip(
        _poses(centers, picks.quaternion[rows]),
        picks.diameter[rows].tolist(),
        _colors(tints(picks.sigma_tilt[rows]), 0.4),
        strict=True,
    )
    return [
        fox.SpherePrimitive(pose=pose, size=fox.Vector3(x=d, y=d, z=DOME * d), color=color)
        for pose, d, color in parts
    ]


def _arrows(picks: Picks, rows: Rows) -> list[fox.ArrowPrimitive]:
    from scipy.spatial.transform import Rotation

    if not len(rows):
        return []
    # An arrow points along +x of its pose, the axis of a cap along +z.
    turn = Rotation.from_euler("y", -90, degrees=True)
    parts = zip(
        _poses(picks.position[rows], (Rotation.from_quat(picks.quaternion[rows]) * turn).as_quat()),
        picks.diameter[rows].tolist(),
        _colors(tints(picks.sigma_tilt[rows])),
        strict=True,
    )
    return [
        fox.ArrowPrimitive(
            pose=pose,
            shaft_length=0.35 * d,
            shaft_diameter=0.002,
            head_length=0.15 * d,
            head_diameter=0.004,
            color=color,
        )
        for pose, d, color in parts
    ]


def _ranks(picks: Picks, rows: Rows) -> list[fox.TextPrimitive]:
    upright = np.tile([0.0, 0.0, 0.0, 1.0], (len(rows), 1))
    return [
        fox.TextPrimitive(
            pose=pose,
            billboard=True,
            font_size=12,
            scale_invariant=True,
            color=_color((255, 255, 255)),
            text=str(rank),
        )
        for rank, pose in enumerate(_poses(picks.position[rows], upright), start=1)
    ]


def _poses(positions: Floats, quaternions: Floats) -> list[fox.Pose]:
    return [
        fox.Pose(
            position=fox.Vector3(x=x, y=y, z=z),
            orientation=fox.Quaternion(x=qx, y=qy, z=qz, w=qw),
        )
        for (x, y, z), (qx, qy, qz, qw) in zip(
            positions.tolist(), quaternions.tolist(), strict=True
        )
    ]
