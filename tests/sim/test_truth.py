"""The simulator's truth against closed forms and against independent rendering."""

import numpy as np
import pytest

from mushpipe.core.truth import Ignore
from mushpipe.sim.annotate import annotate, outline_around
from mushpipe.sim.mushroom import Kind
from mushpipe.sim.raycast import Raycaster, rays
from mushpipe.sim.render import look
from mushpipe.sim.shapes import CapShape, Warp, draw_shape
from mushpipe.sim.world import view_at
from tests.sim.scenes import BALL, ball


def truth_of(settings, world, along=0.0, largest=80.0):
    view = view_at(settings, along)
    return annotate(world, view, look(world, view), largest)


def sphere_outline(camera, center, radius):
    """Centre and equal-area radius (px) of a sphere's image, an ellipse, in closed form."""
    x, y, z = center
    d = z * z - radius**2
    a = camera.fx * radius * np.sqrt(x * x + y * y + d) / d
    b = camera.fx * radius / np.sqrt(d)
    place = np.array([camera.fx * x * z / d + camera.cx, camera.fy * y * z / d + camera.cy])
    return place, np.sqrt(a * b)


def hits_sphere(camera, center, radius, over):
    """Depth (over*H, over*W) of a sphere by the quadratic, inf where a ray misses."""
    v, u = np.mgrid[: camera.height * over, : camera.width * over]
    pixels = np.stack([u, v], axis=-1) / over + (0.5 / over - 0.5)
    ray = camera.deproject(pixels, np.ones(u.shape))
    a, b = (ray**2).sum(axis=-1), ray @ center
    root = b * b - a * (center @ center - radius**2)
    return np.where(root > 0, (b - np.sqrt(np.maximum(root, 0))) / a, np.inf)


@pytest.mark.parametrize("place", [(0.0, 0.0), (0.11, 0.07), (-0.08, 0.05)])
def test_a_sphere_has_the_outline_of_the_closed_form(settings, build, place):
    world = build(ball((*place, 0.03), 0.025))
    truth, _ = truth_of(settings, world)
    center = np.array([place[0], -place[1], 0.5 - 0.03])
    where, radius = sphere_outline(settings.camera(), center, 0.025)
    assert truth.radius[0] == pytest.approx(radius, rel=0.003)
    np.testing.assert_allclose(truth.center[0], where, atol=0.04)
    assert truth.visible[0] == pytest.approx(1, abs=0.06)  # some 800 pixels


def test_apex_surface_axis_and_diameters_of_a_sphere(settings, build):
    axis = np.array([0.3, -0.2, 1.0]) / np.linalg.norm([0.3, -0.2, 1.0])
    world = build(ball((0.02, 0.03, 0.04), 0.02, axis))
    truth, _ = truth_of(settings, world)
    flip = np.array([1, -1, -1])  # the camera looks straight down
    center = np.array([0.02, 0.03, 0.04]) * flip + [0, 0, 0.5]
    np.testing.assert_allclose(truth.axis[0], axis * flip, atol=1e-12)
    np.testing.assert_allclose(truth.apex[0], center + 0.02 * axis * flip, atol=5e-5)
    ray = settings.camera().deproject(truth.center, np.ones(1))[0]
    a, b = ray @ ray, ray @ center
    t = (b - np.sqrt(b * b - a * (center @ center - 0.02**2))) / a
    np.testing.assert_allclose(truth.surface[0], ray * t, atol=5e-5)
    assert truth.diameter[0] == pytest.approx(0.04, rel=0.003)
    assert truth.diameter_max[0] == pytest.approx(0.04, rel=0.003)


def test_depth_is_the_spheres(settings, build):
    world = build(ball((0.0, 0.0, 0.03), 0.025))
    surface = look(world, view_at(settings, 0))
    exact = hits_sphere(settings.camera(), np.array([0, 0, 0.47]), 0.025, 1).ravel()
    inside = surface.outlined & (surface.normal[:, 2] > 0.4)
    assert inside.sum() > 400
    assert np.abs(surface.depth - exact)[inside].max() < 1e-4
    np.testing.assert_allclose(surface.depth[surface.owner < 0], 0.5, atol=1e-6)


def test_visible_share_of_overlapping_spheres(settings, build):
    low, high = ((0.0, 0.0, 0.02), 0.02), ((0.02, 0.0, 0.045), 0.02)
    truth, instances = truth_of(settings, build(ball(*low), ball(*high)))
    camera, over = settings.camera(), 8
    depths = [
        hits_sphere(camera, np.array([c[0], -c[1], 0.5 - c[2]]), r, over) for c, r in (low, high)
    ]
    seen = (depths[0] < depths[1]).sum() / np.isfinite(depths[0]).sum()
    assert truth.visible[0] == pytest.approx(seen, abs=0.05)
    pixels = (instances.labels == 1).sum()
    assert pixels == pytest.approx((depths[0] < depths[1]).sum() / over**2, rel=0.04)
    assert truth.visible[1] == pytest.approx(1, abs=0.06)
    labels = instances.labels
    assert labels.dtype == np.uint16
    assert set(np.unique(labels)) == {0, 1, 2}


