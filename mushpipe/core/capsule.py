"""Failure capsules: the failing frame and its graph in one small MCAP that can be run again."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

from mushpipe.core.document import Document
from mushpipe.core.errors import UsageError
from mushpipe.core.files import recording_of
from mushpipe.core.plan import Node, Plan
from mushpipe.core.recorder import RecordingWriter
from mushpipe.core.recording import GRAPH, RecordingReader
from mushpipe.core.types import RgbdFrame


def write_capsule(folder: Path, plan: Plan, node: Node, frame: RgbdFrame, message: str) -> Path:
    """Write the frame on which a node failed, with the graph up to it, and return the path.

    Its name says of which recording it is the frame, or with which stamp a camera took it.
    The graph keeps its stages, and of its sinks only a failing one, whose files go beside the
    capsule: running it must not reach a robot or write over results.
    """
    folder.mkdir(parents=True, exist_ok=True)
    number = frame.header.sequence if plan.replay() else frame.header.stamp_ns
    path = folder / f"failure-{recording_of(plan.source)}-{node.name}-{number}.mcap"
    kept = replace(
        plan,
        stages=tuple(map(_anchored, plan.stages)),
        sinks=tuple(_anchored(sink) for sink in plan.sinks if sink.name == node.name),
        on_error="fail",  # one frame: skipping it would show nothing
    )
    kept = kept.into(path.absolute().with_suffix(".out"))
    metadata = {GRAPH: {"json": json.dumps(kept.resolved()), "failure": message}}
    writer = RecordingWriter(path, metadata)
    writer.frame(frame)
    writer.close()
    return path


def _anchored(node: Node) -> Node:
    """Return a node that reads the files it reads now, wherever its graph stands."""
    read = node.plugin.path_settings(written=False)
    here = {name: path.absolute() for name, path in read.items()}
    return replace(node, plugin=node.plugin.model_copy(update=here))


def capsule_document(path: Path) -> Document:
    """Return the graph stored in a capsule, with the capsule as its source.

    Raises:
        UsageError: The file holds no graph.
        InputError: The file cannot be read.
    """
    stored = RecordingReader(path).index().metadata.get(GRAPH)
    if stored is None:
        raise UsageError(
            f"{path} is a recording, not a graph: write a graph file and play the recording with "
            f"mushpipe run GRAPH --source {path}"
        )
    data: dict[str, Any] = json.loads(stored["json"])
    data["source"] = {"use": "mcap", "path": str(path.absolute())}
    return Document(str(path), path.parent, data)
