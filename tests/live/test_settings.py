"""Presets, which librealsense's software device does not have, and the graph for a camera."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from mushpipe.core.document import read_document
from mushpipe.core.errors import DeviceError, UsageError
from mushpipe.core.graph import compile_document
from mushpipe.core.libraries import import_realsense
from mushpipe.core.plugins import load_registry
from mushpipe.sources.realsense_device import camera_of, set_preset

rs = import_realsense()
ROOT = Path(__file__).parents[2]
# As librealsense 2.54 calls the presets of an SR300.
NAMES = ["Short Range", "Long Range", "Background Segmentation", "Gesture Recognition"]


class Sensor:
    """The presets of a depth sensor; it may refuse them."""

    def __init__(self, refuses: bool = False) -> None:
        self.refuses = refuses
        self.chosen: float | None = None

    def supports(self, option) -> bool:
        return option == rs.option.visual_preset

    def get_supported_options(self):
        return [rs.option.visual_preset]

    def is_option_read_only(self, option) -> bool:
        return False

    def get_option_range(self, option):
        return SimpleNamespace(min=0.0, max=len(NAMES) - 1.0, default=0.0)

    def get_option_value_description(self, option, value):
        return NAMES[int(value)]

    def set_option(self, option, value) -> None:
        if self.refuses:
            raise RuntimeError("hwmon command failed")
        self.chosen = value


@pytest.mark.parametrize(("preset", "number"), [("long-range", 1), ("Short Range", 0), (3, 3)])
def test_a_preset_is_chosen_by_name_or_number(preset, number):
    sensor = Sensor()
    set_preset(sensor, preset)
    assert sensor.chosen == number


@pytest.mark.parametrize(
    ("preset", "message"),
    [
        ("long-rage", "source.preset: no 'long-rage'; did you mean 'long-range'?"),
        (9, "source.preset: 9 is outside of what this camera takes, 0 to 3 (default 0)"),
    ],
)
def test_a_preset_the_camera_does_not_have(preset, message):
    with pytest.raises(UsageError) as caught:
        set_preset(Sensor(), preset)
    assert str(caught.value) == message


def test_a_camera_that_refuses_a_setting():
    message = "source.preset: the camera did not take 1: hwmon command failed"
    with pytest.raises(DeviceError, match=message):
        set_preset(Sensor(refuses=True), "long-range")


@pytest.mark.parametrize(
    ("model", "coefficients", "expected"),
    [
        ("none", (0.0,) * 5, "none"),
        ("inverse_brown_conrady", (0.0,) * 5, "none"),
        ("brown_conrady", (0.1, 0, 0, 0, 0), "brown_conrady"),
    ],
)
def test_lens_models(model, coefficients, expected):
    given = rs.intrinsics()
    given.width, given.height, given.fx, given.fy = 640, 480, 600.0, 600.0
    given.model, given.coeffs = getattr(rs.distortion, model), list(coefficients)
    assert camera_of(given).model == expected


@pytest.mark.parametrize("model", ["brown_conrady", "inverse_brown_conrady"])
def test_rays_are_those_of_librealsense(model):
    given = rs.intrinsics()  # of a D455, as its owner published it
    given.width, given.height, given.fx, given.fy = 640, 480, 385.0, 384.4
    given.ppx, given.ppy, given.model = 321.7, 238.9, getattr(rs.distortion, model)
    given.coeffs = [-0.0565362684, 0.0682018697, 0.0003659752, 0.0006925757, -0.0218431670]
    pixels = np.array([(x, y) for x in range(0, 640, 71) for y in range(0, 480, 53)], float)
    rays = [rs.rs2_deproject_pixel_to_point(given, pixel, 1.0) for pixel in pixels.tolist()]
    found = camera_of(given).deproject(pixels, np.ones(len(pixels)))
    assert found == pytest.approx(np.array(rays), abs=5e-5)  # it iterates ten times


@pytest.mark.parametrize("first", [0.1, 0.0])
def test_a_lens_that_cannot_be_handled_is_refused(first):
    given = rs.intrinsics()
    given.width, given.height, given.fx, given.fy = 640, 480, 600.0, 600.0
    given.model, given.coeffs = rs.distortion.kannala_brandt4, [first, 0, 0, 0, 0]
    with pytest.raises(DeviceError, match="lens model 'kannala_brandt4' is not supported"):
        camera_of(given)


def test_the_graph_for_a_camera_is_right_and_takes_a_recording_in_its_place():
    document = read_document(ROOT / "graphs/live.yaml")
    plan = compile_document(document, load_registry())
    assert not plan.replay()
    assert plan.warnings == ()
    document = read_document(ROOT / "graphs/live.yaml")
    assert compile_document(document, load_registry(), [], "field.bag").replay()
