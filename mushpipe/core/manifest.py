"""What a run was made of, so that it can be repeated: graph, versions, recording, seed."""

from __future__ import annotations

import hashlib
import platform
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

from mushpipe.core.errors import InputError
from mushpipe.core.files import files_of, recording_of
from mushpipe.core.plan import Plan
from mushpipe.core.stage import RunInfo

_LIBRARIES = ("mushpipe", "numpy", "opencv-python-headless", "scikit-image", "scipy", "mcap")


def build_manifest(plan: Plan) -> dict[str, Any]:
    """Describe a run before it starts, as plain data without any wall-clock time."""
    graph = plan.resolved()
    for node in plan.sinks:  # in which folder a result was written is none of its content
        graph["sinks"][node.name] |= node.paths
    return {
        "graph_file": plan.file,
        "graph": graph,
        "overrides": list(plan.overrides),
        "seed": plan.seed,
        "recordings": [_describe(path) for path in files_of(plan.source)],
        "versions": {"python": platform.python_version(), **_versions(plan)},
    }


def _describe(path: Path) -> dict[str, Any]:
    if not path.is_file():
        return {"file": path.name, "sha256": None, "bytes": None}
    return {"file": path.name, "sha256": sha256(path), "bytes": path.stat().st_size}


def sha256(path: Path) -> str:
    """Return the SHA-256 of a file, in hexadecimal digits.

    Raises:
        InputError: It cannot be read.
    """
    try:
        with path.open("rb") as file:
            return hashlib.file_digest(file, "sha256").hexdigest()
    except OSError as error:
        raise InputError(f"{path}: cannot be read: {error.strerror}") from error


def _versions(plan: Plan) -> dict[str, str]:
    packages = {type(node.plugin).__module__.partition(".")[0] for node in plan.nodes}
    found = {}
    for name in sorted({*_LIBRARIES, *packages}):
        try:
            found[name] = version(name)
        except PackageNotFoundError:
            continue
    return found


def manifest_path(plan: Plan) -> Path:
    """Return where a run's manifest goes: beside its first result file, else ``run.json``."""
    info = RunInfo(recording_of(plan.source), {})
    for node in plan.sinks:
        for path in files_of(node, info):
            if path.is_file() or not path.exists():  # not beside a device such as /dev/null
                return manifest_of(path)
    return Path("run.json")


def manifest_of(path: Path) -> Path:
    """Return where the manifest goes of the run that writes or repeats a file.

    The whole name is kept: ``bed.mcap`` and ``bed.rrd`` may be of two runs.
    """
    return path.with_name(f"{path.name}.run.json")
