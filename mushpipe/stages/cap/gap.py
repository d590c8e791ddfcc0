"""Where depth shows the edges of caps, beside where colour shows them.

A structured-light camera loses a little of each edge, a stereo camera shows caps wider than they
are, by what it matches at once: `cap-fit` takes that off, if it is told by how much. And where
depth is aligned badly to colour, all edges are shifted.
"""

from __future__ import annotations

import logging

import cv2
import numpy as np

from mushpipe import Circles, RgbdFrame
from mushpipe.core.arrays import Bools, Floats, Singles
from mushpipe.stages.calibrated import calibration_of

logger = logging.getLogger("mushpipe")

# Edges: enough to judge by, and how far from what was stated they may lie, px. At two, diameters
# are 1.5 mm off, and axes by 2 degrees more.
ENOUGH, AMISS, SHIFTED = 100, 1.5, 2.0
# After so many frames FEW are judged by, too, for a camera that stands still sees no others; they
# may lie UNSURE further off. It is looked again each time so many frames have come.
PATIENCE, FEW, UNSURE = 60, 12, 1.5
AGAIN = 300  # frames after which it is looked again where all was right
LATEST = 1000  # edges, and circles, that are kept
# Of so many places where a cap ends in colour, and depth is known all around, this share at least
# is an edge in depth as well, and lies as they usually do: on 147 beds 0.24 or more; with depth
# mirrored, turned, or 12 px and more beside colour half of them have 0.1 at most. And the same
# for a camera that stands still.
PLACES, CONFIRMED = 200, 0.2
FEW_PLACES, HARDLY = 40, 0.15
_OUTLIER = 2.0  # px from what is usual
# Least eigenvalue of the normal matrix; 0.5 where all sides are alike. A projector's shadow hides
# depth beside each cap on one side: beds have 0.05 to 0.3, and tell shifts of 5 px to about 1 px.
_LEAST_SPREAD = 0.05
MOST, LEAST_RADIUS = 40, 14  # circles that are looked at: so many, of this radius, px, or more
_DIRECTIONS, _STEP = 32, 0.5  # px between places along a direction
_REACH, _SHARE = 8.0, 0.3  # looked at to both sides of a circle: px, or share of its radius
_DROP_M, _DROP_SHARE = 0.004, 0.25  # least fall of an edge in depth: m, or share of the radius
_WIDE = 2  # steps to either side that a fall of luma is taken over
_LEAST_FALL = 0.06  # of luma


