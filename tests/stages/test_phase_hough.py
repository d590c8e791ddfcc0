from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from pydantic import ValidationError

from mushpipe import Circles, Mask, RgbdFrame
from mushpipe.core.plugins import load_registry
from mushpipe.stages.phase_hough import Evidence, PhaseHough
from tests.stages.scenes import HEADER, discs, frame_of, sphere_depth

TRUTH = [(40.3, 41.7, 15.2), (100.6, 70.1, 20.7), (128.2, 25.9, 12.4)]


def found(image: np.ndarray, depth: np.ndarray | None = None, **options: object) -> Circles:
    return PhaseHough(**options).process(frame_of(image, depth), Mask(image > 0.5))


def as_rows(circles: Circles) -> np.ndarray:
    return np.column_stack([circles.center, circles.radius])


@pytest.mark.parametrize("source", ["image", "mask"])
def test_discs_are_found_once_each_and_to_a_fraction_of_a_pixel(source: str) -> None:
    circles = found(discs(TRUTH, 0.8, 0.15), input=source)
    assert len(circles) == len(TRUTH)
    tolerance = 0.12 if source == "image" else 0.4
    for truth in TRUTH:
        rows = as_rows(circles)
        nearest = rows[np.argmin(np.hypot(*(rows[:, :2] - truth[:2]).T))]
        assert nearest == pytest.approx(truth, abs=tolerance)
    assert (circles.score > 0.5).all()


@pytest.mark.parametrize("source", ["image", "mask"])
@pytest.mark.parametrize("share", [0.02, 0.05, 0.2])
@pytest.mark.parametrize("radius", [6.0, 9.0, 20.0, 45.0])
def test_a_range_of_radii_may_be_as_narrow_as_one_likes(
    radius: float, share: float, source: str
) -> None:
    """The votes of a few radii meet in the same cells, and must agree there."""
    limits = (radius * (1 - share), radius * (1 + share))
    circles = found(discs([(80.3, 60.6, radius)], 0.8, 0.15), input=source, radius_px=limits)
    (row,) = as_rows(circles)
    assert row == pytest.approx((80.3, 60.6, radius), abs=0.15 if source == "image" else 0.4)


@settings(deadline=None, max_examples=12)
@given(dx=st.floats(-0.5, 0.5), dy=st.floats(-0.5, 0.5), radius=st.floats(9, 30))
def test_a_shift_by_fractions_of_a_pixel_moves_the_centre_by_it(
    dx: float, dy: float, radius: float
) -> None:
    circles = found(discs([(80 + dx, 60 + dy, radius)], 0.8, 0.15))
    assert as_rows(circles)[0] == pytest.approx((80 + dx, 60 + dy, radius), abs=0.15)


def test_a_dark_disc_on_a_bright_ground_is_no_cap() -> None:
    image = discs([(80, 60, 18)], 0.1, 0.8)
    assert len(PhaseHough().process(frame_of(image), Mask(np.ones(image.shape, bool)))) == 0


def test_a_cap_below_another_is_found_by_the_part_of_its_outline_that_is_free() -> None:
    lower, upper = (70.0, 60.0, 20.0), (94.0, 60.0, 18.0)
    image = np.where(
        discs([upper], 1, 0) > 0.5, discs([upper], 0.85, 0.12), discs([lower], 0.6, 0.12)
    )
    rows = as_rows(found(image))
    assert len(rows) == 2
    for truth in (lower, upper):
        assert np.abs(rows - truth).max(axis=1).min() < 1.0


def test_edges_explained_by_one_circle_support_no_second_one() -> None:
    assert len(found(discs([(80, 60, 22)], 0.8, 0.15), min_score=0.05)) == 1


