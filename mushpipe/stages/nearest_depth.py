"""The paper's localisation (section V): depth at the centre, else the nearest available."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from mushpipe import Camera, Circles, DepthSource, InputError, Locations, RgbdFrame, Stage

Floats = NDArray[np.float64]


class NearestDepth(Stage):
    """Localises each circle by the depth at its centre, as the paper does.

    Where depth is missing at the centre, the mean of the nearest available points within the
    circle stands in and the source is ``neighbours``; without any, the mushroom is ``missing``.
    The distance is d = sqrt(X^2 + Y^2 + Z^2). The diameter is the mean of the distances between
    the circle's opposite points in its row and in its column, each at the nearest available
    depth inside the circle on its own side.
    """

    neighbours: int = Field(4, ge=1, description="how many nearest points stand in for a missing")

    def process(self, frame: RgbdFrame, circles: Circles) -> Locations:
        """Return one location per circle.

        Raises:
            InputError: The frame has depth but no calibration.
        """
        n = len(circles)
        position, diameter = np.full((n, 3), np.nan), np.full(n, np.nan)
        source = np.zeros(n, np.uint8)
        if frame.depth is not None and n:
            if frame.camera is None:
                raise InputError(
                    "depth cannot be turned into metres without the camera's calibration: record "
                    "camera_info, or set source.camera: {fx: , fy: , cx: , cy: }"
                )
            for i, (center, radius) in enumerate(zip(circles.center, circles.radius, strict=True)):
                cap = _Cap(frame.depth_m, frame.camera, center, float(radius))
                position[i], source[i] = cap.locate(self.neighbours)
                diameter[i] = cap.diameter()
        return Locations(
            position=position,
            distance=np.linalg.norm(position, axis=1),
            diameter=diameter,
            source=source,
            sigma_position=np.full((n, 3), np.nan),
            sigma_diameter=np.full(n, np.nan),
        )


class _Cap:
    """The valid depth pixels inside one circle, as pixels (M, 2) and points (M, 3)."""

    def __init__(
        self, depth_m: NDArray[np.float32], camera: Camera, center: Floats, radius: float
    ) -> None:
        self.camera = camera
        self.center = center
        self.radius = radius
        height, width = depth_m.shape
        (left, top), (right, bottom) = (
            np.clip(np.floor(center - radius), 0, (width, height)).astype(int),
            np.clip(np.ceil(center + radius) + 1, 0, (width, height)).astype(int),
        )
        v, u = np.mgrid[top:bottom, left:right]
        offset = np.stack([u - center[0], v - center[1]], axis=-1)
        patch = depth_m[top:bottom, left:right]
        valid = np.isfinite(patch) & ((offset**2).sum(axis=-1) <= radius**2)
        self.offset: Floats = offset[valid].astype(np.float64)
        self.points = camera.deproject(self.offset + center, patch[valid].astype(np.float64))

    def locate(self, neighbours: int) -> tuple[Floats, DepthSource]:
        """Return the point at the centre pixel, else the mean of the nearest valid points."""
        if not len(self.points):
            return np.full(3, np.nan), DepthSource.MISSING
        squared = (self.offset**2).sum(axis=1)
        nearest = np.argsort(squared, kind="stable")
        # The centre pixel is the one the centre rounds to.
        if np.all(np.abs(self.offset[nearest[0]]) <= 0.5):
            return self.points[nearest[0]], DepthSource.MEASURED
        return self.points[nearest[:neighbours]].mean(axis=0), DepthSource.NEIGHBOURS

    def diameter(self) -> float:
        """Return the mean of the row's and the column's diameter; NaN where neither is known."""
        spans = [self._span(axis) for axis in (0, 1)]
        known = [span for span in spans if np.isfinite(span)]
        return float(np.mean(known)) if known else np.nan

    def _span(self, axis: int) -> float:
        """Return the distance of the opposite points along one image axis."""
        ends = [self._end(axis, sign) for sign in (-1, 1)]
        return float(np.linalg.norm(ends[1] - ends[0]))

    def _end(self, axis: int, sign: int) -> Floats:
        """Return the circle's end point on one side at the nearest depth found on that side."""
        end = np.zeros(2)
        end[axis] = sign * self.radius
        side = np.flatnonzero(self.offset[:, axis] * sign > 0)
        if not len(side):
            return np.full(3, np.nan)
        squared = ((self.offset[side] - end) ** 2).sum(axis=1)
        z = self.points[side[np.argmin(squared)], 2]
        return self.camera.deproject(self.center + end, z)
