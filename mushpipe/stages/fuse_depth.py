"""Depth averaged over the last frames, without mixing what lies behind with what lies before."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray
from pydantic import Field, PrivateAttr

from mushpipe import RgbdFrame, Stage
from mushpipe.core.arrays import Bytes, Singles
from mushpipe.core.jit import jit
from mushpipe.core.types import end_of_scale

SIGMAS = 4.0  # of depth noise, which the gate lets pass
PAUSE_NS = 1_000_000_000  # what was seen longer ago is no part of what is seen now


class FuseDepth(Stage):
    """Averages depth over the last frames of a camera at rest, and fills holes from them.

    A pixel whose depth leaves its mean by more than the gate starts anew: it sees another surface
    now. The gate widens with depth, as noise does. A pixel without depth keeps its mean until it
    has been without for `frames` frames. Where more pixels start anew than noise explains, the
    camera moved, and the frame passes as it is; so it does after a pause, and where stamps go back.
    """

    frames: int = Field(5, ge=1, le=100, description="frames that are averaged")
    gate_mm: float = Field(
        4.0, gt=0, le=100, description="least step of depth at which a pixel starts anew"
    )
    depth_noise_mm: float = Field(
        0.3, ge=0, description="sigma of depth at the camera, mm; the gate is never below four"
    )
    depth_noise_per_m: float = Field(1.2, ge=0, description="its growth with depth, mm per m")
    moved: float = Field(
        0.05,
        gt=0,
        le=1,
        description="share, of the pixels with depth before and now, starting anew at which all do",
    )

    _mean: Singles | None = PrivateAttr(None)
    _count: Bytes | None = PrivateAttr(None)
    _age: Bytes | None = PrivateAttr(None)
    _scale: float = PrivateAttr(0.0)
    _stamp_ns: int = PrivateAttr(0)

    def open(self) -> None:
        """Compile the kernel and forget what was seen."""
        for dtype in (np.uint16, np.float32):
            depth = np.ones((2, 2), dtype)
            depth.flags.writeable = False
            state = np.zeros((2, 2), np.float32), np.zeros((2, 2), np.uint8)
            fuse(depth, *state, np.zeros((2, 2), np.uint8), (1.0, 0.0, 0.0, 9.0), 2)
        self._mean = None

    def process(self, frame: RgbdFrame) -> RgbdFrame:
        """Return the frame with its mean depth, float32 in the sensor's unit, 0 = missing."""
        if frame.depth is None:
            return frame
        depth = frame.depth
        if depth.dtype == np.float32:
            depth = np.nan_to_num(depth, posinf=0.0, neginf=0.0)
            depth.flags.writeable = False
        if (
            self._mean is None
            or self._mean.shape != depth.shape
            or self._scale != frame.depth_scale
            or not 0 <= frame.header.stamp_ns - self._stamp_ns <= PAUSE_NS
        ):
            self._forget(frame)
        self._stamp_ns = frame.header.stamp_ns
        noise = SIGMAS * self.depth_noise_mm / 1000 / frame.depth_scale
        growth = SIGMAS * self.depth_noise_per_m / 1000
        end = float(end_of_scale(depth))
        gate = (self.gate_mm / 1000 / frame.depth_scale, noise, growth, end)
        fresh, known = fuse(depth, self._mean, self._count, self._age, gate, self.frames)
        if fresh > self.moved * known:
            self._forget(frame)
            fuse(depth, self._mean, self._count, self._age, gate, self.frames)
        return replace(frame, depth=np.array(self._mean))

    def _forget(self, frame: RgbdFrame) -> None:
        shape = frame.color.shape[:2]
        self._mean, self._scale = np.zeros(shape, np.float32), frame.depth_scale
        self._count, self._age = np.zeros(shape, np.uint8), np.zeros(shape, np.uint8)


@jit
def fuse(
    depth: NDArray[Any], mean: Any, count: Any, age: Any,
    gate: tuple[float, float, float, float], frames: int,
) -> Any:  # fmt: skip
    """Take one more depth image into a mean.

    Args:
        depth: (H, W) native, 0 = missing, finite.
        mean: (H, W) float32, in and out, 0 = missing.
        count: (H, W) uint8, in and out, how many frames each mean holds.
        age: (H, W) uint8, in and out, for how many frames each pixel had no depth.
        gate: Step at which a pixel starts anew, native: at least the first, and at least the second
            plus the third times its depth. The fourth is where depth ends, native: from there on
            it is missing.
        frames: Most frames that a mean holds.

    Returns:
        How many pixels started anew, and how many had depth before and have it now.
    """
    fresh, known = 0, 0
    for v in range(depth.shape[0]):
        for u in range(depth.shape[1]):
            z = np.float32(depth[v, u])
            if z <= 0 or z >= gate[3]:
                if mean[v, u] > 0:
                    age[v, u] += 1
                    if age[v, u] >= frames:
                        mean[v, u], count[v, u] = 0, 0
                continue
            age[v, u] = 0
            step = z - mean[v, u]
            known += mean[v, u] > 0
            if mean[v, u] > 0 and abs(step) <= max(gate[0], gate[1] + gate[2] * mean[v, u]):
                count[v, u] = min(count[v, u] + 1, frames)
                mean[v, u] += step / np.float32(count[v, u])
            else:
                fresh += mean[v, u] > 0
                mean[v, u], count[v, u] = z, 1
    return fresh, known
