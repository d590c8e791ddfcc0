"""What a run did: the balance of its frames and the time its stages took."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from mushpipe.core.columns import Columns
from mushpipe.core.errors import EXIT_FAILED, EXIT_INTERRUPTED, EXIT_OK, MushpipeError
from mushpipe.core.types import Header


class Durations:
    """A histogram of durations with 1 % wide bins: constant memory however long the run."""

    def __init__(self) -> None:
        self.count = 0
        self.max_ns = 0
        self._bins: Counter[int] = Counter()

    def add(self, duration_ns: int) -> None:
        """Count one duration."""
        self.count += 1
        self.max_ns = max(self.max_ns, duration_ns)
        self._bins[round(100 * math.log(max(duration_ns, 1)))] += 1

    def quantile_ms(self, q: float) -> float:
        """Return the q-quantile (nearest rank) in ms, within 1 %; NaN without data."""
        seen = 0
        for key in sorted(self._bins):
            seen += self._bins[key]
            if seen >= q * self.count:
                return min(math.exp(key / 100), self.max_ns) / 1e6
        return math.nan

    def summary(self) -> dict[str, float]:
        """Return p50, p95, p99 and max in ms."""
        return {
            "p50_ms": round(self.quantile_ms(0.5), 3),
            "p95_ms": round(self.quantile_ms(0.95), 3),
            "p99_ms": round(self.quantile_ms(0.99), 3),
            "max_ms": round(self.max_ns / 1e6, 3),
        }


@dataclass
class SinkReport:
    """What became of the frames handed to one sink."""

    handed: int = 0
    consumed: int = 0
    dropped: int = 0
    failed: int = 0

    def balanced(self) -> bool:
        """Whether every frame is accounted for."""
        return self.handed == self.consumed + self.dropped + self.failed


@dataclass
class Found:
    """The rows of the last table that the stages made of each frame."""

    rows: int = 0
    frames: int = 0
    empty: int = 0

    def add(self, outputs: Mapping[str, tuple[Any, ...]]) -> None:
        """Count what the stages, in order, made of a frame."""
        values = (value for made in outputs.values() for value in made)
        if tables := [value for value in values if isinstance(value, Columns)]:
            self.rows += len(tables[-1])
            self.frames += 1
            self.empty += not len(tables[-1])


@dataclass
class RunReport:
    """The result of a run.

    ``read`` counts frames the source delivered, ``waiting`` those that were read ahead and never
    looked at because the run ended early. ``manifest`` says what the run was made of.
    ``durations`` holds what each node takes for a frame, source and sinks on threads of their own;
    ``frame`` the sum of the stages; ``latency`` the time from when a frame left the source until
    what was found in it is handed to the sinks. ``elapsed_s`` counts from when all is open.
    ``found`` counts the mushrooms; ``span`` holds the first and last stamp and sequence number of
    the frames that went in; ``opened`` tells that source, stages and sinks were, so that what a run
    before has left is no longer there; ``files`` are those that sinks write.
    """

    manifest: dict[str, Any] = field(default_factory=dict)
    read: int = 0
    waiting: int = 0
    processed: int = 0
    dropped: int = 0
    failed: int = 0
    span: dict[str, tuple[int, int]] = field(default_factory=dict)
    found: Found = field(default_factory=Found)
    source: dict[str, int] = field(default_factory=dict)
    device: dict[str, Any] = field(default_factory=dict)
    sinks: dict[str, SinkReport] = field(default_factory=dict)
    durations: dict[str, Durations] = field(default_factory=dict)
    frame: Durations = field(default_factory=Durations)
    latency: Durations = field(default_factory=Durations)
    elapsed_s: float = 0.0
    opened: bool = False
    files: tuple[Path, ...] = ()
    interrupted: bool = False
    error: MushpipeError | None = None
    capsules: list[str] = field(default_factory=list)

    @property
    def frames_in(self) -> int:
        """Frames that entered the pipeline."""
        return self.read - self.waiting

    def widen_span(self, header: Header) -> None:
        """Note that a frame went in, whatever becomes of it."""
        for name in ("stamp_ns", "sequence"):
            value = getattr(header, name)
            low, high = self.span.get(name, (value, value))
            self.span[name] = min(low, value), max(high, value)

    def balanced(self) -> bool:
        """Whether frames in = processed + dropped + failed, for the pipeline and every sink."""
        closed = self.frames_in == self.processed + self.dropped + self.failed
        return closed and all(sink.balanced() for sink in self.sinks.values())

    @property
    def exit_code(self) -> int:
        """The program's exit code for this run."""
        if self.error is not None:
            return self.error.exit_code
        if not self.balanced():
            return EXIT_FAILED
        return EXIT_INTERRUPTED if self.interrupted else EXIT_OK

    def summary(self) -> dict[str, Any]:
        """Return counts and timings as plain data."""
        return {
            "exit_code": self.exit_code,
            "error": str(self.error) if self.error else None,
            "frames": {
                "in": self.frames_in,
                "processed": self.processed,
                "dropped": self.dropped,
                "failed": self.failed,
                "balanced": self.balanced(),
            },
            **({"span": self.span} if self.span else {}),
            **({"found": vars(self.found)} if self.found.frames else {}),
            "source": self.source,
            **({"device": self.device} if self.device else {}),
            "sinks": {name: vars(sink) for name, sink in self.sinks.items()},
            "durations": {name: d.summary() for name, d in self.durations.items() if d.count},
            **({"frame": self.frame.summary()} if self.frame.count else {}),
            **({"latency": self.latency.summary()} if self.latency.count else {}),
            "elapsed_s": round(self.elapsed_s, 3),
            "capsules": self.capsules,
        }
