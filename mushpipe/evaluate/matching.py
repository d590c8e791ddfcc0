"""Which detection is which mushroom: circle overlap, optimal assignment, ignore rules.

The rules, which are worth several points of F and therefore belong beside every figure:

1. A detection can be a mushroom where the IoU of their circles is at least a threshold (0.5).
2. Detections and the truths that count are paired one to one so that the number of pairs is
   largest and, among those pairings, the sum of their IoU.
3. A detection left over counts neither way where its IoU with any *ignored* truth reaches the
   threshold, or where its centre lies in a *may find* circle. Any other one is false.
4. A truth that counts and has no partner is missed. An ignored truth never is.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from mushpipe.core.arrays import Bools, Floats, Rows
from mushpipe.evaluate.truth import FrameTruth


@dataclass(frozen=True, eq=False)
class Matching:
    """The outcome of a frame.

    Attributes:
        truth: (K,) rows of the truth that were found.
        found: (K,) rows of their detections.
        iou: (K,) overlap of each pair.
        missed: rows of the truth that count and were not found.
        false: rows of the detections that are no mushroom.
        ignored: rows of the detections that count neither way.
    """

    truth: Rows
    found: Rows
    iou: Floats
    missed: Rows
    false: Rows
    ignored: Rows


def circle_iou(center_a: Floats, radius_a: Floats, center_b: Floats, radius_b: Floats) -> Floats:
    """Return the exact intersection over union of circles, each of a with each of b.

    The intersection is the lens of two circular segments
    (https://mathworld.wolfram.com/Circle-CircleIntersection.html, equation 14).

    Args:
        center_a: (N, 2) px.
        radius_a: (N,) px.
        center_b: (M, 2) px.
        radius_b: (M,) px.

    Returns:
        (N, M) values in 0..1.
    """
    d = np.linalg.norm(center_a[:, None] - center_b[None], axis=2)
    a, b = np.broadcast_arrays(radius_a[:, None], radius_b[None])
    total = np.pi * (a**2 + b**2)
    inner = np.pi * np.minimum(a, b) ** 2
    crossing = (d < a + b) & (d > np.abs(a - b))
    safe = np.where(crossing, d, 1.0)
    cos_a = np.clip((safe**2 + a**2 - b**2) / (2 * safe * a), -1, 1)
    cos_b = np.clip((safe**2 + b**2 - a**2) / (2 * safe * b), -1, 1)
    kite = (-safe + a + b) * (safe + a - b) * (safe - a + b) * (safe + a + b)
    lens = a**2 * np.arccos(cos_a) + b**2 * np.arccos(cos_b) - np.sqrt(np.maximum(kite, 0)) / 2
    area = np.where(crossing, lens, np.where(d < a + b, inner, 0.0))
    return np.asarray(area / (total - area))


def assign(iou: Floats, threshold: float) -> tuple[Rows, Rows]:
    """Pair rows with columns one to one: most pairs with IoU >= threshold, then most IoU in all.

    Solved exactly by SciPy's ``linear_sum_assignment``: a pair is worth more than all the IoU
    there can be.

    Args:
        iou: (N, M).
        threshold: Smallest IoU of a pair.

    Returns:
        (K,) rows and (K,) columns.
    """
    from scipy.optimize import linear_sum_assignment

    possible = iou >= threshold
    rows, columns = linear_sum_assignment(
        np.where(possible, 1.0 + min(iou.shape) + iou, 0.0), maximize=True
    )
    kept = possible[rows, columns]
    return rows[kept], columns[kept]


def match(truth: FrameTruth, center: Floats, radius: Floats, threshold: float = 0.5) -> Matching:
    """Match detections with the truth of their frame by the rules of this module.

    Args:
        truth: What is there.
        center: (M, 2) px, of the detections.
        radius: (M,) px.
        threshold: Smallest IoU of a match.
    """
    iou = circle_iou(truth.caps.center, truth.caps.radius, center, radius)
    counts = truth.caps.ignore == 0
    counting = np.flatnonzero(counts)
    rows, found = assign(iou[counts], threshold)
    excused = (iou[~counts] >= threshold).any(axis=0) | _inside(center, truth.may_find)
    left = np.setdiff1d(np.arange(len(center)), found)
    return Matching(
        truth=counting[rows],
        found=found,
        iou=iou[counting[rows], found],
        missed=np.delete(counting, rows),
        false=left[~excused[left]],
        ignored=left[excused[left]],
    )


def _inside(center: Floats, circles: Floats) -> Bools:
    """Return which of (M, 2) points lie in any of the (K, 3) circles ``u v radius``."""
    distance = np.linalg.norm(center[:, None] - circles[None, :, :2], axis=2)
    return np.asarray((distance <= circles[None, :, 2]).any(axis=1))
