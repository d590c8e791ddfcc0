"""Settings that name files: what they are relative to, and which of them are written."""

from __future__ import annotations

import os
import re
from pathlib import Path
from typing import Annotated, get_args

from pydantic import AfterValidator, ValidationInfo
from pydantic.fields import FieldInfo

STDIO = Path("-")
"""In place of a file: standard output."""


def resolve_path(path: Path, info: ValidationInfo) -> Path:
    """Return a path of a setting, relative to the graph file or to the shell; a validator."""
    if path == STDIO:
        return path
    context = info.context or {}
    from_shell = info.field_name in context.get("from_shell", ())
    whole = Path("" if from_shell else context.get("base", "")) / path
    short = Path(os.path.normpath(whole))
    # ".." behind a link is beside what it leads to
    return short if short.resolve() == whole.resolve() else whole


GraphPath = Annotated[Path, AfterValidator(resolve_path)]
"""A path setting: relative to the graph file, or to the shell where the command line set it."""


def only_recording(path: Path) -> Path:
    """Raise ValueError where braces of a sink's path hold anything but ``recording``."""
    if unknown := set(re.findall(r"\{[^}]*\}", str(path))) - {"{recording}"}:
        raise ValueError(f"{', '.join(sorted(unknown))} is not known: only {{recording}} is")
    return path


SinkPath = Annotated[Path, AfterValidator(only_recording), AfterValidator(resolve_path)]
"""A path that a sink writes to; {recording} in it is the name of the input."""


def is_written(setting: FieldInfo) -> bool:
    """Whether a setting is a `SinkPath`, or that or None."""
    alternatives = (getattr(kind, "__metadata__", ()) for kind in get_args(setting.annotation))
    validators = (each for group in (setting.metadata, *alternatives) for each in group)
    return any(getattr(each, "func", None) is only_recording for each in validators)
