from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from mushpipe import Circles
from mushpipe.stages.cap.blocks import Image
from mushpipe.stages.cap.linear import solve3
from mushpipe.stages.cap.model import SIZE, span
from mushpipe.stages.cap.regrow import denials, regrow
from mushpipe.stages.cap.samples import DIRECTIONS
from mushpipe.stages.cap_fit import CapFit
from tests.stages.caps import CAMERA, cap, circles_of, draw, frame_from, image_of

BED = 0.44
LOW = cap(15, 60, (0, 0, 0.4), 0.022, 0.55)


def seen(*caps: object) -> Image:
    return image_of(draw(list(caps), BED)[0])


@given(st.integers(0, 2**31))
def test_three_equations_are_solved_as_numpy_does(seed: int) -> None:
    rows = np.random.default_rng(seed).normal(size=(3, 5))
    matrix, right = rows @ rows.T, rows[:, 0].copy()
    found, solution = solve3(tuple(matrix[np.triu_indices(3)]), tuple(right))
    assert found
    assert solution == pytest.approx(np.linalg.solve(matrix, right), rel=1e-6, abs=1e-6)


def test_equations_without_a_solution_are_refused() -> None:
    assert not solve3((1.0,) * 6, (1.0,) * 3)[0]


@pytest.mark.parametrize("wrong", [(4.0, 3.0, 0.8), (-5.0, 0.0, 1.25), (0.0, 6.0, 1.0)])
def test_a_surface_is_followed_to_where_it_ends(wrong: tuple[float, float, float]) -> None:
    circles = circles_of([LOW])
    true = np.append(circles.center[0], circles.radius[0])
    circle = true * [1, 1, wrong[2]] + [wrong[0], wrong[1], 0]
    found = np.empty(3)
    assert regrow(seen(LOW), (0, 1), circle, 0.395, found)
    assert np.abs(found - true).max() < 1.0


def test_a_surface_without_an_end_gives_no_circle() -> None:
    image = seen(LOW)
    endless = image._replace(depth=np.where(image.depth < BED, image.depth, np.float32(0)))
    circles = circles_of([LOW])
    circle = np.append(circles.center[0], circles.radius[0])
    assert not regrow(endless, (0, 1), circle, 0.395, np.empty(3))


@pytest.mark.parametrize("bias", [0.0, 0.018, -0.018])
def test_depth_denies_a_cap_that_is_too_small_or_too_large_and_no_other(bias: float) -> None:
    circles = circles_of([LOW])
    circle = np.append(circles.center[0], circles.radius[0])
    values = np.zeros(SIZE)
    values[:3], values[3:6], values[6:8] = LOW.center, LOW.axis, (LOW.radius, LOW.height)
    span(values)
    image = seen(LOW)
    image = image._replace(depth=image.depth + np.float32(bias))

    def count(image: Image, ranks: tuple[int, int], reach: float) -> int:
        outline = np.full(DIRECTIONS, reach * circle[2], np.float32)
        return denials(image, ranks, values, bias, circle, outline)

    assert count(image, (0, 1), 0.7) > 25
    assert count(image, (0, 1), 1.0) < 3
    assert count(image, (0, 1), 1.3) > 25
    # where another circle begins, what goes on may be its cap
    v, u = np.mgrid[: image.depth.shape[0], : image.depth.shape[1]]
    other = np.hypot(u - circle[0], v - circle[1]) > 0.75 * circle[2]
    image.ranks[:] = np.where(other, 1, 0)
    assert count(image, (0, 2), 0.7) == 0


@pytest.mark.parametrize("bias_mm", [0.0, 18.0, -18.0])
@pytest.mark.parametrize("wrong", [(7.0, 5.0, 1.3), (5.0, -6.0, 1.2), (12.0, 8.0, 0.8)])
def test_a_cap_is_found_in_a_circle_that_is_off(
    wrong: tuple[float, float, float], bias_mm: float
) -> None:
    depth, gray = draw([LOW], BED)
    depth += bias_mm / 1000
    circles = circles_of([LOW])
    shifted = Circles(circles.center + wrong[:2], circles.radius * wrong[2], circles.score)
    stage = CapFit(up="camera", edge_offset_px=0, depth_bias_mm=bias_mm)
    locations, poses, _ = stage.process(frame_from(depth, gray), shifted)
    assert poses.axis[0] @ LOW.axis > np.cos(np.radians(3))
    assert locations.diameter[0] == pytest.approx(0.044, abs=1.5e-3)


@pytest.mark.parametrize("wrong", [(16.0, 0.0, 0.7), (12.0, 8.0, 0.8), (-14.0, 0.0, 0.7)])
def test_it_is_the_cap_of_the_circle_that_depth_suggests_with_all_that_is_known_of_it(
    wrong: tuple[float, float, float],
) -> None:
    depth, gray = draw([LOW], BED)
    circles, grown = circles_of([LOW]), np.empty(3)
    shifted = Circles(circles.center + wrong[:2], circles.radius * wrong[2], circles.score)
    assert regrow(seen(LOW), (0, 1), np.append(shifted.center[0], shifted.radius), 0.395, grown)
    frame, stage = frame_from(depth, gray), CapFit(up="camera", edge_offset_px=0)
    found, same = (
        stage.fit(frame.gray, frame.depth_m, CAMERA, each)
        for each in (shifted, Circles([grown[:2]], grown[2:], circles.score))
    )
    for name in ("center", "axis", "radius", "height", "covariance", "fitness", "misfit"):
        np.testing.assert_allclose(getattr(found, name), getattr(same, name), 1e-4, 1e-9, name)
    assert (found.edges[0], found.lines[0]) == (same.edges[0], same.lines[0])
