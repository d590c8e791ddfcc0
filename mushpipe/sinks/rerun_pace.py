"""Which frames are shown where there are more of them than anybody looks at."""

from __future__ import annotations


class Pace:
    """Lets through at most so many frames per second of sensor time; all of them without a limit.

    Two of the same limit let through the same frames.
    """

    def __init__(self, hz: float | None) -> None:
        self._period_ns = round(1e9 / hz) if hz else 0
        self._next_ns = 0

    def due(self, stamp_ns: int) -> bool:
        """Return whether the frame with this stamp is let through; call it once for each."""
        since_ns = stamp_ns - self._next_ns + self._period_ns
        if 0 <= since_ns < self._period_ns:
            return False
        self._next_ns = stamp_ns + self._period_ns  # also after a leap, forwards or back
        return True
