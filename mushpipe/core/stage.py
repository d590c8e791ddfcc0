"""Stages, sources and sinks: classes whose fields are their settings, checked by pydantic."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar, Literal, Self

from pydantic import Field

from mushpipe.core.errors import PluginError
from mushpipe.core.group import Group
from mushpipe.core.overwriting import make_folder
from mushpipe.core.paths import STDIO, is_written, real
from mushpipe.core.types import RgbdFrame

Kind = Literal["stage", "source", "sink"]


@dataclass(frozen=True)
class RunInfo:
    """What a sink is told when a run begins.

    Attributes:
        recording: Name of what is played, for file names.
        manifest: Resolved graph, versions, recording and seed; plain data.
        live: Whether the frames come from a camera now; False for anything played again.
        frames_read: Returns how many frames the source has delivered; any thread may ask.
    """

    recording: str
    manifest: Mapping[str, Any]
    live: bool = False
    frames_read: Callable[[], int] = lambda: 0

    def path(self, template: Path) -> Path:
        """Fill ``{recording}`` into a path and make its folder.

        Raises:
            UsageError: There can be no such folder.
        """
        path = self.filled(template)
        make_folder(path.parent)
        return path

    def filled(self, template: Path) -> Path:
        """Fill ``{recording}`` into a path, of which nothing has to be there."""
        return Path(str(template).replace("{recording}", self.recording))


class Plugin(Group):
    """Base of all plugins: an immutable description whose fields are its settings.

    State lives in private attributes only; every run works on a fresh copy.
    """

    def __setattr__(self, name: str, value: Any) -> None:
        """Set a private attribute; anything else is a mistake of the plugin's author."""
        if not name.startswith("_"):
            raise AttributeError(
                f"'{name}' cannot be set: settings are frozen; keep state in a private attribute, "
                f"declared in the class, as '_{name}: Any = None' is"
            )
        super().__setattr__(name, value)

    def path_settings(self, written: bool) -> dict[str, Path]:
        """Return the settings that name files: of type `SinkPath`, or to be read as a model is."""
        settings, kinds = type(self).model_fields.items(), Path | str if written else Path
        named = ((n, getattr(self, n)) for n, f in settings if is_written(f) is written)
        return {n: Path(v) for n, v in named if isinstance(v, kinds) and Path(v) != STDIO}

    def streams(self) -> bool:
        """Whether a setting of what is written is standard output."""
        settings = type(self).model_fields.items()
        return any(is_written(f) and getattr(self, n) == STDIO for n, f in settings)

    def required_inputs(self) -> frozenset[str]:
        """Return inputs that a graph may leave out, but not with these settings."""
        return frozenset()

    def close(self) -> None:
        """Release what `open` took; also called after a failure, and after a failed `open`."""


class Stage(Plugin):
    """One step of the pipeline; subclasses add ``process``, whose signature is their ports.

    It is called for all frames in order and one at a time, but not always from the same thread.

    Attributes:
        reentrant: Says that ``process`` depends on its arguments alone and may be in work in
            several threads at once; then it may see the next frame before it is done with one.
    """

    reentrant: ClassVar[bool] = False

    def open(self) -> None:
        """Load weights, compile kernels: once per run, before the first frame."""


class Source(Plugin):
    """Where frames come from."""

    max_frames: int | None = Field(None, ge=1, lt=2**63, description="stop after so many frames")
    max_seconds: float | None = Field(
        None, gt=0, le=1e9, description="stop after so many seconds, by the stamps of the frames"
    )

    @property
    def live(self) -> bool:
        """Whether frames come when they come, so that a late one is dropped, never waited for.

        Asked for when the source is open.
        """
        return False

    def name(self) -> str:
        """Return a short name for file names: of the file or folder it reads, else of its class."""
        paths = [*self.path_settings(written=False).values()]
        if len(paths) != 1:
            return type(self).__name__.lower()
        return real(paths[0]).name if paths[0].is_dir() else paths[0].stem

    def files(self) -> tuple[Path, ...]:
        """Return the recordings it reads, for the manifest."""
        return ()

    def open(self) -> None:
        """Check that there is something to read, before any sink creates a file."""

    def describe(self) -> dict[str, Any]:
        """Return what an opened device says about itself, as plain data for the manifest."""
        return {}

    def frames(self) -> Iterator[RgbdFrame]:
        """Yield frames; raise InputError after the last good one where the input is damaged."""
        raise NotImplementedError

    def interrupt(self) -> None:
        """Give up waiting for a frame; called from another thread when a run ends early."""

    def counts(self) -> dict[str, int]:
        """Return what was lost or repaired on the way in, by a name people understand."""
        return {}


class ReplaySource(Source):
    """A source that can be played again, at any speed, to the same frames."""

    speed: float = Field(
        0.0, ge=0, description="pace of the replay: 1 is real time, 0 as fast as possible"
    )


class Sink(Plugin):
    """Where results go; subclasses add ``consume``, whose parameters are its inputs.

    ``delivery`` says what happens when the sink is slower than a live pipeline: ``every`` blocks
    it, ``latest`` keeps the newest frame and counts the others. A replay never drops.
    """

    delivery: ClassVar[Literal["every", "latest"]] = "every"

    def open(self, run: RunInfo) -> None:
        """Open files and sockets: once per run, before the first frame."""

    def files(self, run: RunInfo) -> tuple[Path, ...]:
        """Return the files it writes; if not overridden, those of settings of type `SinkPath`."""
        return tuple(map(run.path, self.path_settings(written=True).values()))

    def into(self, folder: Path) -> Self:
        """Return a copy that writes the files of its settings of type `SinkPath` into a folder."""
        moved = {n: folder / path.name for n, path in self.path_settings(written=True).items()}
        return self.model_copy(update=moved)

    def finish(self, summary: Mapping[str, Any]) -> None:
        """Take the run's counts and timings, after the last frame and before `close`."""


def kind_of(plugin: type) -> Kind:
    """Return which of the three kinds a class is.

    Raises:
        PluginError: It is none of them.
    """
    kinds: tuple[tuple[type, Kind], ...] = ((Stage, "stage"), (Source, "source"), (Sink, "sink"))
    for base, kind in kinds:
        if isinstance(plugin, type) and issubclass(plugin, base):
            return kind
    name = plugin.__qualname__ if isinstance(plugin, type) else repr(plugin)
    raise PluginError(f"{name} is not a Stage, Source or Sink class")


def require_kind(plugin: type, kind: Kind, called: str) -> None:
    """Raise PluginError, which says how a graph calls the class, where it is none of a kind."""
    try:
        found = kind_of(plugin)
    except PluginError as error:
        raise PluginError(f"{called}: {error}") from error
    if found != kind:
        raise PluginError(f"{called} is a {found}, not a {kind}")
