"""The truth of a recording: from its own truth topic, or from a file of labels."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal

import numpy as np
import orjson
from pydantic import ValidationError
from pydantic_core import ErrorDetails

from mushpipe.core.arrays import Floats
from mushpipe.core.errors import InputError, UsageError, suggest
from mushpipe.core.recording import MAGIC, RecordingReader
from mushpipe.core.truth import TRUTH_TOPIC, Truth
from mushpipe.core.types import Header
from mushpipe.core.wire import decode_table
from mushpipe.evaluate.labels import EXAMPLE, Cap, Frame, Labels, parse_labels, truth_of


@dataclass(frozen=True, eq=False)
class FrameTruth:
    """What is in one frame.

    Attributes:
        caps: The mushrooms; those with an ignore reason count neither way.
        may_find: (K, 3) circles ``u v radius`` px in which a detection counts neither way.
        frame_id: Frame of the 3D values; None where the labels do not say it.
    """

    caps: Truth
    may_find: Floats = field(default_factory=lambda: np.empty((0, 3)))
    frame_id: str | None = None


Place = tuple[Literal["stamp_ns", "index"], int]
"""How a frame is found: by `Header.stamp_ns`, or by its number, `Header.sequence`."""


@dataclass(frozen=True, eq=False)
class TruthSet:
    """The truth of the frames of a recording.

    Attributes:
        name: Where it comes from.
        frames: The truth of each frame.
        damage: What could not be read, in words.
        recording: The recording that carries it; None for a file of labels.
    """

    name: str
    frames: Mapping[Place, FrameTruth]
    damage: tuple[str, ...] = ()
    recording: Path | None = None

    @property
    def numbered(self) -> bool:
        """Whether frames are found by their number."""
        return any(kind == "index" for kind, _ in self.frames)

    def place(self, header: Header) -> Place | None:
        """Return where the truth of a frame stands; None where it is not known.

        Raises:
            InputError: It stands in two places.
        """
        places: tuple[Place, Place] = ("stamp_ns", header.stamp_ns), ("index", header.sequence)
        known = [place for place in places if place in self.frames]
        if len(known) > 1:
            both = " and ".join(f"{kind}={value}" for kind, value in known)
            raise InputError(f"{self.name}: {both} are the same frame; label it once")
        return known[0] if known else None


def read_truth(path: Path) -> TruthSet:
    """Read the truth from a recording, by its name (``.mcap``) or what is in it, or from labels.

    Raises:
        UsageError: There is no such file, or it is a folder.
        InputError: The file cannot be read, holds no truth, or is wrong.
    """
    recorded = path.suffix.lower() == ".mcap" or _is_recording(path)
    return truth_of_recording(path) if recorded else truth_of_labels(path)


def _is_recording(path: Path) -> bool:
    with suppress(OSError), path.open("rb") as file:
        return file.read(len(MAGIC)) == MAGIC
    return False


def has_truth(path: Path) -> bool:
    """Return whether a recording carries its truth."""
    return RecordingReader(path).index().counts[TRUTH_TOPIC] > 0


def truth_of_recording(path: Path) -> TruthSet:
    """Read the truth topic of a recording.

    Raises:
        InputError: It has none, or a message on it cannot be read.
    """
    reader = RecordingReader(path)
    found: list[tuple[Header, FrameTruth]] = []
    for raw in reader.messages({TRUTH_TOPIC}):
        name = raw.schema.name if raw.schema else ""
        try:
            decoded = decode_table(name, raw.message.data, raw.message.log_time)
        except (ValueError, KeyError, TypeError) as error:
            raise InputError(f"{path}: a message on {TRUTH_TOPIC}: {error}") from error
        if decoded is None or not isinstance(decoded.table, Truth):
            raise InputError(f"{path}: {TRUTH_TOPIC} holds '{name}', expected mushpipe.Truth")
        header = decoded.header
        found.append((header, FrameTruth(decoded.table, frame_id=header.frame_id)))
    if not found:
        raise InputError(f"{path}: it carries no truth (no messages on {TRUTH_TOPIC})")
    frames: dict[Place, FrameTruth]
    frames = {("stamp_ns", header.stamp_ns): truth for header, truth in found}
    if len(frames) < len(found):  # stamps stood still
        frames = {("index", header.sequence): truth for header, truth in found}
    return TruthSet(path.name, frames, tuple(reader.damage), path)


def truth_of_labels(path: Path) -> TruthSet:
    """Read a file of labels in the project's format or a foreign one; see `labels`.

    Raises:
        UsageError: There is no such file, or it is a folder.
        InputError: It is no JSON, or no such labels.
    """
    try:
        document = orjson.loads(path.read_bytes())
        if not isinstance(document, dict):
            raise ValueError("expected a JSON object")
        labels = parse_labels(document)
    except FileNotFoundError:
        raise UsageError(f"{path}: there are no such labels") from None
    except IsADirectoryError:
        raise UsageError(f"{path}: it is a folder; labels are a file") from None
    except ValidationError as error:
        faults = list(map(_fault, error.errors()))
        raise InputError("\n  ".join([f"{path}: not valid labels:", *faults[:20]])) from error
    except orjson.JSONDecodeError as error:  # a table (CSV), say
        text = f"{path}: no labels: not JSON ({error}); expected is {EXAMPLE}"
        raise InputError(text) from error
    except (OSError, ValueError) as error:
        raise InputError(f"{path}: no labels: {error}") from error
    for (key, value), times in Counter(map(_place, labels.frames)).items():
        if times > 1:
            raise InputError(f"{path}: the frame of {key} {value} is labelled {times} times")
    frames = {_place(frame): _frame_truth(path, frame, labels.frame_id) for frame in labels.frames}
    return TruthSet(path.name, frames)


def _fault(item: ErrorDetails) -> str:
    place = ".".join(map(str, item["loc"]))
    if item["type"] != "extra_forbidden":
        return f"{place}: {item['msg'].removeprefix('Value error, ')}"
    known = [name for kind in (Labels, Frame, Cap) for name in kind.model_fields]
    return f"{place}: this is not known here; {suggest(str(item['loc'][-1]), known)}"


def _place(frame: Frame) -> Place:
    return ("index", frame.index or 0) if frame.stamp_ns is None else ("stamp_ns", frame.stamp_ns)


def _frame_truth(path: Path, frame: Frame, frame_id: str | None) -> FrameTruth:
    circles = [[c.u, c.v, c.radius_px] for c in frame.may_find]
    may_find = np.array(circles, dtype=float).reshape(-1, 3)
    try:
        return FrameTruth(truth_of(frame.caps), may_find, frame_id)
    except ValueError as error:
        raise InputError(f"{path}: frame {'='.join(map(str, _place(frame)))}: {error}") from error
