"""What a command writes must be none of the files it reads."""

from __future__ import annotations

from pathlib import Path

from mushpipe.core.errors import UsageError


def same_file(a: Path, b: Path) -> bool:
    """Whether two paths lead to one file, by whatever links; a device such as /dev/null is none."""
    if a.exists() and not a.is_file():
        return False
    return a.resolve() == b.resolve() or (a.exists() and b.exists() and a.samefile(b))


def spare(out: Path | None, *read: Path) -> None:
    """Refuse to write over a file that is read; `out` None writes nothing.

    Raises:
        UsageError: `out` is one of the files `read`.
    """
    for path in read:
        if out is not None and same_file(out, path):
            raise UsageError(f"{out} is what is read, and would be written over: give another name")
