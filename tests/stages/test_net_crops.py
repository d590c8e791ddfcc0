"""What `cap-net` is taught: targets say where the caps of a crop really are."""

from __future__ import annotations

import numpy as np
import pytest

from mushpipe.core.truth import Ignore
from mushpipe.stages.cap_decode import HEAT, MASK, circles_of
from training.net.augment import aims, blackened, blotched, crop, overexposed
from training.net.scenes import Picture, settings
from training.net.texture import grained, individual, shadowed, smooth_bed

DISCS = [(150.0, 120.0, 30.0), (300.5, 200.25, 18.0), (420.0, 330.0, 41.0)]


def picture(kind: int = Ignore.COUNTS, visible: float = 1.0) -> Picture:
    """A frame of 640 x 480 with three discs, which are caps of one kind."""
    v, u = np.mgrid[:480, :640]
    cap = np.any([np.hypot(u - x, v - y) < r for x, y, r in DISCS], axis=0)
    color = np.where(cap[..., None], 200, 40).astype(np.uint8).repeat(3, axis=2)
    kinds, seen = np.full(3, kind, np.uint8), np.full(3, visible)
    return Picture(color, cap, np.array(DISCS), kinds, seen)


def test_the_target_decodes_to_the_circles_it_was_made_of() -> None:
    circles = np.array([[20.3, 41.8, 12.0], [100.0, 70.5, 30.0]])
    target, weight = aims(circles, np.zeros(2, bool), 40)
    target[HEAT] = np.log(
        target[HEAT].clip(1e-6, 1 - 1e-6) / (1 - target[HEAT].clip(1e-6, 1 - 1e-6))
    )
    found, _ = circles_of(target, 0.9)
    assert found[np.argsort(found[:, 0])] == pytest.approx(circles, abs=1e-3)
    assert (weight == 1).all()


@pytest.mark.parametrize("seed", range(6))
def test_circles_of_a_crop_lie_on_its_caps(seed: int) -> None:
    _, target, _ = crop(picture(), 224, np.random.default_rng(seed))
    row, column = np.nonzero(target[HEAT] >= 0.999)
    disc = np.zeros(target[MASK].shape, bool)
    v, u = np.mgrid[:56, :56]
    for i, j in zip(row, column, strict=True):
        radius, dx, dy = np.exp(target[2, i, j]), target[3, i, j], target[4, i, j]
        disc |= np.hypot(u - j - dx, v - i - dy) < radius - 1
    assert (target[MASK][disc] > 0.9).all()


def test_a_plain_crop_keeps_light_and_colour_nearly() -> None:
    for seed in range(8):
        usual = crop(picture(), 224, np.random.default_rng(seed))
        plain = crop(picture(), 224, np.random.default_rng(seed), plain=1)
        assert (plain[1] == usual[1]).all()
        assert (plain[2] == usual[2]).all()
        inside = np.kron(plain[1][MASK] > 0.99, np.ones((4, 4), bool))
        if inside.any():
            red, green, blue = np.median(plain[0][:, inside], axis=1)
            assert max(red, green, blue) < 1.5 * min(red, green, blue)


def test_stains_change_images_and_never_targets() -> None:
    changed = 0
    for seed in range(8):
        plain, stained = (
            crop(picture(), 224, np.random.default_rng(seed), stained=s) for s in (False, True)
        )
        changed += bool((plain[0] != stained[0]).any())
        assert (plain[1] == stained[1]).all()
        assert (plain[2] == stained[2]).all()
    assert changed


def test_a_stump_is_no_cap_and_a_hidden_cap_is_not_asked_for() -> None:
    stumps = [crop(picture(Ignore.CUT_STUMP), 224, np.random.default_rng(k)) for k in range(4)]
    assert not any((target[HEAT] > 0).any() for _, target, _ in stumps)
    assert all((weight == 1).all() for _, _, weight in stumps)
    hidden = [crop(picture(visible=0.1), 224, np.random.default_rng(k)) for k in range(4)]
    assert not any((target[HEAT] > 0).any() for _, target, _ in hidden)
    assert any((weight == 0).any() for _, _, weight in hidden)


@pytest.mark.parametrize("seed", range(6))
def test_a_raised_black_point_leaves_caps_brighter_than_the_soil(seed: int) -> None:
    rng = np.random.default_rng(seed)
    image = rng.uniform(0.05, 0.2, (40, 40, 3)).astype(np.float32)
    cap = np.zeros((40, 40), np.float32)
    cap[10:30, 10:30] = 1
    image[cap > 0] += np.float32(0.4)
    dark = blackened(image, cap, rng)
    assert dark.min() >= 0
    assert dark[cap == 0].mean() < image[cap == 0].mean()
    assert dark[cap > 0].mean() > 5 * dark[cap == 0].mean()


