"""Beds by another renderer: what needs no renderer is held against closed forms."""

import numpy as np
import pytest

from mushpipe import Camera
from mushpipe.core.truth import Ignore
from mushpipe.sim.mesh import quads
from mushpipe.sim.mushroom import turned_to
from training.traced import things
from training.traced.bed import Bed, Mushroom, drawn
from training.traced.cameras import OFFSET, UNIT, _hidden, coded_light, stereo
from training.traced.mesh import Mesh
from training.traced.render import View, seen
from training.traced.truth import first_hit, truth_of

CAMERA = Camera(640, 480, 610.0, 610.0, 319.5, 239.5)
HALF = np.array([640, 480]) / 2 / 610


def ball(center, radius, rows=120, columns=240):
    """A sphere, finely."""
    polar, turn = np.linspace(1e-6, np.pi - 1e-6, rows), np.arange(columns) * 2 * np.pi / columns
    p, t = np.meshgrid(polar, turn, indexing="ij")
    points = np.stack([np.sin(p) * np.cos(t), np.sin(p) * np.sin(t), np.cos(p)], -1).reshape(-1, 3)
    return Mesh(center + radius * points, quads(rows, columns, True), np.ones_like(points))


def plane_view(depth):
    z = np.full((480, 640), depth)
    return View(np.ones((480, 640, 3), np.float32), z, np.ones_like(z), np.full(z.shape, -1))


def test_a_ball_has_the_truth_of_a_ball():
    center, radius, axis = np.array([0.03, -0.02, 0.04]), 0.02, np.array([0.0, 0.6, 0.8])
    mesh = ball(center, radius)
    bed = Bed([Mushroom(axis, center, mesh, mesh)], mesh, 0.5, np.diag([1.0, -1, -1]))
    middle = seen(bed, center[None])[0]
    # The outline of a sphere is an ellipse around the line of sight: half-axes by its tangents.
    rows, columns = np.indices((480, 640))
    sight = CAMERA.deproject(np.stack([columns, rows], -1).reshape(-1, 2), np.ones(480 * 640))
    along = sight @ middle / np.linalg.norm(sight, axis=1)
    inside = (middle @ middle - along**2 < radius**2).reshape(480, 640)
    view = plane_view(0.5)
    view.owner[inside] = 0
    truth = truth_of(bed, view, CAMERA)
    ys, xs = np.nonzero(inside)
    assert truth.center[0] == pytest.approx([xs.mean(), ys.mean()], abs=0.1)
    assert truth.radius[0] == pytest.approx(np.sqrt(inside.sum() / np.pi), rel=2e-3)
    assert truth.visible[0] > 0.995
    assert truth.apex[0] == pytest.approx(seen(bed, (center + radius * axis)[None])[0], abs=2e-5)
    assert truth.axis[0] == pytest.approx([0, -0.6, -0.8])
    assert truth.diameter[0] == pytest.approx(2 * radius, rel=1e-3)
    ray = CAMERA.deproject(truth.center, np.ones(1))[0]
    assert np.linalg.norm(truth.surface[0] - middle) == pytest.approx(radius, rel=1e-3)
    assert np.cross(truth.surface[0], ray) == pytest.approx(np.zeros(3), abs=1e-9)
    assert truth.ignore[0] == Ignore.COUNTS


def test_a_ray_that_misses_hits_nothing():
    mesh = ball(np.zeros(3), 1.0)
    assert first_hit(mesh, np.array([0, 0.1, 3]), np.array([0.0, 0, -1])) == pytest.approx(
        3 - np.sqrt(0.99), abs=1e-3
    )
    assert np.isnan(first_hit(mesh, np.array([0, 1.1, 3]), np.array([0.0, 0, -1])))


@pytest.mark.parametrize("seed", range(4))
def test_a_drawn_bed_can_stand(seed):
    bed = drawn(np.random.default_rng(seed), HALF)
    whole = [m for m in bed.mushrooms if m.rest is not None]
    assert len(whole) > 10
    for m in bed.mushrooms:
        assert np.isfinite(m.skin.vertices).all()
        assert np.linalg.norm(m.axis) == pytest.approx(1)
        assert ((m.skin.colors > 0) & (m.skin.colors < 1.2)).all()
    assert np.linalg.det(bed.rotation) == pytest.approx(1)
    at = seen(bed, np.zeros((1, 3)))[0]
    assert at == pytest.approx([0, 0, bed.distance])


@pytest.mark.parametrize("color", things.CAP_COLORS)
def test_a_cap_is_about_as_wide_as_asked(color):
    rng = np.random.default_rng(5)
    for _ in range(10):
        skin, gills = things.cap(0.02, color, rng)
        wide = np.hypot(*skin.vertices[:, :2].T).max()
        assert 0.018 < wide < 0.026
        assert skin.vertices[:, 2].max() < 0.025
        assert gills.vertices[:, 2].max() < skin.vertices[:, 2].max()


def test_the_shadow_of_a_step_is_as_wide_as_two_devices_make_it():
    z = np.full((3, 640), 0.5)
    z[:, 200:260] = 0.4
    power = 610 * 0.047
    width = np.flatnonzero(_hidden(z, power)[1])
    assert width[0] == 260  # on the far side of the step
    assert len(width) == pytest.approx(power * (1 / 0.4 - 1 / 0.5), abs=1.5)


@pytest.mark.parametrize(("sensor", "sigma"), [(coded_light, 0.0009), (stereo, 0.0014)])
def test_depth_of_a_plane_is_unbiased_but_for_the_offset(sensor, sigma):
    depth = sensor(plane_view(0.5), 610.0, np.random.default_rng(1))
    known = depth[depth > 0] * UNIT
    assert (depth > 0).mean() > 0.9
    assert known.mean() == pytest.approx(0.5 + OFFSET, abs=2e-4)
    assert known.std() == pytest.approx(sigma, rel=0.15)


@pytest.mark.parametrize("sensor", [coded_light, stereo])
def test_beyond_the_bed_depth_is_missing(sensor):
    view = plane_view(0.5)
    view.depth[:, 400:] = np.inf
    depth = sensor(view, 610.0, np.random.default_rng(1))
    assert not depth[:, 403:].any()
    assert depth[:, :300].any()


def test_a_stump_is_cut_across():
    up = turned_to(np.array([0.0, 0, 1]), 0.0)
    assert up == pytest.approx(np.eye(3))
    mesh = things.stump(np.zeros(3), 0.006, 0.01, np.random.default_rng(0))
    assert mesh.vertices[:, 2].max() == pytest.approx(0.01, abs=1e-9)
