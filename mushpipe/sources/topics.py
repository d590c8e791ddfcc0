"""Which topics of a recording are colour, depth and calibration."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from itertools import chain
from pathlib import Path

from mushpipe.core.errors import InputError, suggest
from mushpipe.core.recording import Index
from mushpipe.core.wire import RESULT_PREFIX

IMAGES = {
    "sensor_msgs/msg/Image",
    "sensor_msgs/msg/CompressedImage",
    "foxglove.RawImage",
    "foxglove.CompressedImage",
}
CALIBRATIONS = {"sensor_msgs/msg/CameraInfo", "foxglove.CameraCalibration"}
NOT_CAMERA = (RESULT_PREFIX, "/truth/")
ALIGNED = "aligned_depth_to_color"
_WORDS = {"depth": ("depth",), "infra": ("infra",), "color": ("color", "colour", "rgb")}
# What else parts of a topic say of the images, and not of the camera.
_OF_IMAGES = ("image", "rect", "registered", "stereo")
_RAW = 1.1  # what a raw image is worth beside compressed ones
_OF_DEPTH = "/compressedDepth"
_TRANSPORTS = (_OF_DEPTH, "/compressed")


@dataclass(frozen=True)
class Topics:
    """The topics to read; depth and calibration may be absent."""

    color: str
    depth: str | None
    camera: str | None


def choose_topics(
    index: Index,
    path: Path,
    color: str | None,
    depth: str | None,
    camera: str | None,
    use_depth: bool,
) -> Topics:
    """Choose by schema and name; what the user names is taken as it is.

    Names follow realsense2_camera: ``aligned_depth_to_color`` before any other depth, and the
    ``camera_info`` beside the colour image.

    Raises:
        InputError: No colour images, several candidates, depth of another camera, or a named topic
            is not there or holds something else.
    """
    for wanted, kinds in ((color, IMAGES), (depth, IMAGES), (camera, CALIBRATIONS)):
        if wanted is not None and (fault := topic_fault(index, wanted, kinds)):
            raise InputError(f"{path}: {fault}")
    images = images_of(index)
    color = color or _one(path, "color", _colors([t for t in images if t != depth]))
    if color is None:
        known = (t if index.counts[t] else f"{t} without a message" for t in sorted(index.channels))
        found = ", ".join(known) or "no topics at all"
        options = " or ".join(f"--set source.color_topic={t}" for t in images if t != depth)
        hint = f"; where one of these is colour, name it: {options}" if options else ""
        text = f"it holds no colour images (it holds {found}){_of_others(index)}{hint}"
        raise InputError(f"{path}: {text}")
    if not use_depth:
        depth = None
    elif depth is None:
        depths = _depths([t for t in images if _base(t) != _base(color)])
        own = [t for t in depths if not other_camera(t, color)]
        depth = _one(path, "depth", own or depths)
        if depth and other_camera(depth, color):
            raise InputError(
                f"{path}: by its name, depth ({depth}) is of another camera than colour ({color}): "
                f"where it is aligned to it, name it (--set source.depth_topic={depth}); or play "
                "without it: --set source.use_depth=false"
            )
    return Topics(color, depth, camera or _calibration(index, path, color))


def _of_others(index: Index) -> str:
    """Say which topics are called colour and hold what is not read: video, or images of ROS 1."""
    kinds = {t: index.schema_name(t) for t in sorted(index.channels) if _kind(t) == "color"}
    odd = [f"{t} holds {kind}" for t, kind in kinds.items() if kind not in IMAGES | CALIBRATIONS]
    return f"; {', '.join(odd)}, expected {' or '.join(sorted(IMAGES))}" if odd else ""


def topic_fault(index: Index, topic: str, kinds: set[str]) -> str:
    """Return why a topic that somebody names is none of some schemas, empty where it is."""
    if topic not in index.channels:
        return f"there is no topic '{topic}'; {suggest(topic, sorted(index.channels))}"
    schema = index.schema_name(topic) or "messages without a schema"
    expected = " or ".join(sorted(kinds))
    return "" if schema in kinds else f"topic '{topic}' holds {schema}, expected {expected}"


def _topics(index: Index, schemas: set[str]) -> list[str]:
    named = sorted(t for t in index.channels if index.schema_name(t) in schemas)
    return [t for t in named if index.counts[t] and not t.startswith(NOT_CAMERA)]


def _kind(topic: str) -> str:
    """Return what a topic says of its images: depth, infra, color or nothing.

    Of its parts the last one that says something counts: the first may name a depth camera.
    """
    for part in reversed(_base(topic).lower().split("/")):
        for kind, words in _WORDS.items():
            if _says(part, words):
                return kind
    return ""


def _says(part: str, words: Iterable[str]) -> bool:
    return any(word in part for word in words)


def _colors(images: list[str]) -> list[str]:
    named = [t for t in images if _kind(t) == "color"]
    return named or [t for t in images if not _kind(t)]


def _depths(images: list[str]) -> list[str]:
    depths = [t for t in images if _kind(t) == "depth"]
    aligned = [t for t in depths if ALIGNED in t.lower()]
    return aligned or depths


def untold_images(index: Index, color: str) -> list[str]:
    """Return the topics of other images whose names do not say of what: depth may be one."""
    return [t for t in images_of(index) if not _kind(t) and _base(t) != _base(color)]


def images_of(index: Index) -> list[str]:
    """Return the topics of images; of one that is there raw and compressed the fuller."""
    best: dict[str, str] = {}
    for topic in _topics(index, IMAGES):
        twins = (best.get(_base(topic), topic), topic)
        best[_base(topic)] = max(
            # of the compressed ones of depth, image_transport's JPEG of 8 bits is none
            twins,
            key=lambda t: (
                index.counts[t] * (_RAW if t == _base(t) else 1),
                t.endswith(_OF_DEPTH),
            ),
        )
    return sorted(best.values())


def _base(topic: str) -> str:
    for transport in _TRANSPORTS:
        topic = topic.removesuffix(transport)
    return topic


def _calibration(index: Index, path: Path, color: str) -> str | None:
    calibrations = _topics(index, CALIBRATIONS)
    others = [t for t in calibrations if _kind(t) in ("", "color", _kind(color))]
    beside = [t for t in others if is_beside(t, color)]
    aligned = [t for t in calibrations if says_aligned(t, color)]
    return _one(path, "camera", beside or others or aligned)


def is_beside(calibration: str, color: str) -> bool:
    """Return whether a calibration stands in the same folder as the colour images."""
    return calibration.rpartition("/")[0] == _base(color).rpartition("/")[0]


def says_aligned(depth: str, color: str) -> bool:
    """Return whether names say that depth is aligned to these colour images, of one camera."""
    camera, found, _ = depth.lower().partition(ALIGNED)
    return bool(found) and _kind(color) != "infra" and color.lower().startswith(camera)


def other_camera(topic: str, color: str) -> bool:
    """Return whether two topics name two cameras: /left/color/image and /right/depth/image."""
    words = (*chain(*_WORDS.values()), *_OF_IMAGES)
    cameras = [
        [part for part in _base(name).lower().split("/") if part and not _says(part, words)]
        for name in (topic, color)
    ]
    return any(a != b for a, b in zip(*cameras, strict=False))


def _one(path: Path, role: str, candidates: list[str]) -> str | None:
    if len(candidates) > 1:
        options = " or ".join(f"--set source.{role}_topic={topic}" for topic in candidates)
        raise InputError(f"{path}: several topics could be {role}; choose with {options}")
    return candidates[0] if candidates else None
