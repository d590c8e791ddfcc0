"""A layout that is not the one named is refused, though its shape would do."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.special import softmax

from mushpipe.stages.onnx_layouts import boxes_of, in_pixels, probability

RNG = np.random.default_rng(0)
LOGITS = RNG.normal(0, 5, (1, 3, 6, 8))
# rows of corners, score and class, as a model with its own suppression pads them
KEPT = np.zeros((1, 300, 6))
KEPT[0, :2] = (10, 10, 40, 30, 0.9, 0), (50, 50, 90, 95, 0.8, 1)
BOX = np.column_stack([RNG.uniform(20, 300, (400, 4)), RNG.uniform(0, 1, (400, 4))])[None]


def test_logits_become_the_softmax_of_scipy() -> None:
    for k in range(3):
        expected = softmax(LOGITS[0], axis=0)[k]
        assert probability(LOGITS, "logits", k) == pytest.approx(expected, abs=1e-6)
        taken = softmax(LOGITS, axis=1)
        assert probability(taken, "probabilities", k) == pytest.approx(expected, abs=1e-6)


@pytest.mark.parametrize("found", [
    softmax(LOGITS, axis=1), LOGITS.argmax(1), LOGITS.argmax(1).astype(np.uint8), LOGITS[:, 0] > 0,
    LOGITS.argmax(1)[:, None].astype(np.float32),
])  # fmt: skip
def test_what_is_no_logit_is_not_taken_for_one(found: np.ndarray) -> None:
    with pytest.raises(ValueError, match="which logits are not"):
        probability(found, "logits", 0)


def test_labels_are_whole_and_probabilities_within_one() -> None:
    labels = LOGITS.argmax(1)
    for given in (labels, labels[:, None], labels.astype(np.float32)):
        assert np.array_equal(probability(given, "labels", 2), labels[0] == 2)
    with pytest.raises(ValueError, match="no classes of pixels"):
        probability(LOGITS[:, :1], "labels", 1)
    with pytest.raises(ValueError, match="values are -"):
        probability(LOGITS, "probabilities", 1)


@pytest.mark.parametrize("kind", ["logits", "probabilities", "labels"])
def test_a_map_without_a_pixel_is_none(kind: str) -> None:
    """Such are the boxes of a bed in which a detector sees nothing."""
    with pytest.raises(ValueError, match="the shape is another"):
        probability(np.zeros((1, 1, 0)), kind, 0)


@pytest.mark.parametrize(("found", "kind", "text"), [
    (KEPT, "yolov8", "rows and columns are exchanged"),
    (BOX[..., :5] / 320, "yolov8", "rows and columns are exchanged"),
    (KEPT, "yolov5", "as in output 'yolov10'"),
    (BOX, "yolov8", "rows and columns are exchanged"),
    (BOX[..., :5].transpose(0, 2, 1) / 320, "yolov5", "rows and columns are exchanged"),
    (BOX[..., :6], "yolov10", "the last column holds no classes"),
    (BOX, "yolov10", "columns: 8"),
    (BOX * 2, "yolov5", "scores are"),
    (BOX[0], "yolov5", "the shape is another"),
])  # fmt: skip
def test_boxes_of_another_layout_are_refused(found: np.ndarray, kind: str, text: str) -> None:
    with pytest.raises(ValueError, match=text):
        boxes_of(found, kind, 0)


@pytest.mark.parametrize("behind", [
    RNG.normal(0, 0.8, (400, 32)),  # of outlines
    RNG.uniform(0, 320, (400, 51)),  # keypoints
    RNG.uniform(-np.pi / 4, 3 * np.pi / 4, (400, 1)),  # the angle of turned boxes
])  # fmt: skip
def test_what_stands_behind_the_classes_is_no_class(behind: np.ndarray) -> None:
    """As YOLO's models for other tasks have it: it was likelier than mushroom, and no cap was."""
    rows = np.column_stack([BOX[0], behind])
    with pytest.raises(ValueError, match="only one of plain boxes is read"):
        boxes_of(rows.T[None], "yolov8", 0)
    with pytest.raises(ValueError, match="only one of plain boxes is read"):
        boxes_of(np.insert(rows, 4, 0.9, axis=1)[None], "yolov5", 0)


def test_a_class_that_is_1_throughout_may_be_that_of_a_single_class() -> None:
    """YOLOv5 does not train it, and in float16 its sigmoid of 11 is 1."""
    rows = np.column_stack([BOX[0, :, :5], np.float16(1 / (1 + np.exp(-11))) * np.ones(400)])
    assert boxes_of(rows[None], "yolov5", 0)[1] == pytest.approx(BOX[0, :, 4])
    surest_first = rows[np.argsort(-rows[:, 4])]
    with pytest.raises(ValueError, match="as in output 'yolov10'"):
        boxes_of(surest_first[None], "yolov5", 0)


def test_a_box_counts_for_its_likeliest_class_only() -> None:
    rows = np.array([[9, 9, 5, 5, 1, 0.9, 0.8], [9, 9, 5, 5, 1, 0.7, 0.95]])[None]
    for k, expected in ((0, (0.9, 0)), (1, (0, 0.95))):
        assert boxes_of(rows, "yolov5", k)[1] == pytest.approx(expected)
        eight = np.delete(rows, 4, axis=2).transpose(0, 2, 1)
        assert boxes_of(eight, "yolov8", k)[1] == pytest.approx(expected)


def test_corners_the_wrong_way_round_are_no_boxes() -> None:
    box, _ = boxes_of(KEPT[..., [2, 3, 0, 1, 4, 5]], "yolov10", 0)
    with pytest.raises(ValueError, match="negative size"):
        in_pixels(box, normalised=False, canvas=(96, 96))
