"""Settings that name files: what they are relative to, and which of them are written."""

from __future__ import annotations

import os
import re
from collections.abc import Iterable
from contextlib import suppress
from pathlib import Path
from types import UnionType
from typing import Annotated, Any, Union, get_args, get_origin

from pydantic import AfterValidator, BaseModel, PlainSerializer, ValidationInfo
from pydantic.fields import FieldInfo

from mushpipe.core.errors import UsageError

STDIO = Path("-")
"""In place of a file: standard output."""
IMAGES = frozenset([".png", ".jpg", ".jpeg", ".tif", ".tiff", ".bmp", ".webp", ".pgm", ".ppm"])
"""How names of images end, in lower case."""
RECORDINGS = (".mcap", ".db3", ".bag", ".zstd")
"""How names of recordings end, in lower case, those first that are read as they are."""


def from_home(path: str | Path) -> Path:
    """Return a path whose leading ``~`` is the home folder.

    Shells leave it as it is in ``--set log.path=~/x.mcap``, and nobody is there to expand it in a
    graph file: a folder called ``~`` was made.
    """
    with suppress(RuntimeError):  # of no user is it the home: a file may be called ~x
        return Path(path).expanduser()
    return Path(path)


def in_its_place(folder: Path) -> str:
    """Return what to give in place of a folder, where a recording is asked for."""
    files = sorted(folder.iterdir())
    found = [file for kind in RECORDINGS for file in files if file.suffix.lower() == kind]
    return f"; a recording is a file: {found[0]}" if found else ", in which no recording is"


def real(path: Path) -> Path:
    """Return where a path leads; `Path.resolve` fails on a link that leads to itself."""
    return Path(os.path.realpath(path))


def resolve_path(path: Path, info: ValidationInfo) -> Path:
    """Return a path of a setting, relative to the graph file or to the shell; a validator."""
    if path == STDIO:
        return path
    path = from_home(path)
    context = info.context or {}
    from_shell = info.field_name in context.get("from_shell", ())
    return _shortened(Path("" if from_shell else context.get("base", "")) / path)


def _shortened(path: Path) -> Path:
    short = Path(os.path.normpath(path))
    # ".." behind a link is beside what it leads to
    return short if real(short) == real(path) else path


def written_path(path: Path | str) -> str:
    """Return a path as manifests hold it, from which a run is repeated in any folder.

    A default of a group may be text, which nobody has validated.
    """
    path = Path(path)
    return str(path if path == STDIO else _shortened(path.absolute()))


GraphPath = Annotated[
    Path, AfterValidator(resolve_path), PlainSerializer(written_path, str, when_used="json")
]
"""A path setting: relative to the graph file, or to the shell where the command line set it."""


def require_listed(folder: Path) -> None:
    """Raise UsageError where a folder may not be read, in which a search finds nothing."""
    if folder.is_dir() and not os.access(folder, os.R_OK | os.X_OK):
        raise UsageError(f"{folder}: the folder cannot be read: permission denied")


def require_model(path: Path) -> None:
    """Raise UsageError where there is no file at the path of a model."""
    if not path.is_file():
        what = "it is a folder" if path.is_dir() else "there is no such file"
        raise UsageError(f"model {path}: {what}")


def only_recording(path: Path) -> Path:
    """Raise ValueError where a sink's path has more to fill in than the name of its input."""
    if variable := re.search(r"\$\{?[A-Za-z_]\w*\}?", str(path)):
        raise ValueError(
            f"{variable[0]} is not filled in here: only {{recording}} is; name the "
            'file, or let the shell do it, as in --set "log.path=$HOME/x.mcap"'
        )
    if unknown := set(re.findall(r"\{[^}]*\}", str(path))) - {"{recording}"}:
        raise ValueError(f"{', '.join(sorted(unknown))} is not known: only {{recording}} is")
    return path


def of_a_file(path: Path) -> Path:
    """Raise ValueError where a path is that of the folder one is in, or of all files."""
    if not path.name:
        raise ValueError("it names no file")
    return path


SinkPath = Annotated[
    Path, AfterValidator(only_recording), AfterValidator(resolve_path), AfterValidator(of_a_file)
]
"""A path that a sink writes to; {recording} in it is the name of the input."""


def no_stream(path: Path) -> Path:
    """Raise ValueError where a path stands for standard output."""
    if path == STDIO:
        raise ValueError("it cannot be standard output: name a file")
    return path


SinkFile = Annotated[SinkPath, AfterValidator(no_stream)]
"""A `SinkPath` of a sink that cannot write to standard output."""


def is_written(setting: FieldInfo) -> bool:
    """Whether a setting is a `SinkPath`, or that or None."""
    alternatives = (getattr(kind, "__metadata__", ()) for kind in get_args(setting.annotation))
    return any(map(_of_sink, (setting.metadata, *alternatives)))


def writes_within(kind: Any, within: bool = False, seen: tuple[Any, ...] = ()) -> bool:
    """Whether a setting's type has a `SinkPath` within a list, a group or the like."""
    if kind in seen:  # a group of such groups
        return False
    seen = (*seen, kind)
    if get_origin(kind) is Annotated and _of_sink(kind.__metadata__):
        return within
    if isinstance(kind, type) and issubclass(kind, BaseModel):
        fields = kind.model_fields.values()
        return any(
            is_written(field) or writes_within(field.annotation, True, seen) for field in fields
        )
    inside = within or get_origin(kind) not in (Union, UnionType, Annotated)
    return any(writes_within(part, inside, seen) for part in get_args(kind))


def _of_sink(validators: Iterable[Any]) -> bool:
    return any(getattr(each, "func", None) is only_recording for each in validators)
