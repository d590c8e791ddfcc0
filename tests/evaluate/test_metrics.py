from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from mushpipe.core.tables import Picks
from mushpipe.core.truth import Truth
from mushpipe.evaluate.compare import differences
from mushpipe.evaluate.events import Verdict, comparable, events_of, judge
from mushpipe.evaluate.metrics import METRICS, measure
from mushpipe.evaluate.results import of_circles, of_picks
from mushpipe.evaluate.truth import FrameTruth
from tests.evaluate.scenes import FRAME, bed, header, picks_of, tilted


def verdict(truth: Truth, picks: Picks, number: int = 0, surface: Any = 0.0) -> Verdict:
    picks = replace(picks, surface=picks.surface + surface)
    known, at = FrameTruth(truth, frame_id=FRAME), header(number)
    return judge("bed", ("stamp_ns", at.stamp_ns), known, at, of_picks(picks))


def values_of(*verdicts: Verdict, up: Any = (0, 0, -1)) -> dict[str, float]:
    measured = measure(events_of(verdicts, up), len(verdicts), resamples=0)
    return {name: value.value for name, value in measured.items()}


def turned(axis: np.ndarray, angle: float, rng: np.random.Generator) -> np.ndarray:
    """Axes turned by an angle about random perpendiculars."""
    other = np.cross(axis, rng.normal(size=axis.shape))
    other /= np.linalg.norm(other, axis=1, keepdims=True)
    return math.cos(angle) * axis + math.sin(angle) * other


def test_the_truth_against_itself_is_perfect() -> None:
    verdicts = [verdict(bed(i), picks_of(bed(i)), i) for i in range(3)]
    values = values_of(*verdicts)
    for name in ("precision", "recall", "f", "coverage_position", "coverage_axis"):
        assert values[name] == 1
    errors = {n: v for n, v in values.items() if METRICS[n].unit and "upright" not in n}
    assert errors
    assert all(v == pytest.approx(0, abs=1e-9) for v in errors.values()), errors
    assert values["upright_mean_deg"] > 10
    assert math.isnan(values["calibration_position"])
    assert values["coverage_sigma_tilt"] == 0


@given(
    shift=st.tuples(st.floats(-3, 3), st.floats(-3, 3)),
    bias=st.floats(-2, 2),
    wider=st.floats(-0.005, 0.005),
    moved=st.tuples(*[st.floats(-0.01, 0.01)] * 3),
    angle=st.floats(0, 0.7),
    dropped=st.integers(0, 6),
    added=st.integers(0, 6),
    seed=st.integers(0, 1000),
)
@settings(max_examples=60, deadline=None)
def test_injected_errors_are_recovered(
    shift: tuple[float, float],
    bias: float,
    wider: float,
    moved: tuple[float, float, float],
    angle: float,
    dropped: int,
    added: int,
    seed: int,
) -> None:
    rng = np.random.default_rng(seed)
    truth = bed(seed)
    kept = truth.take(np.sort(rng.permutation(20)[dropped:]))
    extra = replace(
        bed(seed, 1, added),
        center=np.array([[90.0 * i, 20] for i in range(added)]).reshape(-1, 2),
        radius=np.full(added, 9.0),
    )
    picks = picks_of(
        kept,
        center=shift,
        radius=bias,
        diameter=wider,
        position=moved,
        axis=turned(kept.axis, angle, rng),
    )
    picks = _joined(picks, picks_of(extra))
    values = values_of(verdict(truth, picks))
    assert values["recall"] == pytest.approx((20 - dropped) / 20)
    assert values["precision"] == pytest.approx((20 - dropped) / (20 - dropped + added))
    assert values["f"] == pytest.approx(2 * (20 - dropped) / (40 - dropped + added))
    expected = {
        "center_u_bias_px": shift[0],
        "center_v_bias_px": shift[1],
        "center_p95_px": math.hypot(*shift),
        "center_std_px": 0,
        "radius_bias_px": bias,
        "radius_mae_px": abs(bias),
        "radius_std_px": 0,
        "diameter_bias_mm": 1e3 * wider,
        "diameter_mae_mm": 1e3 * abs(wider),
        "apex_x_bias_mm": 1e3 * moved[0],
        "apex_z_bias_mm": 1e3 * moved[2],
        "apex_mean_mm": 1e3 * math.hypot(*moved),
        "apex_z_std_mm": 0,
        "axis_mean_deg": math.degrees(angle),
        "axis_median_deg": math.degrees(angle),
        "axis_std_deg": 0,
    }
    for name, value in expected.items():
        assert values[name] == pytest.approx(value, abs=1e-5), name


