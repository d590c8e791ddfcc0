"""RealSense cameras: which are connected, what they say of themselves, how they are set.

Every librealsense error is a plain RuntimeError; here it becomes an error a user can act on.
"""

from __future__ import annotations

import platform
import re
from collections.abc import Iterator, Mapping
from contextlib import suppress
from importlib.metadata import version
from pathlib import Path
from typing import Any, NamedTuple

from mushpipe.core.errors import DeviceError, UsageError, suggest
from mushpipe.core.geometry import Camera
from mushpipe.core.libraries import import_realsense

UDEV_RULE = (
    'SUBSYSTEMS=="usb", ATTRS{{idVendor}}=="8086", ATTRS{{idProduct}}=="{product}", '
    'MODE:="0666", GROUP:="plugdev"'
)
PERMIT = (
    "put this line into /etc/udev/rules.d/99-realsense.rules,\n    "
    "run 'sudo udevadm control --reload-rules && sudo udevadm trigger', plug it in again:"
)
USB = Path("/sys/bus/usb/devices")
_NAMES = {"0aa5": "SR300", "0b48": "SR305"}
_INFO = ("name", "serial_number", "firmware_version", "usb_type_descriptor", "product_line")


def library() -> str:
    """Return which librealsense this is, and under which Python."""
    return f"librealsense {version('pyrealsense2')}, Python {platform.python_version()}"


def knows_sr300() -> bool:
    """Return whether this librealsense still has the driver of SR300 and SR305."""
    major, minor = (int(part) for part in version("pyrealsense2").split(".")[:2])
    return (major, minor) < (2, 55)


class UsbCamera(NamedTuple):
    """A camera as the kernel sees it; ``node`` is the file that a program has to open."""

    product: str
    name: str
    node: Path


def cameras_on_usb(root: Path) -> Iterator[UsbCamera]:
    """Yield every RealSense on USB, whether it can be opened or not."""
    for folder in sorted(root.glob("*")):
        with suppress(OSError):  # a device may vanish while it is looked at
            if (folder / "idVendor").read_text().strip() != "8086":
                continue
            product, name = (folder / "idProduct").read_text().strip(), ""
            with suppress(OSError):
                name = (folder / "product").read_text().strip()
            if product in _NAMES or "realsense" in name.lower():
                bus, number = (int((folder / n).read_text()) for n in ("busnum", "devnum"))
                node = Path(f"/dev/bus/usb/{bus:03d}/{number:03d}")
                yield UsbCamera(product, _NAMES.get(product, name), node)


def no_camera(root: Path) -> DeviceError:
    """Return the error that says why librealsense sees no camera, as far as that can be told."""
    lines = ["no RealSense camera is connected; plug it into a USB 3 port"]
    for product, name, _ in cameras_on_usb(root):
        lines[0] = f"a camera {name} is on USB (8086:{product}), but librealsense cannot open it"
        lines += [
            f"if it is not permitted to, {PERMIT}",
            UDEV_RULE.format(product=product),
        ]
        break
    lines.append(f"this is {library()}")
    if knows_sr300():
        lines.append("an SR300 or SR305 needs pyrealsense2 2.54, as it is here: the last one with")
        lines.append("their driver, built for Python 3.11 and older")
    else:
        lines.append("it cannot see an SR300 or SR305: 2.55 dropped their driver; they need")
        lines.append("pyrealsense2 2.54, which is built for Python 3.11 and older")
    return DeviceError("\n    ".join(lines))


def find_device(context: Any, serial: str | None) -> Any:
    """Return the one camera that is connected, or the one with this serial number.

    Raises:
        DeviceError: No camera, or not that one.
        UsageError: Several cameras and no serial number to choose by.
    """
    devices = [device for device in context.query_devices() if has_depth(device)]
    if not devices:
        raise no_camera(USB)
    known = [info(device).get("serial_number", "") for device in devices]
    told = (f"{info(d).get('name')} {info(d).get('serial_number')}" for d in devices)
    listed = ", ".join(sorted(told))
    if serial is None:
        if len(devices) > 1:
            raise UsageError(f"several cameras are connected, set source.serial: {listed}")
        return devices[0]
    if serial not in known:
        raise DeviceError(f"no camera has the serial number {serial}; connected: {listed}")
    return devices[known.index(serial)]


def has_depth(device: Any) -> bool:
    """Return whether a device has a depth sensor."""
    return any(sensor.is_depth_sensor() for sensor in device.query_sensors())


def info(device: Any) -> dict[str, str]:
    """Return name, serial number, firmware and USB type, as far as the device tells them."""
    rs = import_realsense()
    found = {}
    for name in _INFO:
        key = getattr(rs.camera_info, name)
        if device.supports(key):
            found[name] = " ".join(device.get_info(key).split())
    return found


