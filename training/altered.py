"""Judge graphs/pick.yaml on altered real frames: `python -m training.altered FOLDER`.

A labelled recording has few caps, and chance decides about those at the edge of what is found. So
each of its frames is looked at in other light and colour, less sharp, noisier, turned and scaled,
and in `--draws` of each kind of worse depth: what is found then says more, and is to change little.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable, Iterator
from dataclasses import replace
from itertools import starmap
from pathlib import Path
from typing import NamedTuple

import cv2
import numpy as np

from mushpipe import RgbdFrame
from mushpipe.core.arrays import Bytes, Floats
from training.field import found_and_false, labelled_frames
from training.net.judge import both
from training.sensors import DAMAGES, worse

SCALES = (0.6, 0.75, 1.3)


class Labelled(NamedTuple):
    """A frame with the circles (N, 3) that must, and (M, 3) that may be found, px."""

    frame: RgbdFrame
    must: Floats
    may: Floats


def _light(change: Callable[[Floats], Floats | float]) -> Callable[[Bytes], Bytes]:
    """Return an alteration of each value, 0..1."""
    table = np.clip(np.rint(255 * change(np.arange(256) / 255)), 0, 255).astype(np.uint8)
    return lambda color: table[color]


def _tint(red: float, green: float, blue: float) -> Callable[[Bytes], Bytes]:
    return lambda color: np.clip(color * np.array([red, green, blue]), 0, 255).astype(np.uint8)


def _hue(turn: int, saturation: float) -> Callable[[Bytes], Bytes]:
    def alter(color: Bytes) -> Bytes:
        hsv = cv2.cvtColor(color, cv2.COLOR_RGB2HSV).astype(np.float64)
        hsv[..., 0] = (hsv[..., 0] + turn / 2) % 180
        hsv[..., 1] = np.minimum(255, saturation * hsv[..., 1])
        return np.asarray(cv2.cvtColor(hsv.astype(np.uint8), cv2.COLOR_HSV2RGB), np.uint8)

    return alter


def _blur(sigma: float) -> Callable[[Bytes], Bytes]:
    return lambda color: np.asarray(cv2.GaussianBlur(color, (0, 0), sigma), np.uint8)


def _noise(sigma: float) -> Callable[[Bytes], Bytes]:
    def alter(color: Bytes) -> Bytes:
        noise = np.random.default_rng(0).normal(0, sigma, color.shape)
        return np.clip(color + noise, 0, 255).astype(np.uint8)

    return alter


def _jpeg(quality: int) -> Callable[[Bytes], Bytes]:
    def alter(color: Bytes) -> Bytes:
        data = cv2.imencode(".jpg", color, [cv2.IMWRITE_JPEG_QUALITY, quality])[1]
        return np.asarray(cv2.imdecode(data, cv2.IMREAD_COLOR), np.uint8)

    return alter


def _shaded(color: Bytes) -> Bytes:
    """Darken towards the left, to a quarter."""
    return (color * np.linspace(0.25, 1, color.shape[1])[:, None]).astype(np.uint8)


def _recoloured(caps: tuple[float, float, float], soil: float) -> Callable[[Bytes], Bytes]:
    """Return an alteration of the colour of white caps, and of the brightness of dark soil.

    Both are factors of light. What is brighter than three quarters of Otsu's threshold is a cap.
    """

    def alter(color: Bytes) -> Bytes:
        gray = cv2.GaussianBlur(cv2.cvtColor(color, cv2.COLOR_RGB2GRAY), (0, 0), 1)
        otsu, _ = cv2.threshold(gray, 0, 255, cv2.THRESH_OTSU)
        cap = 1 / (1 + np.exp((0.75 * otsu - gray[..., None].astype(np.float64)) / 6))
        light = (color / 255) ** 2.2 * (cap * np.array(caps) + (1 - cap) * soil)
        return np.asarray(255 * np.clip(light, 0, 1) ** (1 / 2.2), np.uint8)

    return alter


LOOKS: dict[str, Callable[[Bytes], Bytes]] = {
    "as it is": lambda color: color,
    "gamma 0.5": _light(lambda v: v**0.5),
    "gamma 2.2": _light(lambda v: v**2.2),
    "dark": _light(lambda v: 0.3 * v),
    "overexposed": _light(lambda v: 1.3 * v),
    "more so": _light(lambda v: 1.7 * v),
    "pale": _light(lambda v: 0.35 + 0.4 * v),
    "shaded": _shaded,
    "warm": _tint(1.15, 1, 0.7),
    "cold": _tint(0.75, 1, 1.2),
    "violet lamp": _tint(1.1, 0.7, 1.1),
    "green": _tint(0.8, 1.1, 0.8),
    "gray": _hue(0, 0),
    "garish": _hue(0, 2),
    "hue + 16": _hue(16, 1),
    "hue - 16": _hue(-16, 1),
    "hue + 90": _hue(90, 1),
    "brown caps": _recoloured((0.4, 0.25, 0.14), 1),
    "dark caps on bright soil": _recoloured((0.15, 0.1, 0.06), 4),
    "blur 1 px": _blur(1),
    "blur 2 px": _blur(2),
    "blur 3 px": _blur(3),
    "noise 8": _noise(8),
    "noise 20": _noise(20),
    "jpeg 50": _jpeg(50),
    "jpeg 15": _jpeg(15),
}


def flipped(case: Labelled, axes: tuple[int, ...]) -> Labelled:
    """Return a frame with the order of its rows (axis 0), columns (axis 1) or both reversed."""
    frame = case.frame
    height, width = frame.color.shape[:2]
    color, depth = np.flip(frame.color, axes), frame.depth
    depth = depth if depth is None else np.ascontiguousarray(np.flip(depth, axes))
    turn = np.array([-1 if 1 in axes else 1, -1 if 0 in axes else 1, 1])
    last = np.array([width - 1, height - 1, 0]) * (turn < 0)
    camera = frame.camera
    if camera is not None:
        cx, cy, _ = last + turn * [camera.cx, camera.cy, 0]
        camera = replace(camera, cx=cx, cy=cy)
    circles = [last + turn * c for c in (case.must, case.may)]
    color = np.ascontiguousarray(color)
    return Labelled(replace(frame, color=color, depth=depth, camera=camera), *circles)


def scaled(case: Labelled, scale: float) -> Labelled:
    """Return a frame of another size."""
    frame = case.frame
    height, width = (round(scale * n) for n in frame.color.shape[:2])
    how = cv2.INTER_AREA if scale < 1 else cv2.INTER_CUBIC
    color = np.asarray(cv2.resize(frame.color, (width, height), interpolation=how), np.uint8)
    depth, camera = frame.depth, frame.camera
    if depth is not None:
        depth = cv2.resize(depth, (width, height), interpolation=cv2.INTER_NEAREST)
    if camera is not None:
        center = {axis: (getattr(camera, axis) + 0.5) * scale - 0.5 for axis in ("cx", "cy")}
        camera = replace(
            camera, width=width, height=height, fx=scale * camera.fx, fy=scale * camera.fy, **center
        )
    half = np.array([0.5, 0.5, 0])  # px, to the corner of the first pixel
    circles = [scale * (each + half) - half for each in (case.must, case.may)]
    return Labelled(replace(frame, color=color, depth=depth, camera=camera), *circles)


def alterations(case: Labelled) -> Iterator[tuple[str, Labelled]]:
    """Yield all of them with their names, the frame as it is first."""
    for name, look in LOOKS.items():
        color = np.ascontiguousarray(look(case.frame.color))
        yield name, case._replace(frame=replace(case.frame, color=color))
    yield "mirrored", flipped(case, (1,))
    yield "upside down", flipped(case, (0, 1))
    for scale in SCALES:
        yield f"scaled by {scale}", scaled(case, scale)


def cases(folder: Path) -> Iterator[tuple[str, Labelled]]:
    """Yield the labelled frames of the recordings in a folder that show caps."""
    for path in sorted(folder.glob("*.mcap")):
        for case in starmap(Labelled, labelled_frames(path)):
            if len(case.must):
                yield f"{path.stem} #{case.frame.header.sequence}", case


def table(title: str, case: Labelled, beside_depth: float) -> str:
    """Return what is found of a frame in all alterations, without and with depth, and the sum."""
    kinds = (False, True) if case.frame.depth is not None else (False,)
    totals = np.zeros((2, 3), int)
    heads = ["colour", "depth"][: len(kinds)]
    lines = [f"| {title} | {' | '.join(heads)} |", "|---" * (1 + len(kinds)) + "|"]
    for name, (frame, must, may) in alterations(case):
        cells = []
        for deep in kinds:
            right, false = found_and_false(both(frame, deep, beside_depth), must, may)
            totals[int(deep)] += right, len(must), false
            cells.append(f"{right} of {len(must)}, {false} false")
        lines.append(f"| {name} | {' | '.join(cells)} |")
    sums = (totals[int(deep)] for deep in kinds)
    cells = [f"{a} of {n}, {b} false, F {2 * a / (a + n + b):.3f}" for a, n, b in sums]
    return "\n".join([*lines, f"| **all** | {' | '.join(cells)} |"])


def depth_table(title: str, case: Labelled, beside_depth: float, draws: int) -> str:
    """Return what is found of a frame in so many draws of each kind of worse depth, and of all."""
    lines = [f"| {title} | depth |", "|---|---|"]
    kinds = {name: [damage] for name, damage in DAMAGES.items()} | {"all of it": DAMAGES.values()}
    for name, damages in kinds.items():
        right, false = 0, 0
        for seed in range(draws):
            frame = worse(case.frame, np.random.default_rng(seed), damages)
            found = found_and_false(both(frame, True, beside_depth), case.must, case.may)
            right, false = right + found[0], false + found[1]
        lines.append(f"| {name} | {right} of {draws * len(case.must)}, {false} false |")
    return "\n".join(lines)


def main() -> None:
    """Read the command line."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("folder", type=Path)
    parser.add_argument("--beside-depth", type=float, default=0.8, help="setting of cap-net")
    parser.add_argument("--draws", type=int, default=20, help="of each kind of worse depth")
    arguments = parser.parse_args()
    for name, case in cases(arguments.folder):
        print(f"\n{table(name, case, arguments.beside_depth)}", flush=True)
        if case.frame.depth is not None:
            print(
                f"\n{depth_table(name, case, arguments.beside_depth, arguments.draws)}", flush=True
            )


if __name__ == "__main__":
    main()
