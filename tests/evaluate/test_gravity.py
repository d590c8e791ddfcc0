"""`mushpipe calibrate up`, on recordings that another library has written."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml
from scipy.spatial.transform import Rotation
from typer.testing import CliRunner

from mushpipe.cli import app
from mushpipe.core.arrays import Floats
from mushpipe.core.errors import InputError, UsageError
from mushpipe.evaluate.gravity import measure_up
from tests.io.bags import (
    ALIGNED,
    COLOR,
    COLOR_INFO,
    T0,
    Entry,
    camera_info,
    header,
    raw_image,
    ros,
    write_bag,
)

ACCEL, GYRO = "/camera/camera/accel/sample", "/camera/camera/gyro/sample"
OPTICAL = "camera_accel_optical_frame"
# 10 degrees off -z, towards +x
UP = np.array([np.sin(np.radians(10)), 0, -np.cos(np.radians(10))])


def imu(acceleration: Floats, frame_id: str = OPTICAL) -> Any:
    def vector(values: Floats) -> Any:
        x, y, z = map(float, values)
        return ros("geometry_msgs/msg/Vector3", x=x, y=y, z=z)

    still = ros("geometry_msgs/msg/Quaternion", x=0.0, y=0.0, z=0.0, w=1.0)
    unknown = np.zeros(9)
    return ros(
        "sensor_msgs/msg/Imu",
        header=header(T0, frame_id),
        orientation=still,
        orientation_covariance=unknown,
        angular_velocity=vector(np.zeros(3)),
        angular_velocity_covariance=unknown,
        linear_acceleration=vector(acceleration),
        linear_acceleration_covariance=unknown,
    )


def readings(
    up: Floats = UP,
    strength: float = 9.81,
    sway_deg: float = 0.0,
    frame_id: str = OPTICAL,
    topic: str = ACCEL,
) -> list[Entry]:
    """Two hundred readings, which lean by an angle to four sides in turn."""
    sides = np.cross(up, np.eye(3)[np.argmin(np.abs(up))])
    sides /= np.linalg.norm(sides)
    turns = [np.radians(90 * k) * up for k in range(200)]
    axes = Rotation.from_rotvec(turns).apply(sides)
    values = Rotation.from_rotvec(np.radians(sway_deg) * axes).apply(strength * up)
    return [(topic, T0 + k, imu(value, frame_id)) for k, value in enumerate(values)]


def plane_frame(up: Floats) -> list[Entry]:
    """A frame of a plane square to `up`, half a metre away along the optical axis, mm."""
    size = width, height = 320, 240
    v, u = np.mgrid[:height, :width]
    rays = np.stack([(u - 160) / 300, (v - 120) / 300, np.ones_like(u)], axis=-1)
    depth = 500 * up[2] / (rays @ up)
    info = camera_info(size=size, k=(300, 0, 160, 0, 300, 120, 0, 0, 1))
    color = np.zeros((height, width, 3), np.uint8)
    pixels = np.rint(depth).astype(np.uint16)
    return [
        (COLOR_INFO, T0, info),
        (COLOR, T0, raw_image(color, "rgb8")),
        (ALIGNED, T0 + 1, raw_image(pixels, "16UC1")),
    ]


def test_up_is_the_mean_reading_and_is_held_against_the_bed(tmp_path: Path) -> None:
    lean = Rotation.from_rotvec([np.radians(4), 0, 0]).apply(UP)
    found = measure_up(write_bag(tmp_path, [*plane_frame(lean), *readings(sway_deg=2)]))
    np.testing.assert_allclose(found.up, UP, atol=1e-6)
    assert (found.topic, found.frame_id, found.count) == (ACCEL, OPTICAL, 200)
    assert found.sway_deg == pytest.approx(2, abs=1e-4)
    assert found.strength == pytest.approx(9.81 * np.cos(np.radians(2)), abs=1e-4)
    bed = np.degrees(np.arccos(lean @ UP))
    assert found.beside_bed_deg == pytest.approx(bed, abs=0.3)


def test_the_command_prints_what_the_setting_takes(tmp_path: Path) -> None:
    bag = write_bag(tmp_path, [*readings(), *readings(strength=0.01, topic=GYRO)])
    done = CliRunner().invoke(app, ["calibrate", "up", str(bag)])
    assert done.exit_code == 0
    (written,) = yaml.safe_load(done.stdout).items()
    assert written[0] == "up"
    np.testing.assert_allclose(written[1], UP, atol=1e-4)
    assert "200 readings of /camera/camera/accel/sample" in done.stdout
    assert "bed" not in done.stdout


@pytest.mark.parametrize(
    ("entries", "topic", "error", "text"),
    [
        (readings(sway_deg=4), None, InputError, "sways by 4.0 degrees: the camera did not rest"),
        (readings(strength=1), None, InputError, "reads 1.00 m/s^2 in the mean"),
        (readings(strength=0), None, InputError, "reads 0.00 m/s^2 in the mean"),
        (readings(strength=np.nan), None, InputError, "such as are no numbers"),
        (readings(frame_id="imu_link"), None, InputError, "is along the axes of 'imu_link', and"),
        (
            plane_frame(np.array([0, 0, -1.0])) + readings(np.array([0, -1.0, 0])),
            None,
            InputError,
            "up is 90 degrees from the normal of what depth shows",
        ),
        (plane_frame(UP), None, InputError, "it holds no sensor_msgs/msg/Imu"),
        (readings() + readings(topic="/imu"), None, UsageError, f"--topic {ACCEL} or --topic /imu"),
        (readings(), "/imuu", UsageError, "there is no topic '/imuu'"),
        (plane_frame(UP) + readings(), COLOR, UsageError, "holds sensor_msgs/msg/Image, expected"),
    ],
)
def test_what_is_not_gravity_along_the_cameras_axes_is_refused(
    entries: list[Entry], topic: str | None, error: type[Exception], text: str, tmp_path: Path
) -> None:
    with pytest.raises(error) as caught:
        measure_up(write_bag(tmp_path, entries), topic)
    assert text in str(caught.value)


@pytest.mark.parametrize(
    ("frame", "why"),
    [
        ([], "it holds no colour images (it holds /camera/camera/accel/sample)"),
        (plane_frame(UP)[:2], "its first frame has no depth"),
        (plane_frame(UP)[1:], "it has no calibration"),
        ([*plane_frame(UP), ("/b/color", T0, plane_frame(UP)[1][2])], "several topics could be co"),
        (
            [*plane_frame(UP)[:2], ("/depth", T0, raw_image(np.zeros((240, 320), "u2"), "16UC1"))],
            "its first frame has too little depth",
        ),
        (
            [
                *plane_frame(UP)[:2],
                ("/depth", T0, raw_image(np.ones((2, 2), "u2"), "16UC1", T0, "d")),
            ],
            "depth (/depth) is in frame 'd', colour in",
        ),
    ],
)
def test_why_no_bed_tells_of_the_axes_is_said(frame: list[Entry], why: str, tmp_path: Path) -> None:
    with pytest.raises(InputError) as caught:
        measure_up(write_bag(tmp_path, [*frame, *readings(frame_id="imu_link")]))
    assert f"are the camera's (x right, y down, z forward): {why}" in str(caught.value)
    assert str(tmp_path) not in str(caught.value).split("forward)")[1]


def test_other_axes_will_do_where_the_bed_shows_that_they_are_the_cameras(tmp_path: Path) -> None:
    entries = [*plane_frame(UP), *readings(frame_id="imu")]
    found = measure_up(write_bag(tmp_path, entries), ACCEL)
    np.testing.assert_allclose(found.up, UP, atol=1e-6)
