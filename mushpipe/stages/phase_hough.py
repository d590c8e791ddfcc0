"""Stage `phase-hough`: every cap as a sub-pixel circle, by the phase-coded Hough transform."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Annotated, ClassVar, Literal, Self

import cv2
import numpy as np
from pydantic import Field, PrivateAttr, model_validator

from mushpipe import Circles, Mask, RgbdFrame, Stage, UsageError
from mushpipe.core.arrays import Bools, Bytes, Floats, Ints32, Singles
from mushpipe.core.paths import GraphPath
from mushpipe.stages.discs import LIKELY, Extent, Radii, discs_of, many_likely
from mushpipe.stages.doubling import doubled
from mushpipe.stages.phase.blobs import blobs_of
from mushpipe.stages.phase.decide import decide
from mushpipe.stages.phase.depth import NO_RELIEF, Relief, relief_of
from mushpipe.stages.phase.doubt import Contradiction
from mushpipe.stages.phase.edges import Gradient, edges_of, gradient_of, otsu_of
from mushpipe.stages.phase.features import AT_LEARNED, static_features
from mushpipe.stages.phase.fuse import fused
from mushpipe.stages.phase.learned import (
    add_discs,
    agreement,
    candidates_of,
    largest_of,
    of_radii,
    seen_by,
    with_bare,
    without_clods,
)
from mushpipe.stages.phase.polish import polish
from mushpipe.stages.phase.refit import refit
from mushpipe.stages.phase.strips import Strips, in_strips
from mushpipe.stages.phase.verifier import load_verifier
from mushpipe.stages.phase.votes import centres
from mushpipe.stages.verifier_net import Models
from mushpipe.stages.warm_up import example_circles, example_frame

_FLOOR = 4.0  # gray levels per px; Otsu's threshold of an image without edges is noise
_AROUND = np.ones((7, 7), np.uint8)  # edges are taken so far around the foreground
_STANDING = 0.004  # m; what is higher than this over the bed is looked at, in the mask or not
EVIDENCE = 0.07  # share of an outline that votes; half-hidden caps show hardly more
_BESIDE = 0.2  # the same beside a network: what has less it sees as well, and fewer cost less time
_EVERY = 2  # edge points; of so many one votes where network and depth bring candidates as well
# Of `learned`; what has no depth, and the network sees less of, is no cap. Where it sees few caps,
# cups are as many as the caps that it doubts, and look like these to the verifier; and where the
# rest of the frame has depth, nothing that it doubts itself is a cap.
_SEEN, _SEEN_OF_FEW = 0.1, 0.35
_SURE = 0.8  # of a network's circle, from which on it is taken for a cap though it has no outline
_BARE = 0.4  # of such a one where there is depth: it may be a stump, and `cap-fit` can tell
_LARGE = 80.0  # px; radius up to which caps are looked for in any case where [8, null] is set
_SMALLEST = 12  # px; images smaller than this in either direction hold no circle


@dataclass(frozen=True, eq=False)
class Evidence:
    """What was found before anything is decided.

    Attributes:
        edges: Edge points.
        shapes: (N, 5) outlines x, y, r, p, q, px.
        hits: (N, D) rows of the edges that support each.
        table: (N, F) features.
        middle: (N,) m height of the middle over the bed, NaN without depth.
        relief: What stands on the bed.
        radii: That were looked for.
        learned: Circles of the network within the range; None without.
    """

    edges: Strips
    shapes: Floats
    hits: Ints32
    table: Floats
    middle: Floats
    relief: Relief
    radii: Radii
    learned: Circles | None


class PhaseHough(Stage):
    """Detects caps with the phase-coded circular Hough transform of Atherton & Kerbyson (1999).

    Edge points of the gray image, and of the depth image where there is one, vote for centres; each
    peak is refitted to its edges, and a small verifier over named features decides, cap by
    cap, in the order of its probability. The score is that probability. Circles have the area of
    the outline, so a tilted cap's is between its long and its short axis.
    """

    reentrant: ClassVar[bool] = True

    input: Literal["image", "mask"] = Field(
        "image", description="where edges are taken from; `mask` is the paper's variant, no depth"
    )
    radius_px: tuple[Extent, Extent | None] | None = Field(
        (8.0, 38.0),
        description="smallest and largest radius looked for, px; outlines may be fitted a tenth "
        "beyond; null takes them from diameter_mm and depth. [8, null]: 80 px, or more where a cap "
        "of diameter_mm is larger at the depth that is seen, or one that is learned",
    )
    diameter_mm: tuple[Extent, Extent] = Field(
        (6.0, 120.0), description="smallest and largest diameter, mm, where there is depth"
    )
    min_score: float = Field(0.5, ge=0, le=1, description="smallest score that is kept")
    edge: float = Field(
        0.25, ge=0.01, le=2, description="least gradient, in units of Otsu's threshold of gradients"
    )
    evidence: Annotated[float, Field(ge=0.01, le=1)] | None = Field(
        None,
        description="least share of an outline that votes, for a candidate; not set: 0.07, and "
        "0.2 with use_learned, where circles of the network are candidates as well",
    )
    use_depth: bool = Field(True, description="false ignores depth")
    use_blobs: bool = Field(
        True, description="take what stands free on the bed as candidates, where there is depth"
    )
    use_learned: bool = Field(
        False, description="take the circles of the `cap-net` above: as candidates, and as evidence"
    )
    verifier: GraphPath | None = Field(None, description="another verifier than the package's")

    _models: Models | None = PrivateAttr(None)
    _contradiction: Contradiction = PrivateAttr(default_factory=Contradiction)

    @model_validator(mode="after")
    def _ordered(self) -> Self:
        for name in ("radius_px", "diameter_mm"):
            value = getattr(self, name)
            if value is not None and value[0] >= (value[1] or _LARGE):
                raise ValueError(f"{name} must be [smallest, largest], the first below the second")
        if self.diameter_mm[1] < 1:
            raise ValueError("diameter_mm is in mm, and below 1 mm: was it given in m?")
        return self

    def required_inputs(self) -> frozenset[str]:
        """Return the circles of the network with `use_learned`."""
        return frozenset({"learned"} if self.use_learned else ())

    def open(self) -> None:
        """Read the verifier and compile the kernels."""
        self._load()
        self._warm_up()
        self._contradiction = Contradiction()

    def process(self, frame: RgbdFrame, mask: Mask, learned: Circles | None = None) -> Circles:
        """Return the circles in the order they were accepted in; by score beside `learned`.

        Args:
            frame: The image, and depth where there is one.
            mask: Where caps may be.
            learned: Circles of `cap-net`; ignored unless `use_learned`.

        Raises:
            UsageError: `use_learned`, and there are no circles.
        """
        if self.use_learned and learned is None:
            raise UsageError("use_learned needs a stage above that finds circles, such as cap-net")
        found = self.gather(frame, mask, learned if self.use_learned else None)
        if found is None:
            return Circles(np.zeros((0, 2)), np.zeros(0), np.zeros(0))
        # Beside depth: an image alone places circles better than the network does.
        order, chance, owner, sight = self.decide(found, led=found.relief.known)
        shapes, score = found.shapes[order], chance[order]
        # What is hardly a cap changes nothing about those that are likely: it takes no edges from
        # them, and what is a cap only beside it is no more likely than it is.
        after = np.logical_or.accumulate((score < LIKELY) & (sight[order] == 0))
        score[after] = np.minimum.accumulate(score[after])
        owner[np.append(after, False)[owner]] = -1  # an owner of -1 stays one
        polish(found.edges, found.relief, shapes, owner, found.radii)
        circles = Circles(shapes[:, :2], equal_area_radius(shapes), score)
        if found.learned is None:
            return circles
        radius = equal_area_radius(found.shapes)
        bare = self._sure(found.learned, found.relief)
        circles = with_bare(circles, bare, found.shapes, radius, order[score >= LIKELY])
        if learned is None or not found.relief.known:
            return circles
        seen = seen_by(learned, circles)
        self._contradiction.look(frame.header.sequence, circles, seen == 0, found.learned)
        return without_clods(frame.color, circles, seen)

    def gather(
        self, frame: RgbdFrame, mask: Mask, learned: Circles | None = None
    ) -> Evidence | None:
        """Return candidates with their features; None where the image cannot hold such a circle."""
        height, width = mask.foreground.shape
        if min(height, width) < _SMALLEST:
            return None
        literal = self.input == "mask"
        relief = relief_of(frame) if self.use_depth and not literal else NO_RELIEF
        radii = self._radii(relief, learned, height, width)
        if radii.smallest >= radii.largest:
            return None
        image = np.asarray(mask.foreground if literal else frame.gray, np.float32) * np.float32(255)
        gradient = gradient_of(image)
        inside = mask.foreground.view(np.uint8)
        if learned is not None:
            inside = add_discs(learned, inside)
        foreground = _foreground(inside, relief)
        region = np.ones_like(foreground) if literal else cv2.dilate(foreground, _AROUND)
        edges = self._edges(image, gradient, np.asarray(region, np.uint8), relief)
        every = _EVERY if learned is not None and relief.known else 1
        evidence = self.evidence or (EVIDENCE if learned is None else _BESIDE)
        found = centres(edges, radii, (height, width), evidence, every)
        known = None if learned is None else of_radii(learned, radii)
        if known is not None:
            found = np.concatenate([found, candidates_of(known)])
        if relief.known and self.use_blobs:
            found = np.concatenate([found, blobs_of(relief, radii)])
        shapes, hits, residual = refit(edges, relief, found, radii)
        table, middle = static_features(image, gradient, inside, relief, shapes, hits, residual)
        if learned is not None:
            table[:, AT_LEARNED] = agreement(shapes, equal_area_radius(shapes), learned)
        kept = self._plausible(shapes, middle, relief)
        if learned is not None:
            few = LIKELY if relief.known else _SEEN_OF_FEW
            least = _SEEN if many_likely(learned) else few
            kept &= np.isfinite(middle) | (table[:, AT_LEARNED] >= least)
        parts = (shapes[kept], hits[kept], table[kept], middle[kept])
        return Evidence(edges, *parts, relief, radii, known)

    def decide(self, found: Evidence, led: bool = False) -> tuple[Ints32, Floats, Ints32, Floats]:
        """Return the accepted rows in order, all probabilities, whose each edge is; see `decide`.

        `led` is whether the network has a say in the order of the likely ones.
        """
        # Where no circle of the other detector lies, it has nothing to say.
        asked = found.table[:, AT_LEARNED] > 0
        which = (np.isfinite(found.middle) + 2 * asked).astype(np.int32)
        parts = (found.edges, found.shapes, found.hits, found.table)
        return decide(*parts, which, self._load(), self.min_score, led)

    def _sure(self, learned: Circles, relief: Relief) -> Circles:
        """Return the circles of the network that may be caps though no outline is found of them."""
        sure = learned.take(learned.score >= max(_SURE, self.min_score))
        if not relief.known:
            return sure
        discs, score = discs_of(sure), np.minimum(sure.score, _BARE)
        kept = (score >= self.min_score) & self._plausible(discs, relief.heights(discs), relief)
        return Circles(sure.center, sure.radius, score).take(kept)

    def _load(self) -> Models:
        """Return the models, read once."""
        if self._models is None:
            self._models = load_verifier(self.verifier, self.input == "mask")
        return self._models

    def _radii(self, relief: Relief, learned: Circles | None, height: int, width: int) -> Radii:
        """Return which radii are looked for, none larger than the image."""
        smallest, largest = self.radius_px or (8.0, 38.0)
        if largest is None:
            by_depth = self.diameter_mm[1] / 2000 / relief.pixel if relief.known else 0
            largest = max(_LARGE, by_depth, largest_of(learned))
        if self.radius_px is None and relief.known:
            # a cap is nearer than the bed, hence larger in the image
            near = relief.bed_pixel(*np.array([(0, width, 0, width), (0, 0, height, height)]))
            least, most = self.diameter_mm
            smallest = max(5.0, least / 2000 / near.max())
            largest = 1.2 * most / 2000 / near.min()
        return Radii(smallest, min(largest, max(height, width) / 2))

    def _edges(self, image: Singles, gradient: Gradient, region: Bytes, relief: Relief) -> Strips:
        otsu = max(otsu_of(gradient.size), _FLOOR)
        edges, pixels = edges_of(image, gradient, region, self.edge * otsu, 1.2 * otsu)
        if relief.known:
            edges = fused(edges, pixels, relief.edges())
        return in_strips(edges, *image.shape)

    def _plausible(self, shapes: Floats, middle: Floats, relief: Relief) -> Bools:
        """Return which candidates have a possible diameter in metres, or none that is known."""
        if not relief.known:
            return np.ones(len(shapes), bool)
        nearer = np.nan_to_num(middle) / relief.focal
        bed = relief.bed_pixel(shapes[:, 0], shapes[:, 1])
        diameter = 2000 * shapes[:, 2] * (bed - nearer)
        low, high = self.diameter_mm
        return ~np.isfinite(middle) | ((diameter >= low) & (diameter <= high))

    def _warm_up(self) -> None:
        for native in (np.uint16, np.float32):
            frame = example_frame(native=native)
            mask = Mask(frame.depth_m < 0.49)
            self.process(frame, mask, example_circles())
        without_clods(frame.color, example_circles(), np.zeros(1))
        self.process(replace(frame, depth=None), mask, example_circles())


def equal_area_radius(shapes: Floats) -> Floats:
    """Return the radii (N,) of the circles with the area of the outlines (N, 5)."""
    return np.asarray(np.sqrt(shapes[:, 2] ** 2 + (shapes[:, 3] ** 2 + shapes[:, 4] ** 2) / 2))


def _foreground(inside: Bytes, relief: Relief) -> Bytes:
    """Return what is inside a mask or stands on the bed, (H, W) 0 or 1."""
    if not relief.known:
        return inside
    standing = (relief.height > _STANDING).view(np.uint8)
    return np.asarray(inside | doubled(standing, *inside.shape), np.uint8)
