"""Ports: what a plugin takes and returns, read from the signature of one method."""

from __future__ import annotations

import inspect
import typing
from dataclasses import dataclass
from inspect import Parameter
from types import NoneType, UnionType
from typing import Any

import numpy as np

from mushpipe.core.columns import Columns
from mushpipe.core.errors import PluginError
from mushpipe.core.paths import writes_within
from mushpipe.core.settings import WORDS, settings_of
from mushpipe.core.stage import Kind, Plugin, Sink, Source, Stage, kind_of
from mushpipe.core.table_type import table_fault
from mushpipe.core.truth import BUILT_IN
from mushpipe.core.types import Mask, RgbdFrame

# Values are recorded under the names of their types.
_TAKEN: dict[str, type] = {t.__name__: t for t in (*BUILT_IN, Mask, RgbdFrame)}
# An array or a number can be anything: who takes one would get that of the nearest who makes one.
_PLAIN = ("builtins", "numpy")
_METHODS: dict[Kind, str] = {"stage": "process", "source": "frames", "sink": "consume"}
_BASES: dict[Kind, type[Plugin]] = {"stage": Stage, "source": Source, "sink": Sink}


@dataclass(frozen=True)
class Port:
    """An input: parameter name, type, whether a graph must provide it, and what it gets if not."""

    name: str
    type: type
    required: bool
    default: Any = None


@dataclass(frozen=True)
class Ports:
    """Inputs and outputs of a plugin; ``rng`` is the parameter that takes a random generator."""

    inputs: tuple[Port, ...]
    outputs: tuple[type, ...]
    rng: str | None = None


OF_SOURCE = Ports((), (RgbdFrame,))


def ports_of(plugin: type[Plugin]) -> Ports:
    """Read the ports of a plugin class from the annotations of its method.

    Raises:
        PluginError: The method is missing or cannot be called frame by frame, an annotation is
            missing or no class that stages hand on, a setting has a name that a graph could not
            set or files that nobody would look after, or what it returns could not be recorded.
    """
    _check_settings(plugin)
    if plugin.__pydantic_custom_init__:
        raise PluginError(
            f"{plugin.__qualname__} has an __init__, without which a run makes its copy: set state "
            "up in open(), or give private attributes a default"
        )
    kind = kind_of(plugin)
    _check_calls(plugin, kind)
    method, parameters = _method(plugin, kind)
    if kind == "source":
        return OF_SOURCE
    try:
        hints = typing.get_type_hints(method)
    except Exception as error:  # an annotation in quotes can be any code
        where = f"{plugin.__qualname__}.{_METHODS[kind]}"
        raise PluginError(f"{where}: unknown annotation: {error}") from error
    ports = [_port(plugin, parameter, hints) for parameter in parameters]
    random = [port.name for port in ports if port.type is np.random.Generator]
    if len(random) > (kind == "stage"):
        raise PluginError(
            f"{plugin.__qualname__}: parameter '{random[-1]}': a stage gets one random generator, "
            "a sink none"
        )
    inputs = tuple(port for port in ports if port.name not in random)
    outputs = _outputs(plugin, hints) if kind == "stage" else ()
    return Ports(inputs, outputs, random[0] if random else None)


def _check_settings(plugin: type[Plugin]) -> None:
    """Raise PluginError where a graph could not set a setting, or a run not look after it."""
    for name in settings_of(plugin):
        if name in WORDS:
            raise PluginError(
                f"{plugin.__qualname__}: a setting cannot be called '{name}', which in a graph "
                "stands beside the settings; give it another name, or an alias"
            )
    for name, field in plugin.model_fields.items():
        if writes_within(field.annotation):
            raise PluginError(
                f"{plugin.__qualname__}: setting '{name}' has a SinkPath within another type, "
                "where nobody keeps it from what is read: make it a setting of its own"
            )


