"""What flows through a graph, per frame: images, masks and the trace of a frame.

Frozen dataclasses, checked and locked on construction. The per-mushroom types stand in `tables`.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field, fields
from functools import cached_property, partial
from numbers import Real
from types import MappingProxyType
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from mushpipe.core.arrays import Bools, Bytes, Singles, locked
from mushpipe.core.geometry import Camera

T = TypeVar("T")

_FARTHEST_M = 1e5  # the largest number of millimetres that is taken for metres is less
_LATEST_NS = 2**32 * 10**9 - 1  # seconds are recorded in 32 bits
COLOR_FRAME = "camera_color_optical_frame"
"""The frame of the colour images, and of aligned depth, by realsense2_camera's name."""


def end_of_scale(depth: NDArray[Any]) -> np.float32:
    """Return the native value from which on depth is missing; infinity of floats.

    The last of an integer says at most that something is at least so far away.
    """
    last = np.iinfo(depth.dtype).max if depth.dtype.kind == "u" else np.inf
    return np.float32(last)


def known(depth: NDArray[Any]) -> Bools:
    """Return which native values are depth, not missing."""
    return np.asarray((depth > 0) & (depth < end_of_scale(depth)))


@dataclass(frozen=True)
class Header:
    """Where and when a frame was taken.

    Attributes:
        stamp_ns: Sensor time in ns since the epoch.
        sequence: Number of the frame, from 0.
        frame_id: An optical frame: x right, y down, z forward.
        arrival_ns: Host time at which the frame arrived, ns since the epoch.

    Raises:
        TypeError: A time or number is no integer, or `frame_id` no text.
        ValueError: A time or number is below 0, or too large to be recorded.
    """

    stamp_ns: int
    sequence: int
    frame_id: str
    arrival_ns: int = 0

    def __post_init__(self) -> None:
        for name in ("stamp_ns", "sequence", "arrival_ns"):
            value = getattr(self, name)
            if not isinstance(value, int | np.integer):
                raise TypeError(f"{name} of a frame's header is {value!r}, expected an integer")
            most = 2**32 - 1 if name == "sequence" else _LATEST_NS
            if not 0 <= value <= most:
                raise ValueError(f"{name} of a frame's header is {value}, expected 0 to {most}")
            object.__setattr__(self, name, int(value))
        if not isinstance(self.frame_id, str):
            raise TypeError(f"frame_id of a header is {self.frame_id!r}, expected text")
        if not self.arrival_ns:
            object.__setattr__(self, "arrival_ns", self.stamp_ns)


