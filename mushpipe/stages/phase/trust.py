"""How far a network is to be believed where it hardly sees a cap.

A network knows the caps that it was trained on. On a bed of others, dirty or small or under other
light, it misses many of which outline and depth are sure; there, that it sees little says little.
The bed itself tells: by how many of those candidates it sees. A few tell nothing: where caps are
few, cups and stones are among them, and there it is believed.
"""

from __future__ import annotations

import math

from mushpipe.core.arrays import Floats, Ints32
from mushpipe.core.jit import borrower
from mushpipe.stages.cap.kin import FEWEST

SURE = 0.95  # probability without the network from which on a candidate tells
SEEN = 0.5  # agreement from which on the network sees it
FAINT = 0.7  # agreement from which on it speaks for a candidate, and is believed anyway
USUAL, AMONG = 0.9, 10.0  # share that it sees of simulated caps, as if of so many more here
BLIND, SOUND = 0.8, 0.95  # share up to which it is not believed, and from which it wholly is


@borrower
def trust_in(
    shapes: Floats, alone: Floats, agreement: Floats, first: Ints32, beside: Ints32
) -> float:
    """Return how far, 0 to 1, a network is believed where it sees little.

    Args:
        shapes: (N, 5) outlines of candidates.
        alone: (N,) probability without the network, 0 of those that do not tell.
        agreement: (N,) of them with the network.
        first: (N + 1,) as from `phase.decide.neighbours`.
        beside: (M,) as well.
    """
    seen = sure = 0
    for k in range(len(shapes)):
        if alone[k] >= SURE and _leads(k, shapes, alone, beside[first[k] : first[k + 1]]):
            sure += 1
            seen += agreement[k] >= SEEN
    if sure < FEWEST:
        return 1.0
    share = (AMONG * USUAL + seen) / (AMONG + sure)
    return min(1.0, max(0.0, (share - BLIND) / (SOUND - BLIND)))


@borrower
def _leads(k: int, shapes: Floats, alone: Floats, beside: Ints32) -> bool:
    """Whether no outline on the same cap is more probable."""
    for m in beside:
        away = math.hypot(shapes[m, 0] - shapes[k, 0], shapes[m, 1] - shapes[k, 1])
        if away < max(shapes[m, 2], shapes[k, 2]) and (alone[m], m) > (alone[k], k):
            return False
    return True


@borrower
def mixed(trusted: float, alone: float, trust: float) -> float:
    """Return a probability whose logit lies between those of two, by the trust in the first."""
    both = trust * logit(trusted) + (1 - trust) * logit(alone)
    return float(1 / (1 + math.exp(-both)))


@borrower
def logit(chance: float) -> float:
    """Return the logarithm of the odds, finite at 0 and 1."""
    chance = min(max(chance, 1e-9), 1 - 1e-9)
    return math.log(chance / (1 - chance))