def _check_calls(plugin: type[Plugin], kind: Kind) -> None:
    """Raise PluginError where a run could not call a method as it calls that of the base."""
    for name, base in inspect.getmembers(_BASES[kind], inspect.isfunction):
        if base.__module__ != Plugin.__module__ or name.startswith("_"):  # pydantic's own
            continue
        if name in plugin.model_fields:
            raise PluginError(
                f"{plugin.__qualname__}: a setting cannot be called '{name}', as a method of every "
                f"{kind} is: call it '{name}_', with the alias '{name}'"
            )
        expected = list(inspect.signature(base).parameters)
        unbound = not isinstance(inspect.getattr_static(plugin, name), staticmethod | classmethod)
        try:
            inspect.signature(getattr(plugin, name)).bind(*expected[not unbound :])
        except TypeError:
            raise PluginError(
                f"{plugin.__qualname__}.{name} must be a method that takes ({', '.join(expected)})"
            ) from None


def _method(plugin: type[Plugin], kind: Kind) -> tuple[Any, list[Parameter]]:
    """Return the method that a run calls, and its parameters without ``self``."""
    name = _METHODS[kind]
    method, where = getattr(plugin, name, None), f"{plugin.__qualname__}.{name}"
    if method is None or method is Source.frames:
        raise PluginError(f"{plugin.__qualname__} has no method '{name}'")
    if inspect.iscoroutinefunction(method) or inspect.isasyncgenfunction(method):
        raise PluginError(f"{where} is 'async', which nobody awaits: make it a plain method")
    if kind != "source" and inspect.isgeneratorfunction(method):
        raise PluginError(f"{where} yields: it must return what it makes of one frame")
    parameters = list(inspect.signature(method).parameters.values())
    if isinstance(inspect.getattr_static(plugin, name), staticmethod | classmethod):
        return method, parameters
    if not parameters or parameters[0].name != "self":
        raise PluginError(f"{where}: its first parameter must be 'self'")
    return method, parameters[1:]


def _port(plugin: type[Plugin], parameter: Parameter, hints: dict[str, Any]) -> Port:
    hint = hints.get(parameter.name)
    required = parameter.default is Parameter.empty
    default = None if required else parameter.default
    members = typing.get_args(hint)
    if isinstance(hint, UnionType) or typing.get_origin(hint) is typing.Union:
        left = [member for member in members if member is not NoneType]
        if len(left) == 1 and len(members) == 2:
            hint, required = left[0], False
    if parameter.kind in (Parameter.VAR_POSITIONAL, Parameter.VAR_KEYWORD):
        raise PluginError(
            f"{plugin.__qualname__}: '{parameter}' stands for any number of parameters; each input "
            "needs one of its own"
        )
    if parameter.kind is not Parameter.POSITIONAL_OR_KEYWORD:
        raise PluginError(
            f"{plugin.__qualname__}: parameter '{parameter.name}' must be neither positional-only "
            "nor keyword-only: leave out the '/' or '*'"
        )
    if not _is_class(hint):
        raise PluginError(
            f"{plugin.__qualname__}: parameter '{parameter.name}' must be annotated with one type"
        )
    _require_handed_on(hint, f"{plugin.__qualname__}: parameter '{parameter.name}' is")
    return Port(parameter.name, hint, required, default)


def _require_handed_on(kind: type, what: str) -> None:
    """Raise PluginError, which begins with what is of a type, where that is none of a port."""
    if kind.__module__ in _PLAIN:
        raise PluginError(
            f"{what} {kind.__name__}, which no stage hands on: write a type of mushpipe, such as "
            "Mask, or a frozen dataclass of your own"
        )


def _is_class(hint: Any) -> typing.TypeGuard[type]:
    return isinstance(hint, type) and hint is not Any  # which is a class in Python 3.11


def _outputs(plugin: type[Plugin], hints: dict[str, Any]) -> tuple[type, ...]:
    hint = hints.get("return")
    outputs = typing.get_args(hint) if typing.get_origin(hint) is tuple else (hint,)
    if not all(_is_class(t) and t is not NoneType for t in outputs):
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
        if issubclass(output, Columns) and (fault := table_fault(output)):
            raise PluginError(
                f"{plugin.__qualname__}.process returns {output.__name__}, which {fault}"
            )
        _require_handed_on(output, f"{plugin.__qualname__}.process returns")
    return outputs
