"""A live camera, simulated by librealsense's software device, through the product's source."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from mushpipe import Camera
from mushpipe.core.errors import DeviceError, UsageError
from mushpipe.sources.realsense_device import find_device, info
from mushpipe.sources.realsense_frames import CLOCK_TOPIC, LOST, UNPAIRED, Domain
from tests.live.rig import COLOR, DEPTH, SERIAL, SYSTEM, UNITS, Rig


def receive(rig: Rig, numbers, **settings):
    """Feed these frames one by one; return what came of it and the source's counts."""
    source = rig.source(**settings)
    source.open()
    frames, received = source.frames(), []
    for i in numbers:
        rig.feed(i)
        received.append(next(frames))
    source.close()
    return received, source.counts()


def test_60_of_60_frames_arrive_exact_and_stay_so():
    """All are kept while more arrive: each must be a copy."""
    received, counts = receive(Rig(depth=COLOR, shift=(0, 0, 0)), range(60))
    for i, frame in enumerate(received):
        assert frame.header.sequence == i
        assert (frame.color == i).all()
        assert frame.depth is not None
        assert set(np.unique(frame.depth)) <= {0, 4000 + i}
        assert (frame.depth == 4000 + i).mean() > 0.97
        assert frame.depth_scale == pytest.approx(UNITS, rel=1e-6)
        camera = frame.camera
        assert camera is not None
        assert (camera.width, camera.height, camera.model) == (160, 120, "none")
        found = (camera.fx, camera.fy, camera.cx, camera.cy)
        assert found == pytest.approx((COLOR.fx, COLOR.fy, COLOR.cx, COLOR.cy))
    assert counts == {}


@pytest.mark.parametrize(
    ("shift", "turn"),
    [((0.025, 0.0, 0.0), (0.0, 0.0, 0.0)), ((0.025, -0.001, 0.004), (0.02, -0.03, 0.01))],
    ids=["beside", "turned"],
)
def test_depth_is_aligned_to_colour_as_an_independent_projection_says(shift, turn):
    """A tilted plane seen by both cameras; the expectation comes from mushpipe's camera model."""
    color, depth = scaled(COLOR), scaled(DEPTH)
    rotation = Rotation.from_rotvec(turn).as_matrix()
    normal, offset = np.array([0.3, -0.2, -1.0]), -0.5  # of the depth camera
    seen = np.rint(plane(depth, normal, offset) / UNITS).astype(np.uint16)
    turned = rotation @ normal
    expected = plane(color, turned, offset + turned @ shift)
    rig = Rig(color, depth, shift=shift, turn=turn)
    source = rig.source()
    source.open()
    rig.feed(0, {"depth": seen, "color": rig.images(0)["color"]})
    frame = next(source.frames())
    source.close()
    inner = (slice(32, -32), slice(96, -96))
    error = np.abs(frame.depth_m - expected)[inner]
    assert np.isfinite(error).mean() > 0.999
    # From one depth pixel to the next the plane falls by 0.4 mm; a pixel may get its neighbour's.
    assert np.nanmax(error) < 0.001
    assert np.nanmedian(error) < 0.0003
    assert np.median(np.abs(seen * UNITS - expected)[inner]) > 0.004


@pytest.mark.parametrize("model", ["brown_conrady", "inverse_brown_conrady"])
def test_depth_lies_where_a_colour_lens_shows_it(model):
    """librealsense aligns as if there were no lens; the coefficients are those of a D455."""
    coefficients = (-0.0565, 0.0682, 0.0004, 0.0007, -0.0218)
    lens = Camera(640, 480, 387.0, 386.0, 321.5, 243.0, model, coefficients)
    sight = Camera(640, 480, 387.0, 387.0, 318.0, 240.0)
    rig = Rig(color=lens, depth=sight, shift=(-0.059, 0.0, 0.0))
    source = rig.source()
    source.open()
    frames, color = source.frames(), rig.images(0)["color"]
    for number, (u, v) in enumerate([(120, 60), (560, 50), (380, 240), (130, 420), (590, 430)]):
        seen = np.zeros((480, 640), np.uint16)
        seen[v - 5 : v + 6, u - 5 : u + 6] = round(0.4 / UNITS)
        rig.feed(number, {"depth": seen, "color": color})
        rows, columns = np.nonzero(next(frames).depth)
        point = sight.deproject(np.array([u, v]), np.array(0.4)) + np.array([-0.059, 0.0, 0.0])
        matrix = np.array([[387.0, 0, 321.5], [0, 386.0, 243.0], [0, 0, 1]])
        still = np.zeros(3)
        shown = cv2.projectPoints(point[None], still, still, matrix, np.array(coefficients))[0]
        assert (columns.mean(), rows.mean()) == pytest.approx(shown.ravel(), abs=1)
    source.close()


