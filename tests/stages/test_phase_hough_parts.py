from __future__ import annotations

import math

import numpy as np
import pytest

from mushpipe import Mask
from mushpipe.stages.bed import far_cells, fit_plane, plane_depth
from mushpipe.stages.discs import Radii, lens
from mushpipe.stages.phase.decide import (
    decide,
    neighbours,
    outline_features,
    overlap_features,
)
from mushpipe.stages.phase.depth import GRID, NO_RELIEF, closed, halved, relief_of
from mushpipe.stages.phase.edges import edges_of, gradient_of, otsu_of
from mushpipe.stages.phase.features import (
    DEPTH_FEATURES,
    IMAGE_FEATURES,
    LEARNED,
    NAMES,
    static_features,
)
from mushpipe.stages.phase.refit import DIRECTIONS, HIDDEN, directions_of
from mushpipe.stages.phase.scratch import scratch_for
from mushpipe.stages.phase.strips import Strips, in_strips
from mushpipe.stages.phase.verifier import load_verifier
from mushpipe.stages.phase.votes import GAP, peaks, phase_of, rings_between, summed, vote
from mushpipe.stages.phase_hough import PhaseHough, equal_area_radius
from tests.stages.indifferent import indifferent
from tests.stages.scenes import discs, frame_of, sphere_depth

ALL = np.ones((120, 160), np.uint8)


def gray_of(image: np.ndarray) -> np.ndarray:
    return (image * 255).astype(np.float32)


def edges(image: np.ndarray, threshold: float = 5.0) -> Strips:
    gray = gray_of(image)
    return in_strips(edges_of(gray, gradient_of(gray), ALL, threshold, threshold)[0], *image.shape)


def static_row(
    image: np.ndarray,
    shape: tuple[float, ...],
    mask: np.ndarray | None = None,
    height: np.ndarray = NO_RELIEF.height,
) -> tuple[dict[str, float], np.ndarray]:
    gray = gray_of(image)
    hits = np.full((1, DIRECTIONS), -2, np.int32)
    hits[0, : directions_of(shape[2])] = -1
    covered = ALL if mask is None else mask.astype(np.uint8)
    outline = np.array([[*shape, 0.0, 0.0][:5]])
    residual = np.array([0.5], np.float32)
    relief = NO_RELIEF._replace(height=height, pixel=0.002)
    table, _ = static_features(gray, gradient_of(gray), covered, relief, outline, hits, residual)
    return dict(zip(NAMES, table[0], strict=True)), hits[0]


def test_the_gradient_of_a_ramp_is_its_slope() -> None:
    v, u = np.mgrid[:40, :50].astype(np.float32)
    grad = gradient_of(3 * u - 2 * v)
    inner = (slice(5, -5), slice(5, -5))
    assert grad.x[inner] == pytest.approx(3, abs=1e-4)
    assert grad.y[inner] == pytest.approx(-2, abs=1e-4)
    assert grad.size[inner] == pytest.approx(math.sqrt(13), abs=1e-4)


def test_edges_lie_on_the_outline_and_point_to_the_bright_side() -> None:
    found = edges(discs([(80.3, 60.6, 20.0)], 0.8, 0.1))
    dx, dy = found.x - 80.3, found.y - 60.6
    distance = np.hypot(dx, dy)
    assert len(found.x) > 100
    assert distance == pytest.approx(20, abs=0.15)
    assert (-(dx * found.nx + dy * found.ny) / distance).min() > 0.99


def test_an_edge_between_bright_surfaces_is_moved_outwards() -> None:
    dark = edges(discs([(80, 60, 20)], 0.8, 0.1))
    pale = edges(discs([(80, 60, 20)], 0.8, 0.6))
    assert np.hypot(pale.x - 80, pale.y - 60).mean() > np.hypot(dark.x - 80, dark.y - 60).mean() + 1
    assert pale.weight.max() < dark.weight.min()


def test_otsu_of_two_levels_lies_between_them() -> None:
    size = np.full((20, 20), 2.0, np.float32)
    size[:10] = 20
    assert 2 < otsu_of(size) < 20


