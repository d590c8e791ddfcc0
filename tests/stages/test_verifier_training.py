"""What the verifiers are taught."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from mushpipe import Circles
from mushpipe.core.truth import INSTANCES_TOPIC, TRUTH_TOPIC, Ignore
from mushpipe.stages.cap.verify import BESIDE, MODELS, NAMES
from mushpipe.stages.verifier_net import LIMIT, WIDTHS, probability, read_models, write_models
from tests.stages.frames import simulated
from training.fitted import labels, teaches
from training.harder import harder
from training.logistic import fit
from training.matching import counted
from training.net.scenes import cap_mask
from training.scenes import Case
from training.sensors import worse
from training.verifier import (
    FEATURES,
    NET,
    RADII,
    doubtful,
    first_guess,
    fit_logistic,
    fit_network,
    kept,
)


def test_a_doubtful_network_finds_fewer_circles_with_lower_scores_and_no_others() -> None:
    rng = np.random.default_rng(0)
    center, radius = rng.uniform(0, 400, (300, 2)), rng.uniform(8, 40, 300)
    circles = Circles(center, radius, rng.uniform(NET.min_score, 1, 300))
    told = {tuple(place): score for place, score in zip(center, circles.score, strict=True)}
    less = doubtful(circles, rng)
    assert 0 < len(less) < 300
    assert less.score.min() >= NET.min_score
    before = np.array([told[tuple(place)] for place in less.center])
    assert less.score.mean() < before.mean() - 0.05


def test_a_circle_teaches_the_models_that_would_be_asked_about_it() -> None:
    known = {  # fit, likeness -> models
        (True, True): ["fitted", "fitted_kin"],
        (True, False): ["fitted_few", "fitted_rubble"],
        (False, True): ["seen_kin"],
        (False, False): [],
    }
    rows = np.zeros((len(known), len(NAMES)))
    for row, (fitted, alike) in zip(rows, known, strict=True):
        row[1:-2], row[-2] = 0.0 if fitted else np.nan, 0.0 if alike else np.nan
    for beside in (False, True):
        rows[:, -1] = 0.0 if beside else np.nan
        for model in MODELS:
            asked = [[name + beside * BESIDE for name in models] for models in known.values()]
            assert teaches(rows, model).tolist() == [model in models for models in asked]


def test_a_cap_teaches_one_circle_and_what_need_not_be_found_teaches_none() -> None:
    truth = simulated(5, width=640, height=480, count=40).attached[TRUTH_TOPIC]
    counts = counted(truth, *RADII)
    caps, others = np.flatnonzero(counts)[:2], np.flatnonzero(~counts)[:1]
    rows = [caps[0], caps[0], caps[1], *others]
    center, radius = truth.center[rows], truth.radius[rows].copy()
    center[1] += 0.2 * radius[1]  # the worse of two on one cap
    center, radius = np.vstack([center, [[-500.0, -500.0]]]), np.append(radius, 20.0)
    found = labels(Circles(center, radius, np.ones(len(radius))), truth)
    assert len(others) == 1
    assert found[:3].tolist() == [1, 0, 1]
    assert np.isnan(found[3])
    assert found[4] == 0


def test_cut_stumps_are_no_caps_where_they_teach_at_all() -> None:
    truth = simulated(5, width=640, height=480, count=10, stumps=12).attached[TRUTH_TOPIC]
    stumps = truth.ignore == Ignore.CUT_STUMP
    circles = Circles(truth.center, truth.radius, np.ones(len(truth)))
    assert stumps.sum() > 3
    assert np.isnan(labels(circles, truth)[stumps]).all()
    taught = labels(circles, truth, stumps=True)
    assert (taught[stumps] == 0).sum() > 3  # but for those on what does not count
    assert np.array_equal(taught[~stumps], labels(circles, truth)[~stumps], equal_nan=True)


def test_with_a_share_the_probabilities_are_those_of_scenes_that_have_it() -> None:
    rng = np.random.default_rng(0)
    right = (np.arange(20_000) % 2).astype(float)
    x = rng.normal(right[:, None], 1)  # log odds of an even share: x - 1/2
    model = fit(x, right, ("one",), 1e-6, LIMIT, (), share=0.8)
    one = model["features"]["one"]
    slope = one["weight"] / one["scale"]
    assert slope == pytest.approx(1, abs=0.05)
    at_half = model["intercept"] + slope * (0.5 - one["mean"])
    assert at_half == pytest.approx(np.log(4), abs=0.05)


def test_a_worse_camera_sees_less_and_noisier_depth_where_there_was_some() -> None:
    frame = simulated(6, width=640, height=480)
    rng, seen = np.random.default_rng(0), frame.depth_m
    for _ in range(5):
        bad = worse(frame, rng)
        assert bad.depth.shape == frame.depth.shape
        assert np.isfinite(bad.depth_m).mean() < np.isfinite(seen).mean()
        off = np.abs(bad.depth_m - seen)
        assert 0 < np.nanmedian(off) < 0.005


def test_in_some_frames_of_a_worse_camera_caps_are_in_part_as_far_as_the_bed() -> None:
    frame = simulated(6, width=640, height=480)
    cap = cap_mask(frame.attached[TRUTH_TOPIC], frame.attached[INSTANCES_TOPIC])
    bed, rng = np.nanmedian(frame.depth_m[~cap]), np.random.default_rng(0)
    high = cap & (frame.depth_m < bed - 0.02)
    shares = [(worse(frame, rng).depth_m[high] > bed - 0.005).mean() for _ in range(12)]
    assert 2 <= sum(share > 0.02 for share in shares) <= 8
    assert sum(share < 0.002 for share in shares) >= 4


def test_caps_that_worse_depth_puts_on_the_bed_do_not_count() -> None:
    frame = simulated(6, width=640, height=480)
    truth, rng = frame.attached[TRUTH_TOPIC], np.random.default_rng(0)
    labels, counts = frame.attached[INSTANCES_TOPIC].labels, truth.ignore == Ignore.COUNTS
    lost = []
    for _ in range(12):
        hard = harder(Case("even", "a", 6, frame, truth), rng)
        sunk = hard.frame.depth_m > frame.depth_m + 0.008
        share = np.array([sunk[labels == 1 + row].mean() for row in np.flatnonzero(counts)])
        left = hard.truth.ignore[counts] == Ignore.COUNTS
        assert np.array_equal(left, share <= 0.3)
        assert np.array_equal(hard.truth.ignore[~counts], truth.ignore[~counts])
        lost.append((~left).sum())
    assert max(lost) > 0
    assert min(lost) == 0


def test_a_harder_frame_has_blotches_on_its_caps_and_at_times_on_its_bed_and_worse_depth() -> None:
    frame = simulated(6, width=320, height=240)
    truth, rng = frame.attached[TRUTH_TOPIC], np.random.default_rng(0)
    cap = cap_mask(truth, frame.attached[INSTANCES_TOPIC])
    caps, beds = [], []
    for _ in range(8):
        hard = harder(Case("even", "a", 6, frame, truth), rng)
        changed = np.ptp(hard.frame.color.astype(int) - frame.color, axis=2) > 0
        caps.append(changed[cap].mean())
        beds.append(changed[~cap].mean())
        assert np.isfinite(hard.frame.depth_m).mean() < np.isfinite(frame.depth_m).mean()
        assert np.array_equal(hard.truth.center, truth.center)
        assert hard.frame.camera == frame.camera
    assert min(caps) > 0.1
    assert min(beds) == 0
    assert max(beds) > 0.1


def test_only_some_features_are_squared() -> None:
    rng = np.random.default_rng(0)
    x = rng.normal(0, 1, (4000, 2))
    right = (rng.random(4000) < 1 / (1 + np.exp(-(0.5 + x[:, 0] - 0.8 * x[:, 1] ** 2)))).astype(
        float
    )
    model = fit(x, right, ("one", "two"), 1e-6, LIMIT, ("two",))
    one, two = model["features"]["one"], model["features"]["two"]
    assert one["weight"] == pytest.approx(1, abs=0.15)
    assert one["square"] == 0
    assert two["square"] == pytest.approx(-0.8, abs=0.15)


def test_a_network_learns_what_no_regression_on_squares_can(tmp_path: Path) -> None:
    rng, names = np.random.default_rng(0), ("support", "free")
    x = rng.normal(0, 1, (4000, 2))
    right = (x[:, 0] * x[:, 1] > 0).astype(float)
    path = tmp_path / "models.npz"
    models = {"net": fit_network(x, right, 1), "plain": fit_logistic(x, right, names)}
    write_models(path, {name: (names, parts) for name, parts in models.items()})
    both = read_models(path, list(models), names)
    room = np.empty(WIDTHS[0], np.float32), np.empty(WIDTHS[1], np.float32)
    fresh = rng.normal(0, 1, (1000, 2))
    agrees = [
        np.mean([(probability(row, both, k, *room) > 0.5) == (row.prod() > 0) for row in fresh])
        for k in range(2)
    ]
    assert agrees[0] > 0.95
    assert agrees[1] < 0.6


def test_the_first_guess_of_every_model_likes_edges_and_dislikes_overlap(tmp_path: Path) -> None:
    path = tmp_path / "models.npz"
    write_models(path, {name: (known, first_guess(known)) for name, known in FEATURES.items()})
    room = np.empty(WIDTHS[0], np.float32), np.empty(WIDTHS[1], np.float32)
    for name, known in FEATURES.items():
        models = read_models(path, [name], known)
        row = np.full(len(known), 0.5)
        edge, hidden = row.copy(), row.copy()
        edge[known.index("support")] = hidden[known.index("overlap")] = 1.0
        chance = [probability(each, models, 0, *room) for each in (hidden, row, edge)]
        assert chance == sorted(chance)
        assert chance[0] < chance[1] < chance[2]


def test_another_network_changes_no_model_that_knows_of_none(tmp_path: Path) -> None:
    path, again = tmp_path / "models.npz", tmp_path / "again.npz"
    models = {name: (known, first_guess(known)) for name, known in FEATURES.items()}
    for number, (_, parts) in enumerate(models.values()):
        parts["b3"] += number
    write_models(path, models)
    same = kept(path)
    assert {name: tuple(known) for name, (known, _) in same.items()} == {
        name: FEATURES[name] for name in ("image", "depth", "mask")
    }
    write_models(again, same)
    for name, known in FEATURES.items():
        if name in same:
            old, new = (read_models(each, [name], known) for each in (path, again))
            assert all(map(np.array_equal, old, new))
