"""The examples of the documentation: one file, and the same as an installed package."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
EXAMPLE = ROOT / "examples/mushpipe-brightest"


def run(use: str, tmp_path: Path, **environment: str) -> subprocess.CompletedProcess[str]:
    settings = {"segment.use": use, "segment.share": 0.15, "log.path": tmp_path / "log.mcap"}
    overrides = [text for key, value in settings.items() for text in ("--set", f"{key}={value}")]
    code = "from mushpipe.cli import main; main()"
    return subprocess.run(
        [sys.executable, "-c", code, "run", "graphs/classic.yaml", "--frames", "1", *overrides],
        cwd=ROOT,
        env={**os.environ, **environment},
        capture_output=True,
        text=True,
        check=False,
    )


@pytest.fixture
def site(tmp_path: Path) -> Path:
    """A folder of installed packages: the example, and one that cannot be imported."""
    site = tmp_path / "site"
    for name, module in (("mushpipe-brightest", "mushpipe_brightest"), ("broken", "broken_one")):
        info = site / f"{module}-1.0.dist-info"
        info.mkdir(parents=True)
        (info / "METADATA").write_text(f"Metadata-Version: 2.1\nName: {name}\nVersion: 1.0\n")
        (info / "entry_points.txt").write_text(f"[mushpipe]\n{module} = {module}\n")
    (site / "broken_one.py").write_text("import a_library_that_is_not_there\n")
    example = EXAMPLE / "mushpipe_brightest.py"
    (site / "mushpipe_brightest.py").write_text(example.read_text())
    return site


def test_a_segmenter_in_one_file(tmp_path: Path) -> None:
    done = run("./examples/mine.py:Brightest", tmp_path)
    assert done.returncode == 0, done.stderr
    assert "1 processed" in done.stderr


def test_the_same_as_a_package_beside_a_broken_one(tmp_path: Path, site: Path) -> None:
    done = run("brightest", tmp_path, PYTHONPATH=str(site))
    assert done.returncode == 0, done.stderr


def test_a_name_nobody_provides_is_answered_with_what_failed_to_load(
    tmp_path: Path, site: Path
) -> None:
    done = run("brightness", tmp_path, PYTHONPATH=str(site))
    assert done.returncode == 2
    assert "unknown stage 'brightness'; did you mean 'brightest'?" in done.stderr
    assert "it may belong to broken 1.0, which failed to load: ModuleNotFoundError" in done.stderr
