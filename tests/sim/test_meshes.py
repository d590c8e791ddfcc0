"""Meshes and shapes: closed, turned outwards, of the stated form."""

import numpy as np
import pytest

from mushpipe.sim.mesh import Material, box, revolve, sheet, vertex_normals
from mushpipe.sim.mushroom import turned_to
from mushpipe.sim.noise import Noise3, blurred, generator
from mushpipe.sim.shapes import dome, draw_shape, margin, shaped, underside


def volume(mesh):
    """Enclosed volume by the divergence theorem; positive if all triangles face outwards."""
    a, b, c = (mesh.vertices[mesh.triangles[:, k]] for k in range(3))
    return float(np.einsum("tk,tk->", a, np.cross(b, c)) / 6)


def test_a_box_is_closed_and_faces_outwards():
    mesh = box((0.2, 0.3, 0.5), Material.PAPER)
    assert volume(mesh) == pytest.approx(0.03)
    assert mesh.vertices[:, 2].min() == 0
    normals = vertex_normals(mesh.vertices, mesh.triangles)
    assert (np.einsum("vk,vk->v", normals, mesh.vertices - [0, 0, 0.25]) > 0).all()


def test_a_ball_of_revolution():
    t = np.linspace(0, np.pi, 60)
    mesh = sheet(revolve(np.sin(t), np.cos(t), 120), Material.CAP)
    assert volume(mesh) == pytest.approx(4 / 3 * np.pi, rel=0.005)
    used = np.unique(mesh.triangles)
    normals = vertex_normals(mesh.vertices, mesh.triangles)[used]
    assert np.einsum("vk,vk->v", normals, mesh.vertices[used]).min() > 0.995


@pytest.mark.parametrize("family", ["a", "b"])
@pytest.mark.parametrize("age", [0.0, 0.5, 1.0])
def test_caps_are_closed_and_their_rim_is_flat(family, age):
    shape = draw_shape(np.random.default_rng(1), family, age)
    parts = [dome(shape, 40), margin(shape, 12), underside(shape, 0.3, 20)]
    pieces = [sheet(shaped(shape, *part, 96), Material.CAP) for part in parts]
    assert 0.3 < sum(map(volume, pieces)) < 4
    rim = shaped(shape, *dome(shape, 40), 96)[-1]
    normal = np.linalg.svd(rim - rim.mean(axis=0))[2][-1]
    assert np.degrees(np.arccos(abs(normal[2]))) < 1
    assert np.hypot(rim[:, 0], rim[:, 1]).mean() == pytest.approx(1, abs=0.02)


def test_no_cap_of_one_family_fits_the_other():
    """Every dome of family b is farther than 1.5 % of its radius from every superellipse."""
    rng = np.random.default_rng(0)
    share = np.linspace(0.05, 0.95, 50)
    exponents = np.linspace(1.8, 2.5, 40)[:, None]
    superellipses = (1 - share**exponents) ** (1 / exponents)
    for _ in range(60):
        shape = draw_shape(rng, "b", float(rng.uniform()))
        rho, z = dome(shape, 400)
        curve = np.interp(share, rho, z)
        best = (superellipses @ curve) / (superellipses**2).sum(axis=1)
        assert np.abs(curve - best[:, None] * superellipses).max(axis=1).min() > 0.015


def test_turned_to_is_a_rotation_that_takes_z_to_the_axis():
    rng = np.random.default_rng(0)
    for axis in [*rng.normal(size=(20, 3)), np.array([0, 0, 1.0]), np.array([0, 1.0, 0])]:
        axis = axis / np.linalg.norm(axis)
        rotation = turned_to(axis, 1.2)
        np.testing.assert_allclose(rotation @ rotation.T, np.eye(3), atol=1e-12)
        assert np.linalg.det(rotation) == pytest.approx(1)
        np.testing.assert_allclose(rotation[:, 2], axis)


def test_noise_is_standardised_and_its_streams_are_apart():
    field = blurred(generator(0, "ground"), (200, 300), 4.0)
    assert field.std() == pytest.approx(1, abs=0.05)
    streams = [generator(0, "depth frame", k).random() for k in (0, 1)]
    assert streams[0] != streams[1] != generator(1, "depth frame", 0).random()
    noise = Noise3(generator(0, "texture"))
    points = np.random.default_rng(0).uniform(0, 1, (5000, 3))
    assert noise(points, 0.01).std() == pytest.approx(1, abs=0.25)
    nearby = noise(points + 1e-5, 0.01)
    assert np.abs(nearby - noise(points, 0.01)).max() < 0.1
