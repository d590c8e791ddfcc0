"""Blocks ```console in the docs: `$ mushpipe …`, and below it what the command prints.

`python -m tests.docs.consoles` runs the commands and writes their output into the docs.
"""

from __future__ import annotations

import re
import shlex
from pathlib import Path

from typer.testing import CliRunner

from mushpipe.cli import app
from mushpipe.core.errors import MushpipeError

PAGES = [Path("README.md"), *sorted(Path("docs").glob("*.md"))]
BLOCK = re.compile(r"^```console\n\$ mushpipe (.*)\n((?:(?!```).*\n)*)```$", re.MULTILINE)


def output_of(command: str) -> str:
    """Return what `mushpipe COMMAND` prints, stdout and then an error."""
    result = CliRunner(env={"COLUMNS": "100", "NO_COLOR": "1"}).invoke(app, shlex.split(command))
    if isinstance(result.exception, MushpipeError):
        return f"{result.stdout}error: {result.exception}\n"
    if result.exception is not None and not isinstance(result.exception, SystemExit):
        raise result.exception
    return result.stdout


def renewed(text: str) -> str:
    """Return a page with the output of every command as it is now."""
    return BLOCK.sub(lambda m: f"```console\n$ mushpipe {m[1]}\n{output_of(m[1])}```", text)


if __name__ == "__main__":
    for page in PAGES:
        page.write_text(renewed(page.read_text()))
