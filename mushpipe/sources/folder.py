"""Source `images`: plays a folder of image files, or one."""

from __future__ import annotations

import logging
import re
from collections import Counter
from collections.abc import Iterator
from glob import escape
from pathlib import Path, PurePosixPath
from typing import Any, Self

import cv2
import numpy as np
from numpy.typing import NDArray
from pydantic import Field, PrivateAttr, field_validator, model_validator

from mushpipe import Header, InputError, ReplaySource, RgbdFrame, UsageError
from mushpipe.core.paths import IMAGES, RECORDINGS, GraphPath, require_listed
from mushpipe.core.types import COLOR_FRAME
from mushpipe.sources.recorded import NO_CAMERA, NO_DEPTH, DepthScale, Intrinsics

logger = logging.getLogger("mushpipe")
ALONE = "%s images without a %s image"


class ImagesSource(ReplaySource):
    """Plays image files in the order of their names, in which numbers count by their value.

    A colour and a depth image belong together where `*` stands for the same in both names. Depth is
    one channel of 16 bits or float32, aligned to colour; 0 is missing. Files do not say when they
    were taken: the first frame has the stamp 0, and the others follow at `fps`.
    """

    path: GraphPath = Field(description="the folder, or a single colour image")
    color: str = Field(
        "*", description="names of the colour images below the folder: rgb/*.png, or *_color.jpg"
    )
    depth: str | None = Field(None, description="names of the depth images: depth/*.png, say")
    depth_scale: DepthScale | None = Field(
        None, description="metres per unit of depth: 0.001 where a unit is a millimetre"
    )
    camera: Intrinsics | None = Field(None, description="intrinsics of the colour images")
    fps: float = Field(30, ge=1e-6, le=1000, description="frames per second")

    _found: list[tuple[Path, Path | None]] = PrivateAttr(default_factory=list)
    _counts: Counter[str] = PrivateAttr(default_factory=Counter)
    _first: tuple[int, ...] | None = PrivateAttr(None)  # height and width of the first image

    @field_validator("color", "depth")
    @classmethod
    def _has_a_star(cls, value: str | None) -> str | None:
        if value is None:
            return None
        if value.count("*") != 1:
            raise ValueError("expected one `*` for what tells the images apart: depth/*.png")
        names = PurePosixPath(value)  # as paths of files are spelt: without ./ and //
        if names.is_absolute():
            raise ValueError("expected names as seen from the folder (path): depth/*.png")
        return str(names)

    @model_validator(mode="after")
    def _has_a_scale(self) -> Self:
        if self.depth is not None and self.depth_scale is None:
            raise ValueError("with depth, set depth_scale: how many metres a unit of it is")
        return self

    def files(self) -> tuple[Path, ...]:
        """Return all images."""
        if self.path.is_file():
            return (self.path,)
        found = (_named(self.path, names) for names in (self.color, self.depth) if names)
        return tuple(path for images in found for path in images.values())

    def open(self) -> None:
        """Find the images.

        Raises:
            UsageError: There is no such folder or image, or depth for a single image.
            InputError: It holds no such images, or none that belong together.
        """
        self._found = self._pairs()

    def counts(self) -> dict[str, int]:
        """Return how many images are without a partner."""
        return dict(sorted(self._counts.items()))

    def frames(self) -> Iterator[RgbdFrame]:
        """Yield a frame per colour image that there was when the source was opened.

        Raises:
            InputError: A file cannot be read, or is not what it should be.
        """
        if self.depth is None:
            logger.warning(NO_DEPTH, self.name())
        if self.camera is None:
            logger.warning(NO_CAMERA, self.name(), "")
        for sequence, (color, depth) in enumerate(self._found):
            header = Header(round(sequence * 1e9 / self.fps), sequence, COLOR_FRAME)
            yield self._frame(header, color, depth)

    def _pairs(self) -> list[tuple[Path, Path | None]]:
        """Return each colour image with its depth image, and count those that are alone."""
        if self.path.is_file():
            if self.depth is not None:
                raise UsageError(f"{self.path}: a single image has no depth: give its folder")
            return [(self.path, None)]
        if not self.path.is_dir():
            raise UsageError(f"{self.path}: there is no such folder, and no such image")
        colors = _required(self.path, "color", self.color)
        if self.depth is None:
            return [(path, None) for path in colors.values()]
        depths = _required(self.path, "depth", self.depth)
        colors = {key: path for key, path in colors.items() if path not in depths.values()}
        if not colors:
            raise InputError(
                f"{self.path}: no colour is left: every image named {self.color} (source.color) is "
                f"a depth image, named {self.depth} (source.depth)"
            )
        both = colors.keys() & depths.keys()
        if not both:
            raise InputError(
                f"{self.path}: no depth image belongs to a colour image: `*` stands for "
                f"'{next(iter(colors))}' in the first colour image, for '{next(iter(depths))}' in "
                "the first depth image, and must be the same"
            )
        alone = {
            ALONE % ("colour", "depth"): len(colors) - len(both),
            ALONE % ("depth", "colour"): len(depths) - len(both),
        }
        self._counts = Counter({name: count for name, count in alone.items() if count})
        return [(path, depths.get(key)) for key, path in colors.items()]

    def _frame(self, header: Header, color: Path, depth: Path | None) -> RgbdFrame:
        how = cv2.IMREAD_COLOR | cv2.IMREAD_ANYDEPTH
        if depth is not None or self.camera is not None:  # these are of the image as it was taken
            how |= cv2.IMREAD_IGNORE_ORIENTATION
        read = _read(color, how)
        if read.dtype != np.uint8:
            raise InputError(
                f"{color}: {8 * read.itemsize} bits a channel, expected 8; where it is depth, name "
                "it by source.depth, and what is colour by source.color"
            )
        image = cv2.cvtColor(read, cv2.COLOR_BGR2RGB)
        values = None if depth is None else _read(depth, cv2.IMREAD_UNCHANGED)
        size = image.shape[:2]
        self._first = self._first or size
        try:
            camera = self.camera.of_image(size, self._first) if self.camera else None
            return RgbdFrame(header, image, values, self.depth_scale or 0.001, camera)
        except ValueError as error:
            files = color if depth is None else f"{color} and {depth}"
            raise InputError(f"{files}: {error}") from error


