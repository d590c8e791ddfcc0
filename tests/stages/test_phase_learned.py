from __future__ import annotations

import numpy as np
import pytest

from mushpipe import Circles, Mask, UsageError
from mushpipe.stages.cap_fit import CapFit
from mushpipe.stages.discs import LIKELY, Radii
from mushpipe.stages.phase.learned import (
    add_discs,
    agreement,
    candidates_of,
    of_radii,
    with_bare,
    without_clods,
)
from mushpipe.stages.phase_hough import PhaseHough
from tests.stages.caps import cap, draw, frame_from
from tests.stages.scenes import discs, frame_of


def circles(*rows: tuple[float, float, float, float]) -> Circles:
    table = np.array(rows, float).reshape(-1, 4)
    return Circles(table[:, :2], table[:, 2], table[:, 3])


def test_agreement_is_score_times_shared_area() -> None:
    shapes = np.array([[50, 50, 20, 0, 0], [50, 50, 10, 0, 0], [200, 50, 10, 0, 0]], float)
    learned = circles((50, 50, 20, 0.8), (50, 50, 40, 1.0))
    # the same circle; concentric ones share the smaller's area, r^2 / R^2
    wanted = [0.8, 0.8 * 0.25, 0.0]
    assert agreement(shapes, shapes[:, 2], learned) == pytest.approx(wanted)
    assert agreement(shapes, shapes[:, 2], circles()).tolist() == [0, 0, 0]


def test_candidates_are_the_circles_of_the_range_and_a_tenth_beyond() -> None:
    rows = [(50.0, 40.0, radius, 0.5) for radius in (7.1, 7.3, 20.0, 49.0, 50.0)]
    found = candidates_of(of_radii(circles(*rows), Radii(8, 45)))
    assert found == pytest.approx(np.array(rows[1:4]))


def test_beside_a_network_less_of_an_outline_makes_no_candidate_unless_it_is_asked_for() -> None:
    image = discs([(40, 60, 15), (62, 60, 14)], 0.8, 0.15)
    mask, nothing = Mask(image > 0.5), circles()

    def outlines(learned: Circles | None, **settings: float) -> int:
        found = PhaseHough.model_validate(settings).gather(frame_of(image), mask, learned)
        return 0 if found is None else len(found.hits)

    asked = PhaseHough(use_depth=False)
    assert asked.evidence is None
    few, many = outlines(nothing, evidence=0.9), outlines(None, evidence=0.01)
    assert few < many
    assert outlines(None) == outlines(None, evidence=0.07)
    assert outlines(nothing) == outlines(nothing, evidence=0.14)


def test_discs_are_added_to_the_foreground_also_across_the_border() -> None:
    before = np.zeros((60, 80), np.uint8)
    before[0, 0] = 1
    learned = circles((20.3, 30.6, 9, 1.0), (78, 2, 6, 0.1), (-3, 58, 8, 0.5))
    v, u = np.mgrid[:60, :80]
    wanted = before > 0
    for (x, y), radius in zip(learned.center, learned.radius, strict=True):
        wanted = wanted | ((u - x) ** 2 + (v - y) ** 2 <= (radius + 4) ** 2)
    assert np.array_equal(add_discs(learned, before), wanted)
    assert before.sum() == 1


def test_without_circles_use_learned_says_what_is_missing() -> None:
    image, stage = discs([(60, 60, 20)], 0.8, 0.1), PhaseHough(use_learned=True)
    stage.open()
    with pytest.raises(UsageError, match="needs a stage above that finds circles"):
        stage.process(frame_of(image), Mask(image > 0.5))


def test_circles_above_change_nothing_unless_asked_for() -> None:
    image = discs([(40, 60, 20), (110, 60, 15)], 0.8, 0.1)
    frame, mask = frame_of(image), Mask(image > 0.5)
    alone = PhaseHough().process(frame, mask)
    beside = PhaseHough().process(frame, mask, circles((80, 20, 12, 1.0)))
    assert np.array_equal(alone.center, beside.center)
    assert np.array_equal(alone.score, beside.score)


def test_with_depth_the_network_has_nothing_to_say_where_none_of_its_circles_lies() -> None:
    caps = [cap(5, 40, (-0.05, 0, 0.4), 0.02, 0.55), cap(10, 200, (0.05, 0, 0.4), 0.022, 0.6)]
    depth, gray = draw(caps, 0.44)
    frame, mask = frame_from(depth, gray), Mask(depth < 0.435)
    alone = PhaseHough().process(frame, mask)
    asked = PhaseHough(use_learned=True).process(frame, mask, circles())
    assert len(alone) == 2
    # half as many edges vote beside a network, so the fit starts from elsewhere
    assert asked.center == pytest.approx(alone.center, abs=1e-3)
    assert asked.score == pytest.approx(alone.score, abs=1e-4)


