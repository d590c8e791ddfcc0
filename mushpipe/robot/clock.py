"""Time that a robot can rely on, whatever happens to the wall clock."""

from __future__ import annotations

import time
from collections import deque
from dataclasses import dataclass
from math import inf

MEMORY_S = 10.0
TOLERANCE_S = 0.02
STEP_S = 0.002
# Most that two clocks drift apart, s/s: quartzes of cameras and hosts do by a quarter of it.
DRIFT = 2e-4
SET_S = 0.5  # a clock that gains so much from one frame to the next was set
PACED_S = 1.0
# Time spent in suspend must age a target, too; CLOCK_MONOTONIC stands still meanwhile.
_MONOTONIC = getattr(time, "CLOCK_BOOTTIME", time.CLOCK_MONOTONIC)


class Clock:
    """The two clocks of the host; a test puts its own in their place."""

    def monotonic(self) -> float:
        """Return seconds that never jump, from an arbitrary start."""
        return time.clock_gettime(_MONOTONIC)

    def wall_ns(self) -> int:
        """Return ns since the epoch; it may jump at any time, both ways."""
        return time.time_ns()


@dataclass
class _Span:
    """A stretch of monotonic time during which wall minus monotonic was constant.

    It was seen from ``sure`` to ``until``. Between those and ``begin`` and ``end``, the looks
    before and after, the wall clock jumped, who knows how often.
    """

    begin: float
    end: float
    offset: float
    sure: float
    until: float

    def place(self, stamp_s: float) -> float | None:
        """Return when the wall clock may have shown a stamp: the earliest moment that fits."""
        time_s = stamp_s - self.offset
        if not self.begin - TOLERANCE_S <= time_s <= self.end + TOLERANCE_S:
            return None
        if time_s <= self.sure + TOLERANCE_S:
            return min(time_s, self.begin)
        return min(time_s, self.until)


class Placer:
    """Puts the host's wall-clock stamps on the monotonic clock, across jumps of the former.

    It remembers for `MEMORY_S` which offset the wall clock had when. A stamp that the wall clock
    has shown twice, because it was set back in between, counts as the older of the two.
    """

    def __init__(self, clock: Clock) -> None:
        self._clock = clock
        now, offset = self._read()
        self._spans = deque([_Span(now - MEMORY_S, now, offset, now - MEMORY_S, now)])

    def _read(self) -> tuple[float, float]:
        now = self._clock.monotonic()
        return now, self._clock.wall_ns() / 1e9 - now

    def _look(self) -> float:
        """Look at both clocks; return the monotonic time."""
        now, offset = self._read()
        last = self._spans[-1]
        last.end = now
        if abs(offset - last.offset) > STEP_S:
            # The jump came at an unknown moment since the last look: both offsets may hold there.
            self._spans.append(_Span(last.until, now, offset, now, now))
        else:
            last.until = now
        while self._spans[0].end < now - MEMORY_S:
            self._spans.popleft()
        self._spans[0].begin = max(self._spans[0].begin, now - MEMORY_S)
        return now

    def place(self, stamp_ns: int) -> float | None:
        """Return the monotonic time of a stamp; None for the future and the far past."""
        now = self._look()
        placed = [span.place(stamp_ns / 1e9) for span in self._spans]
        found = [time_s for time_s in placed if time_s is not None]
        # A driver that reckons stamps back from now does so with the clock as it is now.
        return min(now, stamp_ns / 1e9 - self._spans[-1].offset, *found) if found else None


class Lateness:
    """How late the frames of a camera arrive whose clock is its own, beyond what is usual.

    The least delay so far counts as none. It may grow, as the clocks drift apart; a delay that
    grows faster comes from a queue or from a computer that stood still. It may shrink as slowly,
    where the camera's clock is the faster one, without a frame being called quick.

    The first frames may have waited, too, and so may those after the clock was set. They count as
    infinitely late until frames have come at the camera's pace for `PACED_S`: out of a queue that
    empties they come faster.
    """

    def __init__(self) -> None:
        self._anchor_ns, self._own_s, self._delay = 0, 0.0, inf
        self._least = self._quickest = inf
        self._paced_from = 0.0

    def of(self, own_ms: float, stamp_ns: int, arrived_s: float) -> float:
        """Return the lateness of the next frame, s; infinite where it cannot be told.

        Args:
            own_ms: Its time on the camera's clock.
            stamp_ns: That as ns since the epoch; another difference of the two, or a time that went
                back, says that nothing is known of its clock any more: the camera was lost, say.
                A time that runs ahead of the arrivals may be a clock that was set.
            arrived_s: Monotonic time of its arrival.
        """
        own_s, anchor_ns = own_ms / 1e3, stamp_ns - round(own_ms * 1e6)
        delay, drift = arrived_s - own_s, DRIFT * abs(own_s - self._own_s)
        lost = abs(anchor_ns - self._anchor_ns) > 1e6 or own_s < self._own_s
        if lost:
            self._least = inf
        if lost or self._delay - delay > SET_S:
            self._quickest = inf
        if delay < self._quickest - drift - TOLERANCE_S:
            self._quickest, self._paced_from = delay, arrived_s
        self._quickest = max(min(delay, self._quickest), self._quickest - drift)
        self._least = min(delay, self._least + drift)
        self._anchor_ns, self._own_s, self._delay = anchor_ns, own_s, delay
        return delay - self._least if arrived_s - self._paced_from >= PACED_S else inf
