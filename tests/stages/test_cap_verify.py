"""What `cap-fit` takes for a cap, on drawn scenes."""

from __future__ import annotations

from dataclasses import fields, replace

import numpy as np
import pytest

from mushpipe import Circles, DepthSource, Locations, Poses, RgbdFrame
from mushpipe.stages.cap.batch import Fits
from mushpipe.stages.cap.verify import FILE, FLAT_CHANCE, NAMES, chances, features
from mushpipe.stages.cap_fit import CapFit
from mushpipe.stages.verifier import LIMIT, logistic, logit, package_file, read_models
from tests.stages.caps import CAMERA, cap, circles_of, draw, frame_from

BED = 0.44
CAPS = [
    cap(10, 40, (-0.07, -0.03, 0.4), 0.02, 0.55),
    cap(20, 200, (0.0, -0.03, 0.4), 0.022, 0.6),
    cap(0, 0, (0.07, -0.03, 0.4), 0.018, 0.65),
    cap(15, 100, (0.07, 0.04, 0.405), 0.021, 0.5),
]


UNKNOWN = np.full(6, np.nan)  # how alike they look


def scene() -> tuple[np.ndarray, np.ndarray, Circles]:
    """Four caps, then a tilted board and a pile of clods that look like discs of 22 px."""
    depth, gray = draw(CAPS, BED)
    rng = np.random.default_rng(0)
    v, u = np.mgrid[: CAMERA.height, : CAMERA.width]
    board, pile = (np.hypot(u - x, v - 165) < 22 for x in (90, 160))
    depth[board] = (0.41 + 0.0008 * (u - 90))[board]
    clods = rng.uniform(0.395, 0.43, (CAMERA.height // 6 + 1, CAMERA.width // 6 + 1))
    depth[pile] = np.kron(clods, np.ones((6, 6)))[: CAMERA.height, : CAMERA.width][pile]
    gray[board | pile] = 0.8
    depth += rng.normal(0, 0.0008, depth.shape)
    caps = circles_of(CAPS)
    center = np.vstack([caps.center, [[90, 165], [160, 165]]])
    return depth, gray, Circles(center, [*caps.radius, 22.0, 22.0], np.full(6, 0.6))


def test_caps_stay_and_what_only_looks_like_one_goes() -> None:
    depth, gray, circles = scene()
    frame = frame_from(depth, gray)
    locations, poses, found = CapFit(up="camera", min_score=0.5).process(frame, circles)
    assert found.center == pytest.approx(circles.center[:4], abs=1)
    assert (found.score > 0.8).all()
    assert len(locations) == len(poses) == 4
    _, _, all_of_them = CapFit(up="camera", min_score=0.0).process(frame, circles)
    assert all_of_them.score[:4] == pytest.approx(found.score)
    assert (all_of_them.score[4:] < 0.5).all()


def test_a_lid_is_no_cap_however_sure_the_detector_is_and_a_flat_cap_is_one() -> None:
    flat = [cap(8, 70, (-0.06, 0, 0.4), 0.02, 0.22), cap(0, 0, (0.06, 0, 0.4), 0.02, 0.22)]
    depth, gray = draw(flat, BED)
    v, u = np.mgrid[: CAMERA.height, : CAMERA.width]
    circles = circles_of(flat)
    lid = np.hypot(u - 160, v - 40) < 20
    depth[lid], gray[lid] = 0.4, 0.8
    depth += np.random.default_rng(1).normal(0, 0.0008, depth.shape)
    center, radius = np.vstack([circles.center, [[160, 40]]]), [*circles.radius, 20.0]
    circles = Circles(center, radius, np.full(3, 0.99))
    _, _, found = CapFit(up="camera", min_score=0.0).process(frame_from(depth, gray), circles)
    assert found.score[2] <= FLAT_CHANCE
    assert (found.score[:2] > 0.9).all()


@pytest.mark.parametrize(
    ("score", "brightness", "learned", "stays"),
    [
        (0.95, 0.8, None, True),
        (0.55, 0.8, None, False),
        (0.95, 0.3, None, False),
        (0.55, 0.8, 0.9, True),
        (0.55, 0.72, 0.9, True),  # a tenth darker, as another of the kind may be
        (0.55, 0.65, 0.9, False),
        (0.55, 0.8, 0.5, False),
        (0.55, 0.3, 0.9, False),
    ],
)
def test_an_old_flat_cap_stays_where_it_looks_like_the_others_and_is_plain(
    score: float, brightness: float, learned: float | None, stays: bool
) -> None:
    places = [(x, y, 0.4) for y in (-0.035, 0.035) for x in (-0.09, -0.03, 0.03, 0.09)]
    caps = [cap(10, 40 * k, place, 0.017, 0.6) for k, place in enumerate(places[:7])]
    old = cap(5, 90, places[7], 0.02, 0.1)
    depth, gray = draw([*caps, old], BED)
    v, u = np.mgrid[: CAMERA.height, : CAMERA.width]
    circles = circles_of([*caps, old])
    inside = np.hypot(u - circles.center[7, 0], v - circles.center[7, 1]) < circles.radius[7]
    gray[inside] = brightness
    depth += np.random.default_rng(1).normal(0, 0.0008, depth.shape)
    circles = Circles(circles.center, circles.radius, [*np.full(7, 0.95), score])
    seen = None
    if learned is not None:
        seen = Circles(circles.center, circles.radius, [*np.full(7, 0.95), learned])
    frame = frame_from(depth, gray)
    _, _, found = CapFit(up="camera", min_score=0.5).process(frame, circles, seen)
    assert len(found) == 7 + stays


def test_the_surer_a_network_is_the_likelier_is_a_cap() -> None:
    depth, gray, circles = scene()
    frame = frame_from(depth, gray)
    fits = CapFit(up="camera").fit(frame.gray, frame.depth_m, CAMERA, circles)
    for some, unlike in ((fits, UNKNOWN), (fits, np.zeros(6)), (None, np.full(6, 2.0))):
        levels = (0, 0.003, 0.1, 0.3, 0.5, 0.7, 0.9, 1)
        chance = [chances(circles, unlike, some, np.full(6, seen)) for seen in levels]
        assert (np.diff(chance, axis=0) >= 0).all()
        assert ((chance[0] < chance[-1]) | (chance[-1] == FLAT_CHANCE)).all()


def test_of_circles_that_only_a_network_found_those_stay_that_fit() -> None:
    depth, gray, circles = scene()
    found = Circles(circles.center, circles.radius, np.full(6, 0.4))  # as `phase-hough` has them
    learned = Circles(circles.center, circles.radius, np.full(6, 0.8))
    stage = CapFit(up="camera", min_score=0.5)
    kept = stage.process(frame_from(depth, gray), found, learned)[2]
    assert kept.center == pytest.approx(circles.center[:4], abs=1)


def test_what_a_network_is_blind_to_may_be_a_cap_all_the_same() -> None:
    depth, gray, circles = scene()
    sure = Circles(circles.center, circles.radius, np.full(6, 0.99))
    frame = frame_from(depth, gray)
    beside = Circles(circles.center[:1], circles.radius[:1], [0.9])
    score = {
        name: CapFit(up="camera", min_score=0.0).process(frame, sure, learned)[2].score
        for name, learned in (("alone", None), ("blind", beside.take([])), ("beside", beside))
    }
    assert (score["blind"][:4] < score["alone"][:4]).all()
    assert (score["blind"][:4] > 0.5).all()
    assert score["beside"][0] > score["blind"][0]
    assert score["beside"][1:] == pytest.approx(score["blind"][1:])


def test_without_a_least_score_nothing_is_left_out_and_scores_stay() -> None:
    depth, gray, circles = scene()
    locations, poses, found = CapFit(up="camera").process(frame_from(depth, gray), circles)
    assert found.score == pytest.approx(circles.score, abs=0)
    assert len(found) == len(locations) == len(poses) == 6


def test_of_two_circles_of_one_cap_that_with_a_position_stays_however_sure_the_other_is() -> None:
    """The rows of what is kept keep their order."""
    circles = Circles([[50, 50], [51, 50], [90, 50], [130, 50]], [20.0] * 4, [0.9, 0.6, 0.7, 0.4])
    position = np.array([[np.nan] * 3, [0, 0, 0.4], [0, 0, 0.5], [0, 0, 0.6]])
    known = np.array([False, True, True, True])
    found = Locations.unknown(
        4,
        position=position,
        distance=position[:, 2],
        source=np.where(known, DepthSource.MEASURED, DepthSource.MISSING),
    )
    located, poses, kept = CapFit(min_score=0.5)._kept(found, Poses.unknown(4), circles)
    assert kept.center[:, 0].tolist() == [51, 90]
    assert located.position[:, 2].tolist() == [0.4, 0.5]
    assert len(poses) == 2
    both = CapFit(min_score=0.5)._kept(Locations.unknown(4), Poses.unknown(4), circles)[2]
    assert both.center[:, 0].tolist() == [50, 90]  # the surer one


def test_the_score_of_the_detector_decides_where_there_is_no_depth() -> None:
    depth, gray, circles = scene()
    circles = Circles(circles.center, circles.radius, [0.6, 0.3, 0.6, 0.6, 0.6, 0.6])
    stage = CapFit(up="camera", min_score=0.5)
    depth[:, :200] = np.nan  # the first two caps, board and pile
    locations, _, found = stage.process(frame_from(depth, gray), circles)
    assert found.score[0] == pytest.approx(0.6)
    assert locations.source[0] == DepthSource.MISSING
    assert len(found) == 5  # but for the second cap
    blind = frame_from(depth, gray)
    blind = RgbdFrame(blind.header, blind.color, None, 1.0, CAMERA)
    locations, poses, found = stage.process(blind, circles)
    assert np.array_equal(found.center, circles.center[[0, 2, 3, 4, 5]])
    assert len(locations) == len(poses) == 5


def test_features_of_what_was_not_fitted_are_unknown_and_its_score_stays() -> None:
    depth, gray, circles = scene()
    depth[:, :200] = np.nan
    frame = frame_from(depth, gray)
    fits = CapFit(up="camera").fit(frame.gray, frame.depth_m, CAMERA, circles)
    assert fits.valid.tolist() == [False, False, True, True, False, False]
    table = features(circles, UNKNOWN, fits)
    assert table.shape == (6, len(NAMES))
    assert np.isnan(table[~fits.valid, 1:]).all()
    assert np.isfinite(table[fits.valid, :-2]).all()
    assert np.isnan(table[:, -2:]).all()
    assert np.array_equal(chances(circles, UNKNOWN, fits)[~fits.valid], circles.score[~fits.valid])
    assert np.array_equal(chances(circles, UNKNOWN), circles.score)


def test_what_looks_unlike_the_sure_caps_is_less_likely_one_and_likeness_is_no_reason() -> None:
    depth, gray, circles = scene()
    depth[:, :200] = np.nan
    frame = frame_from(depth, gray)
    fits = CapFit(up="camera").fit(frame.gray, frame.depth_m, CAMERA, circles)
    models = read_models(package_file(FILE), ["fitted"], NAMES)
    fitted = logistic(logit(np.nan_to_num(features(circles, UNKNOWN, fits)), models["fitted"]))
    fitted = np.where(fits.valid, fitted, circles.score)
    for some, alone in ((fits, fitted), (None, circles.score)):
        beside = [chances(circles, np.full(6, far), some) for far in np.linspace(0, 6, 13)]
        assert (beside <= alone).all()
        assert (np.diff(beside, axis=0) <= 0).all()
        assert (beside[-1] < alone).all()


def test_features_tell_how_far_a_cap_leans_and_how_wrong_the_size_of_its_circle_was() -> None:
    depth, gray, circles = scene()
    frame = frame_from(depth, gray)
    wrong = Circles(circles.center[:4], circles.radius[:4] * [1.1, 1, 0.9, 1], circles.score[:4])
    fits = CapFit(up="camera").fit(frame.gray, frame.depth_m, CAMERA, wrong)
    columns = dict(zip(NAMES, features(wrong, UNKNOWN[:4], fits).T, strict=True))
    assert np.degrees(columns["lean"]) == pytest.approx([10, 20, 0, 15], abs=5)
    moved = np.log(fits.circle[:, 2] / wrong.radius)
    assert columns["resized"] == pytest.approx(np.abs(moved))
    assert (moved[[0, 2]] * [-1, 1] > 0.01).all()
    assert (columns["resized"][[1, 3]] < 0.005).all()


def test_features_are_what_can_be_worked_out_by_hand() -> None:
    circles = Circles([[50, 60], [100, 60], [150, 60], [200, 60]], [20.0] * 4, [0.5, 0.9, 0.2, 0.5])
    fits = Fits(**{each.name: np.zeros(4) for each in fields(Fits)})
    fits = replace(
        fits,
        valid=np.array([True, True, True, False]),
        circle=np.array([[53.0, 64, 20], [100, 60, 30], [150, 60, 10], [200, 60, 20]]),
        radius=np.array([0.02, 0.02, 0.04, np.nan]),
        height=np.array([0.01, 0.02, 0.004, np.nan]),
        misfit=np.array([0.2, 0.4, 0.8, np.nan]),
        sigma_tilt=np.array([0.1, 0.001, 9.0, np.nan]),
        lean=np.array([0.3, 0.0, 1.2, np.nan]),
        stand=np.array([0.03, np.nan, 0.4, np.nan]),
    )
    found = features(circles, np.array([0.7, np.nan, 2.0, 1.0]), fits, np.array([0, 0.5, 1, 0.8]))
    least = np.log(0.005 / 0.995)  # logits have an end
    expected = {
        "score": [0, np.log(9), -np.log(4), 0],
        "misfit": [-np.log(2), 0, np.log(2), np.nan],
        "tilt": [np.log(0.1), np.log(0.02), np.log(3), np.nan],
        "aspect": [0.5, 0.6, 0.2, np.nan],  # 0.5, 1 and 0.1, from 0.2 to 0.6
        "moved": [5 / 20, 0, 0, np.nan],
        "resized": [0, np.log(1.5), np.log(2), np.nan],
        "lean": [0.3, 0, 1.2, np.nan],
        "stand": [1.5, 2.5, 2.5, np.nan],
        "unlike": [0.7, np.nan, 2, 1],
        "learned": [least, 0, -least, np.log(4)],
    }
    for name, column in zip(NAMES, found.T, strict=True):
        assert column == pytest.approx(expected[name], nan_ok=True), name


def test_a_surer_detector_never_makes_a_cap_less_likely() -> None:
    depth, gray, circles = scene()
    frame = frame_from(depth, gray)
    fits = CapFit(up="camera").fit(frame.gray, frame.depth_m, CAMERA, circles)
    chance = [
        chances(Circles(circles.center, circles.radius, np.full(6, score)), UNKNOWN, fits)
        for score in np.linspace(0, 1, 21)
    ]
    assert (np.diff(chance, axis=0) >= 0).all()


def test_the_probability_is_the_logistic_of_clipped_standardised_features() -> None:
    weights = np.array([[1.0, 2.0, 0.7, -0.1], [0.0, 0.5, -0.4, 0.3], [0.0, 1.0, 0.2, 0.0]])
    rows = np.array([[3.0, 0.25], [100.0, -100.0]])
    first = 0.2 + 0.7 * 1 - 0.1 * 1 - 0.4 * 0.5 + 0.3 * 0.25
    second = 0.2 + 0.7 * LIMIT - 0.1 * LIMIT**2 + 0.4 * LIMIT + 0.3 * LIMIT**2
    expected = 1 / (1 + np.exp(-np.array([first, second])))
    assert logistic(logit(rows, weights)) == pytest.approx(expected)