def test_with_depth_what_looks_just_like_dark_soil_is_no_cap() -> None:
    caps = [cap(5, 40, (-0.05, 0, 0.4), 0.02, 0.55), cap(10, 200, (0.05, 0, 0.4), 0.022, 0.6)]
    depth, _ = draw(caps, 0.44)
    left = np.arange(depth.shape[1]) < depth.shape[1] // 2
    gray = np.where((depth < 0.435) & left, 0.7, 0.3)
    soil = gray + (depth >= 0.435) * np.random.default_rng(0).normal(0, 0.06, depth.shape)
    mask, stage = Mask(depth < 0.435), PhaseHough(use_learned=True, min_score=0.2)
    frame, mycelium = frame_from(depth, soil), frame_from(depth, soil + 0.2)
    white, clod = sorted(PhaseHough(min_score=0.2).process(frame, mask).center.tolist())
    for learned in (circles(), circles((*clod, 20, 0.9))):
        only = stage.process(frame, mask, learned).center
        assert only == pytest.approx(np.array([white]), abs=0.5)
        assert len(stage.process(mycelium, mask, learned)) == 2


def test_without_depth_what_the_network_does_not_see_is_no_cap() -> None:
    image = discs([(40, 60, 20), (110, 60, 15)], 0.8, 0.1)
    frame, mask = frame_of(image), Mask(image > 0.5)
    assert len(PhaseHough().process(frame, mask)) == 2
    stage = PhaseHough(use_learned=True)
    assert len(stage.process(frame, mask, circles())) == 0
    seen = stage.process(frame, mask, circles((109, 61, 15, 0.6)))
    assert seen.center == pytest.approx(np.array([[110, 60]]), abs=0.5)


def beside_a_lamp() -> np.ndarray:
    """Two discs, one of them too dim beside the sheet on the right to have edges."""
    image = np.maximum(discs([(40, 40, 15)], 0.6, 0.05), discs([(40, 90, 15)], 0.07, 0.05))
    image[:, 110:] = 1
    return image


def test_a_sure_circle_without_an_outline_is_a_cap_and_one_that_is_not_sure_is_none() -> None:
    image = beside_a_lamp()
    frame, mask = frame_of(image), Mask(image < 0.9)
    stage = PhaseHough(use_learned=True)
    bright, dim = (40.5, 40.5, 15, 0.7), (40.0, 90.0, 15.0, 0.9)
    found = stage.process(frame, mask, circles(bright, dim))
    assert len(found) == 2
    assert found.center[found.score == 0.9] == pytest.approx(np.array([[40, 90]]))
    assert (np.diff(found.score) <= 0).all()
    assert len(stage.process(frame, mask, circles(bright, (*dim[:3], 0.7)))) == 1
    strict = PhaseHough(use_learned=True, min_score=0.95)
    assert 0.9 not in strict.process(frame, mask, circles(bright, dim)).score
    small = PhaseHough(use_learned=True, radius_px=(18, 30))
    assert len(small.process(frame, mask, circles(dim))) == 0


def test_with_depth_a_sure_circle_without_an_outline_is_for_the_fit_to_decide() -> None:
    depth, gray = draw([cap(5, 40, (-0.05, 0, 0.4), 0.02, 0.55)], 0.44)
    frame, mask = frame_from(depth, gray), Mask(depth < 0.435)
    (white,) = PhaseHough().process(frame, mask).center.tolist()
    nothing = (240.0, 120.0, 20.0, 0.95)  # flat, and as its surroundings
    learned = circles((*white, 30, 0.9), nothing)
    only = PhaseHough(use_learned=True).process(frame, mask, learned).center
    assert only == pytest.approx(np.array([white]), abs=0.1)
    found = PhaseHough(use_learned=True, min_score=0.1).process(frame, mask, learned)
    assert found.center[-1].tolist() == [240, 120]
    assert found.score[-1] < LIKELY < found.score[0]
    fit = CapFit(up="camera", min_score=0.5)
    assert fit.process(frame, found, learned)[2].center == pytest.approx(np.array([white]), abs=1)


