"""The kernels of the fit against slow computations in double precision, and closed forms."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.optimize import brentq

from mushpipe.stages.cap.batch import TOLD, locate
from mushpipe.stages.cap.linear import cholesky, invert, multiply, substitute, tukey
from mushpipe.stages.cap.model import (
    BULGE,
    E1,
    E2,
    HEIGHT,
    LIP,
    RADIUS,
    ROOM,
    SIZE,
    UNKNOWNS,
    N,
    fill_rows,
    move,
    span,
)
from mushpipe.stages.cap.outline import LANES_ROOM, LINES, find_steepest, vertex
from mushpipe.stages.cap.samples import DIRECTIONS
from mushpipe.stages.cap.solve import (
    BULGE_LIMIT,
    ROUND,
    STEPS,
    Habit,
    Noise,
    add_priors,
    limit,
    refine,
    tilt,
    variance_of_tilt,
    weigh,
    weigh_circle,
    workspace,
)
from mushpipe.stages.cap.start import STEEPEST, USUAL, axis_of, lean

NOISE = Noise(0.027, 0.03, 1.0, 0.2, 0.02, 0.08, 15.0, 0.25)
R = 0.02
STEP = np.array([1e-7] * 3 + [1e-5] * 2 + [1e-7] * 2 + [1e-5])  # of the unknowns: m, rad, bulge
SOME = [(0.0, 0.5), (0.06, 0.7), (-0.06, 0.9)]  # bulge and aspect


def parameters(
    axis: Any, aspect: float, bulge: float = 0.0, at: Any = (0.03, -0.02, 0.41)
) -> np.ndarray:
    state = np.zeros(SIZE)
    state[:3], state[N : N + 3] = at, np.array(axis) / np.linalg.norm(axis)
    state[RADIUS], state[HEIGHT], state[BULGE] = R, aspect * R, bulge
    span(state)
    return state


def outside(point: np.ndarray, state: np.ndarray, dome: bool) -> float:
    """F - 1 - b w at a point, in one half of a cap."""
    q, radius, height = point - state[:3], state[RADIUS], state[HEIGHT]
    s = q @ state[N : N + 3]
    k = height if dome else LIP * radius
    f = np.sqrt((q @ q - s * s) / radius**2 + s * s / k**2)
    x = s * s / (k * f) ** 2
    return float(f - 1 - (4 * state[BULGE] * x * (1 - x) if dome else 0))


def moved(state: np.ndarray, k: int, by: float) -> np.ndarray:
    """The cap with its kth unknown moved."""
    new = state.copy()
    if k in (3, 4):
        axis = new[N : N + 3] + by * new[(E1, E2)[k - 3] :][:3]
        new[N : N + 3] = axis / np.linalg.norm(axis)
    else:
        new[(0, 1, 2, -1, -1, RADIUS, HEIGHT, BULGE)[k]] += by
    return new


def rows_of(state: np.ndarray, rays: np.ndarray) -> np.ndarray:
    """What `fill_rows` says of rays (4 or more, M)."""
    flat = np.zeros(14 * ROOM, np.float32)
    fill_rows(state, rays.astype(np.float32), rays.shape[1], flat)
    return flat.reshape(14, ROOM)[:10, : rays.shape[1]]


def met(state: np.ndarray, ray: np.ndarray, touches: bool) -> tuple[float, bool, bool]:
    """Where a ray meets the cap without its bulge, m; whether on the dome, and whether it hits.

    The range is that of the first point inside of F = 1, or of the least F.
    """
    plain = state.copy()
    plain[BULGE] = 0.0
    found = []
    for dome in (True, False):
        far = np.linalg.norm(state[:3]) + R * np.array([-1.0, 0.0, 1.0])
        squares = [(outside(t * ray, plain, dome) + 1) ** 2 for t in far]
        a, b, c = np.polyfit(far, squares, 2)  # F^2 is a parabola along the ray
        least = -b / (2 * a)
        hits = c - a * least**2 < 1
        enters = least - np.sqrt(max(0.0, 1 - (c - a * least**2)) / a)
        found.append((least if touches else enters, dome, hits))
    on_dome = (found[0][0] * ray - state[:3]) @ state[N : N + 3] > 0
    return found[0] if on_dome else found[1]


@pytest.mark.parametrize(("bulge", "aspect"), SOME)
@pytest.mark.parametrize("touches", [False, True])
def test_rows_are_the_derivatives_of_the_distance_to_the_surface(
    bulge: float, aspect: float, touches: bool
) -> None:
    state, rng = parameters([0.4, -0.2, -0.85], aspect, bulge), np.random.default_rng(2)
    turn = rng.uniform(0, 2 * np.pi, 60)
    off = np.append(rng.uniform(0, 1, 30), rng.uniform(0.85, 1.15, 30))  # many near the outline
    target = state[:3] + R * np.column_stack([off * np.cos(turn), off * np.sin(turn), 0 * off])
    far = np.linalg.norm(target, axis=1)
    rays = np.vstack([(target / far[:, None]).T, 0 * far if touches else far - 0.3 * R])
    rows, seen = rows_of(state, rays), set()
    for j in range(len(far)):
        ray = rays[:3, j] / np.linalg.norm(rays[:3, j])
        t, dome, hits = met(state, ray, touches)
        point = t * ray
        slope = np.array(
            [
                (outside(point + e, state, dome) - outside(point - e, state, dome)) / 2e-8
                for e in 1e-8 * np.eye(3)
            ]
        )
        steep = np.linalg.norm(slope)
        change = [
            (
                outside(point, moved(state, k, STEP[k]), dome)
                - outside(point, moved(state, k, -STEP[k]), dome)
            )
            / (2 * STEP[k] * steep)
            for k in range(UNKNOWNS)
        ]
        cosine = abs(slope @ ray) / steep if hits and not touches else float(touches)
        residual = outside(point, state, dome) / steep
        if hits and not touches:
            residual += cosine * (t - rays[3, j])
        unit = np.array([1, 1, 1, R, R, 1, 1, R])
        assert rows[:8, j] / unit == pytest.approx(np.array(change) / unit, abs=1e-3)
        assert rows[8, j] / R == pytest.approx(residual / R, abs=1e-4)
        assert rows[9, j] == pytest.approx(cosine, abs=1e-3)
        assert (rows[9, j] == 0) == (not hits and not touches)
        seen.add((dome, hits))
    assert len(seen) >= 3


@given(st.tuples(*[st.floats(-1, 1)] * 3).filter(lambda v: np.linalg.norm(v) > 0.1))
def test_the_span_is_that_of_the_plane_across_the_axis(axis: tuple[float, float, float]) -> None:
    state = parameters(axis, 0.6)
    move(state, np.array([0, 0, 0, 0.3, -0.2, 0, 0, 0]))
    for cap in (state, parameters(axis, 0.6), parameters([0, 0, np.copysign(1, axis[2])], 0.6)):
        basis = np.array([cap[E1 : E1 + 3], cap[E2 : E2 + 3], cap[N : N + 3]])
        assert basis @ basis.T == pytest.approx(np.eye(3), abs=1e-9)


def system_of(seed: int) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Normal matrix and gradient by `multiply`, and as numpy has them."""
    rng, count = np.random.default_rng(seed), 48
    flat = rng.normal(size=14 * ROOM).astype(np.float32)
    weights = rng.uniform(0, 2, ROOM).astype(np.float32)
    normal, gradient = np.full((UNKNOWNS, UNKNOWNS), np.nan), np.empty(UNKNOWNS)
    multiply(flat, weights, count, (normal, gradient))
    rows = flat.reshape(14, ROOM)[: UNKNOWNS + 1, :count].astype(float)
    exact = (rows * weights[:count]) @ rows.T
    return normal, gradient, exact[:UNKNOWNS, :UNKNOWNS], exact[UNKNOWNS, :UNKNOWNS]


