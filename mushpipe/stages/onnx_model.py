"""Stage `onnx`: a network of the user's own, a segmenter or a YOLO detector, mapped by settings."""

from __future__ import annotations

from typing import Annotated, Any, Literal

import cv2
import numpy as np
from numpy.typing import NDArray
from pydantic import Field, PrivateAttr

from mushpipe import Circles, GraphPath, Mask, RgbdFrame, Stage
from mushpipe.core.errors import UsageError
from mushpipe.core.onnx_file import OnnxFile
from mushpipe.stages.cap_decode import first_of_each
from mushpipe.stages.letterbox import Floats, Letterbox, letterbox

Triple = tuple[float, float, float]
Size = Annotated[int, Field(ge=1)]
Spread = Annotated[float, Field(gt=0)]
_MOST = 1000  # boxes that are looked at, the surest
_ROUNDED = 1e-3  # how far rounding takes a score out of 0..1
_SHAPES = {
    "logits": "(1, C, h, w) or (1, h, w)",
    "yolov5": "(1, N, 5 + C)",
    "yolov8": "(1, 4 + C, N)",
    "yolov10": "(1, N, 6)",
}


class Onnx(Stage):
    """Runs an ONNX model of your own on the colour image; gives a mask and circles.

    `logits`: the mask is where the class is likelier than `min_score` (softmax; sigmoid of a
    single channel), and each connected piece becomes the circle of its area. Boxes as YOLO exports
    them: a circle has the area of the ellipse in its box, and the mask is the union of the
    circles. The model takes one image (1, 3, H, W).
    """

    model: GraphPath = Field(description="the ONNX file")
    output: Literal["logits", "yolov5", "yolov8", "yolov10"] = Field(
        description="what it returns: logits (1, C, h, w), or boxes: (1, N, 5 + C) with "
        "objectness, (1, 4 + C, N), or (1, N, 6) with corners, score and class"
    )
    tensor: str | None = Field(None, description="name of the output; null: the first")
    class_id: int = Field(0, ge=0, description="the class, or channel, that is mushroom")
    size: tuple[Size, Size] | None = Field(
        None,
        description="width, height of its input, px, where the model leaves them free; null: the "
        "image's, padded to multiples of 32",
    )
    order: Literal["rgb", "bgr"] = Field("rgb", description="order of its colour channels")
    mean: Triple = Field((0, 0, 0), description="taken off the channels, in their order, on 0..1")
    std: tuple[Spread, Spread, Spread] = Field((1, 1, 1), description="each is divided by this")
    min_score: float = Field(0.5, ge=0, le=1, description="smallest probability that is kept")
    overlap: float = Field(0.4, ge=0, le=1, description="largest IoU of two circles, for boxes")

    _net: OnnxFile | None = PrivateAttr(None)

    def open(self) -> None:
        """Read the model; raises as `_load` does."""
        self._load()

    def _load(self) -> OnnxFile:
        """Return the model.

        Raises:
            UsageError: It is missing, damaged, has no such output, or takes no single image.
            DependencyError: ONNX Runtime is not installed.
        """
        if self._net is not None:
            return self._net
        net = OnnxFile(self.model)
        shapes = list(net.inputs.values())
        if len(shapes) != 1 or len(shapes[0]) != 4 or shapes[0][1] != 3:
            raise UsageError(
                f"model {net.path} takes {net.inputs}, expected one image (1, 3, H, W)"
            )
        if self.tensor not in (None, *net.outputs):
            known = ", ".join(net.outputs)
            raise UsageError(f"model {net.path} has no output '{self.tensor}'; it has: {known}")
        self._net = net
        return net

    def process(self, frame: RgbdFrame) -> tuple[Mask, Circles]:
        """Return mask and circles, the most certain circle first.

        Raises:
            UsageError: The output has not the shape that `output` says.
        """
        net = self._load()
        height, width = frame.color.shape[:2]
        box = self._letterbox(next(iter(net.inputs.values())), width, height)
        found = net(self._values(box.fill(frame.color)), self.tensor or next(iter(net.outputs)))
        try:
            return self._mapped(found, box)
        except (IndexError, ValueError) as error:
            raise UsageError(
                f"model {net.path}: its output has shape {found.shape}; output '{self.output}' "
                f"with class_id {self.class_id} expects {_SHAPES[self.output]}"
            ) from error

    def _letterbox(self, shape: tuple[Any, ...], width: int, height: int) -> Letterbox:
        """Return how an image lies in the model's input, of this shape (1, 3, H, W)."""
        own = (width + -width % 32, height + -height % 32)
        free = self.size or own
        fixed = [n if isinstance(n, int) else f for n, f in zip(shape[:1:-1], free, strict=True)]
        canvas = fixed[0], fixed[1]
        return letterbox((width, height), canvas, enlarge=canvas != own)

    def _values(self, canvas: NDArray[np.uint8]) -> NDArray[np.float32]:
        """Return an image (h, w, 3) RGB as the model wants it, (1, 3, h, w)."""
        ordered = canvas[..., ::-1] if self.order == "bgr" else canvas
        values = (ordered / 255 - np.array(self.mean)) / np.array(self.std)
        return np.ascontiguousarray(values.transpose(2, 0, 1)[None], np.float32)

    def _mapped(self, found: NDArray[Any], box: Letterbox) -> tuple[Mask, Circles]:
        if not np.isfinite(found).all():
            raise UsageError(f"model {self.model}: its output has values that are no numbers")
        if self.output == "logits":
            return pieces(box.cut(probability(found, self.class_id)), self.min_score)
        boxes, score = boxes_of(found.astype(np.float64), self.output, self.class_id)
        if len(score) and not -_ROUNDED <= score.min() <= score.max() <= 1 + _ROUNDED:
            raise UsageError(
                f"model {self.model}: scores are {score.min():.3g} to {score.max():.3g}, expected "
                f"0 to 1: is its output laid out as output '{self.output}' has it, "
                f"{_SHAPES[self.output]}?"
            )
        order = np.flatnonzero(score >= self.min_score)
        order = order[np.argsort(-score[order], kind="stable")][:_MOST]
        boxes, score = box.back(boxes[order]), np.clip(score[order], 0, 1)
        inside = (boxes[:, :2] >= -0.5) & (boxes[:, :2] <= np.array(box.image) - 0.5)
        sound = (boxes[:, 2:] > 0).all(axis=1) & inside.all(axis=1)
        circles = np.column_stack([boxes[:, :2], np.sqrt(np.abs(boxes[:, 2:]).prod(axis=1)) / 2])
        circles, score = circles[sound], score[sound]
        keep = first_of_each(circles, self.overlap)
        return Mask(discs(circles[keep], box.image)), Circles(
            circles[keep, :2], circles[keep, 2], score[keep]
        )


