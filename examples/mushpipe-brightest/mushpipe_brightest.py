"""The same segmenter as an installed package: `pip install .`, then `use: brightest`."""

import numpy as np
from pydantic import Field

from mushpipe import Mask, Registry, RgbdFrame, Stage, hookimpl


class Brightest(Stage):
    """Caps are the brightest part of the image."""

    share: float = Field(0.2, gt=0, lt=1, description="share of the pixels that are cap")

    def process(self, frame: RgbdFrame) -> Mask:
        """Return the pixels above the quantile."""
        return Mask(frame.gray > np.quantile(frame.gray, 1 - self.share))


@hookimpl
def mushpipe_register(registry: Registry) -> None:
    """Register the segmenter by name."""
    registry.stage("brightest", Brightest)
