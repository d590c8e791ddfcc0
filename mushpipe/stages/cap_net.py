"""Stage `cap-net`: caps in a colour image, by a small network that saw only simulated ones."""

from __future__ import annotations

from typing import Self

import cv2
import numpy as np
from pydantic import Field, PrivateAttr, model_validator

from mushpipe import Circles, GraphPath, Header, Mask, RgbdFrame, Stage
from mushpipe.core.arrays import Bools, Bytes, Floats, Singles, locked
from mushpipe.core.errors import UsageError
from mushpipe.core.jit import borrower
from mushpipe.core.onnx_file import OnnxFile
from mushpipe.core.types import known
from mushpipe.stages.cap_decode import CHANNELS, MASK, STRIDE, circles_of, first_of_each
from mushpipe.stages.discs import (
    LEAST_OF_RANGE,
    MOST_OF_RANGE,
    Extent,
    certain_first,
    discs_of,
    many_likely,
)
from mushpipe.stages.letterbox import resized
from mushpipe.stages.verifier import package_file

FILE = "cap_net.onnx"
KIND = "mushpipe cap-net 1"  # what the model's own metadata call it
_BLOCK = 32  # px; the coarsest stride
# px; radii that the training showed. A range beyond them is brought there by scaling the image.
_KNOWN = (7.0, 60.0)
_LARGEST_SCALE = 4.0
_LEAST_KNOWN = 0.35  # share of the pixels with depth from which on depth tells enough
# Depth shrinks the image in such steps: every size of it has a session of its own.
_STEP, _LEAST_SCALE = 0.8, 0.2
_SMALLEST = 400  # px; down to this longer side an image is looked at, whatever was seen before
# px; where few caps were seen, an image less wide than the training's is asked for larger radii
# alone: nothing tells then what caps look like here, and cups look like caps in small images.
_WIDTH, _LARGE = 640, 45.0
_CLEARLY = 1.25  # so much more of the image circles at another scale must explain


