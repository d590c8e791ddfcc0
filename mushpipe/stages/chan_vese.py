"""Chan-Vese active contour without edges, started at Otsu's threshold (paper, section III)."""

from __future__ import annotations

import numpy as np
from pydantic import Field
from scipy.ndimage import distance_transform_edt
from skimage.segmentation import chan_vese

from mushpipe import Mask, RgbdFrame, Stage
from mushpipe.stages.otsu import otsu_foreground


class ChanVese(Stage):
    """Segments by the Chan-Vese active contour (Chan & Vese 2001) on gray.

    The level set of scikit-image with lambda1 = lambda2 = 1, from the signed distance to Otsu's
    contour. The polarity is that of the start: caps are brighter than the bed.
    """

    mu: float = Field(0.1, gt=0, description="weight of the contour's length, on gray in 0..1")
    iterations: int = Field(100, ge=1, description="most iterations of the level set")
    tolerance: float = Field(
        1e-3, gt=0, description="stop when the level set moves less than this (L2 norm, per pixel)"
    )

    def process(self, frame: RgbdFrame) -> Mask:
        """Return the mask with the contour it started from."""
        initial = otsu_foreground(frame.gray)
        if not initial.any() or initial.all():
            return Mask(initial, initial)
        # Signed distance, clipped: the solver's delta function reaches a few pixels only.
        start = distance_transform_edt(initial) - distance_transform_edt(~initial)
        foreground = chan_vese(
            frame.gray,
            mu=self.mu,
            lambda1=1,
            lambda2=1,
            tol=self.tolerance,
            max_num_iter=self.iterations,
            init_level_set=np.clip(start, -5, 5) / 5,
        )
        if frame.gray[foreground].mean() < frame.gray[~foreground].mean():
            foreground = ~foreground
        return Mask(foreground, initial)
