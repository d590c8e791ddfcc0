"""The paper's localisation (section V): depth at the centre, else the nearest available."""

from __future__ import annotations

import numpy as np
from pydantic import Field

from mushpipe import Camera, Circles, DepthSource, Locations, RgbdFrame, Stage
from mushpipe.core.arrays import Bytes, Floats, Ints, Singles
from mushpipe.core.geometry import lengths
from mushpipe.core.jit import jit
from mushpipe.stages.calibrated import calibration_of
from mushpipe.stages.discs import discs_of
from mushpipe.stages.warm_up import example_circles, example_frame

_SIDES = np.array([[-1.0, 0.0], [1.0, 0.0], [0.0, -1.0], [0.0, 1.0]])


class NearestDepth(Stage):
    """Localises each circle by the depth at its centre, as the paper does.

    Where depth is missing at the centre, the mean of the nearest available points within the
    circle stands in and the source is ``neighbours``; without any, the mushroom is ``missing``.
    The distance is d = sqrt(X^2 + Y^2 + Z^2). The diameter is the mean of the distances between
    the circle's opposite points in its row and in its column, each at the nearest available
    depth inside the circle on its own side.
    """

    neighbours: int = Field(
        4, ge=1, le=1000, description="how many nearest points stand in for a missing"
    )

    def open(self) -> None:
        """Compile the kernels."""
        self.process(example_frame(), example_circles())

    def process(self, frame: RgbdFrame, circles: Circles) -> Locations:
        """Return one location per circle.

        Raises:
            InputError: The frame has depth but no calibration.
        """
        n = len(circles)
        if frame.depth is None or not n:
            return Locations.unknown(n)
        camera = calibration_of(frame)
        depth = np.fmax(frame.depth_m, np.float32(0))  # missing: 0 in place of NaN
        depth.flags.writeable = False
        discs = discs_of(circles)
        position, source = self._positions(depth, camera, discs)
        return Locations.unknown(
            n,
            position=position,
            distance=lengths(position),
            diameter=_diameters(depth, camera, discs),
            source=source,
        )

    def _positions(self, depth: Singles, camera: Camera, discs: Floats) -> tuple[Floats, Bytes]:
        """Return positions (N, 3), m, and their sources (N,)."""
        n = len(discs)
        position, source = np.full((n, 3), np.nan), np.full(n, DepthSource.MISSING, np.uint8)
        pixels = np.full((n, self.neighbours, 3), np.nan)
        found = nearest(depth, discs, self.neighbours, pixels)
        points = camera.deproject(pixels[..., :2], pixels[..., 2])
        off = np.abs(pixels[:, 0, :2] - discs[:, :2]).max(axis=1)
        # The centre pixel is the one the centre rounds to.
        measured = (found > 0) & (off <= 0.5)
        points[measured, 1:] = np.nan
        seen = np.asarray(np.isfinite(points).all(axis=2))  # the lens may have no ray there
        points[~seen] = np.nan
        some = seen.any(axis=1)
        position[some] = np.nanmean(points[some], axis=1)
        source[some] = DepthSource.NEIGHBOURS
        source[measured & some] = DepthSource.MEASURED
        return position, source


def _diameters(depth: Singles, camera: Camera, discs: Floats) -> Floats:
    """Return the means (N,) of the distances of opposite ends, m, that are known."""
    rim = np.full((len(discs), 4), np.nan)
    ends(depth, discs, rim)
    corners = discs[:, None, :2] + discs[:, 2, None, None] * _SIDES
    rims = camera.deproject(corners, rim)
    spans = np.linalg.norm(rims[:, 1::2] - rims[:, ::2], axis=2)
    known = np.isfinite(spans)
    diameter = np.where(known, spans, 0).sum(axis=1) / np.maximum(known.sum(axis=1), 1)
    diameter[~known.any(axis=1)] = np.nan
    return np.asarray(diameter)


@jit
def box(depth: Singles, disc: Floats) -> tuple[int, int, int, int]:
    """Return top, bottom, left, right of the pixels around a circle (x, y, r) in the image."""
    height, width = depth.shape
    top, left = np.floor(disc[1] - disc[2]), np.floor(disc[0] - disc[2])
    bottom, right = np.ceil(disc[1] + disc[2]) + 1, np.ceil(disc[0] + disc[2]) + 1
    return (
        int(min(max(top, 0), height)),
        int(min(max(bottom, 0), height)),
        int(min(max(left, 0), width)),
        int(min(max(right, 0), width)),
    )


@jit
def nearest(depth: Singles, discs: Floats, most: int, out: Floats) -> Ints:
    """Find the valid pixels next to each circle's centre, inside it.

    Args:
        depth: (H, W) m, 0 = missing.
        discs: (N, 3) x, y, radius, px.
        most: How many pixels are wanted.
        out: (N, most, 3) out: x, y, depth (m), the nearest first; the rest stays as it is.

    Returns:
        (N,) how many were found.
    """
    counts = np.zeros(len(discs), np.int64)
    best = np.empty(most)
    for i in range(len(discs)):
        top, bottom, left, right = box(depth, discs[i])
        n = 0
        for v in range(top, bottom):
            for u in range(left, right):
                square = (u - discs[i, 0]) ** 2 + (v - discs[i, 1]) ** 2
                if depth[v, u] <= 0 or square > discs[i, 2] ** 2:
                    continue
                if n == most and square >= best[n - 1]:
                    continue
                k = min(n, most - 1)
                while k > 0 and best[k - 1] > square:
                    best[k] = best[k - 1]
                    out[i, k] = out[i, k - 1]
                    k -= 1
                best[k] = square
                out[i, k, 0], out[i, k, 1], out[i, k, 2] = u, v, depth[v, u]
                n = min(n + 1, most)
        counts[i] = n
    return counts


@jit
def ends(depth: Singles, discs: Floats, out: Floats) -> None:
    """Find the depth (N, 4) nearest to the left, right, upper and lower end of each circle.

    Only pixels inside the circle and on the end's own side of the centre count; without any the
    value stays as it is.
    """
    for i in range(len(discs)):
        x, y, r = discs[i, 0], discs[i, 1], discs[i, 2]
        top, bottom, left, right = box(depth, discs[i])
        best = np.full(4, 1e30)
        for v in range(top, bottom):
            for u in range(left, right):
                dx, dy = u - x, v - y
                if depth[v, u] <= 0 or dx * dx + dy * dy > r * r:
                    continue
                for side in range(4):
                    along, across = (dx, dy) if side < 2 else (dy, dx)
                    along = -along if side % 2 == 0 else along
                    square = (along - r) ** 2 + across * across
                    if along > 0 and square < best[side]:
                        best[side] = square
                        out[i, side] = depth[v, u]
