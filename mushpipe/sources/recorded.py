"""What sources that play recorded messages have in common."""

from __future__ import annotations

from collections import Counter
from typing import Annotated

from pydantic import Field, PrivateAttr

from mushpipe.core.geometry import Camera
from mushpipe.core.group import Group
from mushpipe.core.stage import Source

NO_DEPTH = "%s has no depth: positions, distances and diameters will be missing"
NO_CAMERA = "%s has no calibration%s: nothing can be measured in metres"
DepthScale = Annotated[float, Field(ge=1e-9, le=1)]  # m per unit: no camera has more, or less


class Intrinsics(Group):
    """A pinhole camera without distortion, for recordings that carry no calibration."""

    fx: float = Field(ge=1e-3, le=1e6, description="focal length along x, px")
    fy: float = Field(ge=1e-3, le=1e6, description="focal length along y, px")
    cx: float = Field(description="principal point, x, px")
    cy: float = Field(description="principal point, y, px")

    def of_image(self, size: tuple[int, ...], first: tuple[int, ...]) -> Camera:
        """Return the camera of an image.

        Args:
            size: Height and width, px.
            first: Those of the first image, which these intrinsics are taken to be of.

        Raises:
            ValueError: The size is another, or these intrinsics are of larger images.
        """
        here = f"{size[1]}x{size[0]}"
        if size != first:
            raise ValueError(
                f"the image is {here}, the first one {first[1]}x{first[0]}: source.camera holds "
                "for images of one size"
            )
        camera = Camera(size[1], size[0], self.fx, self.fy, self.cx, self.cy)
        if not camera.centred:
            raise ValueError(
                f"the principal point of source.camera, ({self.cx:g}, {self.cy:g}), lies outside "
                f"of the image, which is {here}: intrinsics for that size are expected"
            )
        return camera


class RecordedSource(Source):
    """A source that reads recorded messages: its settings, and what of these was of no use."""

    color_topic: str | None = Field(None, description="colour images; chosen by name if not given")
    depth_topic: str | None = Field(None, description="depth images aligned to colour")
    camera_topic: str | None = Field(None, description="calibration of the colour images")
    use_depth: bool = Field(True, description="false plays colour only")
    depth_scale: DepthScale | None = Field(
        None, description="metres per unit of depth, where the recording does not say it"
    )
    pair_tolerance_ms: float = Field(
        15.0,
        ge=0,
        le=1e9,
        description="largest difference of the stamps of a colour and a depth image",
    )
    camera: Intrinsics | None = Field(
        None, description="intrinsics, in place of those of the recording"
    )

    _counts: Counter[str] = PrivateAttr(default_factory=Counter)

    def counts(self) -> dict[str, int]:
        """Return how many images found no partner or could not be decoded."""
        return {name: count for name, count in sorted(self._counts.items()) if count}
