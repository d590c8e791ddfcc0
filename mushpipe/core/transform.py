"""Rigid transforms between frames, `T_target_source`, as settings of a graph."""

from __future__ import annotations

import json
from collections.abc import Mapping
from contextlib import suppress
from pathlib import Path
from typing import Annotated, Any

import numpy as np
from pydantic import BeforeValidator, Field, ValidationError, ValidationInfo, field_validator

from mushpipe.core.arrays import Floats
from mushpipe.core.document import read_document
from mushpipe.core.errors import GraphError
from mushpipe.core.group import Group
from mushpipe.core.paths import resolve_path
from mushpipe.core.settings import told

UNIT_TOLERANCE = 1e-3
_EXPECTED = "frame, translation: [x, y, z] in m and quaternion: [x, y, z, w]"
REACH = 50.0  # m, of a robot from its camera


class Transform(Group):
    """Takes what is expressed in a source frame to a target frame: p_target = R p_source + t."""

    frame: str = Field(min_length=1, max_length=64, description="name of the target frame")
    translation: tuple[float, float, float] = Field(
        description="origin of the source frame in the target frame, m"
    )
    quaternion: tuple[float, float, float, float] = Field(
        description="rotation from the source frame to the target frame, x y z w"
    )

    @field_validator("translation")
    @classmethod
    def _metres(cls, value: tuple[float, ...]) -> tuple[float, ...]:
        if np.linalg.norm(value) > REACH:
            raise ValueError(f"it is in m, and longer than {REACH:g} m: was it given in mm?")
        return value

    @field_validator("quaternion")
    @classmethod
    def _unit(cls, value: tuple[float, ...]) -> tuple[float, ...]:
        if abs(np.linalg.norm(value) - 1) > UNIT_TOLERANCE:
            raise ValueError("the quaternion must have length 1")
        return value

    @property
    def rise(self) -> float:
        """How much the source frame's z axis rises along that of the target frame, -1 to 1."""
        return float(self._matrix()[2, 2])

    def points(self, points: Floats) -> Floats:
        """Transform (N, 3) points, m; rows of NaN stay NaN."""
        return np.asarray(self.directions(points) + self.translation)

    def directions(self, vectors: Floats) -> Floats:
        """Turn (N, 3) vectors; rows of NaN stay NaN."""
        return np.asarray(vectors @ self._matrix().T)

    def spreads(self, sigmas: Floats, points: Floats) -> Floats:
        """Turn (N, 3) standard deviations along x, y, z of points (N, 3) that a camera measured.

        Their errors lie along the unit ray r with a variance A, across it with C < A: the
        covariance is C I + (A - C) r r^T, and z less the mean of x and y, off its diagonal and off
        that of r r^T, gives A - C. That holds up to 54 degrees off the optical axis; beyond, and
        where errors are no larger along the ray, they are taken for independent.

        Args:
            sigmas: In the camera's frame; rows of NaN stay NaN, and one that is infinite makes the
                whole row infinite, for what is not known along one axis may lie along any.
            points: In the camera's optical frame, m.
        """
        lost = np.isinf(sigmas).any(axis=1, keepdims=True)
        sigmas = np.where(lost, np.nan, sigmas)
        rays = points / np.linalg.norm(points, axis=1, keepdims=True)
        variances, squares = sigmas**2, rays**2
        excess, share = (v[:, 2] - v[:, :2].mean(axis=1) for v in (variances, squares))
        along = np.zeros(len(rays))
        np.divide(np.maximum(excess, 0), share, out=along, where=share > 0)
        # no axis has more of it than all its variance
        along = np.minimum(along, (variances / np.maximum(squares, 1e-12)).min(axis=1))[:, None]
        # what is all along the ray leaves nothing, but for rounding
        rest = np.maximum(variances - along * squares, 0) @ (self._matrix() ** 2).T
        turned = np.sqrt(along * self.directions(rays) ** 2 + rest)
        return np.where(lost, np.inf, turned)

    def rotations(self, quaternions: Floats) -> Floats:
        """Turn (N, 4) orientations, x y z w; rows of NaN stay NaN."""
        from scipy.spatial.transform import Rotation

        turned = quaternions.copy()
        known = np.isfinite(quaternions).all(axis=1)
        if known.any():
            own = Rotation.from_quat(self.quaternion)
            turned[known] = (own * Rotation.from_quat(quaternions[known])).as_quat()
        return turned

    def _matrix(self) -> Floats:
        from scipy.spatial.transform import Rotation

        return np.asarray(Rotation.from_quat(self.quaternion).as_matrix())


def _read(value: Any, info: ValidationInfo) -> Any:
    """Replace the name of a YAML file by the transform that stands in it."""
    if isinstance(value, dict):  # a list is no tuple to a validator that follows another
        return {key: tuple(v) if isinstance(v, list) else v for key, v in value.items()}
    if isinstance(value, list):
        raise ValueError(f"it is a list, or matrix; expected {_EXPECTED}, or a YAML file of these")
    if not isinstance(value, str):
        return value
    path = resolve_path(Path(value), info)
    try:
        data = read_document(path, "frame: robot_base").data
        return Transform.model_validate_json(json.dumps(data), strict=True)
    except (GraphError, ValueError) as error:
        raise ValueError(f"no transform in {path}: {told(error)}; expected {_EXPECTED}") from error


TransformSetting = Annotated[
    Transform, BeforeValidator(_read, json_schema_input_type=Transform | str)
]
"""A `Transform` as a setting: written out, or the name of a YAML file with the same keys."""


def base_of(graph: Mapping[str, Any]) -> Transform | None:
    """Return the pose of the camera in the robot's frame, where a graph gives picks in that."""
    known = None
    for stage in graph.get("stages", {}).values():
        with suppress(ValidationError):  # another plugin's setting of that name
            known = Transform.model_validate(stage.get("T_base_camera"))
    return known
