"""Frames with truth and detections drawn over them, as inline SVG."""

from __future__ import annotations

import base64
import logging
from collections.abc import Iterable, Sequence
from html import escape
from pathlib import Path

import numpy as np

from mushpipe.core.errors import MushpipeError
from mushpipe.core.recording import RecordingReader
from mushpipe.core.types import RgbdFrame
from mushpipe.core.wire import COLOR_TOPIC, jpeg
from mushpipe.evaluate.events import Verdict
from mushpipe.evaluate.judging import Judged
from mushpipe.evaluate.truth import Place
from mushpipe.traces import source_recording

logger = logging.getLogger("mushpipe")
_JPEG_QUALITY = 82


def worst(verdicts: Sequence[Verdict], most: int) -> list[Verdict]:
    """Return the frames in which most is wrong: by share (1 - F), by number, by errors of centres.

    Of two frames that are alike in one the next decides.
    """

    def rank(verdict: Verdict) -> tuple[float, int, float]:
        m = verdict.matching
        error = verdict.detections.center[m.found] - verdict.truth.caps.center[m.truth]
        distance = float(np.linalg.norm(error, axis=1).mean()) if len(error) else 0.0
        wrong = len(m.missed) + len(m.false)
        return -wrong / max(1, wrong + 2 * len(m.truth)), -wrong, -distance

    return sorted(verdicts, key=rank)[:most]


def images_of(judged: Judged, places: Iterable[Place]) -> dict[Place, RgbdFrame]:
    """Return the wanted frames of a recording, as far as they are still to be found."""
    from mushpipe.sources.mcap import McapSource

    wanted, found = set(places), dict[Place, RgbdFrame]()
    path = _with_images(judged)
    if path is None or not wanted:
        return found
    try:
        for frame in McapSource(path=path).frames():
            place = judged.truth.place(frame.header)
            if place in wanted:
                found[place] = frame
            if len(found) == len(wanted):
                break
    except MushpipeError as error:
        logger.warning("some frames are not shown: %s", error)
    return found


def _with_images(judged: Judged) -> Path | None:
    if judged.recording is not None:
        return judged.recording
    path = judged.results.path
    if COLOR_TOPIC in RecordingReader(path).index().channels:
        return path
    return source_recording(path, judged.results.manifest)


def overlay(verdict: Verdict, frame: RgbdFrame | None) -> str:
    """Return a judged frame as SVG; without its image the circles alone."""
    if frame is None:
        width, height = _extent(verdict)
        picture = ""
    else:
        height, width = frame.color.shape[:2]
        data = base64.b64encode(jpeg(frame.color, _JPEG_QUALITY)).decode()
        href = f"data:image/jpeg;base64,{data}"
        picture = f'<image x="-0.5" y="-0.5" width="{width}" height="{height}" href="{href}"/>'
    size = f'viewBox="-0.5 -0.5 {width} {height}" xmlns="http://www.w3.org/2000/svg"'
    return f'<svg {size} role="img">{picture}{"".join(_circles(verdict))}</svg>'


def _extent(verdict: Verdict) -> tuple[int, int]:
    center = np.concatenate([verdict.truth.caps.center, verdict.detections.center, [[600, 440]]])
    width, height = center.max(axis=0) + 40
    return int(width), int(height)


def _circles(verdict: Verdict) -> list[str]:
    caps, found, m = verdict.truth.caps, verdict.detections, verdict.matching
    ignored = np.flatnonzero(caps.ignore != 0)
    result = [_circle("g", (u, v), r, "may be found") for u, v, r in verdict.truth.may_find]
    groups: list[tuple[str, Iterable[int], str]] = [
        ("g", ignored, "ignored"),
        ("t", m.truth, "true"),
        ("m", m.missed, "missed"),
    ]
    for style, rows, word in groups:
        for i in rows:
            text = f"{word} {caps.id[i]}, radius {caps.radius[i]:.1f} px"
            result.append(_circle(style, caps.center[i], caps.radius[i], text))
    groups = [("i", m.ignored, "counts neither way"), ("x", m.false, "false")]
    for style, rows, word in groups:
        for i in rows:
            text = f"{word}, radius {found.radius[i]:.1f} px"
            result.append(_circle(style, found.center[i], found.radius[i], text))
    for i, iou in zip(m.found, m.iou, strict=True):
        text = f"found, radius {found.radius[i]:.1f} px, IoU {iou:.2f}"
        result.append(_circle("d", found.center[i], found.radius[i], text))
    return result


def _circle(style: str, center: Sequence[float], radius: float, text: str) -> str:
    place = f'cx="{center[0]:.1f}" cy="{center[1]:.1f}" r="{radius:.1f}"'
    return f'<circle class="{style}" {place}><title>{escape(text)}</title></circle>'
