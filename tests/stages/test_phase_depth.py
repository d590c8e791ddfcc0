from __future__ import annotations

import numpy as np
import pytest

from mushpipe.stages.phase.depth import NO_RELIEF, halved
from mushpipe.stages.phase_hough import _foreground


@pytest.mark.parametrize("shape", [(6, 8), (7, 8), (6, 9), (5, 7)])
@pytest.mark.parametrize("native", [np.uint16, np.float32])
def test_depth_is_halved_to_the_mean_of_what_is_known(shape: tuple[int, int], native: type) -> None:
    rng = np.random.default_rng(3)
    depth = rng.integers(1, 900, shape).astype(native)
    depth[rng.random(shape) < 0.4] = 0
    if native is np.float32:
        depth[rng.random(shape) < 0.2] = np.nan
        depth[0, 0] = np.inf
    else:
        depth[rng.random(shape) < 0.2] = 65535
    small = halved(depth, 0.001)
    assert small.shape == ((shape[0] + 1) // 2, (shape[1] + 1) // 2)
    for y, x in np.ndindex(*small.shape):
        cell = depth[2 * y : 2 * y + 2, 2 * x : 2 * x + 2]
        known = cell[(cell > 0) & (cell < 65535)]
        wanted = 0.001 * known.mean(dtype=float) if len(known) else -1
        assert small[y, x] == pytest.approx(wanted, rel=1e-6)


@pytest.mark.parametrize("shape", [(6, 8), (7, 8), (6, 9), (5, 7)])
def test_what_stands_on_the_bed_is_added_to_the_mask(shape: tuple[int, int]) -> None:
    rng = np.random.default_rng(4)
    mask = (rng.random(shape) < 0.3).astype(np.uint8)
    height = rng.random(((shape[0] + 1) // 2, (shape[1] + 1) // 2)).astype(np.float32) / 100
    both = _foreground(mask, NO_RELIEF._replace(height=height))
    for y, x in np.ndindex(*shape):
        assert both[y, x] == (mask[y, x] or height[y // 2, x // 2] > 0.004)
