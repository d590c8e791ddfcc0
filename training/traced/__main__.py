"""Render beds into a recording with truth: `python -m training.traced --out FILE`.

Needs Mitsuba (`pip install -e '.[traced]'`) and LLVM 15 or newer (Debian: `libllvm15`; where it is
not found, DRJIT_LIBLLVM_PATH names the library). About ten seconds per frame on two cores.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import numpy as np

from mushpipe import Camera, Header, RgbdFrame
from mushpipe.core.recorder import RecordingWriter
from mushpipe.core.truth import TRUTH_TOPIC
from mushpipe.core.types import COLOR_FRAME
from training.traced.bed import drawn
from training.traced.cameras import UNIT, coded_light, photograph, stereo
from training.traced.render import traced
from training.traced.truth import truth_of

CAMERA = Camera(640, 480, 610.0, 610.0, 319.5, 239.5)
JPEG_QUALITY = 92
START_NS = 1_700_000_000 * 10**9


def frame_of(seed: int, number: int, samples: int) -> RgbdFrame:
    """Return the frame of a seed, with its truth; every second has depth by stereo."""
    rng = np.random.default_rng([seed, 0])
    bed = drawn(rng, np.array([CAMERA.width, CAMERA.height]) / 2 / CAMERA.fx)
    view = traced(bed, CAMERA, samples, seed)
    depth = (stereo if seed % 2 else coded_light)(view, CAMERA.fx, rng)
    header = Header(START_NS + number * 10**9, number, COLOR_FRAME)
    truth = {TRUTH_TOPIC: truth_of(bed, view, CAMERA)}
    return RgbdFrame(header, photograph(view.light, rng), depth, UNIT, CAMERA, truth)


def main() -> None:
    """Read the command line."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--out", type=Path, default=Path("out/traced/traced.mcap"))
    parser.add_argument("--frames", type=int, default=24)
    parser.add_argument("--first-seed", type=int, default=0)
    parser.add_argument("--samples", type=int, default=32, help="paths per pixel")
    arguments = parser.parse_args()
    arguments.out.parent.mkdir(parents=True, exist_ok=True)
    writer = RecordingWriter(arguments.out, {})
    try:
        for number in range(arguments.frames):
            frame = frame_of(arguments.first_seed + number, number, arguments.samples)
            writer.frame(frame, JPEG_QUALITY)
    finally:
        writer.close()
    print(arguments.out)


if __name__ == "__main__":
    main()
