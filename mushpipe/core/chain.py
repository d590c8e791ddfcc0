"""The stages of a plan, through which frames follow one another.

A frame may enter a stage as soon as the frame before it has left that stage: every stage sees all
frames, in order and one at a time, so what comes out is what a single thread would have made. Only
a stage that says it is reentrant may have several frames in it; they leave in order all the same,
since the next one takes them in order.
"""

from __future__ import annotations

import gc
import sys
import threading
import time
import zlib
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, nullcontext
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from mushpipe.core.plan import Node, Plan
from mushpipe.core.stage import Stage
from mushpipe.core.types import Mask, RgbdFrame, Trace

Outputs = dict[str, tuple[Any, ...]]


class Turnstile:
    """Lets the holders of tickets 0, 1, 2 and so on in, one at a time and in that order."""

    def __init__(self) -> None:
        self._next = 0
        self._open = False
        self._inside = threading.Lock()
        self._changed = threading.Condition()

    def wait(self, ticket: int) -> None:
        """Wait for the turn of a ticket."""
        with self._changed:
            self._changed.wait_for(lambda: self._next == ticket or self._open)

    @contextmanager
    def turn(self, ticket: int) -> Iterator[None]:
        """Wait for the turn of a ticket, and end it on leaving."""
        self.wait(ticket)
        try:
            with self._inside:
                yield
        finally:
            with self._changed:
                self._next += 1
                self._changed.notify_all()

    def open(self) -> None:
        """Let everybody through, out of order: the holder of a ticket will not come any more."""
        with self._changed:
            self._open = True
            self._changed.notify_all()


@dataclass
class Passage:
    """What became of a frame on its way: ``failed`` is the stage that raised, with its error."""

    frame: RgbdFrame
    outputs: Outputs
    durations_ns: dict[str, int] = field(default_factory=dict)
    failed: tuple[Node, BaseException] | None = None

    def trace(self, left_ns: int) -> Trace:
        """Return what the sinks get."""
        return Trace(self.frame, self.outputs, self.durations_ns, left_ns)


class Chain:
    """The stages of a plan; several threads may bring frames, each with a ticket of its own."""

    def __init__(self, plan: Plan) -> None:
        self.plan = plan
        self.closed = False
        self._turnstiles = [None if _reentrant(node) else Turnstile() for node in plan.stages]

    def await_first(self, ticket: int) -> None:
        """Wait until the first stage is free for a ticket."""
        if self._turnstiles and (first := self._turnstiles[0]):
            first.wait(ticket)

    def passed(self, frame: RgbdFrame, ticket: int) -> Passage:
        """Take a frame through the stages, up to the one that fails, and return what they did."""
        seen = replace(frame, attached={})
        passage = Passage(frame, {self.plan.source.name: (seen,)})
        for node, turnstile in zip(self.plan.stages, self._turnstiles, strict=True):
            with turnstile.turn(ticket) if turnstile else nullcontext():
                if passage.failed is None and not self.closed:
                    self._step(node, passage)
        return passage

    def close(self) -> None:
        """Let what is on its way pass without calling stages: nobody will look at it."""
        self.closed = True
        for turnstile in filter(None, self._turnstiles):
            turnstile.open()

    def _step(self, node: Node, passage: Passage) -> None:
        begin = time.perf_counter_ns()
        try:
            passage.outputs[node.name] = self._call(node, passage)
        except (Exception, SystemExit) as error:
            passage.failed = (node, error)
        else:
            passage.durations_ns[node.name] = time.perf_counter_ns() - begin

    def _call(self, node: Node, passage: Passage) -> tuple[Any, ...]:
        frame = passage.frame
        arguments = _inputs(node, passage.outputs)
        if node.ports.rng is not None:
            name_key = zlib.crc32(node.name.encode())
            arguments[node.ports.rng] = np.random.default_rng(
                [self.plan.seed, name_key, frame.header.sequence]
            )
        seen = [value for value in arguments.values() if isinstance(value, RgbdFrame)]
        return called(node, arguments, seen[0] if seen else frame)


