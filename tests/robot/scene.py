"""Clocks, picks and servers for the tests of the robot socket."""

from __future__ import annotations

import queue
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from mushpipe import Picks
from mushpipe.robot.abb import AbbSession
from mushpipe.robot.clock import Clock
from mushpipe.robot.connection import Kind, Limits
from mushpipe.robot.hub import Hub, Settings
from mushpipe.robot.server import Listener, Options, RobotServer
from mushpipe.robot.session import JsonSession
from mushpipe.robot.targets import Choice, Filter

FRAME = "camera_color_optical_frame"
EPOCH_NS = 1_800_000_000 * 10**9
PATIENCE_S = 20  # how long a test waits for what must come; it never waits for so long


class FakeClock(Clock):
    """Clocks that move when told."""

    def __init__(self) -> None:
        self.now = 1000.0
        self.offset_s = 0.0

    def monotonic(self) -> float:
        return self.now

    def wall_ns(self) -> int:
        return EPOCH_NS + round((self.now + self.offset_s) * 1e9)


def make_picks(n: int = 3, **changes: Any) -> Picks:
    """n good picks, m0 the best, in a row along x, 0.5 m away; a change replaces a column."""
    columns: dict[str, Any] = {
        "id": np.arange(n),
        "center": np.full((n, 2), 100.0),
        "radius": np.full(n, 20.0),
        "position": np.column_stack([np.arange(n) / 1000, np.zeros(n), np.full(n, 0.5)]),
        "surface": np.tile([0.0, 0.0, 0.5], (n, 1)),
        "distance": np.full(n, 0.5),
        "diameter": np.full(n, 0.04),
        "quaternion": np.tile([1.0, 0.0, 0.0, 0.0], (n, 1)),
        "axis": np.tile([0.0, 0.0, -1.0], (n, 1)),
        "score": np.linspace(0.9, 0.5, n),
        "sigma_position": np.full((n, 3), 0.001),
        "sigma_diameter": np.full(n, 0.001),
        "sigma_tilt": np.full(n, 0.05),
        "source": np.ones(n),
        "flags": np.zeros(n),
    }
    columns |= changes
    missing = np.asarray(columns["source"]) == 0
    columns["surface"] = np.where(missing[:, None], np.nan, columns["surface"])
    return Picks(**columns, frame_id=FRAME)


def choice(n: int = 3, **changes: Any) -> Choice:
    return Filter()(make_picks(n, **changes))


@dataclass
class Bench:
    """A served hub on a fake clock, and what its observer saw."""

    clock: FakeClock
    hub: Hub
    server: RobotServer
    seen: queue.SimpleQueue[tuple[Kind, int, bytes]]
    frames: list[int] = field(default_factory=lambda: [0])

    @property
    def port(self) -> int:
        return self.server.ports[0]

    def publish(self, what: Choice | None = None) -> None:
        """Hand over a result taken now."""
        self.frames[0] += 1
        what = choice() if what is None else what
        self.hub.publish(what, self.frames[0], self.clock.wall_ns(), self.clock.now)
        self.server.wake()

    def advance(self, seconds: float) -> None:
        self.clock.now += seconds
        self.server.wake()

    def until(self, kind: Kind, text: bytes = b"") -> bytes:
        """Wait for the server to have done something."""
        while True:
            seen, _, line = self.seen.get(timeout=PATIENCE_S)
            if seen == kind and text in line:
                return line

    def advance_until_disconnected(self, step: float) -> bytes:
        """Let time pass whenever the server has nothing to do."""
        while True:
            try:
                kind, _, line = self.seen.get(timeout=0.05)
            except queue.Empty:
                self.advance(step)
            else:
                if kind == "event" and line.startswith(b"disconnected"):
                    return line


@contextmanager
def bench(
    limits: Limits | None = None,
    max_clients: int = 8,
    tls: Any = None,
    watched: bool = True,
    **settings: Any,
) -> Iterator[Bench]:
    """Serve JSON on the first port, lines on the second."""
    clock = FakeClock()
    frames = [0]
    hub = Hub(Settings(**settings), clock, lambda: frames[0])
    listeners = (Listener("127.0.0.1", 0, JsonSession), Listener("127.0.0.1", 0, AbbSession))
    seen: queue.SimpleQueue[tuple[Kind, int, bytes]] = queue.SimpleQueue()
    # A fake clock fills no allowance, so the allowance is the whole test's.
    limits = limits or Limits(lines_per_s=1e9)
    server = RobotServer(
        hub,
        Options(listeners, limits, max_clients, tls),
        lambda *what: seen.put(what) if watched else None,
    )
    server.start()
    try:
        yield Bench(clock, hub, server, seen, frames)
    finally:
        server.stop()
