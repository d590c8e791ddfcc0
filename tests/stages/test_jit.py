from __future__ import annotations

import os
import platform
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from numba.core.errors import NumbaError
from numba.core.runtime import _nrt_python as _nrt
from numba.core.runtime import rtsys

import mushpipe
from mushpipe import Mask, Stage
from mushpipe.core import jit as jitting
from mushpipe.sources.synthetic import SyntheticSource
from mushpipe.stages.cap_fit import CapFit
from mushpipe.stages.depth_correct import DepthCorrect
from mushpipe.stages.fuse_depth import FuseDepth
from mushpipe.stages.phase_hough import PhaseHough

SCRIPT = """
import numpy as np
from mushpipe.stages.cap.linear import cholesky
matrix = 4 * np.eye(8)
print(cholesky(matrix), matrix[0, 0])  # the inverse of the factor's diagonal
"""

TARGET = """
from llvmlite.binding import get_host_cpu_features
from mushpipe.core import jit
from numba.core.registry import cpu_target
import numpy as np
@jit.jit
def total(values):
    most = 0.0
    for value in values:
        most += value * value
    return most
total(np.ones(1000))
_, name, features = cpu_target.target_context.codegen().magic_tuple()
print(name, features == "", "zmm" in total.inspect_asm(total.signatures[0]),
      all(get_host_cpu_features().get(each) for each in jit._NEEDED))
"""

HELPER = """
from mushpipe.core.jit import jit
import numpy as np
@jit
def longest(rows):
    best = 0.0
    for row in rows:
        best = max(best, np.sort(row * row).sum())
    return best
@jit
def kernel(rows):
    return longest(rows) + longest(rows[1:]) + longest(rows[2:])
kernel(np.ones((3, 3)))
(code,) = kernel.inspect_asm().values()
print("longest" in code, sum(".weak" in line and "longest" in line for line in code.splitlines()))
"""


def test_a_kernel_never_calls_the_copy_of_another(tmp_path: Path) -> None:
    """Else it matters for the last digits what was compiled or loaded before."""
    environment = {**os.environ, "PYTHONPATH": str(Path(mushpipe.__file__).parents[1])}
    (tmp_path / "kernels.py").write_text(HELPER)
    done = subprocess.run(
        [sys.executable, str(tmp_path / "kernels.py")],
        env=environment,
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.stdout == "True 0\n", done.stderr


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
    assert (done.returncode, done.stdout.strip()) == (0, "True 0.5"), done.stderr


def test_kernels_are_compiled_anew_where_one_changed_and_only_there(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    own, kernel, other = (tmp_path / name for name in ("core/jit.py", "kernel.py", "console.py"))
    own.parent.mkdir()
    own.write_text("")
    monkeypatch.setattr(jitting, "__file__", str(own))
    folders = []
    for number in ("a = 1", "a = 2"):
        for file in (other, kernel):
            text = "from mushpipe.core.jit import jit" if file is kernel else "# mushpipe.core.jit"
            file.write_text(f"{text}\n{number}\n")
            folders.append(jitting._cache_folder())
    assert folders[1] == folders[2]
    assert folders[1] != folders[3]


@pytest.mark.parametrize("stage", [CapFit, DepthCorrect, FuseDepth, PhaseHough])
def test_defaults_are_floats_where_settings_are(stage: type[Stage]) -> None:
    """To a kernel an int is another type: it would be compiled anew where a graph states one."""
    for name, field in stage.model_fields.items():
        numbers = field.default if isinstance(field.default, tuple) else (field.default,)
        if "float" in str(field.annotation):
            assert not any(type(number) is int for number in numbers), name


def test_kernels_that_count_no_references_leave_none_behind() -> None:
    frame = next(SyntheticSource(seed=3, width=320, height=240, count=30).frames())
    detect, pose = PhaseHough(radius_px=(8, 38)), CapFit(min_score=0.5)
    for stage in (detect, pose):
        stage.open()
    _nrt.memsys_enable_stats()
    balances = []
    for _ in range(3):
        circles = detect.process(frame, Mask(frame.gray > 0.4))
        assert len(pose.process(frame, circles)[2]) > 5
        del circles
        stats = rtsys.get_allocation_stats()
        balances.append((stats.alloc - stats.free, stats.mi_alloc - stats.mi_free))
    assert balances[0] == balances[1] == balances[2]


def test_a_kernel_that_counts_no_references_cannot_make_an_array() -> None:
    @jitting.borrower
    def make(n: int) -> float:
        values = np.empty(n)
        values[0] = 1.0
        return float(values[0])

    with pytest.raises(NumbaError, match="Only accept returning of array passed"):
        make(3)


@pytest.mark.skipif(platform.machine() != "x86_64", reason="another kind of processor")
def test_kernels_are_the_same_on_all_x86_processors_of_the_last_ten_years() -> None:
    def compiled(**names: str) -> list[str]:
        environment = {k: v for k, v in os.environ.items() if not k.startswith("NUMBA_CPU")}
        command = [sys.executable, "-c", TARGET]
        printed = subprocess.run(
            command, env=environment | names, capture_output=True, text=True, check=True
        )
        return printed.stdout.split()

    name, bare, wide, able = compiled()
    assert wide == "False"
    assert (name, bare) == ("x86-64-v3", "True") or able == "False"
    assert compiled(NUMBA_CPU_NAME="x86-64")[0] == "x86-64"


def test_the_first_run_of_all_is_told_of_where_no_terminal_shows_it(tmp_path: Path) -> None:
    graph = tmp_path / "graph.yaml"
    graph.write_text(
        "mushpipe: 1\n"
        "source: {use: synthetic, max_frames: 1, width: 64, height: 48, distance: 0.3}\n"
        "stages: {correct: {use: depth-correct}}\n"
    )
    told = [
        subprocess.run(
            [sys.executable, "-m", "mushpipe", "run", "graph.yaml"],
            cwd=tmp_path,
            env={**os.environ, "NUMBA_CACHE_DIR": str(tmp_path / "kernels")},
            capture_output=True,
            text=True,
            check=True,
        ).stderr
        for _ in range(2)
    ]
    assert ["the first run of all compiles" in text for text in told] == [True, False]
