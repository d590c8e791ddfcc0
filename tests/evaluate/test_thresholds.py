from __future__ import annotations

import math

import pytest

from mushpipe.core.errors import UsageError
from mushpipe.evaluate.metrics import METRICS
from mushpipe.evaluate.running import Alternative, alternatives
from mushpipe.evaluate.thresholds import check, parse_threshold, require_known


@pytest.mark.parametrize(
    ("text", "value", "kept"),
    [
        ("f>=0.98", 0.98, True),
        ("f>=0.98", 0.979, False),
        ("f > 0.98", 0.98, False),
        ("|diameter_bias_mm|<=0.3", -0.3, True),
        ("|diameter_bias_mm|<=0.3", -0.31, False),
        ("diameter_bias_mm<0.3", -5, True),
        ("f>=0.98", math.nan, False),
        ("axis_mean_deg<4", math.nan, False),
        ("|radius_bias_px|<4", math.nan, False),
    ],
)
def test_thresholds(text: str, value: float, kept: bool) -> None:
    threshold = parse_threshold(text)
    (outcome,) = check([threshold], {threshold.name: value})
    assert outcome.kept is kept


@pytest.mark.parametrize(
    "text", ["f", "f=1", "f>=", "f>=x", "|f>=1", "f|>=1", ">=1", "f>=nan", "f<=inf"]
)
def test_other_forms_are_refused(text: str) -> None:
    with pytest.raises(UsageError, match="expected NAME>=NUMBER"):
        parse_threshold(text)


def test_unknown_names_get_the_nearest() -> None:
    with pytest.raises(UsageError, match="did you mean 'recall'"):
        require_known([parse_threshold("recal>=1")], METRICS)


def test_matrix_is_every_combination() -> None:
    assert alternatives(["segment.use=otsu,chan-vese"]) == [
        Alternative("segment.use=otsu", ("segment.use=otsu",)),
        Alternative("segment.use=chan-vese", ("segment.use=chan-vese",)),
    ]
    both = alternatives(["a.b=1,2", "c.d=[8,38],[[1,2],3],{x: 1, y: 2}"])
    assert [option.overrides for option in both][:2] == [
        ("a.b=1", "c.d=[8,38]"),
        ("a.b=1", "c.d=[[1,2],3]"),
    ]
    assert len(both) == 6


@pytest.mark.parametrize("text", ["segment.use", "a.b=1,", "a.b=1,1"])
def test_wrong_matrices_are_refused(text: str) -> None:
    with pytest.raises(UsageError, match="--matrix"):
        alternatives([text])
