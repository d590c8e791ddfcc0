"""A live camera, simulated by librealsense's software device, through the product's source."""

from __future__ import annotations

import numpy as np
import pytest

from mushpipe import Camera
from mushpipe.sources.realsense_frames import CLOCK_TOPIC, INCOMPLETE, LOST, Domain
from tests.live.rig import COLOR, DEPTH, HARDWARE, SYSTEM, UNITS, Rig


def test_60_of_60_frames_arrive_exact_and_stay_so():
    """All are kept while more arrive: each must be a copy."""
    flat = Rig(depth=COLOR, baseline=0.0)
    source = flat.source()
    source.open()
    frames, received = source.frames(), []
    for i in range(60):
        flat.feed(i)
        received.append(next(frames))
    for i, frame in enumerate(received):
        assert frame.header.sequence == i
        assert (frame.color == i).all()
        assert frame.depth is not None
        assert set(np.unique(frame.depth)) <= {0, 4000 + i}
        assert (frame.depth == 4000 + i).mean() > 0.97
        assert frame.depth_scale == pytest.approx(UNITS, rel=1e-6)
        assert frame.camera is not None
        assert frame.camera.model == "none"
        assert (frame.camera.fx, frame.camera.cy) == pytest.approx((COLOR.fx, COLOR.cy))
    assert source.counts() == {}
    source.close()
