"""Labels as JSON: the project's own format, and a converter from three that are found in the wild.

`docs/evaluation.md` describes the format. Everything but the circle is optional.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Annotated, Any, Literal

import numpy as np
from pydantic import BaseModel, ConfigDict, Field, field_validator, model_validator

from mushpipe.core.arrays import Floats
from mushpipe.core.truth import Ignore, Truth

Json = dict[str, Any]
Vector = Annotated[list[float], Field(min_length=3, max_length=3)]
Reason = Literal[
    "hidden", "too-small", "too-large", "at-border", "not-upright", "cut-stump", "ambiguous"
]
EXAMPLE = (
    '{"mushpipe_labels": 1, "frames": [{"index": 0, "caps": '
    '[{"u": 320.5, "v": 201.0, "radius_px": 24.5}]}]}'
)
FARTHEST_M = 20.0  # of a cap from its camera
SHORTEST = 1e-6  # length of an axis that points somewhere
_STRICT = ConfigDict(extra="forbid", strict=True, allow_inf_nan=False)


class Circle(BaseModel):
    """A circle in px; the centre of the first pixel is (0, 0)."""

    model_config = _STRICT

    u: float
    v: float
    radius_px: float = Field(gt=0)


class Cap(Circle):
    """A mushroom: its circle, and in metres in the camera's optical frame what else is known."""

    ignore: bool | Reason = False
    id: int | None = Field(None, ge=-(2**63), lt=2**63)
    visible: float | None = Field(None, ge=0, le=1)
    surface_m: Vector | None = None
    apex_m: Vector | None = None
    axis: Vector | None = None
    diameter_m: float | None = Field(None, gt=0)
    diameter_max_m: float | None = Field(None, gt=0)

    @field_validator("diameter_m", "diameter_max_m")
    @classmethod
    def _in_metres(cls, diameter: float | None) -> float | None:
        if diameter is not None and diameter >= 1:
            raise ValueError(f"a cap of {diameter:g} m: are lengths in metres?")
        return diameter

    @field_validator("surface_m", "apex_m")
    @classmethod
    def _near(cls, point: list[float] | None) -> list[float] | None:
        if point is not None and math.hypot(*point) > FARTHEST_M:
            raise ValueError(f"a cap {math.hypot(*point):g} m away: are lengths in metres?")
        return point

    @field_validator("axis")
    @classmethod
    def _direction(cls, axis: list[float] | None) -> list[float] | None:
        if axis is not None and not math.hypot(*axis) > SHORTEST:
            raise ValueError("an axis needs a length")
        return axis


class Frame(BaseModel):
    """The mushrooms of one frame, found by its stamp or by its number."""

    model_config = _STRICT

    stamp_ns: int | None = None
    index: int | None = Field(None, ge=0)
    caps: list[Cap]
    may_find: list[Circle] = []

    @model_validator(mode="after")
    def _named(self) -> Frame:
        if (self.stamp_ns is None) == (self.index is None):
            raise ValueError("give either stamp_ns or index")
        return self


class Labels(BaseModel):
    """A file of labels."""

    model_config = _STRICT

    mushpipe_labels: Literal[1]
    note: str = ""
    frame_id: str | None = None
    frames: list[Frame]


def parse_labels(document: Json) -> Labels:
    """Read a JSON document in the project's format or one that `convert` knows.

    Raises:
        ValueError: It is neither, or a value is wrong.
    """
    return Labels.model_validate(convert(document))


def convert(document: Json) -> Json:
    """Return labels of a foreign layout in the project's format; its own as they are.

    - ``must_find`` ellipses (``cx cy ellipse_px: [axis, axis, angle]``, full axes in px, and
      ``diam_silhouette`` in mm) with ``may_find`` circles (``cx cy r``): one frame, index 0.
    - ``caps`` of circles (``u v radius_px ignore``) beside one ``stamp_ns``.
    - ``frames`` with ``caps`` of boxes (``bbox: [x, y, w, h]`` px): the circle has the box's
      centre and the area of the ellipse in it. ``near_border`` boxes are ignored, since the
      outline beyond the border is not known.

    Raises:
        ValueError: The layout is none of these.
    """
    if "mushpipe_labels" in document:
        return document
    readers: dict[str, Callable[[Json], list[Json]]] = {
        "must_find": _must_find,
        "frames": _boxes,
        "caps": _circles,
    }
    for key, reader in readers.items():
        if key in document:
            try:
                frames = reader(document)
            except (KeyError, TypeError, ValueError) as error:
                fault = f"{error} is missing" if isinstance(error, KeyError) else repr(error)
                raise ValueError(
                    f"labels with '{key}', and without mushpipe_labels so of a foreign layout: "
                    f"{fault}; expected is {EXAMPLE}"
                ) from error
            note = document.get("note", document.get("rule", ""))
            return {"mushpipe_labels": 1, "note": note, "frames": frames}
    known = ", ".join(readers)
    raise ValueError(f"none of mushpipe_labels, {known} is in it; expected is {EXAMPLE}")


