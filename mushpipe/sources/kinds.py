"""Whether a topic that is named as colour or as depth holds that, by its first message."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Literal

from mushpipe.core.errors import InputError
from mushpipe.core.recording import Raw
from mushpipe.sources.decoding import Decoder
from mushpipe.sources.images import kind_of

Role = Literal["color", "depth"]
_CALLED = {"color": "colour", "depth": "depth"}


def require_kind(name: str, role: Role, first: Raw | None, images: Iterable[Raw]) -> None:
    """Refuse a topic that holds the other kind of images, and say which ones hold what is wanted.

    Args:
        name: What messages call the recording.
        role: What the topic is taken for.
        first: Its first message, if there is any.
        images: The first message of each topic of images; looked at only to refuse.

    Raises:
        InputError: It does.
    """
    if first is None or (held := _held(first)) in ("", role):
        return
    fit = [raw.channel.topic for raw in images if _held(raw) == role]
    cure = " or ".join(f"--set source.{role}_topic={topic}" for topic in fit)
    raise InputError(
        f"{name}: topic '{first.channel.topic}' holds {_CALLED[held]}, expected {_CALLED[role]}; "
        f"{cure or f'no topic is known to hold {_CALLED[role]}'}"
    )


def _held(raw: Raw) -> str:
    """Return what a message is an image of, "" where that is not told."""
    try:
        return kind_of(Decoder().decode(raw))
    except Exception:  # whatever a decoder makes of foreign bytes: it is told where it is played
        return ""
