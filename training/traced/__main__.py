"""Render beds into two recordings with truth: `python -m training.traced`.

Needs Mitsuba (`pip install -e '.[traced]'`) and LLVM 16 or newer (Debian: `libllvm19`; where it is
not found, DRJIT_LIBLLVM_PATH names the library). About 15 seconds per frame on two cores.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from mushpipe import Camera, Header, RgbdFrame
from mushpipe.core.recorder import RecordingWriter
from mushpipe.core.truth import TRUTH_TOPIC
from mushpipe.core.types import COLOR_FRAME
from training.traced.bed import drawn
from training.traced.cameras import UNIT, coded_light, photograph, stereo
from training.traced.render import View, traced
from training.traced.truth import truth_of

CAMERA = Camera(640, 480, 610.0, 610.0, 319.5, 239.5)
JPEG_QUALITY = 92
START_NS = 1_700_000_000 * 10**9
Sensor = Callable[[View, float, np.random.Generator], NDArray[np.uint16]]
SENSORS: dict[str, Sensor] = {"traced-coded": coded_light, "traced-stereo": stereo}


def frame_of(seed: int, number: int, samples: int, sensor: Sensor) -> RgbdFrame:
    """Return the frame of a seed, with depth as a sensor takes it, and its truth."""
    rng = np.random.default_rng([seed, 0])
    bed = drawn(rng, np.array([CAMERA.width, CAMERA.height]) / 2 / CAMERA.fx)
    view = traced(bed, CAMERA, samples, seed)
    depth = sensor(view, CAMERA.fx, rng)
    header = Header(START_NS + number * 10**9, number, COLOR_FRAME)
    truth = {TRUTH_TOPIC: truth_of(bed, view, CAMERA)}
    return RgbdFrame(header, photograph(view.light, rng), depth, UNIT, CAMERA, truth)


def main() -> None:
    """Read the command line."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--out", type=Path, default=Path("out/traced"), help="a folder")
    parser.add_argument("--frames", type=int, default=12, help="of either kind of depth")
    parser.add_argument("--first-seed", type=int, default=0, help="the kinds take turns from it on")
    parser.add_argument("--samples", type=int, default=32, help="paths per pixel")
    arguments = parser.parse_args()
    arguments.out.mkdir(parents=True, exist_ok=True)
    for kind, (name, sensor) in enumerate(SENSORS.items()):
        writer = RecordingWriter(arguments.out / f"{name}.mcap", {})
        try:
            for number in range(arguments.frames):
                seed = arguments.first_seed + 2 * number + kind
                writer.frame(frame_of(seed, number, arguments.samples, sensor), JPEG_QUALITY)
        finally:
            writer.close()


if __name__ == "__main__":
    main()