@pytest.mark.parametrize("seed", range(5))
def test_normal_equations_are_built_solved_and_inverted_as_numpy_does(seed: int) -> None:
    normal, gradient, exact, right = system_of(seed)
    lower = np.tril_indices(UNKNOWNS)
    assert normal[lower] == pytest.approx(exact[lower], abs=1e-4)
    assert gradient == pytest.approx(right, abs=1e-4)
    assert cholesky(normal)
    substitute(normal, gradient)
    assert gradient == pytest.approx(np.linalg.solve(exact, right), abs=1e-4)
    inverse, copy = np.linalg.inv(exact), normal.copy()
    assert variance_of_tilt(copy) == pytest.approx((inverse[3, 3] + inverse[4, 4]) / 2, rel=1e-4)
    found = np.empty((UNKNOWNS, UNKNOWNS))
    invert(normal, found)
    assert found == pytest.approx(inverse, abs=1e-5)


def test_a_matrix_that_is_not_positive_definite_is_refused() -> None:
    matrix = np.eye(UNKNOWNS)
    matrix[6, 6] = -1.0
    assert not cholesky(matrix)
    for wrong in (0.0, np.inf, np.nan):
        matrix = np.eye(UNKNOWNS)
        matrix[7, 7] = wrong
        assert not cholesky(matrix)


