"""Stages, sources and sinks: settings as pydantic fields, ports as one typed signature."""

from __future__ import annotations

import typing
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from inspect import Parameter, signature
from pathlib import Path
from types import NoneType, UnionType
from typing import Any, ClassVar, Literal, Self

import numpy as np
from pydantic import BaseModel, ConfigDict, Field

from mushpipe.core.errors import PluginError
from mushpipe.core.paths import STDIO, is_written
from mushpipe.core.truth import BUILT_IN
from mushpipe.core.types import Mask, RgbdFrame

Kind = Literal["stage", "source", "sink"]
WORDS = ("use", "inputs", "delivery")
"""What stands beside the settings of a node in a graph."""
# Values are recorded under the names of their types.
_TAKEN: dict[str, type] = {t.__name__: t for t in (*BUILT_IN, Mask, RgbdFrame)}
_METHODS: dict[Kind, str] = {"stage": "process", "source": "frames", "sink": "consume"}


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
        """Fill ``{recording}`` into a path and make its folder."""
        path = Path(str(template).replace("{recording}", self.recording))
        path.parent.mkdir(parents=True, exist_ok=True)
        return path


class Plugin(BaseModel):
    """Base of all plugins: an immutable description whose fields are its settings.

    State lives in private attributes only; every run works on a fresh copy.
    """

    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)

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

    max_frames: int | None = Field(None, ge=1, description="stop after so many frames")
    max_seconds: float | None = Field(
        None, gt=0, description="stop after so many seconds, by the stamps of the frames"
    )

    @property
    def live(self) -> bool:
        """Whether frames come when they come, so that a late one is dropped, never waited for.

        Asked for when the source is open.
        """
        return False

    def name(self) -> str:
        """Return a short name for file names."""
        return type(self).__name__.lower()

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


@dataclass(frozen=True)
class Port:
    """An input: parameter name, type, and whether a graph must provide it."""

    name: str
    type: type
    required: bool


@dataclass(frozen=True)
class Ports:
    """Inputs and outputs of a plugin, read from its signature."""

    inputs: tuple[Port, ...]
    outputs: tuple[type, ...]
    wants_rng: bool


OF_SOURCE = Ports((), (RgbdFrame,), False)


def kind_of(plugin: type) -> Kind:
    """Return which of the three kinds a class is.

    Raises:
        PluginError: It is none of them.
    """
    kinds: tuple[tuple[type, Kind], ...] = ((Stage, "stage"), (Source, "source"), (Sink, "sink"))
    for base, kind in kinds:
        if isinstance(plugin, type) and issubclass(plugin, base):
            return kind
    raise PluginError(f"{plugin!r} is not a Stage, Source or Sink class")


def settings_of(model: type[BaseModel]) -> dict[str, str]:
    """Return the settings' names in a graph file, each with its attribute of the model."""
    return {field.alias or name: name for name, field in model.model_fields.items()}


def ports_of(plugin: type[Plugin]) -> Ports:
    """Read the ports of a plugin class from the annotations of its method.

    Raises:
        PluginError: The method is missing, an annotation is missing or not a class, or a setting
            has a name that a graph could not set.
    """
    for name in settings_of(plugin):
        if name in WORDS:
            raise PluginError(
                f"{plugin.__qualname__}: a setting cannot be called '{name}', which in a graph "
                "stands beside the settings; give it another name, or an alias"
            )
    if kind_of(plugin) == "source":
        if plugin.frames is Source.frames:  # type: ignore[attr-defined]
            raise PluginError(f"{plugin.__qualname__} has no method 'frames'")
        return OF_SOURCE
    name = _METHODS[kind_of(plugin)]
    method = getattr(plugin, name, None)
    if method is None:
        raise PluginError(f"{plugin.__qualname__} has no method '{name}'")
    try:
        hints = typing.get_type_hints(method)
    except Exception as error:  # an annotation in quotes can be any code
        raise PluginError(f"{plugin.__qualname__}.{name}: unknown annotation: {error}") from error
    inputs, wants_rng = [], False
    for parameter in list(signature(method).parameters.values())[1:]:
        port = _port(plugin, parameter, hints)
        if port.type is np.random.Generator:
            wants_rng = True
        else:
            inputs.append(port)
    outputs = _outputs(plugin, hints) if kind_of(plugin) == "stage" else ()
    return Ports(tuple(inputs), outputs, wants_rng)


def _port(plugin: type[Plugin], parameter: Parameter, hints: dict[str, Any]) -> Port:
    hint = hints.get(parameter.name)
    required = parameter.default is Parameter.empty
    members = typing.get_args(hint)
    if isinstance(hint, UnionType) or typing.get_origin(hint) is typing.Union:
        left = [member for member in members if member is not NoneType]
        if len(left) == 1 and len(members) == 2:
            hint, required = left[0], False
    if not isinstance(hint, type) or parameter.kind is not Parameter.POSITIONAL_OR_KEYWORD:
        raise PluginError(
            f"{plugin.__qualname__}: parameter '{parameter.name}' must be annotated with one type"
        )
    return Port(parameter.name, hint, required)


def _outputs(plugin: type[Plugin], hints: dict[str, Any]) -> tuple[type, ...]:
    hint = hints.get("return")
    outputs = typing.get_args(hint) if typing.get_origin(hint) is tuple else (hint,)
    if not all(isinstance(t, type) and t is not NoneType for t in outputs):
        raise PluginError(
            f"{plugin.__qualname__}.process must be annotated with what it returns: "
            "a type, or a tuple of types"
        )
    if len(set(outputs)) < len(outputs):
        raise PluginError(f"{plugin.__qualname__}.process returns the same type twice")
    for output in outputs:
        if _TAKEN.get(output.__name__, output) is not output:
            raise PluginError(
                f"{plugin.__qualname__}.process returns a type '{output.__name__}' that is not "
                f"mushpipe's: import mushpipe.{output.__name__}, or give your own another name"
            )
    return outputs
