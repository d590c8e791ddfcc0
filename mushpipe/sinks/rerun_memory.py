"""What a viewer would go on showing on frames that it is not of."""

from __future__ import annotations

from typing import Any

from mushpipe.sinks.rerun_layout import MOMENTS


class Remembering:
    """Logs to a recording, and clears what a later frame does not log anew.

    A viewer shows what was logged last, whatever frame that was of.
    """

    def __init__(self, rec: Any) -> None:
        self._rec = rec
        self._before: set[str] = set()
        self._now: set[str] = set()

    def log(self, entity: str, what: Any) -> None:
        """Log what an entity is at this frame."""
        self._rec.log(entity, what)
        if not entity.startswith(MOMENTS):
            self._now.add(entity)

    def settle(self) -> None:
        """End a frame."""
        import rerun as rr

        for entity in sorted(self._before - self._now):
            self._rec.log(entity, rr.Clear(recursive=False))
        self._before, self._now = self._now, set()
