"""Colour and depth images that belong together, by their stamps."""

from __future__ import annotations

from collections import deque
from collections.abc import Iterator
from typing import Generic, TypeVar

C = TypeVar("C")
D = TypeVar("D")


class Pairing(Generic[C, D]):
    """Pairs two streams of stamped items within a tolerance; every colour item comes out once.

    Stamps must rise within each stream. A colour item waits until its depth item came, a later
    depth item shows that none will, or `PATIENCE` further colour items have arrived.
    """

    PATIENCE = 32

    def __init__(self, tolerance_ns: int) -> None:
        self.tolerance_ns = tolerance_ns
        self.color_alone = self.depth_alone = 0
        self._colors: deque[tuple[int, C]] = deque()
        self._depths: deque[tuple[int, D]] = deque()

    def add_color(self, stamp_ns: int, item: C) -> Iterator[tuple[C, D | None]]:
        """Add a colour item; yield what is settled by it."""
        self._colors.append((stamp_ns, item))
        yield from self._settle(last=False)

    def add_depth(self, stamp_ns: int, item: D) -> Iterator[tuple[C, D | None]]:
        """Add a depth item; yield what is settled by it."""
        self._depths.append((stamp_ns, item))
        if not self._colors and len(self._depths) > self.PATIENCE:
            self._depths.popleft()
            self.depth_alone += 1
        yield from self._settle(last=False)

    def finish(self) -> Iterator[tuple[C, D | None]]:
        """Yield what is left, and count the depth items nobody took."""
        yield from self._settle(last=True)
        self.depth_alone += len(self._depths)
        self._depths.clear()

    def _settle(self, last: bool) -> Iterator[tuple[C, D | None]]:
        while self._colors:
            stamp, color = self._colors[0]
            while self._depths and self._depths[0][0] < stamp - self.tolerance_ns:
                self._depths.popleft()
                self.depth_alone += 1
            near = [d for d in self._depths if d[0] <= stamp + self.tolerance_ns]
            later = len(self._depths) > len(near)
            # An exact match is final; otherwise a nearer depth may still come.
            if not ((near and near[-1][0] >= stamp) or later or last or self._impatient()):
                return
            self._colors.popleft()
            if not near:
                self.color_alone += 1
                yield color, None
                continue
            best = min(near, key=lambda d: abs(d[0] - stamp))
            while self._depths[0] is not best:
                self._depths.popleft()
                self.depth_alone += 1
            yield color, self._depths.popleft()[1]

    def _impatient(self) -> bool:
        return len(self._colors) > self.PATIENCE
