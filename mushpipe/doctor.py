"""The verb `mushpipe doctor`: what this computer lacks, and what to do about it."""

from __future__ import annotations

import json
import os
import platform
import sys
import tempfile
import time
from collections.abc import Iterator
from contextlib import suppress
from dataclasses import asdict, dataclass
from enum import StrEnum
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from textwrap import dedent
from typing import Annotated

import typer

from mushpipe.core.errors import EXIT_FAILED, EXIT_NO_DEVICE, EXIT_OK, DependencyError
from mushpipe.output import Output, OutputOption

_PACKAGES = ("mushpipe", "numpy", "opencv-python-headless", "scipy", "numba", "mcap", "rerun-sdk")
# 640x480 colour and depth at 30 frames/s, as `mushpipe record` stores them
_NEEDED_MB_S = 20.0
_TRIAL = 32
_MB = 1_000_000


class State(StrEnum):
    """What a finding means."""

    ok = "ok"
    note = "note"
    warning = "warning"
    error = "error"


@dataclass(frozen=True)
class Finding:
    """One thing that was looked at; ``cure`` says what to do, empty where nothing is."""

    name: str
    state: State
    text: str
    cure: str = ""


CameraOption = Annotated[
    bool, typer.Option("--camera", "--device", help="a camera must be there: exit with 5 if not")
]
FolderOption = Annotated[Path, typer.Option(help="where recordings will go")]


def register(app: typer.Typer) -> None:
    """Add the verb to the program."""
    app.command("doctor")(doctor)


def doctor(
    camera: CameraOption = False,
    folder: FolderOption = Path(),
    output: OutputOption = Output.text,
) -> None:
    """Look at this computer, its libraries and its cameras; say what is wrong and what to do."""
    findings = [*_python(), *_libraries(), *_plugins(), *_kernels(), *_disk(folder)]
    failed = any(finding.state is State.error for finding in findings)
    cameras = list(_cameras())
    findings += [*cameras, *_without_permission()]
    if not cameras:
        findings.append(_no_camera(State.error if camera else State.note))
    if output is Output.json:
        sys.stdout.write(json.dumps([asdict(finding) for finding in findings]) + "\n")
    else:
        _show(findings)
    if camera and not cameras:
        raise typer.Exit(EXIT_NO_DEVICE)
    raise typer.Exit(EXIT_FAILED if failed else EXIT_OK)


def _python() -> Iterator[Finding]:
    text = f"{platform.python_version()} on {platform.system()} {platform.machine()}"
    right = sys.version_info[:2] == (3, 11)
    cure = "" if right else "an SR300 needs Python 3.11; all else works with newer ones"
    yield Finding("Python", State.ok if right else State.note, text, cure)


def _libraries() -> Iterator[Finding]:
    from mushpipe.core.libraries import import_onnxruntime, import_open3d, import_realsense

    native = {
        "open3d": import_open3d,
        "onnxruntime": import_onnxruntime,
        "pyrealsense2": import_realsense,
    }
    for name in _PACKAGES:
        try:
            yield Finding(name, State.ok, version(name))
        except PackageNotFoundError:
            yield Finding(name, State.error, "is not installed", f"pip install {name}")
    for name, load in native.items():
        try:
            module = load()
        except DependencyError as error:
            text, _, cure = str(error).partition(": ")
            yield Finding(name, State.error, text, cure)
        else:
            yield Finding(name, State.ok, getattr(module, "__version__", "") or version(name))


def _plugins() -> Iterator[Finding]:
    from mushpipe.core.plugins import load_registry

    registry = load_registry()
    for broken in registry.broken:
        cure = f"pip install --upgrade {broken.distribution}, or mend or uninstall it"
        yield Finding(f"plugin {broken.name}", State.error, broken.reason, cure)
    for (kind, name), entries in registry.entries.items():
        if len(entries) > 1:
            packages = [entry.distribution for entry in entries]
            text = f"is provided by {' and '.join(packages)}"
            cure = f"write {packages[0]}:{name} in graphs, or uninstall one"
            if len(set(packages)) == 1:
                cure = f"{packages[0]} must register it once"
            yield Finding(f"{kind} {name}", State.warning, text, cure)
    if not registry.broken:
        yield Finding("plugins", State.ok, f"{len(registry.entries)} registered, none failed")