def called(node: Node, arguments: Mapping[str, Any], frame: RgbdFrame | None) -> tuple[Any, ...]:
    """Call a stage and return its outputs.

    Raises:
        TypeError: They are not those that it declares.
        ValueError: They do not fit the frame, if there is one.
    """
    result = node.plugin.process(**arguments)  # type: ignore[attr-defined]
    values = _values(result, node.ports.outputs)
    _check_types(node, values)
    if frame is not None:
        _check_fit(values, frame)
    return values


@contextmanager
def cores_shared() -> Iterator[None]:
    """Let the threads of a run share cores and interpreter well, while it lasts."""
    import cv2

    interval, helpers = sys.getswitchinterval(), cv2.getNumThreads()
    # A stage that comes back from a kernel asks for the interpreter, and would wait for the 5 ms
    # that Python gives a sink by default.
    sys.setswitchinterval(5e-4)
    # What was made until now stays: 200 000 objects of libraries that a full collection would look
    # through in the first seconds, and seldom later, for 40 to 130 ms in which no thread runs.
    gc.freeze()
    # The cores are busy with stages and sinks; OpenCV's own threads would only spin beside them.
    cv2.setNumThreads(1)
    try:
        yield
    finally:
        gc.unfreeze()
        sys.setswitchinterval(interval)
        cv2.setNumThreads(helpers)


def _reentrant(node: Node) -> bool:
    return isinstance(node.plugin, Stage) and node.plugin.reentrant


def sink_inputs(node: Node, trace: Trace) -> dict[str, Any]:
    """Return what a sink asks for, by the name of its parameter."""
    inputs = _inputs(node, trace.outputs)
    for port in node.ports.inputs:
        if port.type is Trace:
            inputs[port.name] = trace
    return inputs


def _inputs(node: Node, outputs: Mapping[str, tuple[Any, ...]]) -> dict[str, Any]:
    """Return the inputs by the name of their parameter; the default of what nothing produces."""
    inputs = {port.name: port.default for port in node.ports.inputs}
    for name, link in node.links.items():
        inputs[name] = outputs[link.producer][link.output]
    return inputs


def _values(result: Any, declared: tuple[type, ...]) -> tuple[Any, ...]:
    """Return a stage's outputs; a tuple is one where the stage declares it to be."""
    single = len(declared) == 1 and isinstance(result, declared[0])
    return (result,) if single or not isinstance(result, tuple) else result


def _check_types(node: Node, values: tuple[Any, ...]) -> None:
    expected = node.ports.outputs
    matches = len(values) == len(expected) and all(map(isinstance, values, expected))
    if not matches:
        raise TypeError(
            f"it returned ({', '.join(type(v).__name__ for v in values)}), "
            f"declared is ({', '.join(t.__name__ for t in expected)})"
            + ("; is a `return` missing?" if len(values) == 1 and values[0] is None else "")
        )


def _check_fit(values: tuple[Any, ...], frame: RgbdFrame) -> None:
    height, width = frame.color.shape[:2]
    for value in values:
        h, w = _size(value) or (height, width)
        if (h, w) != (height, width):
            what = "mask" if isinstance(value, Mask) else "new frame"
            raise ValueError(f"its {what} is {w}x{h}, the frame {width}x{height}")
        if isinstance(value, RgbdFrame) and _moment(value) != _moment(frame):
            raise ValueError(
                f"its new frame has stamp_ns and sequence {_moment(value)}, the frame "
                f"{_moment(frame)}: what is found in it would count as of now; make it by "
                "dataclasses.replace(frame, color=...)"
            )


def _moment(frame: RgbdFrame) -> tuple[int, int]:
    return frame.header.stamp_ns, frame.header.sequence


def _size(value: Any) -> tuple[int, ...] | None:
    """Return height and width of what has pixels."""
    if isinstance(value, Mask):
        return value.foreground.shape
    return value.color.shape[:2] if isinstance(value, RgbdFrame) else None
