"""What a detector is trained against: each setting does what it says, and nothing when off."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from mushpipe.sim.ground import rubble, soil, weathered
from mushpipe.sim.mesh import Material
from mushpipe.sim.mushroom import Kind
from mushpipe.sim.planting import Area
from mushpipe.sim.settings import SceneSettings
from mushpipe.sim.shapes import Family, aged, deformed, dome, draw_shape
from mushpipe.sim.world import World, make_world

AREA = Area(-0.1, 0.1, -0.08, 0.08)


def world(**settings: Any) -> World:
    small: dict[str, Any] = {"width": 160, "height": 120, "count": 12, "pins": 5, **settings}
    return make_world(SceneSettings(**small))


def test_relief_adds_its_standard_deviation_and_wet_soil_is_darker() -> None:
    flat = soil(AREA, 0.0006, 1.0, 0.5, np.random.default_rng(1))
    lumpy = weathered(flat, 0.004, 0.0, np.random.default_rng(2))
    # lumps of two sizes, of standard deviation 1 and a half
    assert (lumpy.height - flat.height).std() == pytest.approx(0.004 * np.sqrt(1.25), rel=0.05)
    assert np.array_equal(lumpy.albedo, flat.albedo)
    wet = weathered(flat, 0.0, 1.0, np.random.default_rng(2))
    assert 0.35 < wet.albedo.mean() / flat.albedo.mean() < 0.9
    assert np.array_equal(wet.height, flat.height)


def test_rubble_is_as_large_as_small_caps() -> None:
    ground, pixel = soil(AREA, 0.0006, 1.0, 0.0, np.random.default_rng(1)), 0.0008
    pieces = rubble(ground, AREA, 100, pixel, np.random.default_rng(3))
    assert len(pieces) == 100
    assert {p.material for p in pieces} == {Material.CLOD, Material.STONE, Material.MYCELIUM}
    radius = [np.ptp(p.vertices[:, :2], axis=0).mean() / 2 / pixel for p in pieces]
    assert 3 < min(radius) < 8
    assert 12 < max(radius) < 32


def test_what_lies_on_the_bed_moves_no_mushroom() -> None:
    plain, full = world(), world(rubble=60, foreign=5)
    assert len(full.triangles) > len(plain.triangles)
    for a, b in zip(plain.mushrooms, full.mushrooms, strict=True):
        assert np.array_equal(a.center, b.center)
        assert np.array_equal(a.foot, b.foot)


def test_leaning_stems_stand_farther_out_under_the_same_caps() -> None:
    plain, leaning = world(), world(lean=1.0)
    assert len(plain.mushrooms) == len(leaning.mushrooms)
    moved = []
    for a, b in zip(plain.mushrooms, leaning.mushrooms, strict=True):
        assert np.array_equal(a.center[:2], b.center[:2])
        assert np.array_equal(a.axis, b.axis)
        away = np.linalg.norm((b.foot - a.foot)[:2]) / a.radius
        assert away <= 1.5
        moved += [away] if a.kind == Kind.GROWING else []
    assert max(moved) > 0.7


def test_sunk_mushrooms_are_the_same_ones_lower_in_the_soil() -> None:
    plain, sunk = world(cluster=0.0), world(cluster=0.0, sunk=1.0)
    share = []
    for a, b in zip(plain.mushrooms, sunk.mushrooms, strict=True):
        assert (a.kind, a.radius, a.shape) == (b.kind, b.radius, b.shape)
        high, low = (m.center[2] - m.foot[2] for m in (a, b))
        assert 0 <= low <= high + 1e-9
        if a.kind == Kind.GROWING:
            share.append(low / high)
        else:
            assert low == pytest.approx(high)
    assert min(share) < 0.15
    assert max(share) > 0.7


def test_lids_lie_flat_and_change_nothing_else() -> None:
    plain, strewn = world(), world(lids=9)
    added = len(strewn.triangles) - len(plain.triangles)
    assert added > 9 * 48
    for a, b in zip(plain.mushrooms, strewn.mushrooms, strict=True):
        assert np.array_equal(a.center, b.center)


def test_a_deformed_cap_keeps_its_family_and_its_rim_plane() -> None:
    rng = np.random.default_rng(4)
    for _ in range(50):
        shape = draw_shape(rng, "a", 0.5)
        other = deformed(shape, 1.0, rng)
        assert other.family == shape.family
        assert 0.25 <= other.height <= 1.2
        assert replace(other, height=shape.height, form=shape.form, warp=shape.warp) == shape


def test_fresh_stumps_are_flat_at_the_cut_and_change_nothing_else() -> None:
    plain, cut = world(stumps=9), world(stumps=9, fresh=1.0)
    assert len(plain.mushrooms) == len(cut.mushrooms)
    for k, (a, b) in enumerate(zip(plain.mushrooms, cut.mushrooms, strict=True)):
        assert a.kind == b.kind
        assert b.fresh == (b.kind == Kind.STUMP)
        if b.kind != Kind.STUMP:
            assert (a.radius, a.shape, a.stem) == (b.radius, b.shape, b.stem)
        else:
            points = cut.vertices[cut.triangles[(cut.owner == k) & (cut.material == Material.CUT)]]
            assert np.abs((points - b.center) @ b.axis).max() < 1e-6
    stumps = [m for m in cut.mushrooms if m.kind == Kind.STUMP]
    assert max(m.radius for m in stumps) > 0.0095


def test_old_caps_are_low_and_some_sunk_in_the_middle_and_others_stay_as_they_are() -> None:
    plain, mixed, old = world(), world(old=0.5), world(old=1.0)
    rows = [k for k, m in enumerate(plain.mushrooms) if m.kind == Kind.GROWING]
    assert all(0.08 <= old.mushrooms[k].shape.height <= 0.34 for k in rows)
    same = [plain.mushrooms[k].shape == mixed.mushrooms[k].shape for k in rows]
    assert 0 < sum(same) < len(rows)
    for a, b in zip(plain.mushrooms, old.mushrooms, strict=True):
        assert np.array_equal(a.center, b.center)
        assert np.array_equal(a.axis, b.axis)


@pytest.mark.parametrize("family", ["a", "b"])
def test_an_old_cap_keeps_its_rim_and_the_height_of_its_middle(family: Family) -> None:
    rng = np.random.default_rng(6)
    for _ in range(50):
        shape = aged(draw_shape(rng, family, 0.8), rng)
        rho, z = dome(shape, 300)
        assert (rho[0], z[0]) == (0, pytest.approx(shape.height))
        assert (rho[-1], z[-1]) == (1, pytest.approx(0, abs=1e-12))
        assert z.min() > -1e-9
        level = dome(replace(shape, sunk=0.0), 300)[1]
        assert np.abs(z - level).max() == pytest.approx(abs(shape.sunk), rel=1e-3)


def test_real_mushrooms_lie_on_a_table_where_asked_for() -> None:
    printed = world(scene="lab", fallen=2)
    assert {m.kind for m in printed.mushrooms} == {Kind.PRINTED}
    real = world(scene="lab", printed=False, fallen=2, stumps=0, pins=0)
    kinds = [m.kind for m in real.mushrooms]
    assert kinds.count(Kind.GROWING) == 12
    assert kinds.count(Kind.FALLEN) == 2
