"""The source `synthetic`: settings, determinism, motion, gaps."""

import hashlib
import importlib
import os
import subprocess
import sys
from itertools import islice

import numpy as np
import pytest
from pydantic import ValidationError

from mushpipe import RgbdFrame
from mushpipe.core.errors import DependencyError
from mushpipe.core.truth import INSTANCES_TOPIC, TRUTH_TOPIC
from mushpipe.sim.ground import RIM_HEIGHT
from mushpipe.sources.synthetic import SyntheticSource

SMALL = {"width": 160, "height": 120, "count": 15, "pins": 5}


def frames(count: int = 1, **settings) -> list[RgbdFrame]:
    return list(islice(SyntheticSource(**(SMALL | settings)).frames(), count))


def digest(frame: RgbdFrame) -> str:
    truth, instances = frame.attached[TRUTH_TOPIC], frame.attached[INSTANCES_TOPIC]
    parts = [frame.color, frame.depth, instances.labels, truth.center, truth.axis, truth.apex]
    return hashlib.sha256(b"".join(np.ascontiguousarray(p).tobytes() for p in parts)).hexdigest()


def test_the_same_settings_give_the_same_frames_however_many():
    many = [digest(frame) for frame in frames(3, seed=5)]
    assert [digest(frame) for frame in frames(2, seed=5)] == many[:2]
    assert len(set(many)) == 3
    assert digest(frames(1, seed=6)[0]) != many[0]


def test_the_hash_seed_does_not_matter():
    code = "from tests.sim.test_synthetic import *; print(digest(frames(1, seed=5)[0]))"
    found = {
        subprocess.run(
            [sys.executable, "-c", code],
            env=os.environ | {"PYTHONHASHSEED": seed},
            capture_output=True,
            text=True,
            check=True,
        ).stdout
        for seed in ("1", "2")
    }
    assert found == {digest(frames(1, seed=5)[0]) + "\n"}


def test_a_resting_camera_changes_only_the_noise():
    first, second = frames(2)
    assert first.attached[TRUTH_TOPIC] is second.attached[TRUTH_TOPIC]
    assert (first.depth != second.depth).mean() > 0.5
    assert np.abs(first.color.astype(int) - second.color).mean() < 3


def test_faults_of_depth_leave_colour_alone():
    perfect = {"noise": 0, "edges": False, "random_holes": 0, "cap_holes": 0, "offset_mm": 0}
    plain, clean = frames()[0], frames(sensor=perfect)[0]
    np.testing.assert_array_equal(plain.color, clean.color)
    assert (plain.depth != clean.depth).mean() > 0.5


def test_a_perfect_colour_camera_repeats_itself():
    quiet = {"noise": 0, "jpeg_quality": 0}
    first, second = frames(2, color=quiet)
    np.testing.assert_array_equal(first.color, second.color)


def test_exposure_brightens_and_vignette_darkens_corners():
    plane = {"scene": "plane", "light_strength": 0}
    dark, bright = (frames(**plane, color={"exposure": e})[0].color.mean() for e in (-1.0, 0.0))
    assert bright > dark + 30
    image = frames(**plane, color={"vignette": 0.8})[0].color.mean(axis=2)
    assert image[55:65, 75:85].mean() > image[:8, :8].mean() + 30


def test_a_gradient_makes_one_side_brighter():
    image = frames(scene="plane", light="gradient", color={"vignette": 0})[0].color.mean(axis=2)
    halves = [image[:60], image[60:], image[:, :80], image[:, 80:]]
    means = [half.mean() for half in halves]
    assert max(means) > min(means) + 15


def test_caps_are_brighter_than_soil_and_brown_ones_darker_than_white():
    def brightness(frame: RgbdFrame) -> tuple[float, float]:
        inside = frame.attached[INSTANCES_TOPIC].labels > 0
        return float(frame.color[inside].mean()), float(frame.color[~inside].mean())

    white, soil = brightness(frames()[0])
    brown, _ = brightness(frames(cap_color="brown")[0])
    assert white > brown + 30
    assert brown > soil + 20


def test_the_two_families_differ():
    a, b = (frames(shape_family=family)[0] for family in "ab")
    assert (a.attached[INSTANCES_TOPIC].labels != b.attached[INSTANCES_TOPIC].labels).any()


@pytest.mark.parametrize("scene", ["bed", "lab", "plane"])
@pytest.mark.parametrize("light", ["even", "gradient", "side", "spot", "harsh"])
def test_every_scene_in_every_light(scene, light):
    frame = frames(scene=scene, light=light, width=96, height=72)[0]
    assert frame.color.std() > 0
    assert (frame.depth > 0).mean() > 0.5
    assert len(frame.attached[TRUTH_TOPIC]) == 0 or scene != "plane"


@pytest.mark.parametrize("table", ["wood", "cloth", "paint"])
def test_printed_mushrooms_stand_on_every_table(table):
    frame = frames(scene="lab", table=table, count=8, size_mm=(34, 48))[0]
    truth = frame.attached[TRUTH_TOPIC]
    assert len(truth) > 3
    assert (truth.diameter > 0.033).all()


