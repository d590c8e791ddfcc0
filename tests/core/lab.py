"""A small world for tests of the framework: plugins without image processing, and a registry."""

import sys
import threading
from collections.abc import Iterator
from pathlib import Path
from textwrap import dedent
from typing import Any, ClassVar

import numpy as np
import pytest
from pydantic import Field

from mushpipe import Circles, Header, Mask, Registry, ReplaySource, RgbdFrame, Sink, Stage, Trace
from mushpipe.core.document import parse_document
from mushpipe.core.errors import GraphError
from mushpipe.core.graph import compile_document
from mushpipe.core.plan import Plan
from mushpipe.core.report import RunReport
from mushpipe.core.run import run

WIDTH, HEIGHT = 8, 6
PATIENCE_S = 180  # a deadlock fails a test instead of hanging it; compiling kernels takes a minute


def make_frame(sequence: int = 0, **changes: Any) -> RgbdFrame:
    """Frame i has the gray level i in all its pixels, 100 ms after the frame before it."""
    header = Header(10**9 + sequence * 10**8, sequence, "camera")
    color = np.full((HEIGHT, WIDTH, 3), sequence, np.uint8)
    return RgbdFrame(**{"header": header, "color": color, **changes})


def circles(*radii: float) -> Circles:
    n = len(radii)
    return Circles(np.zeros((n, 2)), np.array(radii, float), np.ones(n))


def soon(event: threading.Event) -> None:
    if not event.wait(PATIENCE_S):
        raise TimeoutError("an event of the test never came")


class Frames(ReplaySource):
    """Yields a few frames."""

    count: int = Field(3, ge=0, description="how many")

    def frames(self) -> Iterator[RgbdFrame]:
        return (make_frame(i) for i in range(self.count))


class Threshold(Stage):
    """Marks pixels of at least this gray level."""

    level: int = Field(1, ge=0, le=255, description="gray level")
    band: tuple[int, int] | None = Field(None, description="lowest and highest level")

    def process(self, frame: RgbdFrame) -> Mask:
        return Mask(frame.color[..., 0] >= self.level)


class Invert(Stage):
    def process(self, mask: Mask) -> Mask:
        return Mask(~mask.foreground)


class Brighten(Stage):
    by: int = 100

    def process(self, frame: RgbdFrame) -> RgbdFrame:
        return RgbdFrame(frame.header, frame.color + np.uint8(self.by))


class Measure(Stage):
    """One circle: its centre is the frame's gray level and the mask's area."""

    def process(self, frame: RgbdFrame, mask: Mask) -> Circles:
        center = [[frame.color[0, 0, 0], mask.foreground.sum()]]
        return Circles(np.array(center, float), np.ones(1), np.ones(1))


class Both(Stage):
    """Two outputs at once."""

    def process(self, frame: RgbdFrame) -> tuple[Mask, Circles]:
        return Mask(np.ones(frame.color.shape[:2], bool)), circles(7)


class Dice(Stage):
    def process(self, frame: RgbdFrame, rng: np.random.Generator) -> Circles:
        return circles(1 + rng.random())


class Fussy(Stage):
    """Fails on some frames."""

    on: list[int] = Field([], description="sequence numbers of these frames")

    def process(self, frame: RgbdFrame) -> Circles:
        if frame.header.sequence in self.on:
            raise RuntimeError("I do not like it")
        return circles(1)


def held(entered: threading.Event, release: threading.Event) -> type[Stage]:
    """Return a stage that says when it has a frame, and keeps it until it is told."""

    class Held(Stage):
        def process(self, frame: RgbdFrame) -> RgbdFrame:
            entered.set()
            soon(release)
            return frame

    return Held


class Lab:
    """A registry with the plugins above and a sink `collect`, and graphs run on them."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.registry = Registry()
        self.seen: list[Trace] = []
        seen = self.seen

        class Collect(Sink):
            size: float = Field(1, gt=0, description="of nothing")

            def consume(self, trace: Trace) -> None:
                seen.append(trace)

        self.registry.source("frames", Frames)
        self.registry.sink("collect", Collect)
        for cls in (Threshold, Invert, Brighten, Measure, Both, Dice, Fussy):
            self.registry.stage(cls.__name__.lower(), cls)

    def compile(self, text: str, *overrides: str, source: str | None = None) -> Plan:
        document = parse_document(dedent(text).lstrip("\n"), "graph.yaml", self.folder)
        return compile_document(document, self.registry, overrides, source)

    def faults(self, text: str, *overrides: str, source: str | None = None) -> str:
        with pytest.raises(GraphError) as caught:
            self.compile(text, *overrides, source=source)
        assert caught.value.exit_code == 2
        return str(caught.value)

    def run(self, text: str, *overrides: str, **options: Any) -> RunReport:
        return run(self.compile(text, *overrides), **options)

    def chain(self, *stages: type[Stage] | str, source: str = "frames", extra: str = "") -> str:
        """Return a graph of these stages, called a, b, c..., that collects everything."""
        lines = ["mushpipe: 1", f"source: {{use: {source}}}", extra, "stages:"]
        for name, stage in zip("abcdef", stages, strict=False):
            if not isinstance(stage, str):
                self.registry.entries.pop(("stage", f"own-{name}"), None)
                self.registry.stage(f"own-{name}", stage)
                stage = f"own-{name}"
            lines.append(f"  {name}: {{use: {stage}}}")
        return "\n".join([*lines, "sinks: {out: {use: collect}}"])

    def live(self, frames: Any) -> None:
        """Register the source `live`, which calls a function for its iterator of frames."""

        class Live(Frames):
            live: ClassVar[bool] = True

            def frames(self) -> Iterator[RgbdFrame]:
                return frames()

        self.registry.source("live", Live)


def cli(monkeypatch: pytest.MonkeyPatch, *arguments: str | Path) -> int:
    """Call the program in this process and return its exit code."""
    from mushpipe.cli import main

    monkeypatch.setattr(sys, "argv", ["mushpipe", *map(str, arguments)])
    with pytest.raises(SystemExit) as caught:
        main()
    return caught.value.code or 0
