"""A plane under a small camera, and mushrooms put on it one by one."""

from __future__ import annotations

from collections.abc import Callable

import pytest

from mushpipe.core.errors import DependencyError
from mushpipe.core.libraries import import_open3d
from mushpipe.sim.mesh import Material
from mushpipe.sim.mushroom import Mushroom
from mushpipe.sim.planting import Area
from mushpipe.sim.settings import SceneSettings
from mushpipe.sim.table import target
from mushpipe.sim.world import World, assemble


@pytest.fixture(autouse=True)
def _open3d() -> None:
    try:
        import_open3d()
    except DependencyError as error:
        pytest.skip(str(error))


@pytest.fixture
def settings() -> SceneSettings:
    """A plane at 50 cm under a 320x240 camera."""
    return SceneSettings(scene="plane", distance=0.5, width=320, height=240)


@pytest.fixture
def build(settings: SceneSettings) -> Callable[..., World]:
    """Return a function that puts mushrooms on the plane; `pixel` small makes fine meshes."""

    def make(*mushrooms: Mushroom, pixel: float = 0.0004) -> World:
        ground = target(Area(-0.4, 0.4, -0.3, 0.3), 0.01)
        assert ground.material == Material.TARGET
        return assemble(ground, list(mushrooms), [ground.mesh(0.05)], pixel)

    return make
