"""Chan-Vese active contour without edges, started at Otsu's threshold (paper, section III)."""

from __future__ import annotations

from typing import Literal, Self

import numpy as np
from pydantic import Field, model_validator

from mushpipe import Mask, RgbdFrame, Stage
from mushpipe.core.arrays import Bools, Singles
from mushpipe.stages.channels import MANY, Channel, channel_image, inverted
from mushpipe.stages.otsu import initial_contour
from mushpipe.stages.polarity import rise
from mushpipe.stages.warm_up import example_frame

SUNKEN_M = 0.003  # a bright side that lies this much lower is the bed


class ChanVese(Stage):
    """Segments by the Chan-Vese active contour (Chan & Vese 2001) with Otsu's start.

    `fast` minimises the discrete energy, on beds to within a few thousandths of its exact minimum.
    `pde` is the paper's level set (lambda1 = lambda2 = 1, nu = 0, p = 1) by scikit-image.
    `morphological` replaces the length by curvature steps (Marquez-Neila et al. 2014).
    """

    solver: Literal["fast", "pde", "morphological"] = Field("fast", description="how to minimise")
    channel: Channel = Field("gray", description="what it looks at; the paper found gray best")
    polarity: Literal["auto", "bright", "dark"] = Field(
        "auto", description="what caps are; auto: bright, unless depth shows the dark side nearer"
    )
    check: bool = Field(
        True, description="empty mask where there are no two classes; false is plain Otsu"
    )
    mu: float = Field(
        0.1,
        gt=0,
        le=1000,
        description="weight of the contour's length, on gray in 0..1; `pde` stretches gray to it",
    )
    iterations: int = Field(
        100, ge=1, le=10_000, description="most iterations of `pde` and `morphological`"
    )
    smoothing: int = Field(
        1, ge=0, le=100, description="`morphological`: curvature steps per iteration"
    )
    tolerance: float = Field(1e-3, gt=0, description="`pde`: stop when the level set moves less")

    @model_validator(mode="after")
    def _one_channel(self) -> Self:
        if self.channel in MANY and self.solver != "fast":
            raise ValueError(f"channel {self.channel} needs solver fast")
        return self

    def open(self) -> None:
        """Compile the kernels."""
        self.process(example_frame())
        self.process(example_frame(cap=20))  # inverted it is no longer the frame's own array

    def process(self, frame: RgbdFrame) -> Mask:
        """Return the mask with the contour it started from."""
        image = channel_image(frame, self.channel)
        if self.polarity == "dark":
            image = inverted(image, self.channel)
        found = initial_contour(image, self.check)
        if self.polarity == "auto" and rise(frame, found.region) < -SUNKEN_M:
            image = inverted(image, self.channel)
            found = initial_contour(image, self.check)
        initial = found.region
        if not initial.any() or initial.all():
            return Mask(initial, initial)
        if found.floor and image.ndim == 2:  # two phases, not bed, mycelium and caps
            image = np.maximum(image, np.float32(found.floor))
        region = self.solve(image, initial)
        if self.channel == "gray+height" and image.ndim == 3:
            # Where hardly anything stands out, the relief of the soil would be the two sides.
            region &= initial | (image[..., 1] >= 0.5)
        return Mask(region, initial)

    def solve(self, image: Singles, initial: Bools) -> Bools:
        """Evolve a region of an image in 0..1 with the chosen solver."""
        if self.solver == "fast":
            from mushpipe.stages.chan_vese_fast import solve_fast

            return solve_fast(image, initial, self.mu)
        if self.solver == "morphological":
            from mushpipe.stages.chan_vese_morph import solve_morphological

            return solve_morphological(image, initial, self.iterations, self.smoothing)
        return self._solve_pde(image, initial)

    def _solve_pde(self, image: Singles, initial: Bools) -> Bools:
        from scipy.ndimage import distance_transform_edt
        from skimage.segmentation import chan_vese

        # Signed distance, clipped: the solver's delta function reaches a few pixels only.
        start = distance_transform_edt(initial) - distance_transform_edt(~initial)
        region: Bools = chan_vese(
            image,
            mu=self.mu,
            lambda1=1,
            lambda2=1,
            tol=self.tolerance,
            max_num_iter=self.iterations,
            init_level_set=np.clip(start, -5, 5) / 5,
        )
        # The level set knows no inside: keep the side that Otsu's contour began with.
        same = np.count_nonzero(region == initial) >= region.size / 2
        return region if same else ~region