@given(st.floats(0, 100), st.floats(1, 50))
def test_tukey_is_the_biweight(squared: float, cut: float) -> None:
    exact = (1 - squared / cut) ** 2 if squared < cut else 0.0
    assert tukey(np.float32(squared), np.float32(cut)) == pytest.approx(exact, abs=1e-5)


@given(st.floats(0, 0.6), st.floats(0, 2 * np.pi), st.floats(0, 0.8))
def test_a_tilt_is_the_turn_from_the_upright_to_the_axis(
    angle: float, turn: float, lean: float
) -> None:
    state = parameters([np.sin(lean), 0.3, -np.cos(lean)], 0.6)
    axis, e1, e2 = state[N : N + 3], state[E1 : E1 + 3], state[E2 : E2 + 3]
    way = np.cos(turn) * e1 + np.sin(turn) * e2
    up = np.cos(angle) * axis - np.sin(angle) * way  # from there it is `angle` along `way`
    expected = angle * np.array([np.cos(turn), np.sin(turn)])
    assert tilt(state, tuple(up)) == pytest.approx(expected, abs=1e-6)


def test_priors_are_the_slope_and_the_bend_of_what_they_cost() -> None:
    up, state = np.array([0.1, -0.1, -0.99]), parameters([0.3, -0.2, -0.9], 0.8, 0.05)
    up /= np.linalg.norm(up)
    habit = Habit(tuple(up), 0.2, 0.6)

    def off(cap: np.ndarray) -> np.ndarray:
        """What costs half its square, but for the tilt, in sigmas."""
        aspect = (cap[HEIGHT] - habit.aspect * cap[RADIUS]) / (NOISE.aspect_sigma * R)
        return np.array([aspect, (cap[BULGE] - NOISE.bulge) / NOISE.bulge_sigma])

    def cost(cap: np.ndarray) -> float:
        angle = np.arccos(cap[N : N + 3] @ up)
        return float(off(cap) @ off(cap) + (angle / habit.spread) ** 2) / 2

    normal, gradient = np.zeros((UNKNOWNS, UNKNOWNS)), np.zeros(UNKNOWNS)
    add_priors(state, habit, NOISE, (normal, gradient))
    ends = [[moved(state, k, sign * STEP[k]) for k in range(UNKNOWNS)] for sign in (1, -1)]
    slopes = np.array([cost(a) - cost(b) for a, b in zip(*ends, strict=True)]) / (2 * STEP)
    assert gradient == pytest.approx(slopes, rel=1e-4, abs=1e-4)
    jacobian = np.array([off(a) - off(b) for a, b in zip(*ends, strict=True)]) / (2 * STEP)[:, None]
    bend = jacobian @ jacobian.T + np.diag([0, 0, 0, 1, 1, 0, 0, 0]) / habit.spread**2
    lower = np.tril_indices(UNKNOWNS)
    assert normal[lower] == pytest.approx(bend[lower], rel=1e-4)


def circle_rays(state: np.ndarray) -> np.ndarray:
    """The rays (6, ROUND) of the circle of a cap that points at the camera."""
    turn = 2 * np.pi * np.arange(ROUND) / ROUND
    offset = R * np.array([np.cos(turn), np.sin(turn), 0 * turn])
    rays = np.zeros((6, ROUND))
    rays[:3] = state[:3, None] + offset
    rays[:3] /= np.linalg.norm(rays[:3], axis=0)
    return rays


