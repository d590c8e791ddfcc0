"""What is written to Rerun of one frame: images, results in the image and in space, plots, log.

A dozen messages a frame, made in Python: so each has what is of this frame and nothing else (how it
looks is told once, in `rerun_style`), and colours are packed as Rerun stores them.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import lru_cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mushpipe import Camera, Circles, Header, Mask, PickFlag, Picks, RgbdFrame, Trace
from mushpipe.core.arrays import Bools, Bytes, Rows, Singles
from mushpipe.core.scene import CORNER, DOME, SOURCE_COLORS, in_order, labels, posed, tints
from mushpipe.core.transform import Transform
from mushpipe.core.wire import jpeg
from mushpipe.sinks import rerun_layout as at

_FEW = 4  # px between those that a statistic is taken of
FIRST = 20  # picks whose place in the order is written beside them


def masks(trace: Trace) -> dict[str, Bools]:
    """Return masks by entity: each stage's, and each contour that one started from, once."""
    layers: dict[str, Bools] = {}
    for stage, mask in trace.of(Mask):
        known = any(mask.initial is layer for layer in layers.values())
        if mask.initial is not None and not known:
            same = (np.array_equal(mask.initial, layer) for layer in layers.values())
            if not any(same):
                layers[f"{at.INITIAL}/{stage}"] = mask.initial
        layers[f"{at.MASKS}/{stage}"] = mask.foreground
    return layers


def changed(trace: Trace) -> dict[str, RgbdFrame]:
    """Return the frames whose colour a stage changed, by entity."""
    color = trace.frame.color
    return {
        f"{at.FRAMES}/{stage}": frame
        for stage, frame in trace.of(RgbdFrame)
        if frame.color is not color and stage in trace.durations_ns
    }


def distance_of(frame: RgbdFrame) -> float | None:
    """Return how far the bed is, m; None where there is no depth."""
    few = frame.depth_m[::_FEW, ::_FEW]
    known = few[np.isfinite(few)]
    return float(np.median(known)) if known.size else None


def layers_of(trace: Trace) -> list[str]:
    """Return the layers of the image that this frame has, in drawing order."""
    circles = [f"{at.CIRCLES}/{stage}" for stage, _ in trace.of(Circles)]
    picks = [at.PICKS, at.IDS] if any(trace.of(Picks)) else []
    return [*changed(trace), *masks(trace), *circles, *picks]


def log_images(rec: Any, trace: Trace, jpeg_quality: int, cloud_step: int) -> None:
    """Log what takes room: colour, depth with its holes, masks and the coloured cloud."""
    import rerun as rr

    frame = trace.frame
    pictures = {at.COLOR: frame} | changed(trace)
    for order, (entity, picture) in enumerate(pictures.items()):
        data = jpeg(picture.color, jpeg_quality)
        rec.log(entity, rr.EncodedImage(contents=data, media_type="image/jpeg", draw_order=order))
    for order, (entity, mask) in enumerate(masks(trace).items()):
        pixels = mask.view(np.uint8)
        rec.log(entity, rr.SegmentationImage(pixels, opacity=0.3, draw_order=10 + order))
    if frame.camera is not None:
        pinhole = rr.Pinhole(
            focal_length=(frame.camera.fx, frame.camera.fy),
            principal_point=(frame.camera.cx, frame.camera.cy),
            width=frame.camera.width,
            height=frame.camera.height,
            image_plane_distance=distance_of(frame),
        )
        rec.log(at.IMAGE, pinhole)
    if frame.depth is not None:
        _log_depth(rec, frame)
        if frame.camera is not None:
            _log_cloud(rec, frame, frame.camera, cloud_step)


def _log_depth(rec: Any, frame: RgbdFrame) -> None:
    import rerun as rr

    depth = frame.depth_m
    missing = np.isnan(depth)
    few = depth[::_FEW, ::_FEW]
    known = few[np.isfinite(few)] / frame.depth_scale
    reach = np.percentile(known, (1, 99)) if known.size else None
    image = rr.DepthImage(
        frame.depth, meter=1 / frame.depth_scale, depth_range=reach, colormap="viridis"
    )
    rec.log(at.DEPTH, image)
    rec.log(at.HOLES, rr.SegmentationImage(missing.view(np.uint8), opacity=1.0))
    rec.log(f"{at.VALIDITY}/valid", rr.Scalars(100 * (1 - missing.mean())))


def _log_cloud(rec: Any, frame: RgbdFrame, camera: Camera, step: int) -> None:
    import rerun as rr

    rays = _rays(camera, step)
    depth = frame.depth_m[::step, ::step].reshape(-1, 1)
    known = np.flatnonzero((depth > 0) & (rays[:, 2:] > 0))
    points = rays[known] * depth[known]
    colors = frame.color[::step, ::step].reshape(-1, 3)[known]
    radii = 0.6 * step * float(np.median(points[::_FEW, 2])) / camera.fx if len(known) else None
    rec.log(at.CLOUD, rr.Points3D(points, colors=_packed(colors), radii=radii))


@lru_cache(maxsize=4)
def _rays(camera: Camera, step: int) -> Singles:
    """Return the rays (N, 3) of every ``step``-th pixel each way; z is 1, or 0 without a ray."""
    from mushpipe.stages.upright import pixel_rays

    xy = pixel_rays(camera)[::step, ::step].reshape(-1, 2)
    z = (np.abs(xy) < 1e3).all(axis=1, keepdims=True)
    return np.hstack([xy, z], dtype=np.float32)