def _required(folder: Path, setting: str, names: str) -> dict[str, Path]:
    """Return the images of some names, in order, by what `*` stands for.

    Raises:
        InputError: There are none.
    """
    require_listed(folder)
    if found := _named(folder, names):
        return found
    files = [path for path in folder.glob("**/*") if path.is_file()]
    images = [path for path in files if _is_image(path)]
    kinds = Counter(str(path.relative_to(folder).with_stem("*")) for path in images or files)
    hint = ", ".join(f"{each} ({count})" for each, count in kinds.most_common(8)) or "nothing"
    hint = f"no image, but {hint}" if files and not images else hint
    if bags := sorted(path for path in files if path.suffix in RECORDINGS):
        hint += f"; a recording is played by its file: --source '{bags[0]}'"
    raise InputError(f"{folder}: no image is named {names} (source.{setting}); there is {hint}")


def _named(folder: Path, names: str) -> dict[str, Path]:
    before, after = names.split("*")
    keyed: dict[str, Path] = {}
    for path in filter(_is_image, folder.glob(f"{escape(before)}*{escape(after)}")):
        other = keyed.setdefault(_key(path.relative_to(folder), before, after), path)
        if other != path:
            both = " and ".join(sorted({path.name, other.name}))
            raise InputError(f"{folder}: {both} are one image to '{names}': name one kind, *.png")
    return dict(sorted(keyed.items(), key=lambda item: _natural(item[0])))


def _key(path: Path, before: str, after: str) -> str:
    """Return what the star stands for, without the kind of file."""
    text = str(path)[len(before) :].removesuffix(after)
    return text if after else str(Path(text).with_suffix(""))


def _natural(text: str) -> list[str | int]:
    parts = re.split(r"([0-9]+)", text)
    return [int(part) if k % 2 else part for k, part in enumerate(parts)]


def _is_image(path: Path) -> bool:
    if path.name.startswith("."):  # as a shell does; a Mac puts ._7.png beside each 7.png
        return False
    return path.suffix.lower() in IMAGES and path.is_file()


def _read(path: Path, how: int) -> NDArray[Any]:
    try:
        data = np.frombuffer(path.read_bytes(), np.uint8)
    except OSError as error:
        raise InputError(f"{path}: cannot be read: {error.strerror}") from error
    log = cv2.utils.logging
    before = log.setLogLevel(log.LOG_LEVEL_SILENT)  # what is wrong with a file is told here
    try:
        return _decoded(path, data, how)
    finally:
        log.setLogLevel(before)


def _decoded(path: Path, data: NDArray[np.uint8], how: int) -> NDArray[Any]:
    if not len(data):
        raise InputError(f"{path}: it is empty")
    if cv2.imcount(str(path)) > 1:
        raise InputError(f"{path}: it holds several images: make a file of each")
    image = cv2.imdecode(data, how)
    if image is None:  # depth of floats cannot be had as colour
        image = cv2.imdecode(data, cv2.IMREAD_UNCHANGED)
        if image is None or image.dtype == np.uint8:
            raise InputError(f"{path}: it is no image, or damaged")
    return np.asarray(image)
