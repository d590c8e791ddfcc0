from __future__ import annotations

from pathlib import Path

import pytest

from tests.cli.shell import GRAPH


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """A folder with `GRAPH` as graph.yaml."""
    (tmp_path / "graph.yaml").write_text(GRAPH)
    return tmp_path
