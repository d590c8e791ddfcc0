"""What speaks against depth and calibration before anything is measured by them."""

from __future__ import annotations

import logging
from collections.abc import Iterator
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mushpipe.core.arrays import Floats
from mushpipe.core.geometry import Camera
from mushpipe.core.types import RgbdFrame, known

logger = logging.getLogger("mushpipe")
NEAREST_M, FARTHEST_M = 0.02, 30.0
COARSE_M = 0.003  # a cap of 30 mm rises by 9
WIDEST_DEG = 160.0
# A usual cap, m, and how wide it is in an image at least, px: twice the least radius of detectors.
CAP_M, CAP_PX = 0.04, 16.0
OFF_CENTRE = 1 / 6  # share of the image; of cropped images alone principal points lie further off
ALIKE = 0.1  # shares, or ratios, that differ by less are the same
# A `bow`: of beds in z it is 0.4 at most, of the same in ranges nearly always 0.75 to 1.4.
BOWED, MOST_BOWED = 0.6, 1.6
NARROW = 0.03  # where rays at the border are longer by less, ranges make no bowl that could be seen
STILL = 30  # frames
_APART = 16  # px between those that are compared first
_FEWEST_POINTS, _MOST_POINTS = 500, 5000
_FEWEST_LEVELS = 6
_FEWEST_EACH = 8  # depths a level: unlike steps, chance seldom meets a level twice


def judged(frames: Iterator[RgbdFrame], name: str, live: bool) -> Iterator[RgbdFrame]:
    """Pass frames on, and warn of the first that has depth where that is odd.

    And, once, where depth stands still: noise lets no sensor give the same image twice. Colour must
    go on meanwhile, unless they are live: a recording of one picture may be played in a loop.
    """
    done, last, same, moved = False, None, 0, False
    for frame in frames:
        done = done or _warned(name, frame)
        still = last is not None and _stands_still(frame, last)
        changed = still and last is not None and not np.array_equal(frame.color, last.color)
        same, moved = (same + 1, moved or changed) if changed or (still and live) else (0, False)
        if same == STILL:
            logger.warning(
                "%s, frame %d: depth has been the same, to the last digit, for %d frames%s: its "
                "sensor or driver may have stopped, and positions are of then",
                *(name, frame.header.sequence, same),
                " in which colour changed" if moved else ", and so has colour",
            )
        last = frame
        yield frame


def _stands_still(frame: RgbdFrame, last: RgbdFrame) -> bool:
    """Return whether depth, of which some is known, is the same as before."""
    depth, before = frame.depth, last.depth
    if depth is None or before is None:
        return False
    few = depth[::_APART, ::_APART]
    return (
        np.array_equal(few, before[::_APART, ::_APART], equal_nan=True)
        and np.array_equal(depth, before, equal_nan=True)
        and bool(known(depth).any())
    )


def _warned(name: str, frame: RgbdFrame) -> bool:
    """Warn of a frame where it is odd; return whether there is any depth to judge it by."""
    if frame.depth is None:
        return False
    depth = frame.depth[::8, ::8]
    there = known(depth)
    some = depth[there].astype(np.float64) * frame.depth_scale
    if not len(some):
        return False
    told = list(doubts_of_camera(frame.camera))
    if frame.camera is not None and not told:
        pixels = 8 * np.argwhere(there)[:, ::-1].astype(np.float64)
        of_range = doubts_of_points(frame.camera.deproject(pixels, some))
        told = [*doubts_of_view(some, frame.camera), *of_range]
    for doubt in (*doubts(some), *told):
        logger.warning("%s, frame %d: %s", name, frame.header.sequence, doubt)
    return True


def doubts(depth: NDArray[Any]) -> Iterator[str]:
    """Yield what is odd about depths (N,), m, none of them missing, and what to do about it."""
    if not len(depth):
        return
    middle = float(np.median(depth))
    if middle > FARTHEST_M:
        yield (
            f"half of the depth is beyond {middle:.0f} m; where it is in millimetres, set "
            "source.depth_scale: 0.001"
        )
    elif middle < NEAREST_M:
        yield (
            f"half of the depth is nearer than {1000 * middle:.2g} mm; where it is in metres, set "
            "source.depth_scale: 1"
        )
    elif (step := _step(depth)) > COARSE_M:
        yield (
            f"depth comes in steps of {1000 * step:.0f} mm, too coarse for the form of caps, "
            "which may be missed; record it finer (stereo cameras may have a mode called "
            "subpixel), or set source.depth_scale where its unit is another"
        )


