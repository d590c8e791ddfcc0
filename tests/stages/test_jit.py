from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

import mushpipe
from mushpipe.core import jit as jitting

SCRIPT = """
import numpy as np
from mushpipe.stages.chan_vese_fast import solve_fast
image = np.zeros((40, 40), np.float32)
image[10:30, 10:30] = 1
print(int(solve_fast(image, image > 0.5, 0.1).sum()))
"""


def test_kernels_run_where_numba_may_write_nothing(monkeypatch: pytest.MonkeyPatch) -> None:
    asked: list[bool] = []

    def njit(cache: bool = False, **options: object) -> object:
        asked.append(cache)
        if cache:
            raise RuntimeError("cannot cache function: no locator available")
        return lambda function: function

    monkeypatch.setattr(jitting, "njit", njit)
    assert jitting.jit(len)("four") == 4
    assert asked == [True, False]


def test_a_broken_cache_folder_stops_nothing(tmp_path: Path) -> None:
    blocked = tmp_path / "file"
    blocked.write_text("")
    root = str(Path(mushpipe.__file__).parents[1])
    environment = {**os.environ, "NUMBA_CACHE_DIR": str(blocked / "cache"), "PYTHONPATH": root}
    done = subprocess.run(
        [sys.executable, "-c", SCRIPT], env=environment, capture_output=True, text=True, check=False
    )
    assert (done.returncode, done.stdout.strip()) == (0, "400"), done.stderr
