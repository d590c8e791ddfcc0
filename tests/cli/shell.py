"""The program in a process of its own, and a graph for it."""

from __future__ import annotations

import multiprocessing
import os
import subprocess
import sys
from pathlib import Path
from tempfile import TemporaryDirectory

from mushpipe.cli import main

ROOT = Path(__file__).parents[2]
MAIN = [sys.executable, "-c", "from mushpipe.cli import main; main()"]
GRAPH = f"""\
mushpipe: 1
source: {{use: mcap, path: {ROOT / "recordings" / "first-bed.mcap"}}}
stages:
  segment: {{use: otsu}}
  open:    {{use: opening}}
  detect:  {{use: hough}}
  locate:  {{use: nearest-depth}}
  pick:    {{use: picks}}
sinks:
  log: {{use: mcap, path: out.mcap}}
"""


FORKS = multiprocessing.get_context("forkserver")
FORKS.set_forkserver_preload(
    ["mushpipe.console", "mushpipe.sources.mcap", "mushpipe.stages.picks", "mushpipe.sinks.mcap"]
)


def mushpipe(*arguments: object, cwd: Path) -> subprocess.CompletedProcess[str]:
    """Run a command line in a process of its own.

    It is forked from one that has imported the program, which takes longer than most of what is
    tested; `MAIN` is the program as a shell starts it.
    """
    command = list(map(str, arguments))
    with TemporaryDirectory() as folder:
        out, err = Path(folder, "out"), Path(folder, "err")
        process = FORKS.Process(target=_run, args=(command, cwd, dict(os.environ), out, err))
        process.start()
        process.join()
        code = process.exitcode
        assert code is not None
        return subprocess.CompletedProcess(command, code, _read(out), _read(err))


def _run(command: list[str], cwd: Path, environment: dict[str, str], out: Path, err: Path) -> None:
    for number, path in ((1, out), (2, err)):
        os.dup2(os.open(path, os.O_WRONLY | os.O_CREAT), number)
    os.chdir(cwd)
    os.environ.clear()
    os.environ.update(environment)
    sys.argv = ["mushpipe", *command]
    main()


def _read(path: Path) -> str:
    return path.read_bytes().decode().replace("\r\n", "\n")
