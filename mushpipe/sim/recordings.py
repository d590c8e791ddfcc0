"""The recordings the project carries: made from a table of settings, `recordings/recordings.yaml`.

python -m mushpipe.sim.recordings [NAME...] writes them beside that table.
"""

from __future__ import annotations

import json
import sys
from collections.abc import Iterable
from dataclasses import dataclass
from itertools import islice
from pathlib import Path
from typing import Any

import yaml

from mushpipe.core.errors import MushpipeError, UsageError, suggest
from mushpipe.core.recorder import RecordingWriter
from mushpipe.core.recording import MANIFEST
from mushpipe.sources.synthetic import SyntheticSource

JPEG_QUALITY = 92
TABLE = Path("recordings/recordings.yaml")


@dataclass(frozen=True)
class Definition:
    """A recording: its name, what it is for, and the settings of the source that makes it."""

    name: str
    purpose: str
    settings: dict[str, Any]

    def source(self) -> SyntheticSource:
        """Return the source.

        Raises:
            pydantic.ValidationError: A setting is wrong.
        """
        return SyntheticSource(**self.settings)

    def write(self, folder: Path) -> Path:
        """Render all frames into ``NAME.mcap`` in a folder; the same bytes on the same machine.

        Depth and truth are stored exactly, colour as JPEG of quality 92.
        """
        path, source = folder / f"{self.name}.mcap", self.source()
        graph = {"mushpipe": 1, "source": {"use": "synthetic", **self.settings}}
        manifest = {"recording": self.name, "purpose": self.purpose, "graph": graph}
        writer = RecordingWriter(path, {MANIFEST: {"json": json.dumps(manifest)}})
        try:
            for frame in islice(source.frames(), source.max_frames):
                writer.frame(frame, JPEG_QUALITY)
        finally:
            writer.close()
        return path


def definitions(table: Path) -> dict[str, Definition]:
    """Read the table: name -> definition, in the table's order.

    Raises:
        UsageError: There is no such file.
    """
    if not table.is_file():
        raise UsageError(f"there is no {table} here: run this in the project's folder")
    rows = yaml.safe_load(table.read_text())
    return {name: Definition(name, row["purpose"], row["settings"]) for name, row in rows.items()}


def regenerate(names: Iterable[str], table: Path = TABLE) -> list[Path]:
    """Write some recordings, or all where no name is given, beside the table.

    Raises:
        UsageError: There is no recording of a name.
    """
    known = definitions(table)
    wanted = list(names) or list(known)
    for name in wanted:
        if name not in known:
            raise UsageError(f"no recording '{name}': {suggest(name, list(known))}")
    return [known[name].write(table.parent) for name in wanted]


def main() -> int:
    """Write the recordings named on the command line; return the exit code."""
    try:
        for path in regenerate(sys.argv[1:]):
            sys.stdout.write(f"{path}: {path.stat().st_size / 1e6:.2f} MB\n")
    except MushpipeError as error:
        sys.stderr.write(f"{error}\n")
        return error.exit_code
    return 0


if __name__ == "__main__":
    sys.exit(main())