def _must_find(document: Json) -> list[Json]:
    caps = []
    for item in document["must_find"]:
        first, second = map(_size, item["ellipse_px"][:2])
        cap = {"u": item["cx"], "v": item["cy"], "radius_px": math.sqrt(first * second) / 2}
        if "diam_silhouette" in item:
            cap["diameter_m"] = _number(item["diam_silhouette"]) / 1000
        caps.append(cap)
    may_find = [
        {"u": item["cx"], "v": item["cy"], "radius_px": item["r"]}
        for item in document.get("may_find", [])
    ]
    return [{"index": 0, "caps": caps, "may_find": may_find}]


def _circles(document: Json) -> list[Json]:
    known = ("u", "v", "radius_px", "ignore")
    caps = [{key: cap[key] for key in known if key in cap} for cap in document["caps"]]
    place = {"stamp_ns": document["stamp_ns"]} if "stamp_ns" in document else {"index": 0}
    return [{**place, "caps": caps}]


def _boxes(document: Json) -> list[Json]:
    return [
        {"stamp_ns": frame["stamp_ns"], "caps": [_box(cap) for cap in frame["caps"]]}
        for frame in document["frames"]
    ]


def _box(cap: Json) -> Json:
    (x, y), (width, height) = map(_number, cap["bbox"][:2]), map(_size, cap["bbox"][2:])
    return {
        "u": x + (width - 1) / 2,
        "v": y + (height - 1) / 2,
        "radius_px": math.sqrt(width * height) / 2,
        "ignore": "at-border" if cap.get("near_border") else cap.get("ignore", False),
    }


def _number(value: Any) -> float:
    if isinstance(value, bool) or not isinstance(value, int | float):
        raise ValueError(f"expected a number, got {value!r}")
    return value


def _size(value: Any) -> float:
    if not (size := _number(value)) > 0:
        raise ValueError(f"expected a size above 0, got {value!r}")
    return size


def truth_of(caps: list[Cap]) -> Truth:
    """Return labelled caps as a table; what is not labelled is NaN, axes get length 1."""
    axis = _vectors([cap.axis for cap in caps])
    ids = [cap.id for cap in caps]
    return Truth(
        id=np.array(list(range(len(caps))) if None in ids else ids, dtype=np.int64),
        center=np.array([[cap.u, cap.v] for cap in caps], dtype=float).reshape(-1, 2),
        radius=_numbers([cap.radius_px for cap in caps]),
        visible=_numbers([cap.visible for cap in caps]),
        apex=_vectors([cap.apex_m for cap in caps]),
        surface=_vectors([cap.surface_m for cap in caps]),
        axis=axis / np.linalg.norm(axis, axis=1, keepdims=True),
        diameter=_numbers([cap.diameter_m for cap in caps]),
        diameter_max=_numbers([cap.diameter_max_m for cap in caps]),
        ignore=np.array([_reason(cap.ignore) for cap in caps], dtype=np.uint8),
    )


def _reason(ignore: bool | str) -> Ignore:
    if isinstance(ignore, bool):
        return Ignore.AMBIGUOUS if ignore else Ignore.COUNTS
    return Ignore[ignore.upper().replace("-", "_")]


def _numbers(values: list[float | None] | list[float]) -> Floats:
    return np.array([math.nan if v is None else v for v in values], dtype=float)


def _vectors(values: list[list[float] | None]) -> Floats:
    nothing = [math.nan] * 3
    return np.array([v or nothing for v in values], dtype=float).reshape(-1, 3)