@pytest.mark.parametrize(("edge", "dim"), [(0.2, True), (1.0, False)])
def test_edges_much_weaker_than_the_strong_ones_are_none_if_so_asked(
    edge: float, dim: bool
) -> None:
    image = np.maximum(discs([(45, 60, 20)], 0.85, 0.1), discs([(115, 60, 20)], 0.25, 0.1))
    evidence = PhaseHough(edge=edge).gather(frame_of(image), Mask(image > 0.2))
    assert evidence is not None
    assert (evidence.edges.x > 80).any() == dim
    assert (evidence.edges.x < 80).sum() > 60


def test_grain_of_a_gray_level_is_no_edge() -> None:
    image = np.random.default_rng(0).integers(100, 102, (120, 160)) / 255
    evidence = PhaseHough().gather(frame_of(image), Mask(np.ones(image.shape, bool)))
    assert evidence is not None
    assert len(evidence.edges.x) == 0


def test_the_mask_alone_is_looked_at_where_edges_are_taken_from_it() -> None:
    image = discs(TRUTH, 0.8, 0.15)
    ball = ((110 - 79.5) / 200 * 0.4, (60 - 59.5) / 200 * 0.4, 0.4)
    alone = found(image, input="mask")
    beside = found(image, sphere_depth(ball, 0.04, 0.4), input="mask")
    assert (as_rows(alone) == as_rows(beside)).all()
    assert (alone.score == beside.score).all()