class EdgeWatch:
    """Looks at edges of caps until it can judge where depth shows them; tells what is amiss.

    It goes on looking, for cameras are knocked: what was right before must be amiss twice, and by
    `UNSURE` px more, since beds differ by some.

    Attributes:
        amiss_px: By how much that is, px; 0 where nothing is, or is known yet.
    """

    def __init__(self) -> None:
        self.amiss_px = 0.0
        self._told = self._once_right = False
        self._begin(right=False)

    def _begin(self, right: bool) -> None:
        """Begin anew, at once or, where all was right until now, after a while."""
        self._right, self._once_right = right, right or self._once_right
        self._frames = -AGAIN if right else 0
        self._places = self._confirmed = 0
        self._gaps = np.zeros((0, 3))
        self._seen = np.zeros((0, 2))  # centres of the circles that were looked at, px

    def look(self, frame: RgbdFrame, circles: Circles, edge_offset_px: float) -> None:
        """Look at a frame; warn, once, where depth shows caps otherwise than colour.

        Args:
            frame: With depth and calibration.
            circles: Outlines of caps.
            edge_offset_px: How much of an edge depth is said to lose, px.
        """
        self._frames += 1
        patient = self._frames % PATIENCE == 0
        if self._told or self._frames <= 0 or (self._frames > PATIENCE and not patient):
            return
        self._gather(frame, circles)
        enough = len(self._gaps) >= ENOUGH
        if not (enough or patient or self._places >= PLACES):
            return
        found = usual(self._gaps) if len(self._gaps) >= FEW else None
        strange = self._strange(found, patient)
        if not strange and (found is None or not (enough or patient)):
            return
        unsure = 0 if enough and not self._once_right else UNSURE
        amiss = strange or (found is not None and any(_amiss(found, edge_offset_px, unsure)))
        if amiss and not self._right:
            self._tell(None if strange else found, edge_offset_px, unsure)
        elif amiss or enough:
            self._begin(right=not amiss)

    def _gather(self, frame: RgbdFrame, circles: Circles) -> None:
        # Where nothing moves, the same edges again would say nothing new.
        away = np.linalg.norm(circles.center[:, None] - self._seen, axis=2)
        new = _large(circles.take((away > circles.radius[:, None]).all(axis=1)))
        self._seen = np.concatenate([self._seen, new.center])[-LATEST:]
        found, places = edge_gaps(frame, new)
        self._gaps = np.concatenate([self._gaps, found])[-LATEST:]
        self._places, self._confirmed = self._places + places, self._confirmed + len(found)

    def _strange(self, found: Floats | None, patient: bool) -> bool:
        """Return whether edges in depth are hardly more than there are by chance."""
        agreeing = 1.0 if found is None else float(_near(self._gaps, found, _OUTLIER).mean())
        share = agreeing * self._confirmed / max(self._places, 1)
        if self._places >= PLACES:
            return share < CONFIRMED
        return patient and self._places >= FEW_PLACES and share < HARDLY

    def _tell(self, found: Floats | None, stated: float, unsure: float) -> None:
        self._told = True
        if found is None:
            self.amiss_px = _REACH  # or more
            _tell_strange(self._places, self._confirmed)
            return
        self.amiss_px = float(np.hypot(np.hypot(*found[1:]), found[0] + stated))
        _tell_amiss(found, stated, unsure)


def _tell_strange(places: int, confirmed: int) -> None:
    """Warn that depth shows hardly any of the edges that colour shows."""
    logger.warning(
        "cap-fit: of %d places where colour shows the edge of a cap, depth has one at %d, as many "
        "as by chance: it is not aligned to colour, or of another moment or scene; positions are "
        "not to be trusted",
        *(places, confirmed),
    )


def _amiss(found: Floats, stated: float, unsure: float) -> tuple[bool, bool]:
    """Return if depth is shifted, and if it is wider, by more than `unsure` px beyond what may be.

    Args:
        found: (3,) from `usual`.
        stated: How much of an edge depth is said to lose, px.
        unsure: px.
    """
    shifted = np.hypot(*found[1:]) > SHIFTED + unsure
    return bool(shifted), bool(abs(found[0] + stated) > AMISS + unsure)


def _tell_amiss(found: Floats, stated: float, unsure: float) -> None:
    """Warn of what is amiss; arguments as `_amiss`."""
    shifted, wider = _amiss(found, stated, unsure)
    if shifted:
        logger.warning(
            "cap-fit: depth shows caps %.1f px to the %s and %.1f px %s of where colour shows "
            "them: it is not aligned to colour, and positions and axes are wrong; calibrate the "
            "cameras anew",
            *(abs(found[1]), "right" if found[1] > 0 else "left"),
            *(abs(found[2]), "below" if found[2] > 0 else "above"),
        )
    if wider:
        lost = -found[0]
        logger.warning(
            "cap-fit: edges of caps in depth lie %.1f px %s of those in colour, where "
            "edge_offset_px: %g takes them for %.1f px %s; diameters are too %s: set "
            "edge_offset_px: %.1f, and measure a ball of known diameter",
            *(abs(lost), "inside" if lost > 0 else "outside"),
            stated,
            *(abs(stated), "inside" if stated > 0 else "outside"),
            "large" if lost < stated else "small",
            np.clip(lost, -3, 3),
        )