def test_what_is_beyond_the_scale_of_depth_is_missing_also_where_it_is_moved():
    """The last value of 16 bits is no measurement, and none comes of it in a turned camera."""
    rig = Rig(depth=COLOR, shift=(0.0, 0.0, -0.004), turn=(0.02, -0.03, 0.0))
    source = rig.source()
    source.open()
    frames, found = source.frames(), []
    for number, value in enumerate((2**16 - 1, 4000)):
        depth = np.full((COLOR.height, COLOR.width), value, np.uint16)
        rig.feed(number, rig.images(number) | {"depth": depth})
        found.append(np.isfinite(next(frames).depth_m).mean())
    source.close()
    assert found[0] == 0
    assert found[1] > 0.9


def scaled(camera: Camera, by: int = 4) -> Camera:
    lens = (camera.model, camera.coefficients)
    sizes = (camera.width, camera.height, camera.fx, camera.fy, camera.cx, camera.cy)
    return Camera(*(by * size for size in sizes), *lens)


def plane(camera: Camera, normal: np.ndarray, offset: float) -> np.ndarray:
    """Depth in metres, per pixel, of the plane normal . x = offset in the camera's frame."""
    pixels = np.stack(np.meshgrid(np.arange(camera.width), np.arange(camera.height)), axis=-1)
    return offset / (camera.deproject(pixels, np.ones(pixels.shape[:2])) @ normal)


def test_gaps_in_the_frame_numbers_are_counted_and_stay_visible():
    received, counts = receive(Rig(), [7, 8, 11, 12])
    assert [frame.header.sequence for frame in received] == [0, 1, 4, 5]
    assert counts == {LOST: 2}


@pytest.mark.parametrize(("missing", "lost"), [("depth", {}), ("color", {LOST: 1})])
def test_an_image_without_partner_is_left_out_and_counted(missing, lost):
    rig = Rig()
    source = rig.source()
    source.open()
    frames = source.frames()
    for i in (0, 1, 2, 3):
        rig.feed(i, {k: v for k, v in rig.images(i).items() if i != 1 or k != missing})
    received = [next(frames) for _ in range(3)]
    source.close()
    assert [frame.header.sequence for frame in received] == [0, 2, 3]
    for frame in received:
        clock = frame.attached[CLOCK_TOPIC]
        assert clock.number[0] == clock.number[1]
    assert source.counts() == {UNPAIRED: 1, **lost}


def test_frames_are_thrown_away_while_the_exposure_settles():
    rig = Rig()
    source = rig.source(warm_up=2)
    source.open()
    for i in range(3):
        rig.feed(i)
    frame = next(source.frames())
    source.close()
    assert (frame.header.sequence, frame.color[0, 0, 0]) == (0, 2)
    assert source.counts() == {}


def test_colour_alone():
    rig = Rig()
    source = rig.source(depth=None)
    source.open()
    rig.feed(0, {"color": rig.images(0)["color"]})
    frame = next(source.frames())
    source.close()
    assert frame.depth is None
    assert source.counts() == {}


def test_the_cameras_own_clock_gives_the_intervals_and_the_arrival_its_zero():
    (first, second), _ = receive(Rig(), [0, 3])
    assert first.header.stamp_ns == first.header.arrival_ns
    assert second.header.stamp_ns - first.header.stamp_ns == 100_000_000
    assert second.header.arrival_ns > first.header.arrival_ns
    clock = second.attached[CLOCK_TOPIC]
    assert clock.number.tolist() == [3, 3]
    assert clock.time_ms.tolist() == [5100.0, 5100.0]
    assert clock.domain.tolist() == [Domain.HARDWARE, Domain.HARDWARE]


