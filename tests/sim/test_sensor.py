"""The depth camera: what it says of its noise is what its images show."""

import numpy as np
import pytest

from mushpipe.sim.material import Paint
from mushpipe.sim.photo import ColorCamera
from mushpipe.sim.render import look
from mushpipe.sim.scene import Scene
from mushpipe.sim.sensor import BASELINE, GRAZING, DepthSensor, Exact, axial_sigma
from mushpipe.sim.settings import SceneSettings
from mushpipe.sim.world import view_at
from tests.sim.scenes import ball

CLEAN = {
    "shadow": False,
    "grazing": False,
    "highlights": False,
    "cap_holes": 0.0,
    "random_holes": 0.0,
    "edges": False,
}
FLAT = Exact(np.full((240, 320), 0.6, np.float32), np.zeros((240, 320), bool))
UNIT = 0.000125


def metres(sensor, frame=0, exact=FLAT, seed=0):
    return sensor.sense(exact, seed, frame) * (sensor.unit_mm / 1000)


def test_noise_has_the_stated_sigma():
    sensor = DepthSensor(**CLEAN, offset_mm=0)
    sigma = float(axial_sigma(np.float32(0.6)))
    assert sigma == pytest.approx(0.0003 + 0.0012 * 0.6)
    seeds = [metres(sensor, seed=seed).std() for seed in range(5)]
    assert np.mean(seeds) == pytest.approx(sigma, rel=0.02)


def test_the_offset_is_the_papers():
    error = np.mean([metres(DepthSensor(**CLEAN), k, seed=k).mean() - 0.6 for k in range(20)])
    assert error == pytest.approx(0.00285, abs=5e-5)


def test_noise_grows_with_distance():
    spread = {}
    for z in (0.3, 1.2):
        exact = Exact(np.full((240, 320), z, np.float32), FLAT.lost)
        spread[z] = metres(DepthSensor(**CLEAN, fixed_pattern=False), exact=exact).std()
    ratio = (0.3 + 1.2 * 1.2) / (0.3 + 1.2 * 0.3)
    assert spread[1.2] / spread[0.3] == pytest.approx(ratio, rel=0.03)


@pytest.mark.parametrize(
    ("part", "share"), [("white", 0.8), ("correlated", 0.35), ("fixed_pattern", 0.461)]
)
def test_parts_of_the_noise(part, share):
    off = dict.fromkeys(("white", "correlated", "fixed_pattern"), False) | {part: True}
    sensor = DepthSensor(**CLEAN, **off)
    expected = share / np.sqrt(0.975) * float(axial_sigma(np.float32(0.6)))
    spread = np.mean([metres(sensor, seed=seed).std() for seed in range(8)])
    assert spread == pytest.approx(expected, rel=0.06)


def test_the_fixed_pattern_stays_and_the_rest_does_not():
    fixed = DepthSensor(**CLEAN, white=False, correlated=False)
    np.testing.assert_array_equal(fixed.sense(FLAT, 3, 0), fixed.sense(FLAT, 3, 7))
    assert (fixed.sense(FLAT, 3, 0) != fixed.sense(FLAT, 4, 0)).mean() > 0.5
    full = DepthSensor(**CLEAN)
    first, second = metres(full, 0), metres(full, 1)
    sigma = float(axial_sigma(np.float32(0.6)))
    temporal = np.sqrt((0.8**2 + 0.35**2) / 0.975) * sigma
    assert (first - second).std() / np.sqrt(2) == pytest.approx(temporal, rel=0.02)


def test_white_noise_is_white_and_the_correlated_part_is_not():
    def neighbours(**parts):
        image = metres(DepthSensor(**CLEAN, fixed_pattern=False, **parts))
        image = image - image.mean()
        return (image[:, 1:] * image[:, :-1]).mean() / image.var()

    assert abs(neighbours(correlated=False)) < 0.03
    assert neighbours(white=False) > 0.85