@dataclass(frozen=True, eq=False)
class RgbdFrame:
    """One colour image with the depth image aligned to it.

    Attributes:
        header: Time, number and frame.
        color: (H, W, 3) uint8 RGB.
        depth: (H, W) uint16 or float32 in the sensor's unit, 0 = missing, as is the last number of
            uint16 (see `end_of_scale`); None without depth.
        depth_scale: Metres per unit of `depth`.
        camera: Intrinsics of the colour image; None where the recording has none.
        attached: What else is known of this moment, by topic, and recorded beside the images; the
            truth of a simulator, say. Stages never see it.
    """

    header: Header
    color: Bytes
    depth: NDArray[Any] | None = None
    depth_scale: float = 0.001
    camera: Camera | None = None
    attached: Mapping[str, Any] = field(default_factory=dict)

    def __post_init__(self) -> None:
        for name, kind in (("header", Header), ("camera", Camera | None)):
            if not isinstance(value := getattr(self, name), kind):
                raise TypeError(
                    f"{name} of a frame is of type {type(value).__name__}, expected {name.title()}"
                )
        color = locked(self.color, None)
        if color.dtype != np.uint8 or color.ndim != 3 or color.shape[2] != 3 or not color.size:
            raise ValueError(f"color is {color.dtype}{color.shape}, expected uint8 (H, W, 3)")
        object.__setattr__(self, "color", color)
        if self.depth is not None:
            self._check_depth(locked(self.depth, None))
        size = (self.camera.height, self.camera.width) if self.camera else color.shape[:2]
        if size != color.shape[:2]:
            raise ValueError(
                f"the image is {color.shape[1]}x{color.shape[0]}, "
                f"its calibration is for {size[1]}x{size[0]}"
            )
        object.__setattr__(self, "attached", MappingProxyType(dict(self.attached)))

    def __reduce__(self) -> tuple[Any, ...]:
        """Return how to make it anew: what is read-only of `attached` cannot be pickled."""
        return _anew(self)

    def _check_depth(self, depth: NDArray[Any]) -> None:
        if depth.dtype not in (np.uint16, np.float32):
            raise ValueError(f"depth is {depth.dtype}, expected uint16 or float32")
        if depth.ndim != 2:
            raise ValueError(f"depth has shape {depth.shape}, expected one channel: (H, W)")
        if depth.shape != self.color.shape[:2]:
            raise ValueError(
                f"depth has shape {depth.shape}, colour {self.color.shape[:2]}: "
                "depth must be aligned to colour"
            )
        if not (isinstance(self.depth_scale, Real) and 0 < self.depth_scale < math.inf):
            raise ValueError(f"depth_scale is {self.depth_scale!r}, expected metres per unit > 0")
        object.__setattr__(self, "depth", depth)

    @cached_property
    def gray(self) -> Singles:
        """(H, W) float32 luma (ITU-R BT.601) in 0..1, read-only."""
        import cv2

        luma = cv2.cvtColor(self.color, cv2.COLOR_RGB2GRAY)
        return locked(luma * np.float32(1 / 255), np.float32)

    @cached_property
    def depth_m(self) -> Singles:
        """(H, W) float32 depth in metres, NaN = missing (everywhere without depth), read-only.

        What no camera measures (100 km and more, the end of its scale) is missing as well.
        """
        if self.depth is None:
            return locked(np.full(self.color.shape[:2], np.nan), np.float32)
        import cv2

        unit = np.float32(self.depth_scale)
        metres = self.depth * unit
        farthest = np.minimum(np.float32(_FARTHEST_M), end_of_scale(self.depth) * unit)
        known = (metres > 0) & (metres < farthest)
        # three times as fast as to assign where it is not known
        missing = np.full(metres.shape, np.nan, np.float32)
        return locked(cv2.copyTo(metres, known.view(np.uint8), missing), np.float32)


@dataclass(frozen=True, eq=False)
class Mask:
    """What is mushroom.

    Attributes:
        foreground: (H, W) bool.
        initial: (H, W) bool, the contour the segmenter started from; None where it had none.
    """

    foreground: Bools
    initial: Bools | None = None

    def __post_init__(self) -> None:
        for name in ("foreground", "initial"):
            value = getattr(self, name)
            if value is None and name == "initial":
                continue
            array = locked(value, None)
            if array.dtype != np.bool_ or array.shape != np.shape(self.foreground):
                raise ValueError(f"Mask.{name} is {array.dtype}{array.shape}, expected bool (H, W)")
            object.__setattr__(self, name, array)
        if self.foreground.ndim != 2:
            raise ValueError(f"Mask.foreground has {self.foreground.ndim} dimensions, expected 2")


@dataclass(frozen=True, eq=False)
class Trace:
    """All that happened to one frame; a sink that asks for it gets every stage's output.

    Attributes:
        frame: The frame as the source delivered it.
        outputs: Per stage, in graph order, its outputs.
        durations_ns: Per stage, the wall time it took.
        left_ns: When the frame left its source, ns of ``time.perf_counter_ns``; None of a frame
            that nobody plays now.
    """

    frame: RgbdFrame
    outputs: Mapping[str, tuple[Any, ...]]
    durations_ns: Mapping[str, int]
    left_ns: int | None = None

    def __post_init__(self) -> None:
        for name in ("outputs", "durations_ns"):  # other sinks see the same
            object.__setattr__(self, name, MappingProxyType(dict(getattr(self, name))))

    def of(self, kind: type[T]) -> Iterator[tuple[str, T]]:
        """Yield stage and value of each output of a type, in the order of the graph."""
        for stage, values in self.outputs.items():
            for value in values:
                if isinstance(value, kind):
                    yield stage, value

    def __reduce__(self) -> tuple[Any, ...]:
        """Return how to make it anew: what is read-only cannot be pickled."""
        return _anew(self)


def _anew(value: RgbdFrame | Trace) -> tuple[Any, ...]:
    """Return what makes a frame or trace, or one of a class of a plugin, from plain mappings."""
    given = {each.name: getattr(value, each.name) for each in fields(value)}
    plain = {k: dict(v) if isinstance(v, MappingProxyType) else v for k, v in given.items()}
    its_class: Any = type(value)
    return partial(its_class, **plain), ()