def log_results(rec: Any, trace: Trace, base: Transform | None, stages: Sequence[str]) -> None:
    """Log circles, picks in the image and in space, counts, times, and the frame's warnings."""
    for stage, circles in trace.of(Circles):
        rec.log(f"{at.CIRCLES}/{stage}", _rings(circles))
    if trace.durations_ns:
        _log_series(rec, at.TIMES, stages, {n: t / 1e6 for n, t in trace.durations_ns.items()})
    picks = next((value for _, value in reversed([*trace.of(Picks)])), None)
    if picks is not None:
        _log_picks(rec, picks)
        if picks.frame_id in ("", trace.frame.header.frame_id):
            _log_space(rec, picks, at.CAMERA)
        elif base is not None and picks.frame_id == base.frame:
            _log_space(rec, picks, at.BASE)  # elsewhere nobody knows how they lie to the camera


def _log_series(rec: Any, entity: str, names: Sequence[str], values: Mapping[str, float]) -> None:
    """Log a value for each line of a plot, in the order in which `rerun_style` names them."""
    import rerun as rr

    rec.log(entity, rr.Scalars([values.get(name, np.nan) for name in names]))


def _packed(colors: Bytes, alpha: int = 255) -> NDArray[np.uint32]:
    """Return colours (N, 3) as Rerun stores them, (N,)."""
    red, green, blue = colors.T.astype(np.uint32)
    return np.asarray(red << 24 | green << 16 | blue << 8 | np.uint32(alpha), np.uint32)


def _rings(table: Circles | Picks, **colors: Any) -> Any:
    import rerun as rr

    sizes = np.repeat(table.radius[:, None], 2, axis=1)
    return rr.Ellipses2D.from_fields(centers=table.center + CORNER, half_sizes=sizes, **colors)


def _log_picks(rec: Any, picks: Picks) -> None:
    import rerun as rr

    rec.log(at.PICKS, _rings(picks, colors=_packed(SOURCE_COLORS[picks.source])))
    rec.log(at.IDS, rr.Points2D.from_fields(positions=picks.center + CORNER, labels=labels(picks)))
    located = in_order(picks)
    counts = {"found": len(picks), "located": len(located), "oriented": len(posed(picks, located))}
    _log_series(rec, at.COUNTS, [*counts], counts)
    text, level = _summary(picks)
    rec.log(at.LOG, rr.TextLog(text, level=level))


def _log_space(rec: Any, picks: Picks, place: str) -> None:
    """Log picks, their order and their caps below the entity whose frame they are in."""
    import rerun as rr

    located = in_order(picks)
    points, colors = picks.position[located], _packed(SOURCE_COLORS[picks.source[located]])
    rec.log(f"{place}/{at.TARGETS}", rr.Points3D.from_fields(positions=points, colors=colors))
    order = [f"{i + 1}" for i in range(min(len(located), FIRST))]
    first = rr.Points3D.from_fields(positions=points[:FIRST], labels=order)
    rec.log(f"{place}/{at.ORDER}", first)
    _log_caps(rec, picks, posed(picks, located), place)


def _log_caps(rec: Any, picks: Picks, rows: Rows, place: str) -> None:
    import rerun as rr

    radius, axis, apex = picks.diameter[rows] / 2, picks.axis[rows], picks.position[rows]
    colors = tints(picks.sigma_tilt[rows])
    caps = rr.Ellipsoids3D.from_fields(
        centers=apex - DOME * radius[:, None] * axis,
        half_sizes=radius[:, None] * (1, 1, DOME),
        quaternions=picks.quaternion[rows],
        colors=_packed(colors, alpha=90),
    )
    rec.log(f"{place}/{at.CAPS}", caps)
    arrows = rr.Arrows3D.from_fields(
        origins=apex, vectors=radius[:, None] * axis, colors=_packed(colors)
    )
    rec.log(f"{place}/{at.AXES}", arrows)


_WORDS = {
    PickFlag.DEPTH_MISSING: "without depth",
    PickFlag.DEPTH_ESTIMATED: "with estimated depth",
    PickFlag.POSE_UNKNOWN: "without pose",
    PickFlag.AT_BORDER: "at the border",
    PickFlag.OCCLUDED: "partly hidden",
    PickFlag.TILT_UNOBSERVABLE: "with an unsure tilt",
    PickFlag.TOO_CLOSE_TO_NEIGHBOUR: "too close to a neighbour",
}


def _summary(picks: Picks) -> tuple[str, str]:
    """Return the picks of a frame in words, and the level: a warning where some lack depth."""
    counts = {flag: int(np.count_nonzero(picks.flags & np.uint32(flag))) for flag in _WORDS}
    parts = [f"{count} {_WORDS[flag]}" for flag, count in counts.items() if count]
    text = ", ".join([f"{len(picks)} picks", *parts])
    return text, "WARN" if counts[PickFlag.DEPTH_MISSING] else "INFO"


def set_frame(rec: Any, header: Header) -> None:
    """Put what follows at a frame, on both timelines."""
    rec.set_time("frame", sequence=header.sequence)
    rec.set_time("capture", timestamp=np.datetime64(header.stamp_ns, "ns"))
