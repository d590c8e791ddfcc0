"""Tables that a plugin derived from mushpipe's serve where theirs do, in recordings as well."""

from __future__ import annotations

from dataclasses import dataclass, fields
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from mushpipe import Circles, Columns, Picks, column
from mushpipe.core.errors import UsageError
from mushpipe.evaluate.results import read_results
from mushpipe.export import read_picks
from mushpipe.traces import read_traces
from tests.io.values import make_circles, make_frame, make_picks, record, trace_of


@dataclass(frozen=True, eq=False)
class Tracked(Circles):
    """Circles that are followed."""

    track: NDArray[np.int64] = column(dtype=np.int64)


@dataclass(frozen=True, eq=False, kw_only=True)
class Graded(Picks):
    """Picks with a grade."""

    grade: NDArray[np.str_] = column(dtype=str)


def values(table: Columns) -> dict[str, object]:
    return {item.name: getattr(table, item.name) for item in fields(table)}


def test_circles_of_a_subtype_are_judged(tmp_path: Path) -> None:
    """Those of the stage above were, without a word that the last stage's were not looked at."""
    moved = Tracked(make_circles().center + 30, [3, 4], [1, 0.5], [1, 2])
    trace = trace_of(make_frame(), detect=make_circles(), track=moved)
    path = record(tmp_path / "out.mcap", [trace])
    with pytest.raises(UsageError, match="choose with --topic /mushpipe/detect or"):
        read_results(path)
    [(_, found)] = read_results(path, "/mushpipe/track").frames
    assert found.center == pytest.approx(moved.center)
    [(circles,)] = [t.outputs["track"] for t in read_traces(path)]
    assert isinstance(circles, Circles)
    assert circles.center == pytest.approx(moved.center)


def test_picks_of_a_subtype_are_exported(tmp_path: Path) -> None:
    graded = Graded(**values(make_picks()), grade=["A", "B"])
    path = record(tmp_path / "out.mcap", [trace_of(make_frame(), grade=graded)])
    [(_, picks)] = read_picks(path)
    assert picks.id.tolist() == [7, 8]
    [(_, found)] = read_results(path).frames
    assert len(found) == 2