def _joined(a: Picks, b: Picks) -> Picks:
    columns = [n for n, f in Picks.__dataclass_fields__.items() if "shape" in f.metadata]
    both = {n: np.concatenate([getattr(a, n), getattr(b, n)]) for n in columns}
    return Picks(**{**both, "id": np.arange(len(a) + len(b))}, frame_id=FRAME)


def test_a_frame_has_an_f_of_its_own() -> None:
    truth = bed(0)
    extra = picks_of(replace(bed(99, 1, 2), center=np.array([[30.0, 30.0], [600.0, 30.0]])))
    judged = verdict(truth, _joined(picks_of(truth.take(slice(0, 14))), extra))
    assert judged.f == pytest.approx(28 / (28 + 6 + 2))  # 14 found, 6 missed, 2 false
    assert verdict(truth, extra).f == 0
    assert math.isnan(verdict(truth.take(slice(0, 0)), extra).f)


def test_hand_computed_errors() -> None:
    truth = bed(1).take(slice(0, 3))
    picks = picks_of(
        truth,
        center=[[3, 4], [0, 0], [0, 0]],
        radius=[1, -1, 3],
        diameter=[0.001, 0.002, -0.006],
    )
    values = values_of(verdict(truth, picks, surface=[[0, 0, 0.002], [0, 0, 0.004], [0, 0, 0]]))
    assert values["center_mean_px"] == pytest.approx(5 / 3)
    assert values["center_median_px"] == pytest.approx(0)
    assert values["center_u_bias_px"] == pytest.approx(1)
    assert values["radius_bias_px"] == pytest.approx(1)
    assert values["radius_std_px"] == pytest.approx(math.sqrt(8 / 3))
    assert values["radius_mae_px"] == pytest.approx(5 / 3)
    assert values["diameter_bias_mm"] == pytest.approx(-1)
    assert values["diameter_median_mm"] == pytest.approx(2)
    assert values["surface_z_bias_mm"] == pytest.approx(2)
    assert values["surface_mean_mm"] == pytest.approx(2)
    assert values["surface_z_p95_mm"] == pytest.approx(3.8)


def test_a_flipped_axis_is_wrong_by_180_degrees() -> None:
    truth = bed(2)
    values = values_of(verdict(truth, picks_of(truth, axis=-truth.axis)))
    assert values["axis_median_deg"] == pytest.approx(180)


def test_upright_is_the_tilt_against_the_given_gravity() -> None:
    truth = bed(3).take(slice(0, 2))
    truth = replace(truth, axis=tilted(np.radians([10.0, 20.0]), np.zeros(2)))
    picks = picks_of(truth, axis=tilted(np.radians([14.0, 18.0]), np.zeros(2)))
    assert values_of(verdict(truth, picks))["upright_mean_deg"] == pytest.approx(15)
    assert values_of(verdict(truth, picks))["tilt_bias_deg"] == pytest.approx(1)
    up = tilted(np.radians([10.0]), np.zeros(1))[0]
    assert values_of(verdict(truth, picks), up=3 * up)["upright_mean_deg"] == pytest.approx(5)


