"""What a terminal or a pipe gets: colour codes where they are wanted, each notice once."""

from __future__ import annotations

import logging
import os
import pty
import re
import subprocess
import sys
from pathlib import Path

import pytest

from mushpipe import Trace
from mushpipe.console import set_up_logging
from tests.io.values import make_frame, record

COLOUR = re.compile(rb"\x1b\[[0-9;]*[0-9]m")
CODE = "from mushpipe.cli import main; main()"


@pytest.fixture
def graph(tmp_path: Path) -> Path:
    """Return a graph that warns (its output goes nowhere) and prints a table and a balance."""
    source = record(tmp_path / "bed.mcap", [Trace(make_frame(), {}, {})])
    path = tmp_path / "graph.yaml"
    stages = "stages:\n  segment: {use: otsu, check: false}\n"
    path.write_text(f"mushpipe: 1\nsource: {{use: mcap, path: {source}}}\n{stages}")
    return path


def test_pipes_get_plain_text(graph: Path, tmp_path: Path) -> None:
    command = [sys.executable, "-c", CODE, "run", str(graph)]
    result = subprocess.run(command, capture_output=True, check=True, cwd=tmp_path)
    assert b"1 frames in = 1 processed" in result.stderr
    assert b"\x1b" not in result.stdout + result.stderr


@pytest.mark.parametrize("wanted", [True, False], ids=["colour", "NO_COLOR"])
def test_a_terminal_gets_colours_unless_no_color_is_set(
    graph: Path, tmp_path: Path, wanted: bool
) -> None:
    environment = {k: v for k, v in os.environ.items() if k not in ("NO_COLOR", "FORCE_COLOR")}
    environment |= {"TERM": "xterm-256color"} | ({} if wanted else {"NO_COLOR": "1"})
    ours, theirs = pty.openpty()
    command = [sys.executable, "-c", CODE, "run", str(graph)]
    with subprocess.Popen(
        command, stdout=theirs, stderr=theirs, cwd=tmp_path, env=environment
    ) as process:
        os.close(theirs)
        shown = b"".join(iter(lambda: _read(ours), b""))
        assert process.wait(60) == 0
    os.close(ours)
    assert b"1 frames in = 1 processed" in shown
    assert any(_is_colour(code) for code in COLOUR.findall(shown)) == wanted


def _read(terminal: int) -> bytes:
    try:
        return os.read(terminal, 4096)
    except OSError:  # the other end is closed
        return b""


def _is_colour(code: bytes) -> bool:
    """Return whether a code sets a colour; bold and dim are none."""
    numbers = [int(n) for n in re.findall(rb"\d+", code)]
    return any(30 <= n <= 37 or 40 <= n <= 47 or 90 <= n <= 107 or n in (38, 48) for n in numbers)


def test_a_notice_is_given_once_and_a_warning_each_time(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """`eval --matrix` and `bench` open the same stages several times."""
    logger = logging.getLogger("mushpipe")
    set_up_logging(False)
    for offset in (2.85, 2.85, 3.0):
        logger.info("%g mm are taken off", offset)
        logger.warning("no depth")
    lines = capsys.readouterr().err.splitlines()
    assert [line for line in lines if "INFO" in line] == [
        "INFO: 2.85 mm are taken off",
        "INFO: 3 mm are taken off",
    ]
    assert lines.count("WARNING: no depth") == 3
