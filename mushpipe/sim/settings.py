"""What a simulated scene is made of: settings with their units and bounds."""

from __future__ import annotations

import math
from typing import Literal, Self

from pydantic import Field, model_validator

from mushpipe import Camera
from mushpipe.core.group import Group

FOCAL_PX = 617.0  # SR300 colour at 640x480, librealsense issue 10838
SLANTED_DEG = 70  # off the vertical; what looks farther aside may pass the floor's edge


class SceneSettings(Group):
    """The scene under the camera: what grows where, in which light."""

    scene: Literal["bed", "lab", "plane"] = Field(
        "bed", description="growing bed, printed mushrooms on a table, or a bare plane"
    )
    seed: int = Field(0, ge=0, description="seed of everything random")
    width: int = Field(640, ge=64, le=1920, description="image width, px")
    height: int = Field(480, ge=48, le=1440, description="image height, px")
    distance: float = Field(0.5, ge=0.15, le=2, description="camera to bed, m")
    camera_tilt_deg: float = Field(0, ge=0, le=20, description="camera off the vertical, degrees")
    count: int = Field(80, ge=0, le=400, description="mushrooms in view, about")
    cluster: float = Field(0.75, ge=0, le=1, description="0 spread out, 1 all in tight clusters")
    size_mm: tuple[float, float] = Field(
        (16, 58), description="smallest and largest cap diameter, mm (5 to 150)"
    )
    tilt_deg: tuple[float, float] = Field(
        (0, 20), description="smallest and largest tilt of a cap off the vertical, degrees (0-45)"
    )
    shape_family: Literal["a", "b"] = Field(
        "a", description="a: superellipse domes; b: Bezier domes, conical to flat-topped"
    )
    cap_color: Literal["white", "cream", "brown", "mixed", "wood"] = Field(
        "white", description="colour of the caps; wood: turned models with thick stems"
    )
    pins: int = Field(40, ge=0, le=300, description="mushrooms too small to pick, in view, about")
    stumps: int = Field(1, ge=0, le=40, description="stems left by a cut, in view, about")
    fresh: float = Field(
        0, ge=0, le=1, description="share of stumps cut just now: white and flat, and some larger"
    )
    fallen: int = Field(0, ge=0, le=40, description="caps lying on their side, in view, about")
    lean: float = Field(0, ge=0, le=1, description="how far stems lean and show beside their caps")
    sunk: float = Field(
        0, ge=0, le=1, description="how deep mushrooms stand in the soil; 1: some up to the rim"
    )
    deform: float = Field(
        0, ge=0, le=1, description="departure of caps from their family; 0: as the family has it"
    )
    old: float = Field(
        0, ge=0, le=1, description="share of old caps: open, low, their middle often sunk"
    )
    printed: bool = Field(
        True, description="the lab's mushrooms are printed ones; else real ones, cut"
    )
    mycelium: float = Field(0.5, ge=0, le=1, description="white threads, patches and primordia")
    soil: float = Field(1, ge=0.2, le=6, description="brightness of the soil; dry soil is 2 to 4")
    wet: float = Field(0, ge=0, le=1, description="wet soil: darker and glossy")
    relief_mm: float = Field(
        0, ge=0, le=10, description="lumps of the soil, standard deviation of its height, mm"
    )
    rubble: int = Field(
        0, ge=0, le=300, description="clods and stones as large as caps, in view, about"
    )
    pebbles: int = Field(
        0, ge=0, le=300, description="smooth stones of any colour, as large as caps, in view, about"
    )
    foreign: int = Field(0, ge=0, le=20, description="papers, boxes, cups and rails on the bed")
    lids: int = Field(0, ge=0, le=60, description="round lids and paper discs that lie flat")
    tray: bool = Field(False, description="show the rim of the tray at the left")
    table: Literal["wood", "cloth", "paint"] = Field("wood", description="table of the lab scene")
    clutter: int = Field(4, ge=0, le=20, description="papers, boxes and cups on the lab's table")
    light: Literal["even", "gradient", "side", "spot", "harsh"] = Field(
        "even",
        description="soft from above, one side brighter, low lamp, bright centre, bare flash",
    )
    light_strength: float = Field(
        1, ge=0, le=1, description="how far the light departs from even: 0 not at all"
    )
    largest_px: float = Field(
        80, gt=8, description="caps of a larger outline are marked too large in the truth, px"
    )

    @model_validator(mode="after")
    def _ranges(self) -> Self:
        for name, low, high in (("size_mm", 5.0, 150.0), ("tilt_deg", 0.0, 45.0)):
            first, last = getattr(self, name)
            if not low <= first <= last <= high:
                raise ValueError(
                    f"{name} is {first}, {last}: expected {low} <= first <= last <= {high}"
                )
        aside = math.degrees(math.atan(self.height / 2 / self.camera().fy)) + self.camera_tilt_deg
        if aside > SLANTED_DEG:
            raise ValueError(
                f"an image of {self.width}x{self.height} px looks up to {aside:.0f} degrees "
                f"off the vertical, expected at most {SLANTED_DEG}: make it wider, or less high"
            )
        return self

    def camera(self) -> Camera:
        """Return the camera: a pinhole with the SR300's colour field of view."""
        focal = FOCAL_PX * self.width / 640
        center = (self.width - 1) / 2, (self.height - 1) / 2
        return Camera(self.width, self.height, focal, focal, *center)

    def pixel(self) -> float:
        """Return the size of a pixel on the bed, m."""
        return self.distance / self.camera().fx
