"""Colour and depth images that belong together, by their stamps."""

from __future__ import annotations

from collections import deque
from collections.abc import Iterator
from typing import Generic, TypeVar

C = TypeVar("C")
D = TypeVar("D")


class Pairing(Generic[C, D]):
    """Pairs two streams of stamped items within a tolerance; every colour item comes out once.

    Where items are numbered only those of one number belong together. Stamps rise within each
    stream or stand still, or go back where a clock was set. A colour item waits until its depth
    item came, later items show that none will, or `PATIENCE` further items of a kind have arrived.
    """

    PATIENCE = 32

    def __init__(self, tolerance_ns: int) -> None:
        self.tolerance_ns = tolerance_ns
        self.color_alone = self.depth_alone = 0
        self._last_color = self._last_depth = 0
        self._colors: deque[tuple[int, int, C]] = deque()
        self._depths: deque[tuple[int, int, D]] = deque()

    def add_color(self, stamp_ns: int, item: C, number: int = 0) -> Iterator[tuple[C, D | None]]:
        """Add a colour item; yield what is settled by it.

        Where stamps go back, nothing that came before can belong to what follows.
        """
        if stamp_ns < self._last_color - self.tolerance_ns:
            yield from self._settle(last=True)
            self._forget(stamp_ns + self.tolerance_ns)
        self._last_color = stamp_ns
        self._colors.append((stamp_ns, number, item))
        yield from self._settle(last=False)

    def add_depth(self, stamp_ns: int, item: D, number: int = 0) -> Iterator[tuple[C, D | None]]:
        """Add a depth item; yield what is settled by it."""
        if stamp_ns < self._last_depth - self.tolerance_ns and not self._colors:
            self._forget(stamp_ns)
        self._last_depth = stamp_ns
        self._depths.append((stamp_ns, number, item))
        if not self._colors and len(self._depths) > self.PATIENCE:
            self._depths.popleft()
            self.depth_alone += 1
        yield from self._settle(last=False)

    def _forget(self, beyond_ns: int) -> None:
        """Count depth items of later stamps as alone: they are from before stamps went back."""
        kept = [each for each in self._depths if each[0] <= beyond_ns]
        self.depth_alone += len(self._depths) - len(kept)
        self._depths = deque(kept)

    def finish(self) -> Iterator[tuple[C, D | None]]:
        """Yield what is left, and count the depth items nobody took."""
        yield from self._settle(last=True)
        self.depth_alone += len(self._depths)
        self._depths.clear()

    def _settle(self, last: bool) -> Iterator[tuple[C, D | None]]:
        while self._colors:
            stamp, number, color = self._colors[0]
            while self._depths and self._passed(self._depths[0], stamp, number):
                self._depths.popleft()
                self.depth_alone += 1
            near = [
                d for d in self._depths if d[1] == number and abs(d[0] - stamp) <= self.tolerance_ns
            ]
            if not (last or self._impatient() or self._is_final(stamp, near)):
                return
            best = self._nearest(stamp, number, near)
            self._colors.popleft()
            if best is None:
                self.color_alone += 1
                yield color, None
                continue
            while self._depths[0] is not best:
                self._depths.popleft()
                self.depth_alone += 1
            yield color, self._depths.popleft()[2]

    def _passed(self, depth: tuple[int, int, D], stamp: int, number: int) -> bool:
        """Whether a depth item came before the first colour item, and is none of it."""
        before = depth[0] < stamp and depth[1] < number
        return before or depth[0] < stamp - self.tolerance_ns

    def _is_final(self, stamp: int, near: list[tuple[int, int, D]]) -> bool:
        """Whether nothing that is still to come can change the partner of the first colour."""
        if any(d[0] == stamp for d in near):
            return True
        if near and near[-1][0] > stamp:
            return len(self._colors) > 1  # a later depth may belong to the next colour
        return len(self._depths) > len(near)

    def _nearest(
        self, stamp: int, number: int, near: list[tuple[int, int, D]]
    ) -> tuple[int, int, D] | None:
        """Return the nearest depth item that is not nearer to the next colour of its number."""
        follows = len(self._colors) > 1 and self._colors[1][1] == number
        after = self._colors[1][0] if follows else None
        free = [d for d in near if after is None or abs(d[0] - stamp) <= abs(d[0] - after)]
        return min(free, key=lambda d: abs(d[0] - stamp), default=None)

    def _impatient(self) -> bool:
        return max(len(self._colors), len(self._depths)) > self.PATIENCE
