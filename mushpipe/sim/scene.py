"""A scene under a moving or resting camera: everything that stays is computed once."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from mushpipe.core.arrays import Bools, Bytes, Singles
from mushpipe.core.truth import Instances, Truth
from mushpipe.sim.annotate import annotate
from mushpipe.sim.light import ambient, lit, rig_for
from mushpipe.sim.material import Paint, Painter
from mushpipe.sim.noise import generator
from mushpipe.sim.photo import ColorCamera
from mushpipe.sim.render import Surface, look
from mushpipe.sim.sensor import DepthSensor, Exact
from mushpipe.sim.settings import SceneSettings
from mushpipe.sim.world import View, make_world, view_at

_SUBPIXELS = np.array([[-0.34, -0.05], [0.13, -0.32], [0.21, 0.37]])


@dataclass(frozen=True, eq=False)
class Still:
    """What is the same in every frame taken from one place.

    Attributes:
        image: (H, W, 3) exposed light, before noise.
        exact: Depth before noise.
        truth: The mushrooms in view.
        instances: Whose pixel is whose.
    """

    image: Singles
    exact: Exact
    truth: Truth
    instances: Instances


class Scene:
    """A seeded scene; the same settings give the same frames, in any order.

    Args:
        settings: What to build.
        color: The colour camera.
        depth: The depth camera.
        travel: How far along x (m) the camera may go.

    Raises:
        DependencyError: open3d or a library of the system is missing.
    """

    def __init__(
        self, settings: SceneSettings, color: ColorCamera, depth: DepthSensor, travel: float = 0.0
    ) -> None:
        self._settings, self._color, self._depth = settings, color, depth
        self._world = make_world(settings, travel)
        self._painter = Painter(self._world, generator(settings.seed, "texture"))
        self._rig = rig_for(settings, generator(settings.seed, "light"))
        self._place: float | None = None
        self._still: Still | None = None

    def still(self, along: float) -> Still:
        """Return the view from `along` m; it is kept until the camera moves."""
        if self._still is None or self._place != along:
            self._still, self._place = self._take(view_at(self._settings, along)), along
        return self._still

    def _take(self, view: View) -> Still:
        seed = self._settings.seed
        surface = look(self._world, view)
        paint = self._painter(surface)
        light = self._light(surface, paint, view)
        image = self._color.expose(light, generator(seed, "photo"))
        exact = self._depth.scan(self._world, view, surface, paint, seed)
        truth, instances = annotate(self._world, view, surface, self._settings.largest_px)
        return Still(image, exact, truth, instances)

    def _light(self, surface: Surface, paint: Paint, view: View) -> Singles:
        """Return the light (H, W, 3) of each pixel; at edges the mean of several rays."""
        sky = ambient(self._world, surface, generator(self._settings.seed, "ambient"))
        light = lit(self._world, surface, paint, self._rig, surface.blend(sky))
        rows = np.flatnonzero(_edges(surface))
        total = np.zeros((len(rows), 3), np.float32)
        v, u = np.divmod(rows, surface.shape[1])
        for offset in _SUBPIXELS:
            part = look(self._world, view, np.stack([u, v], axis=-1) + offset)
            total += lit(self._world, part, self._painter(part), self._rig, part.blend(sky))
        light[rows] = total / len(_SUBPIXELS)
        return light.reshape(*surface.shape, 3)

    def color(self, still: Still, frame: int) -> Bytes:
        """Return the colour image (H, W, 3) of a frame."""
        return self._color.develop(
            still.image, generator(self._settings.seed, "photo frame", frame)
        )

    def depth(self, still: Still, frame: int) -> NDArray[np.uint16]:
        """Return the depth image (H, W) of a frame, in the sensor's unit."""
        return self._depth.sense(still.exact, self._settings.seed, frame)


def _edges(surface: Surface) -> Bools:
    """Return (P,) where a neighbour belongs to something else or is of another material."""
    kind = (surface.owner * 16 + surface.material).astype(np.float32).reshape(surface.shape)
    kernel = np.ones((3, 3), np.uint8)
    return np.asarray(cv2.dilate(kind, kernel) != cv2.erode(kind, kernel)).ravel()