def test_upright_is_judged_on_the_mushrooms_that_have_an_axis() -> None:
    truth = bed(4)
    axis = truth.axis.copy()
    axis[5:] = np.nan
    values = values_of(verdict(truth, picks_of(truth, axis=axis)))
    tilt = np.degrees(np.arccos(-truth.axis[:5, 2]))
    assert values["upright_mean_deg"] == pytest.approx(tilt.mean())
    assert values["coverage_axis"] == pytest.approx(0.25)
    assert values["coverage_position"] == 1


def test_calibration_is_one_for_honest_sigmas_and_shows_wrong_ones() -> None:
    rng = np.random.default_rng(5)
    verdicts = []
    for i in range(60):
        truth = bed(i)
        n = len(truth)
        picks = picks_of(
            truth,
            position=rng.normal(0, 0.002, (n, 3)),
            diameter=rng.normal(0, 0.001, n),
            axis=turned(truth.axis, math.radians(3), rng),
            sigma_position=0.002,
            sigma_diameter=0.0005,
            sigma_tilt=math.radians(3),
        )
        verdicts.append(verdict(truth, picks, i))
    values = values_of(*verdicts)
    assert values["calibration_position"] == pytest.approx(1, abs=0.1)
    assert values["calibration_diameter"] == pytest.approx(4, abs=0.5)
    assert values["calibration_tilt"] == pytest.approx(1)
    for name in ("position", "diameter", "tilt"):
        assert values[f"coverage_sigma_{name}"] == 1


def test_calibration_is_that_of_the_rows_that_state_a_sigma() -> None:
    truth = bed(5)
    off = np.zeros((20, 3))
    off[:, 0] = [0.001 * row for row in range(20)]
    picks = picks_of(truth, position=off)
    sigma = np.full((20, 3), np.nan)
    sigma[[2, 4, 7]] = 0.001
    judged = verdict(truth, replace(picks, sigma_position=sigma))
    value = measure(events_of([judged]), 1, resamples=200)["calibration_position"]
    assert value.n == 3
    assert value.value == pytest.approx((4 + 16 + 49) / 3 / 3)  # a third: y and z are exact
    assert 4 / 3 <= value.low < value.high <= 49 / 3
    assert values_of(judged)["coverage_sigma_position"] == pytest.approx(3 / 20)


def test_a_position_is_held_against_what_it_claims_to_be() -> None:
    truth = bed(6)
    unknown = np.full_like(truth.axis, np.nan)
    found = of_picks(picks_of(truth, axis=unknown, sigma_position=0.001))
    known = FrameTruth(truth, frame_id=FRAME)
    judged = judge("bed", ("index", 0), known, header(0), found)
    assert values_of(judged)["calibration_position"] == pytest.approx(0, abs=1e-12)
    assert values_of(judged)["apex_mean_mm"] == pytest.approx(4)


def test_a_sigma_of_zero_is_none() -> None:
    truth = bed(7)
    values = values_of(verdict(truth, picks_of(truth, sigma_tilt=0.0)))
    assert math.isnan(values["calibration_tilt"])
    assert values["coverage_sigma_tilt"] == 0


@pytest.mark.parametrize("case", ["no truth", "nothing found", "nothing matched", "no frame"])
def test_empty_cases_invent_nothing(case: str) -> None:
    truth, picks = bed(8), picks_of(bed(8))
    if case == "no truth":
        truth = truth.take(slice(0, 0))
    if case == "nothing found":
        picks = picks_of(truth.take(slice(0, 0)))
    if case == "nothing matched":
        picks = picks_of(truth, radius=200.0)
    verdicts = [] if case == "no frame" else [verdict(truth, picks)]
    measured = measure(events_of(verdicts), len(verdicts), resamples=20)
    values = {name: value.value for name, value in measured.items()}
    expected = {
        "no truth": (0.0, math.nan, math.nan),
        "nothing found": (math.nan, 0.0, 0.0),
        "nothing matched": (0.0, 0.0, 0.0),
        "no frame": (math.nan, math.nan, math.nan),
    }[case]
    found = (values["precision"], values["recall"], values["f"])
    assert found == pytest.approx(expected, nan_ok=True)
    others = [v for n, v in values.items() if n not in ("precision", "recall", "f")]
    assert all(map(math.isnan, others))


