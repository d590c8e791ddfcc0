"""Whether a topic that is named as colour or as depth holds that, by its first message."""

from __future__ import annotations

from typing import Literal

from mushpipe.core.errors import InputError
from mushpipe.core.recording import Index, RecordingReader
from mushpipe.sources.decoding import Decoder
from mushpipe.sources.images import kind_of
from mushpipe.sources.topics import images_of

Role = Literal["color", "depth"]
_CALLED = {"color": "colour", "depth": "depth"}


def require_kind(reader: RecordingReader, index: Index, role: Role, topic: str | None) -> None:
    """Refuse a topic that holds the other kind of images, and say which ones hold what is wanted.

    Raises:
        InputError: It does.
    """
    held = _kind_on(reader, topic) if topic is not None else ""
    if held in ("", role):
        return
    fit = [each for each in images_of(index) if _kind_on(reader, each) == role]
    cure = " or ".join(f"--set source.{role}_topic={each}" for each in fit)
    raise InputError(
        f"{reader.path}: topic '{topic}' holds {_CALLED[held]}, expected {_CALLED[role]}; "
        f"{cure or f'no topic holds {_CALLED[role]}'}"
    )


def _kind_on(reader: RecordingReader, topic: str) -> str:
    """Return what the first message of a topic is an image of, "" where that is not told."""
    first = next(reader.messages({topic}), None)
    try:
        return kind_of(Decoder().decode(first)) if first else ""
    except Exception:  # whatever a decoder makes of foreign bytes: it is told where it is played
        return ""