def test_a_circle_tells_its_centre_and_radius_each_with_its_variance_and_no_more() -> None:
    state, variance = parameters([0, 0, -1], 0.6, at=(0, 0, 2.0)), 4e-8
    rows, weights = rows_of(state, circle_rays(state)), np.zeros(ROOM, np.float32)
    weigh_circle(rows, variance, 9.0, weights)
    told = (rows[:UNKNOWNS, :3] * weights[:3]) @ rows[:UNKNOWNS, :3].T * variance
    # x, y, z and radius; seen from far away, z next to nothing
    some = np.ix_([0, 1, 2, 5], [0, 1, 2, 5])
    assert told[some] == pytest.approx(np.diag([1.0, 1.0, 0.0, 1.0]), abs=0.02)
    state[0] += 4e-4  # two sigmas, of which the cut is 3
    rows = rows_of(state, circle_rays(parameters([0, 0, -1], 0.6, at=(0, 0, 2.0))))
    weigh_circle(rows, variance, 9.0, weights)
    robust = (1 - 4 / 9) ** 2
    assert weights[:3] * variance == pytest.approx([1, 4 * robust, 4], rel=0.01)


@pytest.mark.parametrize("slack", [0.0, 0.3])
def test_a_circle_is_as_sure_as_its_pixels_the_outline_and_the_border_let_it(slack: float) -> None:
    """A cap that points at the camera, of which depth shows but the apex: it says nothing of x."""
    state, pixel, work = parameters([0, 0, -1], 0.6, at=(0, 0, 2.0)), 1e-4, workspace()
    rays = np.full((6, ROOM), 0.3, np.float32)
    rays[:, :ROUND] = circle_rays(state)
    rays[:, ROUND] = 0, 0, 1, 2.0 - 0.6 * R, 1e-4, 1.0
    setting = (NOISE._replace(bulge=0.0), pixel, R, slack)
    refine(state, rays, ROUND + 1, Habit((0.0, 0.0, -1.0), 0.2, 0.6), setting, 0, 1, work)
    covariance = np.empty((UNKNOWNS, UNKNOWNS))
    invert(work[0][0], covariance)
    sigmas = [NOISE.circle_px * pixel * 2.0, NOISE.outline * R, slack * R]
    expected = np.square(sigmas).sum()
    assert covariance[0, 0] == pytest.approx(expected, rel=0.02)
    assert covariance[1, 1] == pytest.approx(expected, rel=0.02)


@pytest.mark.parametrize("step", [0, STEPS - 1, STEPS])
def test_weights_are_those_of_independent_rays_with_their_sigmas(step: int) -> None:
    """Of a surface, an outline and rays beside the cap, by hand."""
    rng, count, pixel = np.random.default_rng(4), 48, 1 / 400
    rows, rays = np.zeros((14, ROOM), np.float32), np.zeros((6, ROOM), np.float32)
    rays[3, :count] = np.where(np.arange(count) % 3 == 0, 0.0, 0.4)
    rays[4, :count], rays[5, :count] = rng.uniform(2e-4, 1e-3, (2, count)) * [[1], [500]]
    beside = (np.arange(count) % 5 == 0) & (rays[3, :count] > 0)
    rows[9, :count] = np.where(beside, 0, np.where(rays[3, :count] > 0, 0.8, 1.0))
    rows[8, :count] = rng.normal(0, 2e-3, count)
    weights = np.zeros(ROOM, np.float32)
    total, misfit = weigh(rows, rays, count, NOISE, pixel, R, step, weights)
    exact, squares, shares, robust = np.zeros(count), 0.0, 0.0, 0.0
    for j in range(count):
        touches = rays[3, j] == 0
        sigmas = [(NOISE.outline if touches else NOISE.shape) * R, rays[4, j] * rows[9, j]]
        sigmas += [0.7 * pixel * 0.4] * bool(beside[j])
        variance = np.square(sigmas).sum()
        cut = [25.0, 9.0, 9.0][[0, 3, 4].index(step)] if touches else (400.0 if not step else 16.0)
        squared = rows[8, j] ** 2 / variance
        weight = max(0.0, 1 - squared / cut) ** 2
        exact[j] = rays[5, j] * weight / variance
        squares, shares = squares + rays[5, j] * min(squared, cut), shares + rays[5, j]
        robust += 0 if touches else weight
    if step:  # what fits badly, or well, says how much the sigmas are worth
        exact *= (NOISE.firm + shares) / (NOISE.firm + squares / NOISE.usual)
    assert weights[:count] == pytest.approx(exact, rel=1e-4)
    assert total == pytest.approx(robust, rel=1e-4)
    assert misfit == pytest.approx(squares / shares, rel=1e-4)


