from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

from tests.evaluate.scenes import (
    bed,
    picks_of,
    write_recording,
    write_results,
)

GRAPH = """
mushpipe: 1
source: {use: mcap, path: bed.mcap}
stages:
  segment: {use: otsu}
  detect:  {use: hough, radius_px: [8, 45]}
  locate:  {use: nearest-depth}
  pick:    {use: picks}
sinks:
  log: {use: mcap, path: must-not-be-written.mcap}
"""


@pytest.fixture
def truths() -> dict[int, Any]:
    return {i: bed(i) for i in range(3)}


@pytest.fixture
def perfect(tmp_path: Path, truths: dict[int, Any]) -> Path:
    answers = {i: picks_of(truth) for i, truth in truths.items()}
    return write_results(tmp_path / "perfect.mcap", answers, truths, milliseconds=2.5)


@pytest.fixture
def graph(tmp_path: Path, truths: dict[int, Any]) -> Path:
    write_recording(tmp_path / "bed.mcap", truths)
    path = tmp_path / "graph.yaml"
    path.write_text(GRAPH)
    return path
