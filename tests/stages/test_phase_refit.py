"""Outlines fitted to edge points that were laid on known ones."""

from __future__ import annotations

import numpy as np
import pytest

from mushpipe.core.arrays import Floats
from mushpipe.stages.discs import Radii
from mushpipe.stages.phase.depth import NO_RELIEF
from mushpipe.stages.phase.edges import Edges
from mushpipe.stages.phase.polish import polish
from mushpipe.stages.phase.refit import refit
from mushpipe.stages.phase.strips import Strips, in_strips

RADII = Radii(8.0, 45.0)
TRUE = (81.3, 60.8, 24.0, 1.6, -1.1)


def ring(shape: tuple[float, ...], low: float = 0, high: float = 360, count: int = 180) -> Floats:
    """Edge points (5, M) of an outline, between two angles in degrees, that face its centre."""
    x, y, r, p, q = shape
    t = np.radians(np.linspace(low, high, count, endpoint=False))
    away = r + p * np.cos(2 * t) + q * np.sin(2 * t)
    c, s = np.cos(t), np.sin(t)
    return np.stack([x + away * c, y + away * s, -c, -s, np.ones(count)])


def strips(*rings: Floats) -> Strips:
    columns = np.concatenate(rings, axis=1).astype(np.float32)
    return in_strips(Edges(*columns), 120, 160)


def candidates(*rows: tuple[float, float, float]) -> np.ndarray:
    return np.array([(*row, 1.0) for row in rows], np.float32)


def test_an_outline_is_found_from_beside_it_and_once() -> None:
    edges = strips(ring(TRUE))
    starts = candidates((81, 61, 24), (84, 58, 22), (79, 63, 26))
    shapes, hits, residual = refit(edges, NO_RELIEF, starts, RADII)
    assert len(shapes) == 1
    # what is expected of an oval is small, which draws p and q a little to 0
    assert shapes[0] == pytest.approx(TRUE, abs=0.06)
    assert residual[0] < 0.1
    found = hits[0][hits[0] != -2]
    assert len(found) == int(np.pi * shapes[0, 2])  # a direction every 2 px
    assert (found >= 0).all()


def test_points_far_off_and_such_as_face_away_move_nothing() -> None:
    rng, clean = np.random.default_rng(0), ring(TRUE)
    turned = ring((81.3, 60.8, 22.0, 0.0, 0.0))
    turned[2:4] *= -1
    stray = np.stack([rng.uniform(0, 160, 60), rng.uniform(0, 120, 60), *np.zeros((3, 60))])
    turn = rng.uniform(0, 2 * np.pi, 60)
    stray[2:] = np.cos(turn), np.sin(turn), np.ones(60)
    starts = candidates((81, 61, 24))
    (alone,), *_ = refit(strips(clean), NO_RELIEF, starts, RADII)
    (among,), *_ = refit(strips(clean, turned, stray), NO_RELIEF, starts, RADII)
    assert among == pytest.approx(alone, abs=0.15)


@pytest.mark.parametrize("share", [0.11, 0.25])
def test_hardly_an_outline_is_none(share: float) -> None:
    edges = strips(ring((*TRUE[:3], 0, 0), 0, 360 * share, round(1500 * share)))
    shapes, *_ = refit(edges, NO_RELIEF, candidates(TRUE[:3]), RADII)
    assert (len(shapes) > 0) == (share > 0.15)


def test_radii_beyond_the_range_are_left_out() -> None:
    edges = strips(ring((80, 60, 30, 0, 0)))
    for radii, count in ((Radii(8, 45), 1), (Radii(8, 25), 0), (Radii(36, 45), 0)):
        assert len(refit(edges, NO_RELIEF, candidates((80, 60, 30)), radii)[0]) == count


UPPER, LOWER = (60.0, 60.0, 20.0, 0.0, 0.0), (88.0, 60.0, 20.0, 0.0, 0.0)
OFF = (1.0, -0.8, 0.7, 0, 0)


def polished(false: Floats, owned: bool) -> Floats:
    """The lower of two circles, begun beside it, where false edges lie on the side that dips."""
    own, upper = ring(LOWER, -120, 120, 60), ring(UPPER)
    edges = strips(own, upper, false)
    at = np.stack([edges.x, edges.y])
    owner = np.full(len(edges.x), -1, np.int32)
    for points, number in ((upper, 0), (own, 1), (false, 0)):
        same = (
            np.abs(at[:, :, None] - points[:2, None, :]).max(axis=0).min(axis=1, initial=1) < 1e-3
        )
        owner[same] = number if points is not false or owned else -1
    outlines = np.array([UPPER, LOWER]) + np.array([[0.0] * 5, OFF])
    polish(edges, NO_RELIEF, outlines, owner, RADII)
    assert outlines[0] == pytest.approx(UPPER, abs=0.05)
    return outlines[1]


def test_an_accepted_outline_is_fitted_to_what_is_its_own() -> None:
    nothing = np.zeros((5, 0))
    assert polished(nothing, True) == pytest.approx(LOWER, abs=0.05)
    # an inner ring on the open side, which is another's
    shade = ring((88, 60, 18.8, 0, 0), -50, 50, 240)
    assert polished(shade, True) == pytest.approx(LOWER, abs=0.05)
    assert np.abs(polished(shade, False) - LOWER).max() > 0.2
    # nobody's, but just outside the circle above, in whose shade it lies
    t = np.radians(np.concatenate([np.linspace(-56, -38, 200), np.linspace(38, 56, 200)]))
    c, s = np.cos(t), np.sin(t)
    beside = np.stack([60 + 22 * c, 60 + 22 * s, c * 0 + 1, -np.sign(s) * 0.3, c * 0 + 1])
    beside[2:4] /= np.hypot(*beside[2:4])
    assert polished(beside, False) == pytest.approx(LOWER, abs=0.05)


def test_an_outline_that_would_leave_its_place_or_the_range_stays() -> None:
    edges = strips(ring(LOWER, count=900))
    owner = np.full(len(edges.x), 0, np.int32)
    for start, radii in (
        ((88.0, 60.0, 23.9, 0.0, 0.0), RADII),  # too large by more than 0.15 of the radius
        ((88.5, 60.0, 20.5, 0.0, 0.0), Radii(25.0, 45.0)),
    ):
        outlines = np.array([start])
        polish(edges, NO_RELIEF, outlines, owner, radii)
        assert outlines[0].tolist() == list(start)