@pytest.mark.parametrize("seed", range(6))
def test_blotches_stay_within_what_they_are_laid_on(seed: int) -> None:
    shape = ((64, 64), (48, 64), (64, 48))[seed % 3]
    image = np.full((*shape, 3), 0.5, np.float32)
    cap = np.zeros(shape, np.float32)
    cap[16:40, 16:40] = 1
    blotchy = blotched(image, cap, np.random.default_rng(seed))
    assert (blotchy[cap == 0] == 0.5).all()
    assert blotchy[cap > 0].std(axis=0).max() > 0.01
    assert (blotchy > 0).all()


@pytest.mark.parametrize("seed", range(6))
def test_grain_stays_on_caps_and_smoothing_on_the_bed(seed: int) -> None:
    rng = np.random.default_rng(seed)
    shape = ((64, 64), (48, 64), (64, 48))[seed % 3]
    image = np.where(np.indices(shape).sum(axis=0) % 2, 0.1, 0.3)[..., None].repeat(3, axis=2)
    image, cap = image.astype(np.float32), np.zeros(shape, np.float32)
    image[16:40, 16:40], cap[16:40, 16:40] = 0.8, 1
    grainy, smooth = grained(image, cap, rng), smooth_bed(image, cap, 2.0)
    assert (grainy[cap == 0] == image[cap == 0]).all()
    assert grainy[cap > 0].std(axis=0).min() > 0.003
    assert grainy[cap > 0].mean() == pytest.approx(0.8, abs=0.05)
    assert smooth[cap > 0] == pytest.approx(image[cap > 0])
    # no brightness of the cap leaks into the bed beside it
    assert smooth[cap == 0] == pytest.approx(0.2, abs=0.04)


@pytest.mark.parametrize("seed", range(6))
def test_a_shadow_lies_on_one_side_of_its_cap_and_lamps_brighten_nothing(seed: int) -> None:
    image = np.full((160, 160, 3), 0.5, np.float32)
    rng = np.random.default_rng(seed)
    circles = np.array([[80.0, 80.0, 20.0]] * 6)  # each casts one in four of five cases
    dark = 0.5 - shadowed(image, circles, rng)[..., 0]
    assert dark.min() >= 0
    assert 0.1 <= dark.max() <= 0.4 + 1e-6
    v, u = np.nonzero(dark > 0.05)
    way = np.array([u.mean() - 79.5, v.mean() - 79.5])
    assert np.hypot(*way) > 4
    lit = np.array([80, 80]) - 17 * way / np.hypot(*way)
    assert dark[round(lit[1]), round(lit[0])] < 0.05


@pytest.mark.parametrize("seed", range(6))
def test_each_cap_gets_one_gain_and_the_bed_none(seed: int) -> None:
    image = np.full((120, 160, 3), 0.5, np.float32)
    v, u = np.mgrid[:120, :160]
    circles = np.array([[40.0, 60, 25], [110.0, 60, 30]])
    discs = [np.hypot(u - x, v - y) < r - 1 for x, y, r in circles]
    cap = np.any(discs, axis=0).astype(np.float32)
    changed = individual(image, cap, circles, np.random.default_rng(seed))
    assert (changed[cap == 0] == 0.5).all()
    colors = [changed[disc] for disc in discs]
    assert all(np.ptp(one, axis=0).max() < 1e-6 for one in colors)
    assert np.abs(colors[0][0] - colors[1][0]).max() > 0.001


@pytest.mark.parametrize("seed", range(6))
def test_overexposure_only_brightens_and_by_one_factor(seed: int) -> None:
    image = np.random.default_rng(seed).uniform(0.1, 0.3, (40, 40, 3)).astype(np.float32)
    ratio = overexposed(image, np.ones((40, 40), np.float32), np.random.default_rng(seed)) / image
    assert ratio == pytest.approx(ratio[0, 0, 0])
    assert ratio[0, 0, 0] * np.median(image) >= 0.7 - 1e-6


def test_drawn_settings_are_ones_the_simulator_takes_and_of_family_a() -> None:
    from mushpipe.sources.synthetic import SyntheticSource

    drawn = [SyntheticSource(**settings(seed)) for seed in range(60)]
    assert {source.shape_family for source in drawn} == {"a"}
    assert {source.scene for source in drawn} == {"bed", "lab"}
