"""mushpipe: RGB-D camera above a mushroom bed in, pick targets for a robot out.

This module is what a plugin author needs.
"""

import mushpipe.core.interrupt  # noqa: F401 - before what takes long to import
from mushpipe.core.columns import Columns, column
from mushpipe.core.errors import (
    DependencyError,
    DeviceError,
    InputError,
    MushpipeError,
    UsageError,
)
from mushpipe.core.geometry import Camera, quaternion_from_axis
from mushpipe.core.paths import GraphPath, SinkPath
from mushpipe.core.plugins import Registry, hookimpl
from mushpipe.core.stage import ReplaySource, RunInfo, Sink, Source, Stage
from mushpipe.core.tables import (
    Circles,
    DepthSource,
    Locations,
    PickFlag,
    Picks,
    Poses,
)
from mushpipe.core.types import Header, Mask, RgbdFrame, Trace

__all__ = [
    "Camera",
    "Circles",
    "Columns",
    "DependencyError",
    "DepthSource",
    "DeviceError",
    "GraphPath",
    "Header",
    "InputError",
    "Locations",
    "Mask",
    "MushpipeError",
    "PickFlag",
    "Picks",
    "Poses",
    "Registry",
    "ReplaySource",
    "RgbdFrame",
    "RunInfo",
    "Sink",
    "SinkPath",
    "Source",
    "Stage",
    "Trace",
    "UsageError",
    "column",
    "hookimpl",
    "quaternion_from_axis",
]
