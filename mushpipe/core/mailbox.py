"""The hand-over between two threads: the only place where frames wait or are dropped."""

from __future__ import annotations

import threading
from collections import deque
from typing import Generic, TypeVar

T = TypeVar("T")


class Mailbox(Generic[T]):
    """A bounded queue that blocks when full, or, with ``latest``, drops the oldest and counts it.

    ``accepted == taken + dropped + waiting`` holds at all times.
    """

    def __init__(self, capacity: int, latest: bool = False) -> None:
        self.capacity = capacity
        self.latest = latest
        self.accepted = self.taken = self.dropped = 0
        self._items: deque[T] = deque()
        self._closed = False
        self._changed = threading.Condition()

    @property
    def waiting(self) -> int:
        """Number of items handed in and not yet taken."""
        return len(self._items)

    def put(self, item: T) -> bool:
        """Hand an item in, waiting for room unless ``latest``; False when closed meanwhile."""
        with self._changed:
            while not self.latest and len(self._items) >= self.capacity and not self._closed:
                self._changed.wait()
            if self._closed:
                return False
            if len(self._items) >= self.capacity:
                self._items.popleft()
                self.dropped += 1
            self._items.append(item)
            self.accepted += 1
            self._changed.notify_all()
            return True

    def get(self, timeout: float | None = None) -> T | None:
        """Take the oldest item; None on timeout, or when closed and empty."""
        with self._changed:
            self._changed.wait_for(lambda: self._items or self._closed, timeout)
            if not self._items:
                return None
            self.taken += 1
            self._changed.notify_all()
            return self._items.popleft()

    def close(self) -> None:
        """Accept nothing more; what waits can still be taken, and a blocked `put` gives up."""
        with self._changed:
            self._closed = True
            self._changed.notify_all()

    @property
    def finished(self) -> bool:
        """Whether the box is closed and everything was taken."""
        with self._changed:
            return self._closed and not self._items
