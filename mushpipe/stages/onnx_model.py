"""Stage `onnx`: a network of the user's own, a segmenter or a YOLO detector, mapped by settings."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Annotated, Any, Literal, Self

import cv2
import numpy as np
from numpy.typing import NDArray
from pydantic import Field, PrivateAttr, field_validator, model_validator

from mushpipe import Circles, GraphPath, Mask, RgbdFrame, Stage
from mushpipe.core.arrays import Bools, Bytes, Floats, Singles
from mushpipe.core.errors import UsageError
from mushpipe.core.onnx_file import OnnxFile
from mushpipe.stages.cap_decode import first_of_each
from mushpipe.stages.letterbox import Letterbox, letterbox
from mushpipe.stages.onnx_layouts import PER_PIXEL, SHAPES, boxes_of, in_pixels, probability

Triple = tuple[float, float, float]
Size = Annotated[int, Field(ge=1)]
Spread = Annotated[float, Field(ge=1e-6)]
_MOST = 1000  # boxes that are looked at, the surest


class Onnx(Stage):
    """Runs an ONNX model of your own on the colour image; gives a mask and circles.

    `logits`: the mask is where the class is likelier than `min_score` (softmax; sigmoid of a
    single channel), and each connected piece becomes the circle of its area. `probabilities` are
    those of a model that ends in these, `labels` (classes of pixels) those of one that ends in an
    argmax. Boxes as YOLO exports them: a circle has the area of the ellipse in its box, and the
    mask is the union of the circles. The model takes one image (1, 3, H, W) of floats.
    """

    model: GraphPath = Field(description="the ONNX file")
    output: Literal["logits", "probabilities", "labels", "yolov5", "yolov8", "yolov10"] = Field(
        description="what it returns: logits or probabilities (1, C, h, w), classes of pixels, or "
        "boxes: (1, N, 5 + C) with objectness, (1, 4 + C, N), or (1, N, 6) with corners, score and "
        "class"
    )
    tensor: str | None = Field(None, description="name of the output; null: the first")
    class_id: int = Field(
        0, ge=0, description="the class, or channel, that is mushroom; to be given for `labels`"
    )
    normalised: bool = Field(
        False, description="boxes are shares (0..1) of the input's width and height, not px"
    )
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

    @field_validator("mean", "std")
    @classmethod
    def _of_shares(cls, value: Triple) -> Triple:
        if max(map(abs, value)) > 10:
            raise ValueError("channels are on 0..1: was it given for 0..255? Divide it by 255")
        return value

    @model_validator(mode="after")
    def _labelled(self) -> Self:
        if self.output == "labels" and "class_id" not in self.model_fields_set:
            raise ValueError("class_id is missing: which label is mushroom? 0 is mostly the ground")
        return self

    def open(self) -> None:
        """Read the model; raises as `_load` does."""
        self._load()

    def _load(self) -> OnnxFile:
        """Return the model.

        Raises:
            UsageError: It is missing, damaged, has no such output, or takes no single image, or
                none of such a size.
            DependencyError: ONNX Runtime is not installed.
        """
        if self._net is not None:
            return self._net
        net = OnnxFile(self.model)
        shapes = list(net.inputs.values())
        if len(shapes) != 1 or len(shapes[0]) != 4 or not _fits(shapes[0][:2], (1, 3)):
            raise UsageError(
                f"model {net.path} takes {net.inputs}, expected one image (1, 3, H, W)"
            )
        if self.size and not _fits(shapes[0][:1:-1], self.size):
            raise UsageError(
                f"model {net.path} takes images of {shapes[0][3]}x{shapes[0][2]} px, which `size` "
                "cannot change: leave it out"
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
                f"model {net.path}: {error}; its output has shape {found.shape}; output "
                f"'{self.output}' with class_id {self.class_id} expects {SHAPES[self.output]}"
            ) from error

    def _letterbox(self, shape: tuple[Any, ...], width: int, height: int) -> Letterbox:
        """Return how an image lies in the model's input, of this shape (1, 3, H, W)."""
        own = (width + -width % 32, height + -height % 32)
        free = self.size or own
        fixed = [n if isinstance(n, int) else f for n, f in zip(shape[:1:-1], free, strict=True)]
        canvas = fixed[0], fixed[1]
        return letterbox((width, height), canvas, enlarge=canvas != own)

    def _values(self, canvas: Bytes) -> Singles:
        """Return an image (h, w, 3) RGB as the model wants it, (1, 3, h, w)."""
        ordered = canvas[..., ::-1] if self.order == "bgr" else canvas
        values = (ordered / 255 - np.array(self.mean)) / np.array(self.std)
        return np.ascontiguousarray(values.transpose(2, 0, 1)[None], np.float32)

    def _mapped(self, found: NDArray[Any], box: Letterbox) -> tuple[Mask, Circles]:
        if not np.isfinite(found).all():
            raise ValueError("there are values that are no numbers")
        if self.output in PER_PIXEL:
            likely = probability(found, self.output, self.class_id)
            return pieces(box.cut(likely), self.min_score)
        boxes, score = boxes_of(found.astype(np.float64), self.output, self.class_id)
        order = np.flatnonzero(score >= self.min_score)
        order = order[np.argsort(-score[order], kind="stable")][:_MOST]
        boxes = box.back(in_pixels(boxes[order], self.normalised, box.canvas))
        inside = (boxes[:, :2] >= -0.5) & (boxes[:, :2] <= np.array(box.image) - 0.5)
        sound = (boxes[:, 2:] > 0).all(axis=1) & inside.all(axis=1)
        circles = np.column_stack([boxes[:, :2], np.sqrt(boxes[:, 2:].prod(axis=1)) / 2])[sound]
        score = np.clip(score[order], 0, 1)[sound]
        keep = first_of_each(circles, self.overlap)
        return Mask(discs(circles[keep], box.image)), Circles(
            circles[keep, :2], circles[keep, 2], score[keep]
        )


def _fits(shape: Sequence[Any], wanted: Sequence[int]) -> bool:
    """Return whether free dimensions, which are no int, can be as wanted, and the others are."""
    return all(not isinstance(n, int) or n == size for n, size in zip(shape, wanted, strict=True))


def pieces(likely: Singles, least: float) -> tuple[Mask, Circles]:
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


def discs(circles: Floats, size: tuple[int, int]) -> Bools:
    """Return the union (H, W) of circles (N, 3) in an image of (width, height)."""
    width, height = size
    union = np.zeros((height, width), np.bool_)
    for x, y, radius in circles:
        left, right = np.clip((x - radius, x + radius + 1), 0, width).astype(int)
        top, bottom = np.clip((y - radius, y + radius + 1), 0, height).astype(int)
        v, u = np.ogrid[top:bottom, left:right]
        union[top:bottom, left:right] |= (u - x) ** 2 + (v - y) ** 2 <= radius**2
    return union
