"""Time per stage, from the timing topic of results."""

from __future__ import annotations

from collections.abc import Iterable, Mapping

import numpy as np

from mushpipe.core.wire import TOTAL
from mushpipe.evaluate.results import Results


def speed_of(results: Iterable[Results]) -> dict[str, dict[str, float]]:
    """Return p50 and p95 in ms and the number of frames, per stage and for their ``total``."""
    pooled: dict[str, list[float]] = {}
    for result in results:
        for stage, durations in result.durations_ms.items():
            pooled.setdefault(stage, []).extend(durations)
    if TOTAL in pooled:  # last
        pooled[TOTAL] = pooled.pop(TOTAL)
    return {
        stage: {
            "p50_ms": float(np.percentile(durations, 50)),
            "p95_ms": float(np.percentile(durations, 95)),
            "frames": len(durations),
        }
        for stage, durations in pooled.items()
    }


def named(speed: Mapping[str, Mapping[str, float]]) -> dict[str, float]:
    """Return the same as metrics by name: ``speed_<stage>_p50_ms`` and ``speed_<stage>_p95_ms``."""
    return {
        f"speed_{stage}_{key}": row[key]
        for stage, row in speed.items()
        for key in ("p50_ms", "p95_ms")
    }
