"""numba's `njit`, cached on disk where that is possible."""

from __future__ import annotations

import hashlib
import os
import platform
import shutil
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any, TypeVar, cast

import numba
from llvmlite.binding import get_host_cpu_features
from numba import njit
from numba.core.codegen import JITCodeLibrary, JITCPUCodegen

F = TypeVar("F", bound=Callable[..., Any])
_FAST = {"reassoc", "contract", "arcp", "nsz"}


def _cache_folder() -> Path:
    """Return a folder for compiled kernels that is new whenever the source of any kernel is.

    numba looks only at the file of the kernel that is called: change one that it calls, in another
    file, and the old code goes on running.
    """
    package = Path(__file__).parents[1]
    digest = hashlib.sha256()
    for path in sorted(package.rglob("*.py")):
        text = path.read_bytes()
        if b"core.jit import" in text or path == Path(__file__):
            digest.update(text)
    folder = package / "__pycache__"
    if not os.access(folder if folder.exists() else package, os.W_OK):
        folder = Path.home() / ".cache" / "mushpipe"
    folder = folder / f"kernels-{digest.hexdigest()[:12]}"
    for old in folder.parent.glob("kernels-*"):
        # a younger one may be another process's, started before the source changed
        if old != folder and old.stat().st_mtime < time.time() - 86_400:
            shutil.rmtree(old, ignore_errors=True)
    return folder


_TARGET = "x86-64-v3"  # AVX2 and FMA, which x86 processors have since about 2013
_NEEDED = ("avx2", "fma", "bmi", "bmi2", "f16c", "lzcnt", "movbe")


def _same_everywhere() -> None:
    """Compile the same code on all x86 processors that can run it.

    Code for the processor at hand sums in an order of its own, and what is decided by a hair falls
    otherwise: of one frame of 119 circles a fifth moved by more than a thousandth.
    """
    if platform.machine() != "x86_64" or os.environ.get("NUMBA_CPU_NAME"):
        return
    known = get_host_cpu_features()
    if all(known.get(name) for name in _NEEDED):
        numba.config.CPU_NAME, numba.config.CPU_FEATURES = _TARGET, ""  # type: ignore[attr-defined]


_same_everywhere()
if not os.environ.get("NUMBA_CACHE_DIR"):
    numba.config.CACHE_DIR = str(_cache_folder())  # type: ignore[attr-defined]


def cold() -> bool:
    """Return whether nothing was compiled yet: the first run of all takes a minute or two more."""
    return next(Path(numba.config.CACHE_DIR).rglob("*.nbi"), None) is None  # type: ignore[attr-defined]


class _SelfContained(JITCodeLibrary):
    """A kernel with copies of all that it calls for itself.

    numba lets the linker take the copy that was loaded first, be it another kernel's, optimised
    beside other code. Sums in it may then be ordered otherwise, and results differ in their last
    digits between the run that compiles and those that load what it compiled.
    """

    def _optimize_final_module(self) -> None:
        for function in self._final_module.functions:
            if not function.is_declaration and function.linkage.name == "linkonce_odr":
                function.linkage = "internal"
        super()._optimize_final_module()  # type: ignore[no-untyped-call]


JITCPUCodegen._library_class = _SelfContained


def jit(function: F) -> F:
    """Compile a kernel on first use; on a machine without a writable cache, in every process.

    Sums may be reordered, but NaN and infinity keep their meaning: missing depth is NaN. Division
    by zero gives infinity and does not raise.
    """
    return _compiled(function, counting=True)


def borrower(function: F) -> F:
    """Compile a kernel that neither makes nor returns an array, and so counts no references.

    numba counts them atomically wherever an array is passed on, sliced or taken out of a tuple,
    which costs small kernels a fifth of their time. All that they work on belongs to their caller.
    """
    return _compiled(function, counting=False)


def _compiled(function: F, counting: bool) -> F:
    options: dict[str, Any] = {
        "nogil": True,
        "fastmath": _FAST,
        "error_model": "numpy",
        "_nrt": counting,
        "no_cfunc_wrapper": True,  # nobody calls them from C; it would take a sixth of the time
    }
    try:
        return cast(F, njit(cache=True, **options)(function))
    except RuntimeError:  # numba found no folder it may write to
        return cast(F, njit(**options)(function))


def inlined(function: F) -> F:
    """Make a part of kernels that is copied into them, so that loops around it use SIMD."""
    return cast(F, njit(inline="always", fastmath=_FAST, error_model="numpy")(function))
