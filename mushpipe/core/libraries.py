"""Importing the heavy native libraries, with an error that says what the system lacks."""

from __future__ import annotations

import ctypes
import importlib
import re
from contextlib import suppress
from typing import Any

from mushpipe.core.errors import DependencyError

# shared object -> Debian package
_APT = {
    "libEGL.so.1": "libegl1",
    "libGL.so.1": "libgl1",
    "libGLX.so.0": "libgl1",
    "libX11.so.6": "libx11-6",
    "libgomp.so.1": "libgomp1",
    "libusb-1.0.so.0": "libusb-1.0-0",
    "libudev.so.1": "libudev1",
}


def import_open3d() -> Any:
    """Import open3d, with libusb as `import_realsense` has it: open3d links to it for its cameras.

    Raises:
        DependencyError: It is not installed, or a system library is missing.
    """
    _load_libusb()
    return _import("open3d")


def import_realsense() -> Any:
    """Import pyrealsense2, with libusb from the package `libusb-package` already in place.

    Raises:
        DependencyError: It is not installed, or a system library is missing.
    """
    _load_libusb()
    return _import("pyrealsense2")


def import_onnxruntime() -> Any:
    """Import onnxruntime.

    Raises:
        DependencyError: It is not installed, or a system library is missing.
    """
    return _import("onnxruntime")


def _load_libusb() -> None:
    # the system may have its own libusb; if not, the import that needs it says so
    with suppress(ImportError, OSError):
        library = importlib.import_module("libusb_package").get_library_path()
        ctypes.CDLL(str(library), mode=ctypes.RTLD_GLOBAL)


def _import(name: str) -> Any:
    try:
        return importlib.import_module(name)
    except ModuleNotFoundError as error:
        raise DependencyError(f"{name} is not installed: pip install {name}") from error
    except (ImportError, OSError) as error:
        raise DependencyError(explain(name, str(error))) from error


def explain(name: str, message: str) -> str:
    """Return one line that says which Debian package a failed import asks for."""
    missing = re.search(r"(lib[\w.+-]+\.so[.\d]*)", message)
    if missing is None:
        return f"{name} cannot be imported: {message}"
    library = missing.group(1)
    package = _APT.get(library)
    cure = f"apt-get install {package}" if package else f"install the package that has {library}"
    return f"{name} needs the system library {library}: {cure}"