def test_a_time_since_the_epoch_is_taken_as_it_is():
    rig = Rig()
    source = rig.source()
    source.open()
    rig.feed(0, time_ms=1_700_000_000_123.5, domain=SYSTEM)
    frame = next(source.frames())
    source.close()
    assert frame.header.stamp_ns == 1_700_000_000_123_500_000
    assert frame.attached[CLOCK_TOPIC].domain.tolist() == [Domain.SYSTEM, Domain.SYSTEM]


def test_options_are_set_and_told():
    rig = Rig(options={"laser_power": (0, 16, 16), "accuracy": (0, 3, 1), "exposure": (1, 99, 9)})
    source = rig.source(laser_power=5, depth_options={"exposure": 33})
    source.open()
    told = source.describe()
    source.close()
    assert told["options"]["Depth"] | {"depth_units": 0} == {
        "laser_power": 5,
        "accuracy": 1,
        "exposure": 33,
        "frames_queue_size": told["options"]["Depth"]["frames_queue_size"],
        "depth_units": 0,
    }
    assert told["name"].endswith("Simulated SR300")
    assert told["serial_number"] == "617203001234"
    assert told["depth_scale"] == pytest.approx(UNITS)
    assert told["streams"]["Depth"]["model"] == "inverse_brown_conrady"
    assert told["T_color_depth"]["translation_m"] == pytest.approx([0.025, 0, 0])


@pytest.mark.parametrize(
    ("settings", "error", "message"),
    [
        (
            {"laser_power": 40},
            UsageError,
            "source.laser_power: 40 is outside of what this camera takes, 0 to 16 (default 16)",
        ),
        (
            {"accuracy": 1},
            UsageError,
            "source.accuracy: this camera has no such option; "
            "known: laser_power, frames_queue_size, depth_units",
        ),
        (
            {"depth_options": {"laser_pwer": 1}},
            UsageError,
            "source.depth_options.laser_pwer: this camera has no such option; "
            "did you mean 'laser_power'?",
        ),
        ({"preset": "short-range"}, UsageError, "source.preset: this camera has no presets"),
        ({"speed": 2.0}, UsageError, "source.speed is for recordings; a camera has its own pace"),
        (
            {"color": "640x480"},
            DeviceError,
            "Software-Device Simulated SR300: no color of 640x480 @ 30; it has: 160x120 @ 30",
        ),
        (
            {"fps": 60},
            DeviceError,
            "Software-Device Simulated SR300: no color of 160x120 @ 60; it has: 160x120 @ 30; "
            "no depth of 160x120 @ 60; it has: 160x120 @ 30",
        ),
        (
            {"serial": "01"},
            DeviceError,
            "no camera has the serial number 01; "
            "connected: Software-Device Simulated SR300 617203001234",
        ),
        (
            {"serial": 617203001233},  # as YAML reads it
            DeviceError,
            "no camera has the serial number 617203001233; "
            "connected: Software-Device Simulated SR300 617203001234",
        ),
    ],
)
def test_what_a_camera_cannot_do_is_said(settings, error, message):
    source = Rig(options={"laser_power": (0, 16, 16)}).source(**settings)
    with pytest.raises(error) as caught:
        source.open()
    source.close()
    assert str(caught.value) == message


def test_of_two_cameras_the_serial_number_chooses():
    rig, other = Rig(), Rig(serial="42")
    other.device.add_to(rig.context)
    with pytest.raises(UsageError, match=r"set source\.serial: .* 42, .* 617203001234$"):
        rig.source().open()
    for serial in ("42", SERIAL):
        assert info(find_device(rig.context, serial))["serial_number"] == serial


def test_the_filters_of_librealsense_run_before_alignment(caplog):
    """A hole in the depth image is there without the filter, and closed with it, which is said."""
    rig = Rig(depth=COLOR, shift=(0, 0, 0))
    holed = rig.images(0)
    holed["depth"][60, 80:84] = 0
    found = {}
    for name, number in (("none", 0), ("hole-filling", 1)):
        source = rig.source(filters=() if name == "none" else (name,))
        source.open()
        assert ("hole-filling invents depth" in caplog.text) is (name == "hole-filling")
        rig.feed(number, holed)
        found[name] = next(source.frames()).depth
        source.close()
    assert not found["none"][60, 80:84].all()
    assert found["hole-filling"][60, 80:84].all()