def describe(profile: Any) -> dict[str, Any]:
    """Return all a camera says of itself, as plain data: identity, streams, calibration, options.

    Args:
        profile: A resolved pipeline profile.
    """
    video = (stream for stream in profile.get_streams() if stream.is_video_stream_profile())
    streams = [stream.as_video_stream_profile() for stream in video]
    result: dict[str, Any] = {**info(profile.get_device()), "librealsense": version("pyrealsense2")}
    result["streams"] = {
        stream.stream_name(): {
            "format": stream.format().name,
            "fps": stream.fps(),
            **_intrinsics(stream.get_intrinsics()),
        }
        for stream in streams
    }
    kinds = {stream.stream_type().name: stream for stream in streams}
    if "depth" in kinds:
        sensor = profile.get_device().first_depth_sensor()
        result["depth_scale"] = sensor.get_depth_scale()
        if "color" in kinds:
            pose = kinds["depth"].get_extrinsics_to(kinds["color"])
            result["T_color_depth"] = {
                "rotation_column_major": list(pose.rotation),
                "translation_m": list(pose.translation),
            }
    sensors = profile.get_device().query_sensors()
    result["options"] = {str(sensor.name): _values(sensor) for sensor in sensors}
    return result


def _intrinsics(given: Any) -> dict[str, Any]:
    return {
        **{name: getattr(given, name) for name in ("width", "height", "fx", "fy")},
        "cx": given.ppx,
        "cy": given.ppy,
        "model": given.model.name,
        "coefficients": list(given.coeffs),
    }


def _values(sensor: Any) -> dict[str, float]:
    values = {}
    for option in sensor.get_supported_options():
        with suppress(RuntimeError):  # some options of real cameras cannot be read at all times
            values[option.name] = float(sensor.get_option(option))
    return values


def camera_of(given: Any) -> Camera:
    """Turn librealsense's intrinsics of a colour stream into a `Camera`.

    D400 cameras call their colour lens ``inverse_brown_conrady``, but librealsense (since 2.45)
    and ROS take its coefficients on the way into the image, as a lens has them.

    Raises:
        DeviceError: The lens model is not one that `Camera` has.
    """
    model, coefficients = given.model.name, tuple(given.coeffs)
    if not any(coefficients) and model not in ("ftheta", "kannala_brandt4"):  # fisheyes stay so
        model = "none"
    if model not in ("none", "brown_conrady", "inverse_brown_conrady"):
        raise DeviceError(f"the colour camera's lens model '{model}' is not supported")
    model = "brown_conrady" if model == "inverse_brown_conrady" else model
    return Camera(
        *(given.width, given.height, given.fx, given.fy, given.ppx, given.ppy),
        model,
        () if model == "none" else coefficients,
    )


def set_preset(sensor: Any, preset: str | int) -> None:
    """Choose a visual preset by name, as the camera calls it, or by number.

    Raises:
        UsageError: The camera has no presets, or not this one.
    """
    option = import_realsense().option.visual_preset
    if not sensor.supports(option):
        raise UsageError("source.preset: this camera has no presets")
    if isinstance(preset, str):
        limits = sensor.get_option_range(option)
        numbers = range(int(limits.min), int(limits.max) + 1)
        told = {i: sensor.get_option_value_description(option, i) or "" for i in numbers}
        names = {_plain(text): i for i, text in told.items() if text}
        if _plain(preset) not in names:
            raise UsageError(f"source.preset: no '{preset}'; {suggest(preset, list(names))}")
        preset = names[_plain(preset)]
    _set(sensor, "visual_preset", preset, "source.preset")


def _plain(name: str) -> str:
    return "-".join(re.findall(r"[a-z]+|\d+", name.lower()))


def set_options(sensor: Any, options: Mapping[str, float], where: str = "source") -> None:
    """Set options by their librealsense names.

    Raises:
        UsageError: The camera has no such option, it cannot be set, or not to this value.
    """
    for name, value in options.items():
        _set(sensor, name, value, f"{where}.{name}")


def _set(sensor: Any, name: str, value: float, label: str) -> None:
    option = getattr(import_realsense().option, name, None)
    supported = [option.name for option in sensor.get_supported_options()]
    if name not in supported or sensor.is_option_read_only(option):
        free = [n for n in supported if n != name]
        raise UsageError(f"{label}: this camera has no such option; {suggest(name, free)}")
    limits = sensor.get_option_range(option)
    if not limits.min <= value <= limits.max:
        raise UsageError(
            f"{label}: {value:g} is outside of what this camera takes, "
            f"{limits.min:g} to {limits.max:g} (default {limits.default:g})"
        )
    try:
        sensor.set_option(option, value)
    except RuntimeError as error:
        raise DeviceError(f"{label}: the camera did not take {value:g}: {error}") from error