def test_without_noise_depth_is_exact_to_its_unit():
    ramp = np.linspace(0.4, 0.9, 240 * 320, dtype=np.float32).reshape(240, 320)
    exact = Exact(ramp, FLAT.lost)
    for unit_mm in (0.125, 1.0):
        sensor = DepthSensor(**CLEAN, noise=0, offset_mm=0, unit_mm=unit_mm)
        image = sensor.sense(exact, 0, 0)
        assert image.dtype == np.uint16
        np.testing.assert_array_equal(image, np.rint(ramp.astype(float) / (unit_mm / 1000)))


def test_random_holes_have_the_stated_share():
    image = DepthSensor(**(CLEAN | {"random_holes": 0.04})).sense(FLAT, 0, 0)
    assert (image == 0).mean() == pytest.approx(0.04, rel=0.15)
    assert (DepthSensor(**CLEAN).sense(FLAT, 0, 0) > 0).all()


def test_edges_tear_and_nothing_else():
    depth = np.full((120, 160), 0.6, np.float32)
    depth[:, 80:] = 0.55
    exact = Exact(depth, np.zeros(depth.shape, bool))
    sensor = DepthSensor(**(CLEAN | {"edges": True}), noise=0, offset_mm=0)
    image = sensor.sense(exact, 0, 0) * UNIT
    band = np.zeros(depth.shape, bool)
    band[:, 79:81] = True
    np.testing.assert_allclose(image[~band], depth[~band], atol=UNIT)
    flying = (image[band] > 0.552) & (image[band] < 0.598)
    assert 0.1 < flying.mean() < 0.4
    assert 0.2 < (image[band] == 0).mean() < 0.45


def bed(**sensor):
    settings = SceneSettings(seed=3, width=320, height=240, count=60, distance=0.45)
    scene = Scene(settings, ColorCamera(), DepthSensor(**(CLEAN | sensor)))
    return scene.still(0.0)


@pytest.mark.parametrize(
    "part", [{"shadow": True}, {"grazing": True}, {"cap_holes": 1.0}, {"highlights": True}]
)
def test_each_kind_of_hole_can_be_had_alone(part):
    lost = bed(**part).exact.lost
    assert 0 < lost.mean() < 0.3


def test_no_holes_where_all_are_switched_off():
    assert not bed().exact.lost.any()


def test_the_shadow_lies_away_from_the_projector():
    still = bed(shadow=True)
    inside = still.instances.labels > 0
    left, right = np.zeros_like(inside), np.zeros_like(inside)
    left[:, :-4], right[:, 4:] = inside[:, 4:], inside[:, :-4]
    lost = still.exact.lost & ~inside
    assert (lost & right & ~left).sum() > 3 * (lost & left & ~right).sum()


def test_what_is_out_of_range_is_missing():
    sensor = DepthSensor(**CLEAN, range_m=(0.2, 0.4))
    settings = SceneSettings(scene="plane", width=160, height=120)
    still = Scene(settings, ColorCamera(), sensor).still(0.0)
    assert still.exact.lost.all()


@pytest.mark.parametrize("fault", [{"edges": False}, {"random_holes": 0.0}])
def test_switching_a_fault_off_leaves_the_noise_as_it_was(fault):
    step = np.full((240, 320), 0.6, np.float32)
    step[:, 160:] = 0.55
    exact = Exact(step, np.zeros(step.shape, bool))
    a, b = (DepthSensor(**drawn).sense(exact, 3, 5) for drawn in ({}, fault))
    flat = np.abs(np.arange(320) - 160) > 20
    both = ((a > 0) & (b > 0))[:, flat]
    assert both.mean() > 0.95
    assert (a[:, flat][both] == b[:, flat][both]).all()