def usual(gaps: Floats) -> Floats | None:
    """Return by how much depth shows caps wider than colour (3,), px, and shifted along x and y.

    Args:
        gaps: (K, 3) from `edge_gaps`.

    Returns:
        None where the edges lie on so few sides that the three cannot be told apart.
    """
    basis = _basis(gaps)
    if np.linalg.eigvalsh(basis.T @ basis / len(gaps))[0] < _LEAST_SPREAD:
        return None
    found = np.array([np.median(gaps[:, 0]), 0.0, 0.0])
    for reach in (4 * _OUTLIER, 2 * _OUTLIER, _OUTLIER, _OUTLIER):
        near = _near(gaps, found, reach)
        found = np.linalg.lstsq(basis[near], gaps[near, 0], rcond=None)[0]
    return found


def _basis(gaps: Floats) -> Floats:
    return np.column_stack([np.ones(len(gaps)), gaps[:, 1:]])


def _near(gaps: Floats, found: Floats, reach: float) -> Bools:
    """Return which gaps (K, 3) are as is usual (3,), to so many px."""
    return np.asarray(np.abs(gaps[:, 0] - _basis(gaps) @ found) <= reach)


def _large(circles: Circles) -> Circles:
    """Return the circles that are looked at: the largest, and of what is smaller none."""
    large = np.argsort(-circles.radius, kind="stable")[:MOST]
    return circles.take(large[circles.radius[large] >= LEAST_RADIUS])


def edge_gaps(frame: RgbdFrame, circles: Circles) -> tuple[Floats, int]:
    """Return by how much edges in depth lie outside of those in colour, and where (K, 3).

    Distance, px, and direction from the centre, x and y of a unit vector. Looked for along 32
    directions across the circles, where all of the depth is known.

    Args:
        frame: With depth and calibration.
        circles: Outlines of caps.

    Returns:
        These, and at how many places colour shows an edge, whether or not depth does.
    """
    if not len(circles):
        return np.zeros((0, 3)), 0
    depth, fx = np.nan_to_num(frame.depth_m), calibration_of(frame).fx
    found = [
        _gaps(frame.gray, depth, fx, center, float(radius))
        for center, radius in zip(circles.center, circles.radius, strict=True)
    ]
    gaps, places = zip(*found, strict=True)
    return np.concatenate(gaps), sum(places)


def _gaps(
    gray: Singles, depth: Singles, fx: float, center: Floats, radius: float
) -> tuple[Floats, int]:
    reach = min(_REACH, _SHARE * radius)
    away = np.arange(-reach, reach + 1e-6, _STEP)
    angle = np.arange(_DIRECTIONS)[:, None] * (2 * np.pi / _DIRECTIONS)
    direction = np.hstack([np.cos(angle), np.sin(angle)])
    x, y = (center[i] + direction[:, i : i + 1] * (radius + away) for i in (0, 1))
    x, y = x.astype(np.float32), y.astype(np.float32)
    height, width = gray.shape
    inside = ((x >= 0) & (x <= width - 1) & (y >= 0) & (y <= height - 1)).all(axis=1)
    if not inside.any():
        return np.zeros((0, 3)), 0
    luma = cv2.remap(gray, x[inside], y[inside], cv2.INTER_LINEAR)
    z = cv2.remap(depth, x[inside], y[inside], cv2.INTER_NEAREST)
    known = (z > 0).all(axis=1)
    luma, z, direction = luma[known], z[known], direction[inside][known]
    if not len(z):
        return np.zeros((0, 3)), 0
    rows = np.arange(len(z))
    drop = z[:, 2:] - z[:, :-2]
    edge = drop.argmax(axis=1)
    last = drop.shape[1] - 1 - drop[:, ::-1].argmax(axis=1)  # a sheer drop is seen from both sides
    least = np.maximum(_DROP_M, _DROP_SHARE * radius * z[:, 0] / fx)
    fall = np.abs(luma[:, 2 * _WIDE :] - luma[:, : -2 * _WIDE])
    steepest = fall.argmax(axis=1)
    seen = fall[rows, steepest] >= _LEAST_FALL
    seen &= (steepest > 0) & (steepest < fall.shape[1] - 1)  # at an end it may lie beyond
    good = seen & (drop[rows, edge] >= least)
    middle = (away[edge + 1] + away[last + 1]) / 2
    gap = middle[good] - away[steepest[good] + _WIDE]
    return np.column_stack([gap, direction[good]]), int(seen.sum())