def test_with_depth_a_network_adds_no_circle_of_a_diameter_that_is_not_looked_for() -> None:
    caps = [cap(5, 40, (-0.05, 0, 0.4), 0.02, 0.55), cap(5, 40, (0.05, 0, 0.4), 0.012, 0.55)]
    depth, gray = draw(caps, 0.44)
    frame, mask = frame_from(depth, gray), Mask(depth < 0.435)
    found = PhaseHough(min_score=0.1).process(frame, mask)
    learned = Circles(found.center, found.radius, np.full(2, 0.95))
    small = PhaseHough(use_learned=True, min_score=0.1, diameter_mm=(6, 30))
    only = small.process(frame, mask, learned)
    assert only.radius == pytest.approx([found.radius.min()], abs=0.5)


def test_circles_without_an_outline_come_from_nowhere_but_free_ground() -> None:
    shapes = np.array([[50, 50, 20, 0, 0], [150, 50, 20, 0, 0]], float)
    rows = [(50, 58, 20, 0.9), (50, 76, 12, 0.9), (50, 62, 8, 0.9), (150, 62, 8, 0.9)]
    # shares of the circle within the first outline, and IoU, by counting points
    v, u = np.mgrid[0:100:0.1, 0:200:0.1]
    discs_ = [(u - x) ** 2 + (v - y) ** 2 <= r * r for x, y, r, _ in rows]
    one = (u - 50) ** 2 + (v - 50) ** 2 <= 400
    same = [(one & d).sum() / (one | d).sum() for d in discs_]
    covered = [(one & d).sum() / d.sum() for d in discs_]
    assert same[0] > 0.5
    assert covered[1] < 0.5 < covered[2]
    found = with_bare(circles(), circles(*rows), shapes, shapes[:, 2], np.array([0]))
    # the last lies in an outline that was not accepted
    assert found.center.tolist() == [[50, 76], [150, 62]]


def test_clods_look_like_dark_soil_and_nearly_so_where_the_network_sees_nothing() -> None:
    soil, white, brown = np.array([(60, 48, 40), (190, 180, 165), (120, 80, 55)])
    v, u = np.mgrid[:120, :240]
    grain = np.random.default_rng(0).normal(1, 0.25, (120, 240, 1))
    found = circles((40, 60, 12, 0.9), (90, 60, 12, 0.9), (150, 60, 12, 0.9), (205, 60, 12, 0.9))

    def scene(ground: np.ndarray, light: float = 1.0) -> np.ndarray:
        color = np.broadcast_to(ground, (120, 240, 3)).copy()
        for (x, y), tone in zip(found.center, (white, soil, brown, 1.3 * soil), strict=True):
            color[np.hypot(u - x, v - y) < 12] = tone
        return np.clip(light * color, 0, 255).astype(np.uint8)

    def left(rows: list[int], color: np.ndarray, by: float = 0.8) -> list[float]:
        seen = np.where(np.isin(np.arange(4), rows), by, 0.0)
        return without_clods(color, found, seen).center[:, 0].tolist()

    assert left([], scene(soil * grain)) == [40, 150]
    assert left([3], scene(soil * grain)) == [40, 150, 205]
    assert left([0, 1, 2, 3], scene(soil * grain)) == [40, 150, 205]
    assert left([1], scene(soil * grain), 0.95) == [40, 90, 150]  # the network is sure of it
    assert left([], scene(soil)) == [40, 150, 205]  # even
    assert left([], scene(soil * grain, 0.2)) == [40, 90, 150, 205]  # night
    assert left([], scene(soil * grain, 2.5)) == [40, 90, 150, 205]  # as bright as mycelium
    cut = Circles(found.center - (80, 0), found.radius, found.score).take([1, 3])
    color = scene(soil * grain)[:, 80:]
    assert without_clods(color, cut, np.zeros(2)).center[:, 0].tolist() == [10]


@pytest.mark.parametrize("dirty", range(8))
def test_what_looks_like_half_of_the_sure_caps_is_none_of_the_clods(dirty: int) -> None:
    """Caps that soil lies on look like soil, and a network may be blind to the dirtiest."""
    soil, white = np.array([(60, 48, 40), (190, 180, 165)])
    found = circles(*((30 + 40 * i, 60, 12, 0.95) for i in range(8)))
    v, u = np.mgrid[:120, :340]
    color = soil * np.random.default_rng(0).normal(1, 0.25, (120, 340, 1))
    for i, (x, y) in enumerate(found.center):
        color[np.hypot(u - x, v - y) < 12] = soil if i in (*range(dirty), 7) else white
    seen = np.append(np.full(7, 0.95), 0)  # all but the last
    left = without_clods(color.astype(np.uint8), found, seen)
    assert len(left) == (8 if dirty >= 4 else 7)
    few = without_clods(color.astype(np.uint8), found.take([0, 1, 2, 7]), seen[[0, 1, 2, 7]])
    assert len(few) == 3  # tell nothing
