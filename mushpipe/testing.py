"""For the tests of plugins: a stage held to its rules, and a graph played frame by frame."""

from __future__ import annotations

import time
from collections.abc import Iterator, Mapping
from contextlib import ExitStack
from dataclasses import fields, is_dataclass
from pathlib import Path
from typing import Any

import numpy as np

from mushpipe.core.chain import Chain, called
from mushpipe.core.document import read_document
from mushpipe.core.edges import failure, limited, named, opened
from mushpipe.core.errors import PluginError
from mushpipe.core.graph import compile_document
from mushpipe.core.plan import Node, Plan
from mushpipe.core.plugins import load_registry
from mushpipe.core.ports import ports_of
from mushpipe.core.settings import writing_fault
from mushpipe.core.stage import Source, Stage
from mushpipe.core.types import RgbdFrame, Trace


def check_stage(stage: Stage, **inputs: Any) -> tuple[Any, ...]:
    """Run a stage as a graph would, and hold it to the rules of docs/plugins.md.

    Its settings must be the same when written into a graph and read again; what it returns must be
    as declared, of the frame's size and time; and a second copy must return the same. It cannot
    write into its inputs. A generator of random numbers is given to it as a run does.

    Args:
        stage: A stage with its settings.
        inputs: What `process` takes, by the name of the parameter.

    Returns:
        A value per output.

    Raises:
        PluginError: It breaks a rule, or inputs are not those that it takes.
        StageError: It raised an error, or what it returned is not as declared.
    """
    name = type(stage).__qualname__
    node = Node(name, "stage", name, stage, ports_of(type(stage)))
    if fault := writing_fault(stage):
        raise PluginError(f"{name}: its settings cannot be written and read again: {fault}")
    arguments = {port.name: port.default for port in node.ports.inputs} | inputs
    for port in node.ports.inputs:
        value = arguments[port.name]
        if not isinstance(value, port.type) and (port.required or value is not port.default):
            raise PluginError(
                f"{name}: input '{port.name}' is {port.type.__name__}, got {type(value).__name__}"
            )
    if unknown := arguments.keys() - {port.name for port in node.ports.inputs}:
        raise PluginError(f"{name}: it has no input '{min(unknown)}'")
    first, second = (_result(node.fresh(), arguments) for _ in range(2))
    for kind, one, other in zip(node.ports.outputs, first, second, strict=True):
        if not _same(one, other):
            raise PluginError(
                f"{name}: a second copy returned another {kind.__name__}: chance must come from a "
                "parameter 'rng: numpy.random.Generator', and state be in private attributes"
            )
    return first


def _result(node: Node, arguments: dict[str, Any]) -> tuple[Any, ...]:
    """Open a stage, call it once and close it."""
    frame = next((v for v in arguments.values() if isinstance(v, RgbdFrame)), None)
    if node.ports.rng is not None:
        arguments = arguments | {node.ports.rng: np.random.default_rng(0)}
    with opened(node):
        try:
            return called(node, arguments, frame)
        except (Exception, SystemExit) as error:
            raise failure(node, frame.header.sequence if frame else None, error) from error


def _same(one: Any, other: Any) -> bool:
    """Return whether two values are equal to the bit; NaN equals NaN."""
    if is_dataclass(one) and type(one) is type(other):
        return all(_same(getattr(one, f.name), getattr(other, f.name)) for f in fields(one))
    if isinstance(one, Mapping) and isinstance(other, Mapping):
        return one.keys() == other.keys() and all(_same(one[key], other[key]) for key in one)
    if isinstance(one, np.ndarray) and isinstance(other, np.ndarray):
        return (one.dtype, one.shape, one.tobytes()) == (other.dtype, other.shape, other.tobytes())
    return bool(one == other)


def replay(graph: str | Path, source: str | Path | None = None, *overrides: str) -> Iterator[Trace]:
    """Play a graph frame by frame, without its sinks: what `mushpipe run` would hand to them.

    Args:
        graph: The graph file.
        source: As after ``--source``: a recording or a folder of images, say.
        overrides: As after ``--set``: texts ``a.b=value``.

    Yields:
        A trace per frame; ``trace.outputs["pick"]`` is a tuple of what the stage `pick` returned.

    Raises:
        GraphError: The graph has faults; before the first frame.
        StageError: A stage failed, whatever ``on_error`` says.
        InputError: The recording is damaged; after the last frame that it holds.
    """
    document = read_document(Path(graph))
    document.data["sinks"] = {}
    played = None if source is None else str(source)
    return _traces(compile_document(document, load_registry(), overrides, played).fresh())


def _traces(plan: Plan) -> Iterator[Trace]:
    chain, source = Chain(plan), plan.source.plugin
    if not isinstance(source, Source):
        raise TypeError("the plan's source is not a Source")
    with ExitStack() as stack:
        for node in (plan.source, *plan.stages):
            stack.enter_context(opened(node))
        stack.enter_context(named(plan.source, "frames"))
        for ticket, frame in enumerate(limited(source.frames(), source)):
            left_ns = time.perf_counter_ns()
            passage = chain.passed(frame, ticket)
            if passage.failed is not None:
                node, error = passage.failed
                raise failure(node, frame.header.sequence, error) from error
            yield passage.trace(left_ns)
