from __future__ import annotations

import numpy as np
import pytest

from mushpipe.stages.doubling import doubled


@pytest.mark.parametrize("shape", [(6, 8), (7, 8), (6, 9), (5, 7)])
@pytest.mark.parametrize("up", [0, 1])
def test_each_pixel_stands_for_four(shape: tuple[int, int], up: int) -> None:
    rng = np.random.default_rng(4)
    small = (rng.random([(size + up) // 2 for size in shape]) < 0.3).astype(np.uint8)
    whole = doubled(small, *shape)
    assert whole.shape == shape
    for y, x in np.ndindex(*shape):
        assert whole[y, x] == small[min(y // 2, len(small) - 1), min(x // 2, small.shape[1] - 1)]