def test_phases_of_the_smallest_and_largest_radius_leave_a_gap() -> None:
    low, high = phase_of(np.array([8.0, 38.0]), Radii(8, 38))
    assert high - low == pytest.approx(2 * np.pi * (1 - GAP))
    assert low == pytest.approx(-high)


@pytest.mark.parametrize("every", [1, 2])
@pytest.mark.parametrize("radius", [9.0, 17.0, 34.0])
def test_the_peak_of_a_full_circle_is_about_one_and_its_phase_the_radius(
    radius: float, every: int
) -> None:
    found = edges(discs([(80, 60, radius)], 0.8, 0.1))
    radii = Radii(8.0, 38.0)
    total, size = summed(vote(found, rings_between(radii), (60, 80), every))
    best = max(peaks(total, size, 0.2, radii).tolist(), key=lambda peak: peak[3])
    assert best[:3] == pytest.approx([80, 60, radius], abs=1.2)
    assert 0.6 < best[3] < 1.4


def test_the_circle_of_an_outline_has_its_area() -> None:
    turn = np.linspace(0, 2 * np.pi, 20_000, endpoint=False)
    r = 20 + 2 * np.cos(2 * turn) - 1.5 * np.sin(2 * turn)
    area = 0.5 * (r**2).mean() * 2 * np.pi
    radius = equal_area_radius(np.array([[0, 0, 20, 2, -1.5]]))
    assert np.pi * radius**2 == pytest.approx(area)


def test_lens_by_hand() -> None:
    assert lens(5.0, 2.0, 3.0) == 0
    assert lens(0.5, 2.0, 3.0) == pytest.approx(4 * np.pi)
    assert lens(1.0, 1.0, 1.0) == pytest.approx(2 * np.pi / 3 - np.sqrt(3) / 2)


def test_overlap_features_by_hand() -> None:
    row = np.zeros(7)
    small = np.array([0.0, 0, 10, 0, 0])
    overlap_features(small, np.array([[0.0, 0, 20, 0, 0], [100, 0, 5, 0, 0]]), row)
    assert row[4:] == pytest.approx([1.0, 0.25, 0.25])