def test_models_of_wood_are_brown_and_striped():
    lab = {"scene": "lab", "count": 8, "size_mm": (40, 50), "clutter": 0, "distance": 0.3}

    def caps(**settings: str) -> np.ndarray:
        frame = frames(**lab, **settings)[0]
        return frame.color[frame.attached[INSTANCES_TOPIC].labels > 0].astype(float)

    wood, plastic = caps(cap_color="wood"), caps()
    assert (wood[:, 0] - wood[:, 2]).mean() > (plastic[:, 0] - plastic[:, 2]).mean() + 20


def test_a_bed_with_everything_on_it():
    frame = frames(tray=True, stumps=4, fallen=4, cap_color="mixed", tilt_deg=(20, 45))[0]
    truth = frame.attached[TRUTH_TOPIC]
    upright = truth.axis[truth.ignore == 0]
    tilt = np.degrees(np.arccos(-upright[:, 2]))
    assert ((tilt > 19.9) & (tilt < 45.1)).all()


def test_the_rim_of_a_tray_stands_at_the_left_and_nowhere_else():
    """A plank 16 mm wide, whose inner face is at 0.09 of the view of the bed."""
    perfect = dict.fromkeys(("shadow", "grazing", "highlights", "edges"), False)
    perfect |= {"noise": 0, "offset_mm": 0, "cap_holes": 0, "random_holes": 0}
    empty = SMALL | {"count": 0, "pins": 0, "distance": 0.5, "sensor": perfect}
    bare, rimmed = (next(SyntheticSource(**empty, tray=tray).frames()) for tray in (False, True))
    away = 0.5 - RIM_HEIGHT
    right = round(160 * (0.5 - 0.41 * 0.5 / away))  # px; what is higher is seen further out
    left = right - round(0.016 * rimmed.camera.fx / away)
    top = rimmed.depth_m[:, left + 1 : right - 1]
    assert top.shape[1] > 1
    np.testing.assert_allclose(top, away, atol=2e-4)
    assert (rimmed.depth_m != bare.depth_m)[:, 17:].mean() < 0.02  # small things on the bed


def test_a_tilted_camera_sees_a_tilted_bed():
    frame = frames(scene="plane", camera_tilt_deg=15, sensor={"noise": 0})[0]
    column = frame.depth_m[:, 80]
    assert abs(np.nanmean(column[:30]) - np.nanmean(column[-30:])) > 0.03


def test_the_gantry_moves_to_and_fro():
    source = SyntheticSource(**SMALL, step_mm=20, travel_mm=50)
    assert [round(1000 * source._along(k, 0.05)) for k in range(6)] == [0, 20, 40, 40, 20, 0]
    first, second = frames(2, step_mm=20, seed=2)
    before, after = (f.attached[TRUTH_TOPIC] for f in (first, second))
    common, i, j = np.intersect1d(before.id, after.id, return_indices=True)
    assert len(common) > 3
    np.testing.assert_allclose(after.apex[j] - before.apex[i], [[-0.02, 0, 0]] * len(i), atol=1e-6)


def test_missing_depth_and_a_gap_in_time():
    found = frames(4, missing_depth=2, gap_after=2, gap_s=3, fps=10)
    assert [frame.depth is None for frame in found] == [False, True, False, True]
    steps = np.diff([frame.header.stamp_ns for frame in found]) / 1e9
    np.testing.assert_allclose(steps, [0.1, 3.1, 0.1])


@pytest.mark.parametrize(
    "wrong",
    [
        {"tilt_deg": (0, 60)},
        {"tilt_deg": (30, 10)},
        {"size_mm": (1, 50)},
        {"scene": "field"},
        {"shape_family": "c"},
        {"distance": 0},
        {"sensor": {"unit_mm": 0}},
        {"sensor": {"nois": 1}},
        {"color": {"jpeg_quality": 101}},
        {"lamps": 3},
        {"step_mm": 5, "travel_mm": 0},
        {"width": 64, "height": 240, "camera_tilt_deg": 20},
    ],
)
def test_wrong_settings_are_refused(wrong):
    with pytest.raises(ValidationError):
        SyntheticSource(**wrong)


def test_a_high_image_sees_ground_or_floor_everywhere():
    high = {"width": 64, "height": 240, "camera_tilt_deg": 7, "distance": 2}
    far = {"range_m": (0.2, 12), "unit_mm": 0.5, "random_holes": 0}
    off = dict.fromkeys(("grazing", "shadow", "edges"), False)
    (frame,) = frames(**high, scene="plane", sensor=far | off)
    assert (frame.depth > 0).all()


def test_every_setting_is_described():
    for name, field in SyntheticSource.model_fields.items():
        assert field.description, name


def test_without_open3d_the_error_names_the_packages(monkeypatch):
    def missing(name: str) -> None:
        raise ImportError("libGL.so.1: cannot open shared object file")

    monkeypatch.setattr(importlib, "import_module", missing)
    with pytest.raises(DependencyError, match="apt-get install libgl1") as caught:
        frames()
    assert "\n" not in str(caught.value)
