"""What is written must be none of the files that are read, and must be possible to write."""

from __future__ import annotations

import errno
import fcntl
import os
from collections.abc import Iterable, Iterator, Mapping
from io import FileIO
from pathlib import Path

from mushpipe.core.errors import MushpipeError, UsageError
from mushpipe.core.paths import STDIO, real


def same_file(a: Path, b: Path) -> bool:
    """Whether two paths lead to one file, by whatever links; a device such as /dev/null is none."""
    if a.exists() and not a.is_file():
        return False
    return real(a) == real(b) or (a.exists() and b.exists() and a.samefile(b))


def spare(out: Path | None, *read: Path) -> None:
    """Refuse to write over a file that is read; `out` None writes nothing.

    Raises:
        UsageError: `out` is one of the files `read`.
    """
    for path in read:
        if out is not None and same_file(out, path):
            raise UsageError(f"{out} is what is read, and would be written over: give another name")


def require_writable(out: Path | None, with_folder: bool = False) -> None:
    """Find out before any work that its outcome cannot be written; touches nothing.

    Args:
        out: The file to write; None writes nothing.
        with_folder: Whether its folder will be made where there is none.

    Raises:
        UsageError: No file can be written at `out`.
    """
    if out is not None and (fault := _fault(out, with_folder)):
        raise UsageError(f"{out} cannot be written: {fault}")


def write_text(out: Path, text: str) -> None:
    """Write a file of text.

    Raises:
        MushpipeError: It cannot be written, or not all of it.
    """
    try:
        out.write_text(text, encoding="utf-8")
    except OSError as error:  # of a full disk, it names no file
        raise MushpipeError(
            f"{out}: not written to its end: {error.strerror}; make room, or give another path"
        ) from error


def make_folder(folder: Path) -> None:
    """Make a folder for what will be written, where there is none yet.

    Raises:
        UsageError: There can be none.
    """
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise UsageError(f"{folder} cannot be a folder: {error.strerror}") from error


def opened_alone(path: Path) -> FileIO:
    """Open a file to write, made if need be and not emptied, that no other run is to write.

    Raises:
        UsageError: Another run is writing it, or it is a pipe that nobody reads.
        OSError: It cannot be opened.
    """
    try:
        file = FileIO(path, "ab", opener=_open_at_once)
    except OSError as error:
        if error.errno != errno.ENXIO:
            raise
        raise UsageError(f"{path} is a pipe that nobody reads: start first what does") from error
    try:
        if path.is_file():  # a device such as /dev/null is for everybody
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError as error:
        file.close()
        raise UsageError(f"{path} is being written by another run: give another name") from error
    return file


def _open_at_once(path: str, flags: int) -> int:
    """Open a file; a pipe that nobody reads is an error, where `open` alone waits for ever."""
    number = os.open(path, flags | os.O_NONBLOCK, 0o666)
    os.set_blocking(number, True)
    return number


def spare_files(read: Iterable[Path], written: Mapping[str, Iterable[Path]]) -> None:
    """Refuse what sinks could not write, or not without harm, before any of them opens.

    Args:
        read: What the run reads.
        written: Files of each sink, by its name.

    Raises:
        UsageError: A sink would write over what is read or another sink's file, or cannot write.
    """
    for name, harm in clashes(read, written):
        raise UsageError(f"sink '{name}' {harm}")
    for name, paths in written.items():
        for path in paths:
            if fault := _fault(path, with_folder=True):
                raise UsageError(f"sink '{name}': {path} cannot be written: {fault}")


def clashes(
    read: Iterable[Path], written: Mapping[str, Iterable[Path]]
) -> Iterator[tuple[str, str]]:
    """Yield each sink with a file that is read or another sink's, and what it would do to it."""
    taken = [("what is read", path) for path in read]
    for name, paths in written.items():
        for path in paths:
            for whose, other in taken:
                if same_file(path, other):
                    yield name, f"would write over {whose}, {path}"
                    break
        taken += [(f"the file of sink '{name}'", path) for path in paths]


def _fault(path: Path, with_folder: bool) -> str:
    """Return why no file can be written at a path, "" where one can."""
    if path == STDIO:
        return "it would be standard output; name a file"
    if path.is_dir():
        return "it is a folder"
    if not path.parent.is_dir():
        return _folder_fault(path.parent) if with_folder else f"there is no folder {path.parent}"
    if not os.access(path if path.exists() else path.parent, os.W_OK):
        return "permission denied"
    if path.is_file():
        try:
            opened_alone(path).close()
        except UsageError:
            return "another run is writing it; give another name"
    return ""


def _folder_fault(folder: Path) -> str:
    """Return why no folder can be made, "" where one can."""
    above = next(each for each in (folder, *folder.parents) if os.path.lexists(each))
    if not above.is_dir():
        return f"{above} is no folder"
    return "" if os.access(above, os.W_OK) else f"permission denied in {above}"
