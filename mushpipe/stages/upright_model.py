"""An upright mushroom as a cloud with normals: what registration compares a cap with."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from mushpipe import InputError
from mushpipe.core.arrays import Floats
from mushpipe.core.libraries import import_open3d
from mushpipe.core.paths import require_model

ASPECT, LIP, STEM, STEM_LENGTH = 0.62, 0.2, 0.4, 1.4  # in rim radii


@dataclass(frozen=True, eq=False)
class Model:
    """A cloud of rim radius 1, centred on the rim, z out of the cap.

    Attributes:
        points: (M, 3).
        normals: (M, 3) unit, outwards.
        axis: (3,) unit, the model's own normal vector.
        top: Height of the cap over the rim's plane.
    """

    points: Floats
    normals: Floats
    axis: Floats
    top: float


def made(full: bool, spacing: float) -> Model:
    """Return the project's own mushroom: half an ellipsoid, a margin that rolls in, and a stem.

    Args:
        full: With underside and stem; else only what can be seen from above.
        spacing: Distance of neighbouring points, in rim radii.
    """
    dome, margin = np.linspace(0, np.pi / 2, 400), np.linspace(0, np.pi / 2, 100)[1:]
    rho = np.concatenate([np.sin(dome), 1 - 0.25 * (1 - np.cos(margin))])
    z = np.concatenate([ASPECT * np.cos(dome), -LIP * np.sin(margin)])
    if full:
        rho = np.concatenate([rho, np.linspace(0.75, STEM, 50)[1:], np.full(100, STEM)])
        z = np.concatenate([z, np.full(49, -LIP), np.linspace(-LIP, -LIP - STEM_LENGTH, 100)])
    points, normals = _revolved(rho, z, spacing)
    return Model(points, normals, np.array([0.0, 0.0, 1.0]), ASPECT)


def _revolved(rho: Floats, z: Floats, spacing: float) -> tuple[Floats, Floats]:
    """Spread points (M, 3) evenly over a surface of revolution, with outward normals."""
    length = np.concatenate([[0], np.cumsum(np.hypot(np.diff(rho), np.diff(z)))])
    at = np.arange(spacing / 2, length[-1], spacing)
    radius, height = np.interp(at, length, rho), np.interp(at, length, z)
    apart = length + np.arange(len(length)) * 1e-12  # no two points in one place
    d_rho, d_z = (np.interp(at, length, np.gradient(part, apart)) for part in (rho, z))
    points: list[Floats] = []
    normals: list[Floats] = []
    for r, h, dr, dz in zip(radius, height, d_rho, d_z, strict=True):
        count = max(1, round(2 * np.pi * r / spacing))
        turn = (np.arange(count) + 0.5 * (len(points) % 2)) * (2 * np.pi / count)
        c, s = np.cos(turn), np.sin(turn)
        points.append(np.stack([r * c, r * s, np.full(count, h)], axis=1))
        normals.append(np.stack([-dz * c, -dz * s, np.full(count, dr)], axis=1))
    normal = np.concatenate(normals)
    return np.concatenate(points), normal / np.linalg.norm(normal, axis=1, keepdims=True)


def _points(o3d: Any, path: Path) -> Floats:
    """Return the points (M, 3) of a cloud, or as many of a mesh as tell its surface."""
    require_model(path)
    with o3d.utility.VerbosityContextManager(o3d.utility.VerbosityLevel.Error):
        mesh = o3d.io.read_triangle_mesh(str(path))
        cloud = o3d.io.read_point_cloud(str(path))
    if len(mesh.triangles):
        o3d.utility.random.seed(0)  # the same model in every run
        cloud = mesh.sample_points_uniformly(20_000, use_triangle_normal=True)
    if len(cloud.points) < 100:
        raise InputError(
            f"model {path} has {len(cloud.points)} points that Open3D can read: expected a mesh or "
            "cloud (.ply, .pcd, .obj, .stl) of at least 100"
        )
    return np.asarray(cloud.points)


def read(path: Path, spacing: float) -> Model:
    """Read a mesh or cloud of an upright mushroom, z up, in any unit.

    Its rim is where it is widest. Its normal vector is the smallest principal axis of the points
    above the rim, turned upwards. Of a model that leans it shows a part of that only, since they
    are cut off level: poses are then off by the rest.

    Raises:
        UsageError: There is no such file.
        InputError: The file has too few points.
        DependencyError: open3d is missing.
    """
    o3d = import_open3d()
    points = _points(o3d, path)
    points = points - [*np.median(points[:, :2], axis=0), 0]
    radius = float(np.quantile(np.hypot(points[:, 0], points[:, 1]), 0.995))
    widest = np.hypot(points[:, 0], points[:, 1]) > 0.9 * radius
    points = (points - [0, 0, np.median(points[widest, 2])]) / radius
    thin = o3d.geometry.PointCloud(o3d.utility.Vector3dVector(points))
    thin = thin.voxel_down_sample(spacing)
    thin.estimate_normals(o3d.geometry.KDTreeSearchParamHybrid(3 * spacing, 30))
    points, normals = np.asarray(thin.points), np.asarray(thin.normals)
    inwards = (normals * (points + np.array([0, 0, 0.3]))).sum(axis=1) < 0
    cap = points[points[:, 2] > 0]
    axis = np.linalg.svd(cap - cap.mean(axis=0))[2][2]
    normals = np.where(inwards[:, None], -normals, normals)
    return Model(points, normals, axis * np.sign(axis[2]), float(points[:, 2].max()))
