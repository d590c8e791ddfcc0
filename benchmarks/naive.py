"""The paper's chain as one would first write it: scikit-image, OpenCV and Open3D, mask to pose.

Functions on arrays and nothing of this project's methods; the stage at the end only carries the
outcome into a graph, so that `mushpipe eval` judges it like any other (`benchmarks/naive.yaml`).
"""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np
from skimage.filters import threshold_otsu
from skimage.segmentation import chan_vese

from mushpipe import Camera, DepthSource, PickFlag, Picks, RgbdFrame, Stage, quaternion_from_axis
from mushpipe.core.libraries import import_open3d

RADIUS_PX = (8, 45)
KERNEL = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (10, 10))


def segmented(gray: np.ndarray) -> np.ndarray:
    """Return the opened foreground of an (H, W) image in 0..1, Chan-Vese from Otsu's contour."""
    start = np.where(gray > threshold_otsu(gray), 1.0, -1.0)
    mask = chan_vese(gray, mu=0.1, tol=1e-12, max_num_iter=500, init_level_set=start)
    if mask.any() and not mask.all() and gray[mask].mean() < gray[~mask].mean():
        mask = ~mask
    return np.asarray(cv2.morphologyEx(mask.astype(np.uint8), cv2.MORPH_OPEN, KERNEL))


def circles(mask: np.ndarray) -> np.ndarray:
    """Return (N, 3) x, y, radius in px."""
    found = cv2.HoughCircles(
        cv2.GaussianBlur(255 * mask, (5, 5), 1.2), cv2.HOUGH_GRADIENT, dp=1, minDist=16,
        param1=100, param2=14, minRadius=RADIUS_PX[0], maxRadius=RADIUS_PX[1],
    )  # fmt: skip
    return np.zeros((0, 3)) if found is None else found[0, :, :3].astype(float)


def nearest(cloud: np.ndarray, circle: np.ndarray, x: float, y: float) -> np.ndarray:
    """Return the point (3,) of the cloud (H, W, 3) nearest to a pixel within the circle."""
    v, u = np.mgrid[: cloud.shape[0], : cloud.shape[1]]
    usable = (u - circle[0]) ** 2 + (v - circle[1]) ** 2 <= circle[2] ** 2
    usable &= cloud[..., 2] > 0
    if not usable.any():
        return np.full(3, np.nan)
    at = np.argmin(np.where(usable, (u - x) ** 2 + (v - y) ** 2, np.inf))
    return np.asarray(cloud.reshape(-1, 3)[at])


def diameter(cloud: np.ndarray, circle: np.ndarray) -> float:
    """Return the mean of the distances of opposite end points, m."""
    x, y, r = circle
    across = nearest(cloud, circle, x - r, y) - nearest(cloud, circle, x + r, y)
    along = nearest(cloud, circle, x, y - r) - nearest(cloud, circle, x, y + r)
    return float((np.linalg.norm(across) + np.linalg.norm(along)) / 2)


def axis(o3d: Any, cloud: np.ndarray, circle: np.ndarray, size: float) -> np.ndarray:
    """Return the normal (3,) of a half-ellipsoid registered to the points in a circle."""
    v, u = np.mgrid[: cloud.shape[0], : cloud.shape[1]]
    inside = (u - circle[0]) ** 2 + (v - circle[1]) ** 2 <= circle[2] ** 2
    points = cloud[inside & (cloud[..., 2] > 0)]
    if len(points) < 30:
        return np.full(3, np.nan)
    voxel, registration = 0.12 * size, o3d.pipelines.registration
    mesh = o3d.geometry.TriangleMesh.create_sphere(1.0)
    shell = np.asarray(mesh.sample_points_uniformly(3000).points)
    model = shell[shell[:, 2] < 0] * [size, size, 0.62 * size] + points.mean(axis=0)
    clouds, features = [], []
    for part in (model, points):
        small = o3d.geometry.PointCloud(o3d.utility.Vector3dVector(part)).voxel_down_sample(voxel)
        small.estimate_normals(o3d.geometry.KDTreeSearchParamHybrid(3 * voxel, 30))
        small.orient_normals_towards_camera_location(np.zeros(3))
        search = o3d.geometry.KDTreeSearchParamHybrid(5 * voxel, 100)
        clouds.append(small)
        features.append(registration.compute_fpfh_feature(small, search))
    fgr = registration.registration_fgr_based_on_feature_matching(
        *clouds, *features,
        registration.FastGlobalRegistrationOption(
            maximum_correspondence_distance=1.5 * voxel, use_absolute_scale=True
        ),
    )  # fmt: skip
    icp = registration.registration_icp(
        *clouds, 3 * voxel, fgr.transformation,
        registration.TransformationEstimationPointToPoint(),
    )  # fmt: skip
    return np.asarray(icp.transformation)[:3, :3] @ [0.0, 0.0, -1.0]


def point_cloud(depth_m: np.ndarray, camera: Camera) -> np.ndarray:
    """Return (H, W, 3) m."""
    v, u = np.mgrid[: depth_m.shape[0], : depth_m.shape[1]]
    z = np.nan_to_num(depth_m)
    return np.stack([(u - camera.cx) * z / camera.fx, (v - camera.cy) * z / camera.fy, z], axis=-1)


class Naive(Stage):
    """Picks of the plain script."""

    def process(self, frame: RgbdFrame) -> Picks:
        """Return a pick for each circle."""
        if frame.depth is None or frame.camera is None:
            raise ValueError("the script needs depth and calibration")
        o3d = import_open3d()
        o3d.utility.random.seed(0)
        found = circles(segmented(frame.gray))
        cloud, focal = point_cloud(frame.depth_m, frame.camera), frame.camera.fx
        position = np.array([nearest(cloud, c, *c[:2]) for c in found]).reshape(-1, 3)
        size = found[:, 2] * position[:, 2] / focal
        with o3d.utility.VerbosityContextManager(o3d.utility.VerbosityLevel.Error):
            axes = np.array(
                [axis(o3d, cloud, c, s) if s > 0 else np.full(3, np.nan)
                 for c, s in zip(found, size, strict=True)]
            ).reshape(-1, 3)  # fmt: skip
        n, missing = len(found), np.isnan(position[:, 0])
        flags = PickFlag.DEPTH_MISSING * missing + PickFlag.POSE_UNKNOWN * np.isnan(axes[:, 0])
        unknown = np.full(n, np.nan)
        return Picks(
            id=np.arange(n), center=found[:, :2], radius=found[:, 2],
            position=position, surface=position,
            distance=np.linalg.norm(position, axis=1),
            diameter=np.array([diameter(cloud, c) for c in found]),
            quaternion=quaternion_from_axis(axes), axis=axes, score=np.ones(n),
            sigma_position=np.full((n, 3), np.nan), sigma_diameter=unknown, sigma_tilt=unknown,
            source=np.where(missing, DepthSource.MISSING, DepthSource.MEASURED), flags=flags,
            frame_id=frame.header.frame_id,
        )  # fmt: skip