@given(st.lists(st.floats(-3, 3), min_size=8, max_size=8), st.floats(0.7, 1.5))
def test_a_step_stays_where_the_model_is_meant(steps: list[float], size: float) -> None:
    state, step = parameters([0.2, 0, -1], 0.6), np.array(steps) * [R, R, R, 1, 1, R, R, 1]
    asked = step.copy()
    limit(state, step, size * R)
    length, turn = np.linalg.norm(step[:3]), np.hypot(step[3], step[4])
    assert length <= 0.35 * size * R * (1 + 1e-9)
    assert turn <= 0.35 * (1 + 1e-9)
    assert np.linalg.norm(np.cross(step[:3], asked[:3])) < 1e-12  # only shorter
    assert step[3] * asked[4] == pytest.approx(step[4] * asked[3])
    assert step[:3] @ asked[:3] >= 0
    radius, height, bulge = state[6:9] + step[5:8]
    assert max(0.8, 0.6 * size) * R - 1e-12 <= radius <= min(1.2, 1.6 * size) * R + 1e-12
    assert 0.08 * radius - 1e-12 <= height <= 1.3 * 1.6 * size * R + 1e-12
    assert abs(bulge) <= BULGE_LIMIT + 1e-12
    small = 0.05 * asked / 3
    inside = small.copy()
    limit(state, inside, R)
    assert inside == pytest.approx(small, abs=1e-15)


def surface(state: np.ndarray, ray: np.ndarray) -> np.ndarray:
    """Where a ray meets a cap first."""

    def at(t: float) -> float:
        point = t * ray
        return outside(point, state, bool((point - state[:3]) @ state[N : N + 3] > 0))

    far = np.linalg.norm(state[:3]) + np.linspace(-1.6, 0.2, 200) * R
    first = next(k for k in range(199) if at(far[k]) > 0 >= at(far[k + 1]))
    return np.asarray(brentq(at, far[first], far[first + 1], xtol=1e-15) * ray)


def test_a_cap_like_any_other_is_found_exactly() -> None:
    """Where priors, circle, points and outline all say the same, no start makes a difference."""
    axis = np.array([0.1, -0.05, -1.0]) / np.linalg.norm([0.1, -0.05, -1.0])
    true = parameters(axis, 0.6, 0.0, (0.0, 0.0, 0.4))
    rng, work = np.random.default_rng(6), workspace()
    rays, n = np.full((6, ROOM), 0.3, np.float32), ROUND  # of others before, beyond its own
    for x, y in rng.uniform(-0.65, 0.65, (60, 2)):
        ray = np.array([R * x, R * y, 0.4]) / np.linalg.norm([R * x, R * y, 0.4])
        point = surface(true, ray)
        rays[:, n] = *ray, np.linalg.norm(point), 3e-4, 0.5
        n += 1
    habit, noise = Habit(tuple(axis), 0.4, 0.6), NOISE._replace(bulge=0.0)
    turn = 2 * np.pi * np.arange(ROUND) / ROUND
    for j in range(ROUND):  # the outline, where a ray of its direction touches

        def passes(reach: float, j: int = j) -> float:
            ray = np.array([reach * np.cos(turn[j]), reach * np.sin(turn[j]), 0.4])
            ray /= np.linalg.norm(ray)
            t, dome, _ = met(true, ray, True)
            return outside(t * ray, true, dome)

        reach = brentq(passes, 0.7 * R, 1.4 * R)
        ray = np.array([reach * np.cos(turn[j]), reach * np.sin(turn[j]), 0.4])
        rays[:, j] = *ray / np.linalg.norm(ray), 0, 0, 0
    found = moved(moved(moved(moved(true, 3, 0.2), 5, 0.1 * R), 6, 0.2 * R), 1, 0.2 * R)
    span(found)
    total, misfit = refine(found, rays, n, habit, (noise, 1 / 400, R, 0.0), 0, 12, work)
    assert total == pytest.approx(60, abs=0.01)
    assert misfit < 1e-4
    assert found[:3] == pytest.approx(true[:3], abs=2e-6)
    assert found[N : N + 3] == pytest.approx(axis, abs=1e-4)
    assert found[RADIUS : HEIGHT + 1] == pytest.approx(true[RADIUS : HEIGHT + 1], abs=2e-6)
    assert found[BULGE] == pytest.approx(0, abs=1e-4)