def probability(logits: NDArray[Any], channel: int) -> NDArray[np.float32]:
    """Return the probability (h, w) of a channel of logits (1, C, h, w) or (1, h, w).

    Raises:
        ValueError, IndexError: They have another shape, or no such channel.
    """
    planes = logits[0] if logits.ndim == 4 else logits
    if planes.ndim != 3 or logits.shape[0] != 1:
        raise ValueError("neither (1, C, h, w) nor (1, h, w)")
    if not 0 <= channel < len(planes):
        raise IndexError(channel)
    others = np.delete(planes, channel, axis=0).astype(np.float64)
    rival = np.logaddexp.reduce(others, axis=0) if len(others) else 0.0
    return np.asarray(1 / (1 + np.exp(np.clip(rival - planes[channel], -80, 80))), np.float32)


def boxes_of(found: Floats, kind: str, class_id: int) -> tuple[Floats, Floats]:
    """Return boxes (N, 4), centre x, y, width, height in the input's px, and scores (N,).

    Args:
        found: What the model returned, in one of the three layouts that YOLO exports.
        kind: ``yolov5``: rows of box, objectness, classes; ``yolov8``: columns of box, classes;
            ``yolov10``: rows of corners, score, class.
        class_id: The class that is wanted.

    Raises:
        ValueError, IndexError: Another shape, or no such class.
    """
    if found.ndim != 3 or found.shape[0] != 1:
        raise ValueError("not (1, ., .)")
    rows = found[0].T if kind == "yolov8" else found[0]
    if kind == "yolov10":
        if rows.shape[1] != 6:
            raise ValueError("not six columns")
        rows = rows[rows[:, 5] == class_id]
        return np.column_stack(
            [(rows[:, :2] + rows[:, 2:4]) / 2, rows[:, 2:4] - rows[:, :2]]
        ), rows[:, 4]
    if kind == "yolov5":
        return rows[:, :4], rows[:, 4] * rows[:, 5 + class_id]
    return rows[:, :4], rows[:, 4 + class_id]


def pieces(likely: NDArray[np.float32], least: float) -> tuple[Mask, Circles]:
    """Return where a probability (H, W) is at least `least`, and a circle per connected piece.

    A circle has the area and the centroid of its piece; its score is the mean probability there.
    """
    foreground = likely >= least
    count, labels, facts, centers = cv2.connectedComponentsWithStats(foreground.astype(np.uint8))
    area = facts[1:, cv2.CC_STAT_AREA].astype(np.float64)
    total = np.bincount(labels.ravel(), likely.ravel(), count)[1:]
    score = np.clip(total / np.maximum(area, 1), 0, 1)
    order = np.argsort(-score, kind="stable")
    return Mask(foreground), Circles(centers[1:][order], np.sqrt(area[order] / np.pi), score[order])


def discs(circles: Floats, size: tuple[int, int]) -> NDArray[np.bool_]:
    """Return the union (H, W) of circles (N, 3) in an image of (width, height)."""
    union = np.zeros(size[::-1], np.uint8)
    for x, y, radius in np.rint(circles * 16).astype(int).tolist():  # sixteenths of a pixel
        cv2.circle(union, (x, y), radius, 1, -1, shift=4)
    return union > 0