class CapNet(Stage):
    """Detects caps in colour with a network of 161 000 parameters, trained on simulated beds.

    Heat map, radius, offset and mask at a quarter of the resolution (after CenterNet, Zhou et al.
    2019, arXiv 1904.07850). The score is the height of a circle's peak. Depth tells at most how
    large caps can be in the image.
    """

    radius_px: tuple[Extent, Extent | None] = Field(
        (8, 45),
        description="smallest and largest radius, px; circles may be a tenth beyond; the image is "
        "scaled to suit. [8, null]: what largest_mm is at the depth that is seen, 60 px or more; "
        "without depth smaller scales are looked at, and what is seen there better stays",
    )
    largest_mm: float = Field(
        90, ge=1, description="largest diameter, mm, where radius_px leaves it to depth"
    )
    beside_depth: float = Field(
        1.0,
        ge=0.5,
        le=1,
        description="scale of the image where a third of the frame has depth, for a detector that "
        "uses it: it needs less of the network, and 0.8 takes two thirds of the time",
    )
    min_score: float = Field(
        0.438, ge=0, le=1, description="smallest score that is kept; chosen on simulated beds"
    )
    overlap: float = Field(0.4, ge=0, le=1, description="largest IoU of two circles")
    model: GraphPath | None = Field(None, description="another model than the package's, ONNX")

    _net: OnnxFile | None = PrivateAttr(None)

    @model_validator(mode="after")
    def _ordered(self) -> Self:
        smallest, largest = self.radius_px
        if smallest >= (largest or _KNOWN[1]):
            raise ValueError("radius_px must be [smallest, largest], the first below the second")
        if _scale_for(smallest, largest or _KNOWN[1]) > _LARGEST_SCALE:
            raise ValueError("radius_px lies below what an image shows of a cap; is it in px?")
        return self

    def open(self) -> None:
        """Read the model and run it once, for the first image takes several times as long.

        Raises:
            UsageError: The model is missing, damaged, or not one that `make train` wrote.
            DependencyError: ONNX Runtime is not installed.
        """
        color = np.zeros((480, 640, 3), np.uint8)
        self.process(RgbdFrame(Header(0, 0, "warm-up"), color))

    def _load(self) -> OnnxFile:
        """Return the model; raises as `open` does."""
        if self._net is not None:
            return self._net
        net = OnnxFile(self.model or package_file(FILE))
        kind = net.metadata.get("kind")
        if kind != KIND:
            raise UsageError(
                f"model {net.path}: it calls itself {kind!r}, expected {KIND!r} as `make train` "
                "writes it; for a model of your own use the stage `onnx`"
            )
        self._net = net
        return net

    def process(self, frame: RgbdFrame) -> tuple[Mask, Circles]:
        """Return what is cap and the circles, the most certain first.

        Raises:
            UsageError: The model's output has not the shape of `cap-net`.
        """
        scale, largest = self.scaling(frame)
        mask, found = self._look(frame.color, scale, largest or _KNOWN[1])
        if largest is not None:
            return mask, found
        side, further = max(frame.color.shape), True
        while (further and scale / 2 >= _LEAST_SCALE) or side * scale / 2 >= _SMALLEST:
            # Nothing tells how large caps are, but that more is explained at the scale they are of.
            scale /= 2
            seen, coarse = self._look(frame.color, scale, _KNOWN[1] / scale)
            if side * scale < _WIDTH and not many_likely(found):
                coarse = coarse.take(coarse.radius >= _LARGE / (2 * scale))
            if further := _explained(coarse) > _CLEARLY * _explained(found):
                mask = Mask(mask.foreground | seen.foreground)
                found = self._together(found, coarse)
        return mask, found

    def _together(self, fine: Circles, coarse: Circles) -> Circles:
        """Return the circles of two scales; of a fine one within a surer coarse one nothing."""
        away = np.linalg.norm(fine.center[:, None] - coarse.center, axis=2)
        within = (away < coarse.radius) & (fine.score[:, None] <= coarse.score)
        every = certain_first(coarse.joined(fine.take(~within.any(axis=1))))
        return every.take(first_of_each(discs_of(every), self.overlap))

    def _look(self, color: Bytes, scale: float, largest: float) -> tuple[Mask, Circles]:
        """Return what is found in an image at a scale, up to a radius, px of the image."""
        height, width = color.shape[:2]
        size = (max(1, round(width * scale)), max(1, round(height * scale)))
        maps = self._maps(color if scale == 1 else resized(color, size))
        # pixel x of the frame lies at ratio (x + 1/2) - 1/2 of the scaled image
        ratio = np.array([width / size[0], height / size[1]])
        circles, score = circles_of(maps, self.min_score)
        circles[:, :2] = (circles[:, :2] + 0.5) * ratio - 0.5
        circles[:, 2] *= np.sqrt(ratio.prod())
        within = self._within(circles, width, height, largest)
        circles, score = circles[within], score[within]
        keep = first_of_each(circles, self.overlap)
        # the maps reach beyond the image, to whole blocks
        reach = np.rint(STRIDE * ratio * maps.shape[:0:-1]).astype(int).tolist()
        cap = resized(maps[MASK], (max(width, reach[0]), max(height, reach[1])))
        found = Circles(circles[keep, :2], circles[keep, 2], score[keep])
        return Mask(cap[:height, :width] > 0), found

    def scaling(self, frame: RgbdFrame) -> tuple[float, float | None]:
        """Return by how much a frame's image is scaled, and the largest radius, px of the frame.

        The scale brings the radii to those that the network knows. Where neither setting nor depth
        tells the radius it is None, and the scale that for the known ones.
        """
        depth = _depth_seen(frame)
        smallest, largest = self.radius_px
        scale = _scale_for(smallest, largest or _KNOWN[1])
        scale *= 1.0 if depth is None else self.beside_depth
        if largest is not None:
            return scale, largest
        if depth is None or frame.camera is None:
            return scale, None
        largest = max(_KNOWN[1], self.largest_mm / 2000 * frame.camera.fx / depth)
        # Of small caps the network sees less then; a detector that uses depth finds those itself.
        while scale * largest > _KNOWN[1] and scale > _LEAST_SCALE:
            scale *= _STEP
        return scale, largest

    def _within(self, circles: Floats, width: int, height: int, largest: float) -> Bools:
        """Return which circles (N, 3) are within the range, their centres within the image."""
        x, y, radius = circles.T
        inside = (x >= -0.5) & (x < width - 0.5) & (y >= -0.5) & (y < height - 0.5)
        sized = (radius >= LEAST_OF_RANGE * self.radius_px[0]) & (radius <= MOST_OF_RANGE * largest)
        return np.asarray(inside & sized)

    def _maps(self, color: Bytes) -> Singles:
        """Return the maps (5, h, w) of an image, padded to whole blocks."""
        net = self._load()
        bottom, right = (-n % _BLOCK for n in color.shape[:2])
        if bottom or right:
            color = cv2.copyMakeBorder(color, 0, bottom, 0, right, cv2.BORDER_REPLICATE)
        # read-only as a frame's: to the compiler another type, and another kernel
        color = locked(color, np.uint8)
        height, width = color.shape[:2]
        image = np.empty((1, 3, height, width), np.float32)
        _fill_planes(color, image[0])
        maps = net(image, next(iter(net.outputs)))
        expected = (1, CHANNELS, height // STRIDE, width // STRIDE)
        if maps.shape != expected:
            raise UsageError(
                f"model {net.path}: its output has shape {maps.shape}, expected {expected}"
            )
        return np.asarray(maps[0], np.float32)


def _scale_for(smallest: float, largest: float) -> float:
    """Return by how much an image is scaled to bring a range of radii, px, to the known ones."""
    least, most = _KNOWN[0] / smallest, _KNOWN[1] / largest
    if least > most:
        return float(np.sqrt(least * most))
    return float(np.clip(1.0, least, most))


def _explained(circles: Circles) -> float:
    """Return how much of an image circles explain: their squared radii, as far as they are sure."""
    return float((circles.score * circles.radius**2).sum())


def _depth_seen(frame: RgbdFrame) -> float | None:
    """Return the median depth, m; None where a detector cannot rely on it, so little is known."""
    if frame.depth is None:
        return None
    depth = frame.depth[::8, ::8]
    seen = depth[known(depth)]
    if len(seen) < _LEAST_KNOWN * depth.size:
        return None
    return float(np.median(seen)) * frame.depth_scale


@borrower
def _fill_planes(color: Bytes, planes: Singles) -> None:
    """Write the channels of an image (H, W, 3) into planes (3, H, W), 0..1."""
    unit = np.float32(1 / 255)
    for y in range(color.shape[0]):
        line = color[y]
        for channel in range(3):
            row = planes[channel, y]
            for x in range(color.shape[1]):
                row[x] = np.float32(line[x, channel]) * unit