COVARIANCE = np.random.default_rng(7).normal(size=(2 * UNKNOWNS, UNKNOWNS))
COVARIANCE *= [3e-4, 3e-4, 3e-4, 0.05, 0.05, 3e-4, 3e-4, 0.0]
COVARIANCE = COVARIANCE.T @ COVARIANCE / (2 * UNKNOWNS)


def located(state: np.ndarray, ray: np.ndarray, covariance: np.ndarray, sigma: float) -> np.ndarray:
    out = np.full(TOLD, np.nan)
    locate(state, tuple(ray), covariance, sigma, out)
    return out


@pytest.mark.parametrize("bulge", [0.0, 0.06])
@pytest.mark.parametrize("place", [(0.3, -0.2), (-0.4, 0.1), (0.0, 0.0)])
def test_a_point_is_where_the_ray_meets_the_cap_and_as_sure_as_the_cap_is_along_it(
    bulge: float, place: tuple[float, float]
) -> None:
    state = parameters([0.35, 0.2, -0.9], 0.6, bulge, (0.08, -0.06, 0.4))
    ray = state[:3] + R * np.array([*place, 0.0])
    ray /= np.linalg.norm(ray)
    change = [
        (surface(moved(state, k, STEP[k]), ray) - surface(moved(state, k, -STEP[k]), ray))
        / (2 * STEP[k])
        for k in range(UNKNOWNS)
    ]
    found = located(state, ray, COVARIANCE, 0.0)
    assert found[:3] == pytest.approx(surface(state, ray), abs=2e-7 if bulge == 0 else 1e-5)
    spread = np.sqrt(np.diag(np.transpose(change) @ COVARIANCE @ np.array(change)))
    assert found[3:6] == pytest.approx(spread, rel=1e-3 if bulge == 0 else 0.1)


@pytest.mark.parametrize("place", [(0.3, -0.2), (-0.4, 0.1), (0.0, 0.3)])
@pytest.mark.parametrize("centre", [(0.0, 0.0), (0.1, -0.07)])
def test_a_ray_that_is_off_moves_the_point_across_it_and_along_the_slope(
    place: tuple[float, float], centre: tuple[float, float]
) -> None:
    at = np.array([*centre, 0.4])
    on_axis = centre == (0.0, 0.0)
    ray = at / np.linalg.norm(at)
    state = parameters([0.35, 0.2, -0.9], 0.6, 0.0, at - R * np.array([*place, 0.0]))
    sigma, change = 1 / 400, []
    first = np.cross(ray, [0.0, 1.0, 0.0])
    first /= np.linalg.norm(first)
    for way in (first, np.cross(ray, first)):
        ends = [ray + sign * 1e-6 * way for sign in (1, -1)]
        points = [surface(state, end / np.linalg.norm(end)) for end in ends]
        change.append((points[0] - points[1]) / 2e-6)
    squares = sigma**2 * np.square(change).sum(axis=0)
    found = located(state, ray, np.zeros((UNKNOWNS, UNKNOWNS)), sigma)[3:6] ** 2
    assert found.sum() == pytest.approx(squares.sum(), rel=2e-3)
    if on_axis:  # elsewhere each coordinate is known but roughly
        assert found == pytest.approx(squares, rel=2e-3)