def test_what_no_unit_can_say_is_lost_and_a_range_has_two_ends():
    far = Exact(np.full((24, 32), 0.8, np.float32), np.zeros((24, 32), bool))
    assert (DepthSensor(**CLEAN, unit_mm=0.01).sense(far, 0, 0) == 0).all()
    with pytest.raises(ValueError, match="nearest, farthest"):
        DepthSensor(range_m=(1.5, 0.2))
    with pytest.raises(ValueError, match="in m, at most 100"):
        DepthSensor(range_m=(200, 1500))  # in mm: every pixel would be lost


def holes(settings, world, gloss=1.0, **parts):
    """What is lost of a world, and its surface; every pixel as glossy as said."""
    view = view_at(settings, 0.0)
    surface = look(world, view)
    count = len(surface.depth)
    paint = Paint(np.ones((count, 3)), np.full(count, gloss), surface.normal)
    return DepthSensor(**(CLEAN | parts)).scan(world, view, surface, paint, 0).lost, surface


def test_a_wet_plane_mirrors_the_projector_half_way_to_it(settings, build):
    """Where the upright halves the angle between the ways to camera and projector, to 3 degrees."""
    lost, surface = holes(settings, build(), highlights=True)
    camera, projector = np.array([0, 0, 0.5]), np.array([-BASELINE, 0, 0.5])
    ways = [place - surface.point for place in (camera, projector)]
    half = sum(way / np.linalg.norm(way, axis=1, keepdims=True) for way in ways)
    cosine = half[:, 2] / np.linalg.norm(half, axis=1)
    assert lost.sum() > 500
    np.testing.assert_array_equal(lost.ravel(), cosine > 0.9985)
    u = np.nonzero(lost)[1].mean()
    assert u == pytest.approx(
        settings.camera().cx - settings.camera().fx * BASELINE / 2 / 0.5, abs=1
    )
    assert not holes(settings, build(), gloss=0.1, highlights=True)[0].any()


def test_a_ball_is_lost_where_it_is_seen_at_a_grazing_angle(settings, build):
    center = np.array([0.08, -0.05, 0.04])
    lost, surface = holes(settings, build(ball(center, 0.03)), grazing=True)
    normal = (surface.point - center) / 0.03
    sight = np.array([0, 0, 0.5]) - surface.point
    cosine = np.sum(normal * sight, axis=1) / np.linalg.norm(sight, axis=1)
    on, clear = surface.outlined, np.abs(cosine - GRAZING) > 0.03
    assert 20 < lost.sum() < on.sum() / 2
    np.testing.assert_array_equal(lost.ravel()[on & clear], cosine[on & clear] < GRAZING)
    assert not lost.ravel()[surface.owner < 0].any()


def test_a_hole_in_a_cap_lies_around_its_top_and_a_share_of_the_caps_has_one(settings, build):
    axis = np.array([0.3, 0.2, 1.0]) / np.linalg.norm([0.3, 0.2, 1.0])
    centers = [np.array([x, y, 0.04]) for x in (-0.1, -0.03, 0.04, 0.11) for y in (-0.06, 0, 0.06)]
    world = build(*(ball(center, 0.025, axis) for center in centers))
    every, surface = holes(settings, world, cap_holes=1.0)
    assert not every.ravel()[surface.owner < 0].any()
    for k, center in enumerate(centers):
        own = surface.owner == k
        away = np.linalg.norm(surface.point[own] - (center + 0.025 * axis), axis=1) / 0.025
        lost = every.ravel()[own]
        assert lost[away < 0.07].all()
        assert not lost[away > 0.23].any()
        assert away[lost].max() < away[~lost].min()
    some = holes(settings, world, cap_holes=0.5)[0].ravel()
    assert 2 <= len(np.unique(surface.owner[some])) <= 10


def test_what_is_too_near_is_missing(settings, build):
    lost, surface = holes(settings, build(ball((0, 0, 0.03), 0.025)), range_m=(0.48, 1.5))
    np.testing.assert_array_equal(lost.ravel(), surface.depth < 0.48)
    assert lost.any()