def doubts_of_view(depth: NDArray[Any], camera: Camera) -> Iterator[str]:
    """Yield why no caps can be seen at depths (N,), m, none of them missing, and what to do.

    A unit that is wrong by a factor of eight leaves depths that some camera could have measured,
    but not of caps.
    """
    middle = float(np.median(depth)) if len(depth) else 0.0
    if not NEAREST_M <= middle <= FARTHEST_M:
        return
    if camera.height < 2 * CAP_PX:  # of a test, say: a cap is too small or too large in any case
        return
    wide = camera.focal * CAP_M / middle
    if not CAP_PX <= wide <= camera.height / 2:
        yield (
            f"half of the depth is {'nearer' if wide > CAP_PX else 'farther'} than {middle:.2g} m, "
            f"where a cap of {1000 * CAP_M:.0f} mm is {wide:.0f} px wide in an image of "
            f"{camera.width}x{camera.height}: caps may be missed, and others found; if that is not "
            "how far the bed is away, set source.depth_scale, or the focal length, to what they are"
        )


def doubts_of_points(points: Floats) -> Iterator[str]:
    """Yield why points (N, 3), m, seem to have been made of ranges, and what to do about it."""
    points = points[np.isfinite(points).all(axis=1)]
    if len(points) < _FEWEST_POINTS:
        return
    points = points[:: 1 + len(points) // _MOST_POINTS]
    longer = float(np.percentile(_stretch(points), 98)) - 1
    if longer > NARROW and BOWED < bow(points) < MOST_BOWED:
        yield (
            "depth looks like the distance from the camera (range), not along its axis (z): so "
            "taken the bed is flat, else a bowl; make it z, for as it is, what is seen at the "
            f"border is placed up to {1000 * longer * float(np.median(points[:, 2])):.0f} mm too "
            "far away"
        )


def bow(points: Floats) -> float:
    """Return how far a bed departs from a plane towards what a plane's ranges look like as z.

    A plane has 1/z = a + b x/z + c y/z; its ranges are longer than z by the `_stretch` s of their
    rays, 1/range = (a + b x/z + c y/z) (1 + g (1/s - 1)) with g = 1. The g returned is that of
    least squares, without what is far off the fit, as caps are.

    Args:
        points: (N, 3) m.
    """
    inverse, bowl = 1 / points[:, 2], 1 / _stretch(points) - 1
    plane = np.column_stack([np.ones(len(points)), points[:, :2] * inverse[:, None]])
    kept, share = np.ones(len(points), bool), 0.0
    for _ in range(4):
        flat = plane @ np.linalg.lstsq(plane[kept], inverse[kept], rcond=None)[0]
        both = np.column_stack([plane, flat * bowl])
        found = np.linalg.lstsq(both[kept], inverse[kept], rcond=None)[0]
        off = np.abs(both @ found - inverse)
        kept, share = off <= 2.5 * np.median(off), float(found[3])
    return share


def _stretch(points: Floats) -> Floats:
    """Return how much longer the rays (N,) of points are than their z."""
    return np.asarray(np.linalg.norm(points, axis=1) / points[:, 2])


def doubts_of_camera(camera: Camera | None) -> Iterator[str]:
    """Yield what is odd about a calibration, and what to do about it."""
    if camera is None:
        return
    yield from _doubts_of_size(camera)
    view = float(np.degrees(2 * np.arctan2(camera.width / 2, camera.fx)))
    if view > WIDEST_DEG:
        yield (
            f"a focal length of {camera.fx:g} px makes a view of {view:.0f} degrees; where it is "
            "in millimetres, state it in px: mm / width of the sensor in mm x width of the image"
        )


def _doubts_of_size(camera: Camera) -> Iterator[str]:
    """Yield why a calibration looks as if it were of images of another size, or of other pixels."""
    x, y = camera.cx / camera.width, camera.cy / camera.height
    off = min(abs(x - 0.5), abs(y - 0.5))
    if camera.centred and off > OFF_CENTRE and abs(x - y) < ALIKE:
        yield (
            f"the principal point of the calibration, ({camera.cx:g}, {camera.cy:g}), is that of "
            f"images of about {2 * camera.cx:.0f}x{2 * camera.cy:.0f}, and these are "
            f"{camera.width}x{camera.height}; unless they were cut out of larger ones, positions "
            "are off: set source.camera"
        )
    if abs(np.log(camera.fx / camera.fy)) > ALIKE:
        yield (
            f"focal lengths of {camera.fx:g} and {camera.fy:g} px make pixels that are not square, "
            "and caps that are not round; make the images so, or set source.camera"
        )


def _step(depth: NDArray[Any]) -> float:
    """Return the usual step between depths (N,), m; 0 where they are too few to tell."""
    levels = np.unique(depth)
    if not _FEWEST_LEVELS <= len(levels) <= len(depth) / _FEWEST_EACH:
        return 0.0
    return float(np.median(np.diff(levels)))
