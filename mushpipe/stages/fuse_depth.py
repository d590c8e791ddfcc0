"""A running mean of depth, without mixing what lies behind with what lies before."""

from __future__ import annotations

from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from pydantic import Field, PrivateAttr

from mushpipe import RgbdFrame, Stage
from mushpipe.core.arrays import Bytes, Singles
from mushpipe.core.jit import jit
from mushpipe.core.types import end_of_scale

SIGMAS = 4.0  # of depth noise, which the gate lets pass
# What was seen longer ago fills no hole: robots are told the age of the frame.
LONGEST_NS = 500_000_000


class Memory(NamedTuple):
    """What was seen so far.

    Attributes:
        mean: (H, W) native, 0 = missing.
        held: (H, W) how many frames each mean holds.
        age: (H, W) for how many frames each pixel had no depth.
    """

    mean: Singles
    held: Bytes
    age: Bytes


class Gate(NamedTuple):
    """What is mixed with what was seen before, native.

    Attributes:
        step: At which a pixel starts anew: at least this,
        noise: and at least this,
        growth: plus so many times its depth.
        end: Where depth ends; from there on it is missing.
    """

    step: float
    noise: float
    growth: float
    end: float


def nothing(shape: tuple[int, ...]) -> Memory:
    """Return the memory (H, W) of a camera that has seen nothing."""
    return Memory(np.zeros(shape, np.float32), np.zeros(shape, np.uint8), np.zeros(shape, np.uint8))


class FuseDepth(Stage):
    """Averages the depth of a camera at rest, and fills holes from the last frames.

    The first `frames` frames weigh alike; then each new one counts a `frames`-th, and what was
    seen before it fades.

    A pixel whose depth leaves its mean by more than the gate starts anew: it sees another surface
    now. The gate widens with depth, as noise does. A pixel without depth keeps its mean until it
    has been without for `frames` frames or half a second. Where more pixels start anew than noise
    explains, the camera moved, and the frame passes as it is; so it does after half a second
    without a frame, and where stamps go back.
    """

    frames: int = Field(5, ge=1, le=100, description="a frame counts one of so many")
    gate_mm: float = Field(
        4.0, gt=0, le=100, description="least step of depth at which a pixel starts anew"
    )
    depth_noise_mm: float = Field(
        0.3,
        ge=0,
        le=25,
        description="sigma of depth at the camera, mm; the gate is never below four",
    )
    depth_noise_per_m: float = Field(
        1.2, ge=0, le=25, description="its growth with depth, mm per m"
    )
    moved: float = Field(
        0.05,
        gt=0,
        le=1,
        description="share, of the pixels with depth before and now, starting anew at which all do",
    )

    _memory: Memory | None = PrivateAttr(None)
    _scale: float = PrivateAttr(0.0)
    _stamps_ns: tuple[int, ...] = PrivateAttr(())  # of the last frames, the newest first

    def open(self) -> None:
        """Compile the kernel and forget what was seen."""
        for dtype in (np.uint16, np.float32):
            depth = np.ones((2, 2), dtype)
            depth.flags.writeable = False
            fuse(depth, nothing(depth.shape), Gate(1.0, 0.0, 0.0, 9.0), 2, 0)
        self._memory = None

    def process(self, frame: RgbdFrame) -> RgbdFrame:
        """Return the frame with its mean depth, float32 in the sensor's unit, 0 = missing."""
        if frame.depth is None:
            return frame
        depth = frame.depth
        if depth.dtype == np.float32:
            depth = np.nan_to_num(depth, posinf=0.0, neginf=0.0)
            depth.flags.writeable = False
        memory, now_ns = self._memory, frame.header.stamp_ns
        if (
            memory is None
            or memory.mean.shape != depth.shape
            or self._scale != frame.depth_scale
            or not all(0 <= now_ns - stamp <= LONGEST_NS for stamp in self._stamps_ns[:1])
        ):
            memory, self._stamps_ns = self._forget(frame), ()
        held = sum(0 <= now_ns - stamp <= LONGEST_NS for stamp in self._stamps_ns)
        self._stamps_ns = (now_ns, *self._stamps_ns)[: self.frames - 1]
        noise = SIGMAS * self.depth_noise_mm / 1000 / frame.depth_scale
        growth = SIGMAS * self.depth_noise_per_m / 1000
        end = float(end_of_scale(depth))
        gate = Gate(self.gate_mm / 1000 / frame.depth_scale, noise, growth, end)
        fresh, known = fuse(depth, memory, gate, self.frames, held)
        if fresh > self.moved * known:
            memory = self._forget(frame)
            fuse(depth, memory, gate, self.frames, 0)
        return replace(frame, depth=np.array(memory.mean))

    def _forget(self, frame: RgbdFrame) -> Memory:
        """Return a memory to begin anew with."""
        self._memory, self._scale = nothing(frame.color.shape[:2]), frame.depth_scale
        return self._memory


@jit
def fuse(
    depth: NDArray[Any], memory: Memory, gate: Gate, frames: int, longest: int
) -> tuple[int, int]:
    """Take one more depth image into a mean.

    Args:
        depth: (H, W) native, 0 = missing, finite.
        memory: In and out.
        gate: What is mixed with it.
        frames: A frame is at least one of so many parts of a mean.
        longest: How many frames without depth a mean outlasts.

    Returns:
        How many pixels started anew, and how many had depth before and have it now.
    """
    (mean, held, age), fresh, known = memory, 0, 0
    for v in range(depth.shape[0]):
        for u in range(depth.shape[1]):
            z = np.float32(depth[v, u])
            if z <= 0 or z >= gate.end:
                if mean[v, u] > 0:
                    age[v, u] += 1
                    if age[v, u] > longest:
                        mean[v, u] = 0
                continue
            age[v, u] = 0
            step = z - mean[v, u]
            known += mean[v, u] > 0
            widest = max(gate.step, gate.noise + gate.growth * mean[v, u])
            if mean[v, u] > 0 and abs(step) <= widest:
                held[v, u] = min(held[v, u] + 1, frames)
                mean[v, u] += step / np.float32(held[v, u])
            else:
                fresh += mean[v, u] > 0
                mean[v, u], held[v, u] = z, 1
    return fresh, known
