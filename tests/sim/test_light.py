"""Light on a plane and on balls, against the closed forms it is made of."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest

from mushpipe.sim.light import Lamp, Rig, ambient, lit
from mushpipe.sim.material import Paint
from mushpipe.sim.raycast import Raycaster, rays
from mushpipe.sim.render import Surface, look
from mushpipe.sim.settings import SceneSettings
from mushpipe.sim.world import World, view_at
from tests.sim.scenes import ball

SPOT = np.array([0.12, -0.05, 0.6])
WARM = (1.1, 1.0, 0.9)
Build = Callable[..., World]


def seen(settings: SceneSettings, world: World, gloss: float = 0.0) -> tuple[Surface, Paint]:
    """What a camera above sees, painted white all over."""
    surface = look(world, view_at(settings, 0.0))
    count = len(surface.depth)
    white = np.ones((count, 3), np.float32)
    return surface, Paint(white, np.full(count, gloss, np.float32), surface.normal)


def cosine(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    return np.sum(a * b, axis=1) / np.linalg.norm(a, axis=1) / np.linalg.norm(b, axis=1)


@pytest.mark.parametrize("beam", [0.0, 0.05])
def test_a_lamp_over_a_plane_follows_lambert_and_the_square_of_the_distance(
    settings: SceneSettings, build: Build, beam: float
) -> None:
    world = build()
    surface, paint = seen(settings, world)
    lamp = Lamp(np.array([SPOT, SPOT]), 0.8, WARM, beam)  # two spots share the power
    light = lit(world, surface, paint, Rig(0.0, (lamp,)), np.ones(len(paint.gloss), np.float32))
    way = SPOT - surface.point
    expected = 0.8 * (SPOT @ SPOT) / np.sum(way**2, axis=1) * way[:, 2]
    expected /= np.linalg.norm(way, axis=1)
    if beam:  # distance from the line between the spot and the middle of the bed
        aside = np.linalg.norm(np.cross(surface.point, SPOT), axis=1) / np.linalg.norm(SPOT)
        expected /= 1 + (aside / beam) ** 4
    np.testing.assert_allclose(light, expected[:, None] * WARM, rtol=1e-3, atol=1e-5)


def test_a_slope_fades_all_light_across_the_bed(settings: SceneSettings, build: Build) -> None:
    world = build()
    surface, paint = seen(settings, world)
    light = lit(world, surface, paint, Rig(0.5, (), (3.0, -8.0)), np.ones(len(paint.gloss)))
    change = 1 + 3.0 * surface.point[:, 0] - 8.0 * surface.point[:, 1]
    assert change.min() < 0.12
    assert change.max() > 2.2
    expected = 0.5 * np.clip(change, 0.12, 2.2)
    np.testing.assert_allclose(light, np.stack([expected] * 3, axis=1), rtol=1e-5)


def test_a_ball_casts_a_shadow_and_flesh_scatters_light(
    settings: SceneSettings, build: Build
) -> None:
    """A low lamp; the second ball lies wholly in the shadow of the first."""
    spot, center, radius = np.array([0.4, 0.0, 0.3]), np.array([0.0, 0.0, 0.06]), 0.03
    world = build(ball(center, radius), ball((-0.05, 0.0, 0.03), 0.015))
    surface, paint = seen(settings, world)
    rig = Rig(0.0, (Lamp(spot[None], 1.0),))
    light = lit(world, surface, paint, rig, np.ones(len(paint.gloss)))[:, 0]
    way = spot - surface.point
    fall, facing = (spot @ spot) / np.sum(way**2, axis=1), cosine(surface.normal, way)
    away = np.linalg.norm(np.cross(center - surface.point, way), axis=1)
    away /= np.linalg.norm(way, axis=1)
    ground, behind = surface.owner < 0, surface.point[:, 0] < 0
    dark = ground & behind & (away < 0.9 * radius)
    free = ground & (away > 1.2 * radius) & (np.abs(surface.point[:, 1]) > 0.05)
    assert dark.sum() > 100
    assert (light[dark] == 0).all()
    np.testing.assert_allclose(light[free], (fall * facing)[free], rtol=1e-3)
    # flesh is lit a little beyond where the lamp sets, and in shadow
    soft = fall * (facing + 0.1) / 1.1
    for number, share in ((0, 1.0), (1, 0.08)):
        on = surface.outlined & (surface.owner == number) & (facing > -0.08)
        assert on.sum() > 50
        np.testing.assert_allclose(light[on], share * soft[on], atol=2e-3)


def test_a_wet_ball_gleams_where_it_mirrors_the_lamp(settings: SceneSettings, build: Build) -> None:
    center = np.array([0.03, 0.02, 0.05])
    world = build(ball(center, 0.03))
    (surface, dry), (_, wet) = (seen(settings, world, gloss) for gloss in (0.0, 0.5))
    rig, sky = Rig(0.0, (Lamp(SPOT[None], 1.0),)), np.ones(len(dry.gloss))
    gleam = lit(world, surface, wet, rig, sky) - lit(world, surface, dry, rig, sky)
    np.testing.assert_allclose(gleam[:, 0], gleam[:, 2])  # of the lamp's colour, not the skin's
    brightest = np.argmax(np.where(surface.outlined, gleam[:, 0], 0))
    point = surface.point[brightest]
    normal = (point - center) / np.linalg.norm(point - center)
    to_lamp, to_camera = SPOT - point, np.array([0, 0, 0.5]) - point
    half = to_lamp / np.linalg.norm(to_lamp) + to_camera / np.linalg.norm(to_camera)
    assert np.degrees(np.arccos(normal @ half / np.linalg.norm(half))) < 2.5
    assert gleam[brightest, 0] == pytest.approx(0.5 * (SPOT @ SPOT) / (to_lamp @ to_lamp), rel=0.1)


def test_the_sky_reaches_open_ground_whole_and_little_of_it_what_a_ball_hides(
    settings: SceneSettings, build: Build
) -> None:
    world = build(ball((-0.2, 0.0, 0.04), 0.04))
    surface, _ = seen(settings, world)
    share = surface.blend(ambient(world, surface, np.random.default_rng(0)))
    away = np.hypot(surface.point[:, 0] + 0.2, surface.point[:, 1])
    ground = surface.owner < 0
    assert np.abs(share[ground & (surface.point[:, 0] > 0.15)] - 1).max() < 1e-3
    assert np.abs(share[surface.outlined & (away < 0.01)] - 1).max() < 0.05
    assert 0.3 < share[ground & (away < 0.06)].mean() < 0.9


def test_of_the_sky_s_light_neighbours_throw_a_part_back_warm(
    settings: SceneSettings, build: Build
) -> None:
    world = build(ball((0.0, 0.0, 0.03), 0.025))
    surface, paint = seen(settings, world)
    share = np.full(len(paint.gloss), 0.4, np.float32)
    light = lit(world, surface, paint, Rig(0.5, ()), share)
    for where, back in ((surface.outlined, 0.28), (surface.owner < 0, 0.03)):
        expected = 0.5 * (0.4 + back * 0.6 * np.array([1.0, 0.93, 0.78]))
        np.testing.assert_allclose(light[where], np.tile(expected, (where.sum(), 1)), rtol=1e-5)


def test_what_stands_beyond_the_lamp_casts_no_shadow() -> None:
    corners = np.array([[-1.0, -1, 1], [1, -1, 1], [0, 2, 1]])
    caster = Raycaster(corners, np.array([[0, 1, 2]]))
    up = rays(np.zeros((2, 3)), np.array([[0, 0, 1.0], [0, 0, 2.0]]))
    # distances count in lengths of the direction
    assert caster.blocked(up, 0.9).tolist() == [False, True]
    assert caster.blocked(up, 0.4).tolist() == [False, False]
    assert caster.blocked(up, 1.1).tolist() == [True, True]
