"""Ctrl-C and SIGTERM: once finishes the frame and closes the files."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
from pathlib import Path

import pytest
from mcap.reader import make_reader

from mushpipe.core.errors import EXIT_INTERRUPTED
from tests.cli.shell import ROOT

GRAPH = f"""\
mushpipe: 1
source: {{use: mcap, path: {ROOT / "recordings" / "first-bed.mcap"}, loop: 0}}
stages:
  say: {{use: "./say.py:Say"}}
sinks:
  log: {{use: mcap, path: out.mcap, frames: false}}
"""
# Tells on stdout that a frame is being processed, so that the test need not guess by time.
SAY = """\
import sys
from mushpipe import Mask, RgbdFrame, Stage

class Say(Stage):
    def process(self, frame: RgbdFrame) -> Mask:
        sys.stdout.write("frame\\n"); sys.stdout.flush()
        return Mask(frame.gray > 0.5)
"""


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_one_signal_ends_the_run_in_order(tmp_path: Path, number: signal.Signals) -> None:
    (tmp_path / "graph.yaml").write_text(GRAPH)
    (tmp_path / "say.py").write_text(SAY)
    code = "from mushpipe.cli import main; main()"
    process = subprocess.Popen(
        [sys.executable, "-c", code, "run", "graph.yaml"],
        cwd=tmp_path,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )
    assert process.stdout is not None
    assert process.stdout.readline() == "frame\n"
    process.send_signal(number)
    _, stderr = process.communicate(timeout=60)
    assert process.returncode == EXIT_INTERRUPTED, stderr
    assert f"{number.name}: finishing this frame" in stderr
    with (tmp_path / "out.mcap").open("rb") as file:
        summary = make_reader(file).get_summary()
    assert summary is not None
    assert summary.statistics is not None
    assert f"{summary.statistics.message_count // 2} processed" in stderr


def test_where_native_code_crashes_is_told(tmp_path: Path) -> None:
    """A library of a plugin may abort; that was all one saw of it."""
    (tmp_path / "graph.yaml").write_text(GRAPH)
    crash = SAY.replace("import sys", "import os").replace(
        'sys.stdout.write("frame\\n"); sys.stdout.flush()', "os.abort()"
    )
    (tmp_path / "say.py").write_text(crash)
    command = [sys.executable, "-m", "mushpipe", "run", "graph.yaml"]
    ended = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, check=False)
    assert ended.returncode == -signal.SIGABRT
    assert f'File "{tmp_path / "say.py"}", line 6 in process' in ended.stderr


def test_who_reads_our_output_may_have_read_enough() -> None:
    """As `| head` does, which is no failure of ours."""
    read, write = os.pipe()
    os.close(read)
    command = [sys.executable, "-m", "mushpipe", "plugins", "list"]
    done = subprocess.run(command, stdout=write, stderr=subprocess.PIPE, text=True, check=False)
    os.close(write)
    assert (done.returncode, done.stderr) == (0, "")


@pytest.mark.parametrize("begun", ["numpy", "typer", "mushpipe.core.plan"])
def test_ctrl_c_while_the_program_is_imported_is_one_line(tmp_path: Path, begun: str) -> None:
    """It was a traceback into whatever was being imported."""
    (tmp_path / "sitecustomize.py").write_text(
        f"""\
import os, signal, sys

class Interrupt:
    def find_spec(self, name, *_):
        if name == {begun!r}:
            os.kill(os.getpid(), signal.SIGINT)

sys.meta_path.insert(0, Interrupt())
"""
    )
    path = os.pathsep.join([str(tmp_path), *filter(None, sys.path)])
    done = subprocess.run(
        [sys.executable, "-m", "mushpipe", "bench", "graph.yaml"],
        cwd=tmp_path, env={**os.environ, "PYTHONPATH": path},
        capture_output=True, text=True, check=False,
    )  # fmt: skip
    assert (done.returncode, done.stderr) == (EXIT_INTERRUPTED, "SIGINT: interrupted\n")


def test_other_programs_keep_their_ctrl_c() -> None:
    code = "import signal, mushpipe.cli; print(signal.getsignal(signal.SIGINT).__name__)"
    command = [sys.executable, "-c", code]
    done = subprocess.run(command, capture_output=True, text=True, check=True)
    assert done.stdout == "default_int_handler\n"


def test_modules_of_packages_that_import_mushpipe_keep_their_ctrl_c(tmp_path: Path) -> None:
    """Such a package is imported while `-m` still stands for the module."""
    (tmp_path / "package").mkdir()
    (tmp_path / "package" / "__init__.py").write_text("import mushpipe\n")
    code = "import signal; print(signal.getsignal(signal.SIGINT).__name__)\n"
    (tmp_path / "package" / "tool.py").write_text(code)
    path = os.pathsep.join([str(tmp_path), *filter(None, sys.path)])
    done = subprocess.run(
        [sys.executable, "-m", "package.tool", "mushpipe"],
        env={**os.environ, "PYTHONPATH": path}, capture_output=True, text=True, check=True,
    )  # fmt: skip
    assert done.stdout == "default_int_handler\n"


@pytest.mark.parametrize("verb", [["run"], ["bench", "--frames", "100000"]])
def test_ctrl_c_may_end_who_reads_our_errors_first(tmp_path: Path, verb: list[str]) -> None:
    """As with `2>&1 | tee`: it passed for a run without fault, whose frame was not finished."""
    (tmp_path / "graph.yaml").write_text(GRAPH)
    (tmp_path / "say.py").write_text(SAY)
    read, write = os.pipe()
    process = subprocess.Popen(
        [sys.executable, "-m", "mushpipe", *verb, "graph.yaml"],
        cwd=tmp_path, stdout=subprocess.PIPE, stderr=write, text=True,
    )  # fmt: skip
    os.close(write)
    assert process.stdout is not None
    assert process.stdout.readline() == "frame\n"
    os.close(read)
    process.send_signal(signal.SIGINT)
    process.communicate(timeout=60)
    assert process.returncode == EXIT_INTERRUPTED


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_a_bench_that_is_interrupted_says_so_and_leaves_nothing(
    tmp_path: Path, number: signal.Signals
) -> None:
    (tmp_path / "graph.yaml").write_text(GRAPH)
    (tmp_path / "say.py").write_text(SAY)
    (tmp_path / "tmp").mkdir()
    process = subprocess.Popen(
        [sys.executable, "-m", "mushpipe", "bench", "graph.yaml", "--frames", "100000"],
        cwd=tmp_path, env={**os.environ, "TMPDIR": str(tmp_path / "tmp")},
        stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True,
    )  # fmt: skip
    assert process.stdout is not None
    assert process.stdout.readline() == "frame\n"
    process.send_signal(number)
    _, stderr = process.communicate(timeout=60)
    assert process.returncode == EXIT_INTERRUPTED, stderr
    assert stderr.endswith(f"{number.name}: interrupted\n")
    assert not list((tmp_path / "tmp").glob("mushpipe-*"))