@pytest.mark.parametrize("family", ["a", "b"])
@pytest.mark.parametrize("seed", range(4))
def test_the_hull_is_the_caps_outline(settings, build, family, seed):
    rng = np.random.default_rng(seed)
    shape = draw_shape(rng, family, float(rng.uniform(0, 1)))
    turn, tilt = rng.uniform(0, 2 * np.pi), np.radians(rng.uniform(0, 40))
    axis = (np.sin(tilt) * np.cos(turn), np.sin(tilt) * np.sin(turn), np.cos(tilt))
    world = build(ball((0.02, 0.01, 0.05), 0.03, axis, shape=shape))
    truth, _ = truth_of(settings, world)
    alone = Raycaster(world.vertices, world.triangles[world.outlined])
    camera, over = settings.camera(), 6
    v, u = np.mgrid[: camera.height * over, : camera.width * over].reshape(2, -1)
    pixels = np.stack([u, v], axis=-1) / over + (0.5 / over - 0.5)
    view = view_at(settings, 0)
    distance, _, _ = alone.first(rays(view.position, view.directions(pixels)))
    hit = np.isfinite(distance)
    assert truth.radius[0] == pytest.approx(np.sqrt(hit.sum() / over**2 / np.pi), rel=0.004)
    np.testing.assert_allclose(truth.center[0], pixels[hit].mean(axis=0), atol=0.05)


def test_the_axis_is_the_normal_of_the_rim_plane(build):
    rng = np.random.default_rng(3)
    shape = draw_shape(rng, "a", 1.0)
    axis = np.array([0.3, 0.1, 0.9]) / np.linalg.norm([0.3, 0.1, 0.9])
    world = build(ball((0, 0, 0.05), 0.03, axis, shape=shape))
    along = (world.vertices[world.bodies[0]] - [0, 0, 0.05]) @ axis
    across = world.vertices[world.bodies[0]] - [0, 0, 0.05] - along[:, None] * axis
    far = np.linalg.norm(across, axis=1)
    ring = world.vertices[world.bodies[0]][(np.abs(along) < 0.003) & (far > 0.026)]
    normal = np.linalg.svd(ring - ring.mean(axis=0))[2][-1]
    assert np.degrees(np.arccos(abs(normal @ axis))) < 1.5


def test_an_elliptic_rim_gives_both_diameters(settings, build):
    warp = Warp(rim=((0.1, 2, 0.0),))
    shape = CapShape("a", 0.5, (2.0,), 0.1, 0.2, True, warp)
    truth, _ = truth_of(settings, build(ball((0, 0, 0.05), 0.03, shape=shape)))
    turn = np.linspace(0, 2 * np.pi, 20001)
    area = np.trapezoid((0.03 * (1 + 0.1 * np.cos(2 * turn))) ** 2 / 2, turn)
    # hull over polar curve: the waist of this shape is convex at 10 %
    assert truth.diameter[0] == pytest.approx(2 * np.sqrt(area / np.pi), rel=0.004)
    assert truth.diameter_max[0] == pytest.approx(0.066, rel=0.003)


def test_outline_of_a_rectangle():
    outline = outline_around(np.array([[1, 1], [5, 1], [5, 4], [1, 4], [2, 2]], float))
    assert outline.area == pytest.approx(12)
    np.testing.assert_allclose(outline.center, [3, 2.5])
    assert outline.extent() == pytest.approx(5)
    assert outline.share_inside(4, 10) == pytest.approx(2.5 / 4)


CASES = {
    Ignore.COUNTS: [ball((0, 0, 0.03), 0.025)],
    Ignore.HIDDEN: [ball((0, 0, 0.01), 0.018), ball((0.012, 0, 0.06), 0.02)],
    Ignore.TOO_SMALL: [ball((0, 0, 0.03), 0.008)],
    Ignore.TOO_LARGE: [ball((0, 0, 0.08), 0.09)],
    Ignore.AT_BORDER: [ball((0.275, 0, 0.03), 0.03)],
    Ignore.NOT_UPRIGHT: [ball((0, 0, 0.03), 0.025, axis=(1, 0, 0.2), kind=Kind.FALLEN)],
    Ignore.CUT_STUMP: [ball((0, 0, 0.02), 0.03, kind=Kind.STUMP)],
}


@pytest.mark.parametrize(
    ("reason", "mushrooms"), CASES.items(), ids=lambda v: getattr(v, "name", "")
)
def test_reasons_to_ignore(settings, build, reason, mushrooms):
    truth, _ = truth_of(settings, build(*mushrooms), largest=30)
    assert truth.ignore[0] == reason


def test_what_is_out_of_view_has_no_row(settings, build):
    world = build(ball((0.35, 0, 0.03), 0.02), ball((0, 0, 0.03), 0.02))
    truth, instances = truth_of(settings, world)
    np.testing.assert_array_equal(truth.id, [1])
    assert set(np.unique(instances.labels)) == {0, 1}


def test_an_empty_bed_has_an_empty_truth(settings, build):
    truth, instances = truth_of(settings, build())
    assert len(truth) == 0
    assert not instances.labels.any()


def test_a_moving_camera_shifts_the_truth(settings, build):
    world = build(ball((0, 0, 0.03), 0.025, shape=BALL))
    still, _ = truth_of(settings, world)
    moved, _ = truth_of(settings, world, along=0.02)
    np.testing.assert_allclose(moved.apex[0], still.apex[0] - [0.02, 0, 0], atol=1e-6)
    assert moved.center[0, 0] < still.center[0, 0] - 5
