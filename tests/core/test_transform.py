"""Transforms as settings: written out in a graph, or in a file of their own."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from mushpipe.core.document import parse_document
from mushpipe.core.errors import GraphError
from mushpipe.core.graph import compile_document
from mushpipe.core.plugins import load_registry
from mushpipe.core.transform import Transform

GRAPH = """
mushpipe: 1
source: {{use: synthetic}}
stages:
  segment: {{use: otsu}}
  detect: {{use: hough}}
  locate: {{use: nearest-depth}}
  pick: {{use: picks, T_base_camera: {}}}
"""
INLINE = "{frame: base, translation: [0.1, 0, 1], quaternion: [1, 0, 0, 0]}"


def setting(folder: Path, text: str) -> object:
    document = parse_document(GRAPH.format(text), str(folder / "g.yaml"), folder)
    plan = compile_document(document, load_registry())
    return plan.stages[-1].plugin.T_base_camera  # type: ignore[attr-defined]


def test_a_file_means_the_same_as_its_content(tmp_path: Path) -> None:
    (tmp_path / "camera.yaml").write_text(
        "frame: base\ntranslation: [0.1, 0, 1]\nquaternion: [1, 0, 0, 0]\n"
    )
    written = Transform(frame="base", translation=(0.1, 0, 1), quaternion=(1, 0, 0, 0))
    assert setting(tmp_path, "camera.yaml") == setting(tmp_path, INLINE) == written


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (INLINE.replace("[1, 0, 0, 0]", "[1, 0, 0, 1]"), "must have length 1"),
        (INLINE.replace("[0.1, 0, 1]", "[100, 0, 1000]"), "was it given in mm?"),
        (INLINE.replace("frame", "fame"), "unknown setting 'fame'"),
        ("[[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0]]", "or matrix; expected frame, translation"),
        ("5", "Input should be an object, got 5"),
        ("missing.yaml", "missing.yaml: there is no such file"),
        ("bad.yaml", "expected frame, translation"),
        ("list.yaml", "list.yaml:1:1: expected a mapping such as 'frame: robot_base'; expected fr"),
    ],
)
def test_faults_are_reported_where_they_stand(tmp_path: Path, text: str, message: str) -> None:
    (tmp_path / "list.yaml").write_text("[[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0]]\n")
    (tmp_path / "bad.yaml").write_text("frame: base\ntranslation: [1, 2]\n")
    with pytest.raises(GraphError, match=r"T_base_camera|fame") as caught:
        setting(tmp_path, text)
    assert message in str(caught.value)
    assert "g.yaml:8:" in str(caught.value)


@given(
    angles=st.tuples(*[st.floats(-180, 180)] * 3),
    point=st.tuples(st.floats(-0.2, 0.2), st.floats(-0.2, 0.2), st.floats(0.3, 1)),
    along=st.floats(1e-4, 5e-3),
    share=st.floats(0.05, 1),
)
def test_spreads_of_what_a_camera_measures_turn_as_its_covariance(
    angles: tuple[float, ...], point: tuple[float, ...], along: float, share: float
) -> None:
    turn, ray = Rotation.from_euler("xyz", angles, degrees=True), np.array(point)
    ray /= np.linalg.norm(ray)
    across = along * share
    covariance = across**2 * np.eye(3) + (along**2 - across**2) * np.outer(ray, ray)
    turned = turn.as_matrix() @ covariance @ turn.as_matrix().T
    x, y, z, w = turn.as_quat()
    spreads = Transform(frame="b", translation=(0, 0, 0), quaternion=(x, y, z, w)).spreads(
        np.sqrt(np.diag(covariance))[None], np.array([point])
    )
    np.testing.assert_allclose(spreads[0], np.sqrt(np.diag(turned)), rtol=1e-6)


def test_spreads_are_independent_where_nothing_says_they_are_along_the_ray() -> None:
    quarter = Transform(frame="b", translation=(0, 0, 0), quaternion=(0, 0, 0.5**0.5, 0.5**0.5))
    sigmas = np.array([[0.001, 0.002, 0.001], [np.nan] * 3])
    spreads = quarter.spreads(sigmas, np.array([[0.1, 0.1, 0.5], [np.nan] * 3]))
    np.testing.assert_allclose(spreads, [[0.002, 0.001, 0.001], [np.nan] * 3])


def test_what_spreads_along_the_ray_alone_spreads_nowhere_across_it() -> None:
    rays = np.random.default_rng(0).uniform((-0.3, -0.3, 0.3), (0.3, 0.3, 1), (200, 3))
    rays /= np.linalg.norm(rays, axis=1, keepdims=True)
    for ray in rays:
        across = np.cross(ray, (0, 0, 1)) / np.hypot(*ray[:2])
        turn = Rotation.from_matrix([across, np.cross(ray, across), ray])
        x, y, z, w = turn.as_quat()
        spreads = Transform(frame="b", translation=(0, 0, 0), quaternion=(x, y, z, w)).spreads(
            0.003 * np.abs(ray)[None], ray[None]
        )
        np.testing.assert_allclose(spreads, [[0, 0, 0.003]], atol=1e-9)


def test_a_spread_that_is_infinite_stays_so() -> None:
    turned = Transform(frame="b", translation=(0, 0, 0), quaternion=(1, 0, 0, 0))
    sigmas = np.array([[0.001, 0.001, np.inf], [0.001, 0.001, 0.002]])
    spreads = turned.spreads(sigmas, np.array([[0.1, 0.1, 0.5]] * 2))
    assert np.isinf(spreads[0]).all()
    np.testing.assert_allclose(spreads[1], sigmas[1])