def _kernels() -> Iterator[Finding]:
    import numba

    import mushpipe.core.jit  # noqa: F401 - chooses the folder

    folder = Path(os.environ.get("NUMBA_CACHE_DIR") or str(numba.config.CACHE_DIR))  # type: ignore[attr-defined]
    try:
        folder.mkdir(parents=True, exist_ok=True)
        tempfile.TemporaryFile(dir=folder).close()
    except OSError as error:
        cure = "set NUMBA_CACHE_DIR to a folder that can be written; else every start compiles"
        yield Finding("kernel cache", State.warning, f"{folder}: {error.strerror}", cure)
        return
    count = sum(1 for _ in folder.rglob("*.nbc"))
    first = "" if count else "the first run compiles them, which takes a while"
    yield Finding("kernel cache", State.ok, f"{folder}: {count} kernels", first)


def _disk(folder: Path) -> Iterator[Finding]:
    try:
        speed, free = _write_speed(folder), _free(folder)
    except OSError as error:
        cure = "choose another folder with --folder"
        yield Finding("disk", State.error, f"{folder.absolute()}: {error.strerror}", cure)
        return
    minutes = free / (_NEEDED_MB_S * _MB) / 60
    text = f"{folder.absolute()}: {speed:.0f} MB/s, {free / 1e9:.0f} GB free ({minutes:.0f} min)"
    slow = "too slow for 30 frames/s: record with --colour jpeg, or to another disk"
    full = "soon full: make room, or record to another disk"
    cure = slow if speed < 1.5 * _NEEDED_MB_S else full if minutes < 10 else ""
    yield Finding("disk", State.warning if cure else State.ok, text, cure)


def _free(folder: Path) -> int:
    status = os.statvfs(folder)
    return status.f_bavail * status.f_frsize


def _write_speed(folder: Path) -> float:
    """Return MB/s of a short file, up to the disk itself."""
    block = os.urandom(_MB)
    with tempfile.TemporaryFile(dir=folder) as file:
        begin = time.monotonic()
        for _ in range(_TRIAL):
            file.write(block)
        file.flush()
        os.fsync(file.fileno())
        return _TRIAL / max(time.monotonic() - begin, 1e-9)


def _cameras() -> Iterator[Finding]:
    from mushpipe.core.libraries import import_realsense
    from mushpipe.sources.realsense_device import info

    with suppress(DependencyError):  # told among the libraries
        for item in import_realsense().context().query_devices():
            with suppress(RuntimeError):  # it goes while it is asked
                yield _camera(info(item))


def _camera(told: dict[str, str]) -> Finding:
    usb = told.get("usb_type_descriptor", "unknown")
    text = (
        f"{told.get('name')}, serial number {told.get('serial_number')}, "
        f"firmware {told.get('firmware_version', 'unknown')}, USB {usb}"
    )
    if usb.startswith("2"):
        cure = "use a USB 3 port and cable: not every size and rate is there on USB 2"
        return Finding("camera", State.warning, text, cure)
    return Finding("camera", State.ok, text)


def _no_camera(state: State) -> Finding:
    from mushpipe.sources import realsense_device as device

    text, _, rest = str(device.no_camera(device.USB)).partition("\n")
    return Finding("camera", state, text, dedent(rest))


def _without_permission() -> Iterator[Finding]:
    """Tell of cameras on USB that this user may not open, with the udev rule that they need."""
    from mushpipe.sources import realsense_device as device

    for product, name, node in device.cameras_on_usb(device.USB):
        if not os.access(node, os.W_OK):
            cure = dedent(f"    {device.PERMIT}\n    {device.UDEV_RULE.format(product=product)}")
            yield Finding("USB", State.error, f"{name}: no permission for {node}", cure)


def _show(findings: list[Finding]) -> None:
    """Print a table on a terminal, and plain lines elsewhere."""
    from rich.console import Console
    from rich.markup import escape
    from rich.table import Table

    console = Console(file=sys.stdout, highlight=False)
    if not console.is_terminal:
        for finding in findings:
            sys.stdout.write(f"{finding.state.upper():8}{finding.name}: {finding.text}\n")
            for line in finding.cure.splitlines():
                sys.stdout.write(f"{'':8}-> {line}\n")
        return
    colours = {State.ok: "green", State.note: "cyan", State.warning: "yellow", State.error: "red"}
    table = Table("", "what", "found", "what to do", box=None, pad_edge=False)
    for column in table.columns:
        column.overflow = "fold"
    for finding in findings:
        state = f"[{colours[finding.state]}]{finding.state}[/]"
        table.add_row(state, *map(escape, (finding.name, finding.text, finding.cure)))
    console.print(table)
