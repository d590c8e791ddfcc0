from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from mushpipe import Mask
from mushpipe.core.arrays import Floats
from mushpipe.stages.phase.decide import decide, neighbours
from mushpipe.stages.phase.features import LEARNED, NAMES
from mushpipe.stages.phase.trust import mixed, trust_in
from mushpipe.stages.phase_hough import PhaseHough
from tests.stages.indifferent import indifferent
from tests.stages.scenes import discs, frame_of


def trust(alone: Floats, seen: Floats, apart: float = 50.0) -> float:
    """Trust where circles of 10 px stand in a row, so far apart."""
    shapes = np.zeros((len(alone), 5))
    shapes[:, 0], shapes[:, 2] = apart * np.arange(len(alone)), 10.0
    return float(trust_in(shapes, alone, seen, *neighbours(shapes)))


@given(st.integers(0, 100), st.integers(0, 100))
def test_trust_grows_with_the_share_of_sure_caps_that_the_network_sees(
    seen: int, unseen: int
) -> None:
    agreement = np.repeat([0.9, 0.1], [seen, unseen])
    now = trust(np.full(seen + unseen, 0.97), agreement)
    share = (9 + seen) / (10 + seen + unseen)
    expected = np.interp(share, (0.8, 0.95), (0, 1))
    assert now == pytest.approx(expected if seen + unseen >= 6 else 1)  # few tell nothing
    # what is no sure cap tells nothing, whatever the network says of it
    unsure = np.repeat([0.97, 0.5], [seen + unseen, 40])
    assert trust(unsure, np.append(agreement, np.zeros(40))) == now


def test_rivals_on_one_cap_count_once() -> None:
    """A rival agrees less with the network's circle than the cap does, as it should."""
    alone, agreement = np.tile([0.99, 0.96], 20), np.tile([0.9, 0.1], 20)
    assert trust(alone, agreement, apart=50) == 0
    shapes = np.zeros((40, 5))
    shapes[:, 0], shapes[:, 2] = 25.0 * np.arange(40) - np.tile([0, 20], 20), 10.0
    assert trust_in(shapes, alone, agreement, *neighbours(shapes)) == 1


@given(st.floats(0, 1), st.floats(0, 1), st.floats(0, 1))
def test_a_mixed_probability_lies_between_both(one: float, other: float, share: float) -> None:
    now = mixed(one, other, share)
    assert min(one, other) - 1e-8 <= now <= max(one, other) + 1e-8
    assert mixed(one, other, 1.0) == pytest.approx(one, abs=1e-8)
    assert mixed(one, other, 0.0) == pytest.approx(other, abs=1e-8)


@pytest.mark.parametrize(("agreement", "expected"), [(0.1, 0.96), (0.69, 0.2), (0.9, 0.2)])
def test_what_a_blind_network_hardly_sees_is_decided_without_it(
    agreement: float, expected: float
) -> None:
    """Of those that it does see it is believed, and where it sees all it may doubt the last one."""
    image = discs([(u, v, 12) for u in range(20, 300, 40) for v in range(20, 220, 40)], 0.8, 0.15)
    found = PhaseHough().gather(frame_of(image), Mask(image > 0.5))
    assert found is not None
    n = len(found.shapes)
    found.table[:, NAMES.index(LEARNED)] = agreement
    models = indifferent(0, np.log(0.96 / 0.04), 0, np.log(0.2 / 0.8))
    parts = (found.edges, found.shapes, found.hits, found.table)
    which = np.full(n, 3, np.int32)
    _, chance, *_ = decide(*parts, which, models, least=0.05, led=True)
    np.testing.assert_allclose(chance, expected, rtol=1e-5)
    _, chance, *_ = decide(*parts, which, models, least=0.05, led=False)
    np.testing.assert_allclose(chance, 0.2, rtol=1e-5)