def test_a_direction_under_an_accepted_circle_is_not_free() -> None:
    image = discs([(80, 60, 20)], 0.8, 0.1)
    found = edges(image)
    shape = np.array([80.0, 60, 20, 0, 0])
    n = directions_of(20)
    hits = np.full(DIRECTIONS, -2, np.int32)
    hits[:n] = -1
    hits[: n // 4] = 0
    hits[n // 4 : n // 2] = HIDDEN
    row, owner = np.zeros(7), np.full(len(found.x), -1, np.int32)
    scratch = scratch_for(len(found.x))
    outline_features(found, shape, hits, owner, np.zeros((0, 5)), row, scratch)
    quarter = (n // 4) / n
    hidden = (n // 2 - n // 4) / n
    assert row[0] == pytest.approx(1 - hidden)
    assert row[1] == pytest.approx(quarter / (1 - hidden))
    assert row[2] == pytest.approx(found.weight[0] * quarter / (1 - hidden))
    assert row[3] == pytest.approx(math.log(1 + n // 4))
    above = np.array([[80.0, 45, 16, 0, 0]])
    outline_features(found, shape, hits, owner, above, row, scratch)
    assert row[0] < 1 - hidden
    owner[0] = 1
    outline_features(found, shape, hits, owner, np.zeros((0, 5)), row, scratch)
    assert row[1] == row[2] == row[3] == 0


def test_what_lies_beyond_the_image_is_no_part_of_an_outline() -> None:
    found, n = edges(discs([(80, 60, 20)], 0.8, 0.1)), directions_of(20)
    hits = np.full(DIRECTIONS, -2, np.int32)
    beyond = np.cos(2 * np.pi * np.arange(n) / n) < -0.01
    hits[:n] = np.where(beyond, HIDDEN, -1)
    row, owner = np.zeros(7), np.full(len(found.x), -1, np.int32)
    shape, scratch = np.array([0.0, 60, 20, 0, 0]), scratch_for(len(found.x))
    outline_features(found, shape, hits, owner, np.zeros((0, 5)), row, scratch)
    assert row[0] == 1


def test_neighbours_are_all_whose_circles_meet_or_nearly_so() -> None:
    rng = np.random.default_rng(5)
    shapes = np.column_stack(
        [rng.uniform(0, 300, (60, 2)), rng.uniform(5, 40, 60), np.zeros((60, 2))]
    )
    first, beside = neighbours(shapes)
    for k, (x, y, r, *_) in enumerate(shapes):
        away = np.hypot(shapes[:, 0] - x, shapes[:, 1] - y) - shapes[:, 2] - r
        expected = set(np.flatnonzero(away < 4)) - {k}
        assert set(beside[first[k] : first[k + 1]]) == expected


def test_a_peak_lies_in_the_middle_of_its_cell_and_phase_0_is_the_middle_radius() -> None:
    total, size = np.zeros((30, 40, 2), np.float32), np.zeros((30, 40), np.float32)
    for (v, u), value in {(10, 20): 1.0, (10, 19): 0.5, (10, 21): 0.5, (20, 8): 0.7}.items():
        total[v, u, 0] = size[v, u] = value
    total[20, 8] = 0, 0.7  # a quarter of a turn on
    found = peaks(total, size, 0.6, Radii(8.0, 32.0))
    # of 4 times as large the middle is twice; a cell is 2 px wide
    quarter = 8 * 4 ** (0.5 + 0.25 / (1 - GAP))
    expected = [[40.5, 20.5, 16, 1.0], [16.5, 40.5, quarter, 0.7]]
    assert found == pytest.approx(np.array(expected), rel=1e-4)


def test_oval_and_texture_by_hand() -> None:
    ramp = 0.2 + 0.005 * np.arange(160) + np.zeros((120, 1))  # 0.6 at x = 80
    row, _ = static_row(ramp, (80, 60, 20, 3, 4))
    assert row["oval"] == pytest.approx(5 / 20)
    assert row["texture"] == pytest.approx(0.005 * 20 / 0.6, rel=0.02)


def test_roughness_is_what_a_smooth_surface_leaves_and_a_spot_bends_nothing() -> None:
    image, grain = np.full((120, 160), 0.5), np.random.default_rng(0).choice([-1, 1], (60, 80))
    row, _ = static_row(image, (80, 60, 20), None, (0.02 + 0.001 * grain).astype(np.float32))
    assert row["roughness"] == pytest.approx(0.001 / 0.04, rel=0.15)
    flat = np.full((60, 80), 0.02, np.float32)
    assert static_row(image, (80, 60, 20), None, flat)[0]["roughness"] < 1e-3
    flat[27:32, 45:48] = 0.03
    assert static_row(image, (80, 60, 20), None, flat)[0]["bend_large"] < 0.03


def test_a_stem_is_one_whichever_way_it_lies() -> None:
    v, u = np.mgrid[:60, :80].astype(float)
    x, y = (2 * u + 0.5 - 80) * 0.002, (2 * v + 0.5 - 60) * 0.002
    for turn in np.radians([0, 30, 45, 100]):
        across = np.cos(turn) * y - np.sin(turn) * x
        height = np.sqrt(np.maximum(0.04**2 * 1.2 - across**2, 0)).astype(np.float32)
        row, _ = static_row(np.full((120, 160), 0.5), (80, 60, 20), None, height)
        assert row["bend_small"] == pytest.approx(0, abs=0.06)
        assert row["bend_large"] > 0.7


def test_image_features_of_a_disc_by_hand() -> None:
    image = discs([(80, 60, 20)], 0.8, 0.2)
    left = np.zeros(image.shape, bool)
    left[:, :80] = True
    row, _ = static_row(image, (80, 60, 20), left)
    assert row["cover"] == pytest.approx(0.5, abs=0.06)
    assert row["coherence"] > 0.9
    assert row["texture"] == pytest.approx(0, abs=0.01)
    assert row["residual"] == pytest.approx(0.5 / 20)


def test_a_flat_image_has_no_coherence() -> None:
    row, _ = static_row(np.full((120, 160), 0.5), (80, 60, 20))
    assert row["coherence"] == pytest.approx(0, abs=1e-6)


def test_curvatures_tell_a_ball_from_a_stem_and_from_paper() -> None:
    v, u = np.mgrid[:60, :80].astype(float)
    x, y = (2 * u + 0.5 - 80) * 0.002, (2 * v + 0.5 - 60) * 0.002
    radius = 20 * 0.002
    ball = np.sqrt(np.maximum(radius**2 * 1.2 - x**2 - y**2, 0)).astype(np.float32)
    stem = np.sqrt(np.maximum(radius**2 * 1.2 - y**2, 0)).astype(np.float32)
    paper = np.full_like(ball, 0.02)
    image = np.full((120, 160), 0.5)
    small, large = {}, {}
    for name, height in (("ball", ball), ("stem", stem), ("paper", paper)):
        row, _ = static_row(image, (80, 60, 20), None, height)
        small[name], large[name] = row["bend_small"], row["bend_large"]
    assert small["ball"] == pytest.approx(large["ball"], abs=0.05)
    assert 0.7 < small["ball"] < 1.5
    assert small["stem"] == pytest.approx(0, abs=0.05)
    assert large["stem"] > 0.7
    assert large["paper"] == pytest.approx(0, abs=0.01)


def test_height_drop_and_rise_by_hand() -> None:
    v, u = np.mgrid[:60, :80]
    height = np.where(np.hypot(2 * u - 80, 2 * v - 60) <= 20, 0.03, 0.0).astype(np.float32)
    height[:, :15] = 0.08
    row, hits = static_row(np.full((120, 160), 0.5), (80, 60, 20), None, height)
    assert row["height"] == pytest.approx(0.03 / (0.03 + 0.04), abs=0.01)
    assert row["drop"] == 1
    assert row["rise"] == 0
    height[:, :31] = 0.08
    row, hits = static_row(np.full((120, 160), 0.5), (80, 60, 20), None, height)
    assert 0.1 < row["rise"] < 0.5
    assert (hits == HIDDEN).sum() > 5


def test_missing_depth_switches_the_features_of_depth_off() -> None:
    row, _ = static_row(np.full((120, 160), 0.5), (80, 60, 20), None, np.full((60, 80), -1.0, "f4"))
    assert [row[name] for name in DEPTH_FEATURES if name != "gap"] == [0] * 6
    assert row["gap"] == 1


def test_a_bed_is_found_below_a_ball_and_at_a_slant() -> None:
    ball = sphere_depth((0.0, 0.0, 0.4), 0.04, 9.0)
    slant = 1 / (1 / 0.42 - 0.5 * ((np.arange(160) + 0.5) / 160 - 0.5))
    depth = np.minimum(ball, slant[None])
    small = halved(depth.astype(np.float32), 1.0)
    plane = fit_plane(far_cells(small, GRID))
    assert plane is not None
    u = np.arange(80)
    expected = 1 / (1 / 0.42 - 0.5 * ((u + 0.5) / 80 - 0.5))
    assert plane_depth(plane, u, 30) == pytest.approx(expected, abs=0.0005)


def test_heights_of_a_ball_over_the_bed() -> None:
    image = np.full((120, 160), 0.5)
    frame = frame_of(image, sphere_depth((0.0, 0.0, 0.4), 0.04, 0.42))
    relief = relief_of(frame)
    assert relief.height.max() == pytest.approx(0.06, abs=0.003)
    assert np.median(relief.height) == pytest.approx(0, abs=0.002)


def test_small_gaps_close_at_the_lower_end_and_wide_ones_stay() -> None:
    height = np.full((3, 40), 0.02, np.float32)
    height[:, 10:] = 0.0
    height[:, 8:12] = -1
    height[:, 20:35] = -1
    out = closed(height)
    assert (out[:, 8:12] == 0).all()
    assert (out[:, 20:35] == -1).all()


def test_the_verifier_of_the_package_asks_of_depth_only_where_there_is_some() -> None:
    first_depth, learned = len(IMAGE_FEATURES), NAMES.index(LEARNED)
    for literal in (False, True):
        models = load_verifier(literal=literal)
        asked = np.any(models.w1 != 0, axis=2) | (models.a != 0) | (models.s != 0)
        assert not asked[[0, 2], first_depth:learned].any()
        assert asked[[1, 3], first_depth:learned].all()
        assert asked[:, learned].tolist() == [False, False, True, True]
        assert (models.scale > 0).all()


def test_every_candidate_has_all_features_and_a_probability() -> None:
    image = discs([(40, 60, 15), (62, 60, 14)], 0.8, 0.15)
    stage = PhaseHough()
    found = stage.gather(frame_of(image), Mask(image > 0.5))
    assert found is not None
    order, chance, owner, sight = stage.decide(found)
    assert not sight.any()
    assert found.table.shape == (len(found.shapes), len(NAMES))
    assert np.isfinite(found.table).all()
    assert ((chance >= 0) & (chance <= 1)).all()
    assert set(owner.tolist()) <= {-1, *range(len(order))}


@pytest.mark.parametrize("likely", [True, False])
def test_of_likely_rivals_the_one_that_a_network_agrees_with_comes_first(likely: bool) -> None:
    """Of unlikely ones it does not: what they are is no more than a guess."""
    image = discs([(40, 60, 15), (62, 60, 14), (90, 40, 12)], 0.8, 0.15)
    found = PhaseHough().gather(frame_of(image), Mask(image > 0.5))
    assert found is not None
    n = len(found.shapes)
    found.table[:, NAMES.index(LEARNED)] = np.linspace(0.9, 0.2, n)
    models = indifferent(*4 * [0.4 if likely else -0.4])
    which = np.zeros(n, np.int32)
    parts = (found.edges, found.shapes, found.hits, found.table)
    order, *_ = decide(*parts, which, models, least=0.3, led=True)
    first_agreed, last_given = list(range(n)), list(range(n))[::-1]
    assert order.tolist() == (first_agreed if likely else last_given)


@pytest.mark.parametrize(("surer", "first"), [(0.99, "surer"), (0.85, "agreed")])
def test_a_rival_that_is_surer_by_far_comes_before_one_that_a_network_agrees_with(
    surer: float, first: str
) -> None:
    """A circle that spans two caps looks like one to the network, too."""
    image = discs([(40, 60, 15), (62, 60, 14), (90, 40, 12)], 0.8, 0.15)
    found = PhaseHough().gather(frame_of(image), Mask(image > 0.5))
    assert found is not None
    n = len(found.shapes)
    agreed = np.arange(n) < n // 2
    found.table[:, NAMES.index(LEARNED)] = np.where(agreed, 0.9, 0.5)
    models = indifferent(np.log(0.8 / 0.2), 0, np.log(surer / (1 - surer)), 0)
    which = np.where(agreed, 0, 2).astype(np.int32)
    parts = (found.edges, found.shapes, found.hits, found.table)
    order, *_ = decide(*parts, which, models, least=0.3, led=True)
    assert agreed[order[0]] == (first == "agreed")


@pytest.mark.parametrize("doubted", [0.1, 0.3])
def test_what_depth_alone_is_against_comes_first_where_image_and_network_are_sure(
    doubted: float,
) -> None:
    """As where a stereo camera sees the ground within a smooth cap: a part of it is likelier."""
    image = discs([(40, 60, 15), (62, 60, 14), (90, 40, 12)], 0.8, 0.15)
    found = PhaseHough().gather(frame_of(image), Mask(image > 0.5))
    assert found is not None
    n = len(found.shapes)
    agreed = np.where(np.arange(n) < n // 2, 0.9, 0.2)
    found.table[:, NAMES.index(LEARNED)] = agreed
    against = np.log(doubted / (1 - doubted))
    models = indifferent(0, against, np.log(0.95 / 0.05), against)
    parts = (found.edges, found.shapes, found.hits, found.table)
    which = np.full(n, 3, np.int32)  # all have depth, and a circle of the network
    order, chance, _, sight = decide(*parts, which, models, least=0.05, led=True)
    np.testing.assert_allclose(chance, doubted, rtol=1e-5)
    seen = doubted >= 0.2
    np.testing.assert_allclose(sight, np.where((agreed > 0.8) & seen, 0.95, 0), rtol=1e-5)
    first = list(range(n // 2))[::-1] if seen else []
    assert order[: len(first)].tolist() == first
    order, _, _, sight = decide(*parts, which, models, least=0.05, led=False)
    assert not sight.any()