def test_a_ray_that_misses_the_cap_gives_a_number() -> None:
    state = parameters([0.35, 0.2, -0.9], 0.6)
    ray = state[:3] + R * np.array([1.3, 0.0, 0.0])
    ray /= np.linalg.norm(ray)
    found = located(state, ray, COVARIANCE, 1 / 400)[:6]
    assert found[:3] / np.linalg.norm(found[:3]) == pytest.approx(ray)
    assert np.linalg.norm(found[:3] - state[:3]) < 3 * R
    assert (found[3:] < 2 * R).all()
    assert (found[3:] > 0).all()


def dome_points(state: np.ndarray) -> np.ndarray:
    """Rays (6, M) to points all over the visible surface of a cap."""
    rays, ends = [], np.linspace(-0.9, 0.9, 13)
    for x, y in [(x, y) for x in ends for y in ends if np.hypot(x, y) < 0.95]:
        ray = state[:3] + R * np.array([x, y, 0.0])
        point = surface(state, ray / np.linalg.norm(ray))
        rays.append([*point / np.linalg.norm(point), np.linalg.norm(point), 1e-4, 0.5])
    return np.array(rays, np.float32).T.copy()


@pytest.mark.parametrize("toward", [(1, 0), (0, -1), (-0.6, 0.8)])
def test_a_fit_starts_near_the_axis_of_a_cap_as_high_as_is_usual(toward: tuple[int, int]) -> None:
    tilt = np.radians(20)
    axis = np.array([*(np.sin(tilt) * np.array(toward)), -np.cos(tilt)])
    state = parameters(axis, USUAL[0], at=(0.0, 0.0, 0.4))
    points = dome_points(state)
    found = axis_of(points, points.shape[1], (0.0, 0.0, -1.0), (0.0, 0.0, 1.0), USUAL[0])
    assert np.linalg.norm(found) == pytest.approx(1)
    assert np.degrees(np.arccos(np.dot(found, axis))) < 5  # the plane through them is 8 off


def test_points_on_a_line_leave_the_axis_to_the_upright() -> None:
    points = np.zeros((6, ROOM), np.float32)
    points[0], points[2], points[3] = np.linspace(-0.1, 0.1, ROOM), 1.0, 0.4
    up = (0.0, 0.6, -0.8)
    assert axis_of(points, 2, up, (0.0, 0.0, 1.0), 0.62) == up


def test_no_fit_starts_from_a_cap_seen_from_aside() -> None:
    """The plane through the points leans by an angle, the cap by a share more, to a limit."""
    for angle, expected in [(0.0, 0.0), (0.1, 0.1 / 0.75), (-0.3, -0.4), (0.8, STEEPEST)]:
        for beside in (0.0, 0.2):  # where the ray goes
            ray, axis = (np.sin(beside), np.cos(beside)), angle - beside
            leaning = np.sin(expected - beside), -np.cos(expected - beside)
            found = lean((np.sin(axis), 0.0, -np.cos(axis)), (ray[0], 0.0, ray[1]), 0.5)
            assert found == pytest.approx((leaning[0], 0.0, leaning[1]))
            found = lean((0.0, np.sin(axis), -np.cos(axis)), (0.0, *ray), 0.5)
            assert found == pytest.approx((0.0, *leaning))


@given(st.integers(6, 14), st.floats(-0.3, 0.3))
def test_the_steepest_fall_of_a_line_is_found_between_its_steps(step: int, beside: float) -> None:
    """Of a cubic the fall from two steps before to two after is a parabola around its middle."""
    count, row = 21, np.zeros(LANES_ROOM, np.float32)
    away = np.arange(count) - step - beside
    lanes = row[LINES : LINES + count * DIRECTIONS].reshape(count, DIRECTIONS)
    lanes[:] = (-0.05 * away + 0.002 * away**3)[:, None]
    lanes[:, 3] *= -1  # here it rises
    fall = 0.2 - 0.002 * (12 * beside**2 + 16)
    for j, sign in ((5, 1.0), (3, -1.0)):
        find_steepest(row, count, sign)
        assert vertex(row, j, count, sign) == pytest.approx((step + beside, fall), abs=1e-3)