def test_values_in_another_frame_are_not_compared() -> None:
    truth = bed(9)
    foreign = verdict(truth, replace(picks_of(truth), frame_id="robot_base"))
    assert not comparable(foreign)
    values = values_of(foreign)
    assert values["f"] == 1
    assert math.isnan(values["apex_mean_mm"])
    assert math.isnan(values["axis_mean_deg"])
    assert values["coverage_position"] == 1


def test_circles_alone_are_judged_in_the_image() -> None:
    from mushpipe.core.tables import Circles

    truth = bed(10)
    circles = Circles(truth.center, truth.radius, np.ones(len(truth)))
    known = FrameTruth(truth, frame_id=FRAME)
    values = values_of(judge("bed", ("index", 0), known, header(0), of_circles(circles)))
    assert values["f"] == 1
    assert values["coverage_position"] == 0
    assert math.isnan(values["surface_mean_mm"])


def test_intervals_are_seeded_and_hold_the_value() -> None:
    rng = np.random.default_rng(11)
    verdicts = [verdict(bed(i), picks_of(bed(i), radius=rng.normal(0, 1, 20)), i) for i in range(8)]
    events = events_of(verdicts)
    first = measure(events, 8, resamples=200, seed=1)
    assert repr(first) == repr(measure(events, 8, 200, 1))
    assert repr(first) != repr(measure(events, 8, 200, 2))
    bias = first["radius_bias_px"]
    assert bias.low < bias.value < bias.high
    assert bias.n == 160
    # One frame: its mushrooms are resampled, so there is an interval all the same.
    single = measure(events_of(verdicts[:1]), 1, resamples=200)["radius_bias_px"]
    assert single.low < single.value < single.high


def test_paired_differences_are_those_of_the_frames() -> None:
    rng = np.random.default_rng(12)
    base, other = [], []
    for i in range(10):
        hard = rng.normal(0, 2)  # shared by both, so it must not widen the interval
        base.append(verdict(bed(i), picks_of(bed(i), radius=hard), i))
        dropped = bed(i).take(slice(2, None))
        other.append(verdict(bed(i), picks_of(dropped, radius=hard + 0.5), i))
    result = differences(events_of(base), events_of(other), 10, resamples=300)
    assert result["recall"].value == pytest.approx(-0.1)
    assert result["radius_bias_px"].value == pytest.approx(0.5)
    assert result["radius_bias_px"].high - result["radius_bias_px"].low < 0.01
    assert result["recall"].low == pytest.approx(-0.1)
    same = differences(events_of(base), events_of(base), 10, resamples=100)
    assert (same["f"].value, same["f"].low, same["f"].high) == (0, 0, 0)


def test_a_single_frame_is_paired_by_its_mushrooms() -> None:
    truth = bed(13)
    base = events_of([verdict(truth, picks_of(truth))])
    other = events_of([verdict(truth, picks_of(truth.take(slice(4, None))))])
    result = differences(base, other, 1, resamples=200)["recall"]
    assert result.value == pytest.approx(-0.2)
    assert -0.5 < result.low < -0.2 < result.high < 0
    # A false detection that both make is the same one: no difference, and no doubt about it.
    extra = picks_of(replace(bed(99, 1, 2), center=np.array([[30.0, 30.0], [600.0, 30.0]])))
    wrong = events_of([verdict(truth, _joined(picks_of(truth), extra))])
    same = differences(wrong, wrong, 1, resamples=100)["f"]
    assert (same.value, same.low, same.high) == (0, 0, 0)
