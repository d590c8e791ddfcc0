"""What a user is told when a native library cannot be imported."""

import importlib
from types import ModuleType, SimpleNamespace

import pytest

from mushpipe.core import libraries
from mushpipe.core.errors import DependencyError


@pytest.fixture
def world(monkeypatch):
    """Say what importing each module gives: a module, or the error it raises."""
    modules: dict[str, object] = {}

    def fake(name: str) -> object:
        found = modules.get(name, ModuleNotFoundError(f"No module named '{name}'"))
        if isinstance(found, Exception):
            raise found
        return found

    monkeypatch.setattr(importlib, "import_module", fake)
    return modules


@pytest.mark.parametrize(
    ("error", "message"),
    [
        (
            ImportError("libEGL.so.1: cannot open shared object file: No such file or directory"),
            "open3d needs the system library libEGL.so.1: apt-get install libegl1",
        ),
        (
            OSError("libGL.so.1: cannot open shared object file: No such file or directory"),
            "open3d needs the system library libGL.so.1: apt-get install libgl1",
        ),
        (
            ImportError("libstrange-2.so.7: cannot open shared object file"),
            "open3d needs the system library libstrange-2.so.7: "
            "install the package that has libstrange-2.so.7",
        ),
        (ImportError("a circle"), "open3d cannot be imported: a circle"),
        (ModuleNotFoundError("x"), "open3d is not installed: pip install open3d"),
    ],
)
def test_a_failed_import_names_its_cure(world, error, message):
    world["open3d"] = error
    with pytest.raises(DependencyError) as caught:
        libraries.import_open3d()
    assert str(caught.value) == message
    assert caught.value.exit_code == 1


def test_a_good_import(world):
    world["open3d"] = ModuleType("open3d")
    assert libraries.import_open3d() is world["open3d"]


@pytest.mark.parametrize(
    ("name", "load"),
    [("pyrealsense2", libraries.import_realsense), ("open3d", libraries.import_open3d)],
)
def test_libusb_is_loaded_before_what_links_to_it(world, monkeypatch, name, load):
    order = []
    world["libusb_package"] = SimpleNamespace(get_library_path=lambda: "/x/libusb-1.0.so")
    world[name] = ModuleType(name)
    monkeypatch.setattr(libraries.ctypes, "CDLL", lambda path, mode: order.append(path))
    assert load() is world[name]
    assert order == ["/x/libusb-1.0.so"]


def test_realsense_may_find_its_libusb_in_the_system(world):
    world["pyrealsense2"] = ModuleType("pyrealsense2")
    assert libraries.import_realsense() is world["pyrealsense2"]
