"""What networks return, read as a probability per pixel or as boxes with scores.

A wrong layout mostly has a shape that would do; so values are looked at as well, lest a bed be
empty, or a single cap, without a word.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from mushpipe.core.arrays import Floats, Singles

SHAPES = {
    "logits": "(1, C, h, w) or (1, h, w)",
    "probabilities": "(1, C, h, w) or (1, h, w), 0 to 1",
    "labels": "(1, 1, h, w) or (1, h, w), whole numbers",
    "yolov5": "(1, N, 5 + C)",
    "yolov8": "(1, 4 + C, N)",
    "yolov10": "(1, N, 6)",
}
PER_PIXEL = ("logits", "probabilities", "labels")
_ROUNDED = 1e-3  # how far rounding takes a score out of 0..1
_SHARE = 1.5  # boxes with no larger number are shares of the input, not px


def probability(found: NDArray[Any], kind: str, class_id: int) -> Singles:
    """Return the probability (h, w) of a class.

    Args:
        found: What the model returned.
        kind: ``logits`` (softmax; sigmoid of a single channel), ``probabilities``, or ``labels``,
            each pixel's class.
        class_id: The class, or channel, that is wanted.

    Raises:
        ValueError, IndexError: Another shape, no such channel, or values of another kind.
    """
    planes = found[0] if found.ndim == 4 else found
    if planes.ndim != 3 or found.shape[0] != 1 or not planes.size:
        raise ValueError("the shape is another")
    planes = planes.astype(np.float64)
    if kind == "labels":
        if len(planes) != 1 or not _whole(planes):
            raise ValueError("these are no classes of pixels")
        return np.asarray(planes[0] == class_id, np.float32)
    shares = _shares(planes)
    if kind == "probabilities" and not shares:
        raise ValueError(f"values are {_range(planes)}")
    labels = found.dtype.kind != "f" or (len(planes) == 1 and planes.min() >= 0 and _whole(planes))
    if kind == "logits" and (shares or labels):
        raise ValueError(
            f"values are {_range(planes)}, {found.dtype}, which logits are not; if a sigmoid, "
            "softmax or argmax is in the model, it is output 'probabilities' or 'labels'"
        )
    if not 0 <= class_id < len(planes):
        raise IndexError(f"channels: {len(planes)}")
    if kind == "probabilities":
        return np.asarray(np.clip(planes[class_id], 0, 1), np.float32)
    others = np.delete(planes, class_id, axis=0)
    rival = np.logaddexp.reduce(others, axis=0) if len(others) else 0.0
    return np.asarray(1 / (1 + np.exp(np.clip(rival - planes[class_id], -80, 80))), np.float32)


def boxes_of(found: Floats, kind: str, class_id: int) -> tuple[Floats, Floats]:
    """Return boxes (N, 4), centre x, y, width, height as the model has them, and scores (N,).

    A box of which another class is likelier has a score of 0.

    Args:
        found: What the model returned, in one of the three layouts that YOLO exports.
        kind: ``yolov5``: rows of box, objectness, classes; ``yolov8``: columns of box, classes;
            ``yolov10``: rows of corners, score, class.
        class_id: The class that is wanted.

    Raises:
        ValueError, IndexError: Another shape, no such class, or values of another kind.
    """
    if found.ndim != 3 or found.shape[0] != 1:
        raise ValueError("the shape is another")
    rows = found[0].T if kind == "yolov8" else found[0]
    if kind == "yolov10":
        return _of_corners(rows, class_id)
    objectness, classes = (rows[:, 4], rows[:, 5:]) if kind == "yolov5" else (1.0, rows[:, 4:])
    if not 0 <= class_id < classes.shape[1]:
        raise IndexError(f"classes: {classes.shape[1]}")
    if rows.shape[1] > len(rows) >= 5:
        raise ValueError("there are more classes than boxes: rows and columns are exchanged")
    if kind == "yolov5" and classes.shape[1] == 1 and len(rows) and _are_kept(rows):
        raise ValueError("the last column holds whole numbers, as in output 'yolov10'")
    score = objectness * classes[:, class_id]
    _require_scores(score)
    if not _shares(classes):
        raise ValueError(
            f"class scores are {_range(classes)}, expected 0 to 1: a model of outlines, keypoints "
            "or turned boxes has more than classes behind its boxes; only one of plain boxes is "
            "read"
        )
    return rows[:, :4], np.where(classes[:, class_id] >= classes.max(axis=1), score, 0)


def in_pixels(boxes: Floats, normalised: bool, canvas: tuple[int, int]) -> Floats:
    """Return boxes (N, 4) in px of an input of (width, height).

    Raises:
        ValueError: Their numbers are in px where shares are expected, or the reverse.
    """
    largest = float(np.abs(boxes).max(initial=0.0))
    if normalised:
        if largest > _SHARE:
            raise ValueError(f"boxes reach {largest:.4g}, but `normalised` says shares of 1")
        return np.asarray(boxes * np.tile(canvas, 2))
    if 0 < largest <= _SHARE:
        raise ValueError(
            "no box has a number over 1.5, so they are in shares, not in px: set `normalised`"
        )
    if len(boxes) and boxes[:, 2:].min() < 0:
        raise ValueError("there are boxes of negative size: the four numbers are others")
    return boxes


def _of_corners(rows: Floats, class_id: int) -> tuple[Floats, Floats]:
    if rows.shape[1] != 6:
        raise ValueError(f"columns: {rows.shape[1]}")
    if not _whole(rows[:, 5]):
        raise ValueError("the last column holds no classes; with objectness it is output 'yolov5'")
    _require_scores(rows[:, 4])
    rows = rows[rows[:, 5] == class_id]
    middle, extent = (rows[:, :2] + rows[:, 2:4]) / 2, rows[:, 2:4] - rows[:, :2]
    return np.column_stack([middle, extent]), rows[:, 4]


def _are_kept(rows: Floats) -> bool:
    """Whether rows end in score and class, the surest first, as after a suppression.

    A single class scored 1 throughout tells nothing: so it is in float16, where YOLOv5 does not
    train it.
    """
    return _whole(rows[:, 5]) and not ((rows[:, 5] == 1).all() and (np.diff(rows[:, 4]) > 0).any())


def _require_scores(score: Floats) -> None:
    if not _shares(score):
        raise ValueError(f"scores are {_range(score)}, expected 0 to 1")


def _shares(values: Floats) -> bool:
    low, high = values.min(initial=0.0), values.max(initial=1.0)
    return bool(low >= -_ROUNDED and high <= 1 + _ROUNDED)


def _whole(values: Floats) -> bool:
    return bool((values == np.rint(values)).all())


def _range(values: Floats) -> str:
    return f"{values.min():.3g} to {values.max():.3g}"