def test_what_is_a_cap_only_beside_an_unlikely_one_is_no_more_likely(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    rows, chances = [2, 0, 1], np.array([0.3, 0.8, 0.9])

    def decided(self: PhaseHough, evidence: Evidence, led: bool = False) -> tuple[np.ndarray, ...]:
        n, owner = len(evidence.shapes), np.full(len(evidence.edges.x), -1, np.int32)
        chance = np.concatenate([chances, np.zeros(n - 3)])
        return np.array(rows, np.int32), chance, owner, np.zeros(n)

    monkeypatch.setattr(PhaseHough, "decide", decided)
    assert found(discs(TRUTH, 0.8, 0.15), evidence=0.05).score.tolist() == [0.9, 0.3, 0.3]


@pytest.mark.parametrize(("long", "short"), [(23, 19), (25, 19)])
def test_a_tilted_cap_gives_the_circle_of_the_same_area(long: float, short: float) -> None:
    v, u = np.mgrid[:120, :160].astype(float)
    level = np.hypot((u - 80) / long, (v - 60) / short)
    image = 0.15 + 0.65 / (1 + np.exp((level - 1) * 18 / 0.4))
    rows = as_rows(found(image))
    assert rows == pytest.approx(np.array([[80, 60, np.sqrt(long * short)]]), abs=0.3)


def test_an_overexposed_cap_is_found_and_an_overexposed_bed_holds_none() -> None:
    rows = as_rows(found(np.minimum(discs([(80, 60, 20)], 3.0, 0.15), 1)))
    assert rows == pytest.approx(np.array([[80, 60, 20]]), abs=1)
    assert len(found(np.minimum(discs([(80, 60, 20)], 3.0, 1.5), 1))) == 0


def test_noise_holds_no_circle() -> None:
    rng = np.random.default_rng(0)
    image = np.clip(rng.normal(0.4, 0.05, (120, 160)), 0, 1)
    for mask in (np.ones(image.shape, bool), image > 0.4):
        assert len(PhaseHough().process(frame_of(image), Mask(mask))) == 0


@pytest.mark.parametrize("level", [0.0, 0.4, 1.0])
def test_an_image_of_one_level_holds_no_circle(level: float) -> None:
    image = np.full((120, 160), level)
    for mask in (np.zeros(image.shape, bool), np.ones(image.shape, bool)):
        assert len(PhaseHough().process(frame_of(image), Mask(mask))) == 0


@pytest.mark.parametrize("shape", [(1, 1), (1, 2), (2, 1), (5, 7), (13, 200), (48, 48)])
def test_small_images_do_no_harm(shape: tuple[int, int]) -> None:
    rng = np.random.default_rng(0)
    color = rng.integers(0, 255, (*shape, 3)).astype(np.uint8)
    frame = RgbdFrame(HEADER, color, np.full(shape, 500, np.uint16), 0.001, None)
    for options in ({}, {"input": "mask"}, {"radius_px": (300, 600)}):
        PhaseHough(**options).process(frame, Mask(np.ones(shape, bool)))


@pytest.mark.parametrize("shape", [(720, 1280), (1080, 1920)])
def test_large_images_work(shape: tuple[int, int]) -> None:
    color = np.full((*shape, 3), 30, np.uint8)
    v, u = np.mgrid[: shape[0], : shape[1]]
    inside = np.hypot(u - shape[1] + 60, v - shape[0] + 60) < 25
    color[inside] = 210
    rows = as_rows(PhaseHough().process(RgbdFrame(HEADER, color), Mask(inside)))
    assert rows == pytest.approx(np.array([[shape[1] - 60, shape[0] - 60, 25]]), abs=0.5)


def test_a_radius_range_beyond_the_image_finds_nothing() -> None:
    assert len(found(discs(TRUTH, 0.8, 0.15), radius_px=(200, 400))) == 0


@pytest.mark.parametrize("value", [np.nan, 0.0])
def test_depth_without_a_value_is_no_depth(value: float) -> None:
    image = discs(TRUTH, 0.8, 0.15)
    without = found(image)
    with_it = found(image, np.full(image.shape, value))
    assert as_rows(with_it) == pytest.approx(as_rows(without), abs=1e-6)


def test_depth_without_calibration_is_not_used() -> None:
    image = discs(TRUTH, 0.8, 0.15)
    frame = frame_of(image, np.full(image.shape, 0.5), None)
    assert len(PhaseHough().process(frame, Mask(image > 0.5))) == len(TRUTH)


def test_depth_removes_a_painted_disc_and_keeps_a_sphere() -> None:
    # px per m at 0.4 m: 500; a ball of 40 mm half sunk into the bed beside a disc of paint
    ball = ((110 - 79.5) / 200 * 0.4, (60 - 59.5) / 200 * 0.4, 0.4)
    depth = sphere_depth(ball, 0.04, 0.4)
    image = discs([(40, 60, 20)], 0.8, 0.15)
    image = np.where(depth < 0.399, 0.8, image)
    assert len(found(image)) == 2
    circles = found(image, depth)
    assert len(circles) == 1
    assert circles.center[0] == pytest.approx((110.5, 60), abs=2)


def test_a_cap_of_an_impossible_size_is_left_out() -> None:
    ball = ((80 - 79.5) / 200 * 0.4, 0.0, 0.4)
    depth = sphere_depth(ball, 0.04, 0.4)
    image = np.where(depth < 0.399, 0.8, 0.15)
    assert len(found(image, depth)) == 1
    assert len(found(image, depth, diameter_mm=(10, 40))) == 0
    assert len(found(image, depth, radius_px=None, diameter_mm=(50, 120))) == 1


def test_the_same_frame_gives_the_same_circles() -> None:
    image = discs(TRUTH, 0.8, 0.15)
    stage = PhaseHough()
    first, second = (stage.process(frame_of(image), Mask(image > 0.5)) for _ in range(2))
    assert (as_rows(first) == as_rows(second)).all()


def test_ranges_the_wrong_way_round_are_refused() -> None:
    with pytest.raises(ValidationError, match="radius_px must be"):
        PhaseHough(radius_px=(38, 8))
    with pytest.raises(ValidationError, match="diameter_mm must be"):
        PhaseHough(diameter_mm=(60, 20))


def test_diameters_in_metres_are_refused() -> None:
    with pytest.raises(ValueError, match="was it given in m"):
        PhaseHough(diameter_mm=(0.008, 0.12))


def test_it_is_registered() -> None:
    assert "phase-hough" in load_registry().names("stage")
