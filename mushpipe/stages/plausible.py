"""Whether a camera can have seen what locations and poses say: nothing else may reach a robot."""

from __future__ import annotations

import logging

import numpy as np

from mushpipe import Circles, Locations, Poses
from mushpipe.core.arrays import Bools, Floats
from mushpipe.core.geometry import Camera, lengths
from mushpipe.core.tables import LARGEST_M

logger = logging.getLogger("mushpipe")
ENOUGH = 8  # caps that tell what is usual
SMALL_M, LARGE_M = 0.01, 0.1  # pins are smaller, and no variety is larger but for single caps
_METRES = "are all lengths in metres, and all of this circle?"
# No unit is mistaken for another by less. What is found differs by a factor of three at most.
UNIT = 10.0
MOST = 4.0  # times that the lengths of one row may differ: one of them is of something else


class UsualSize:
    """Warns, once, where the usual cap of a frame is as small or as large as hardly any cap is.

    In metres of another length all of them look as caps do: only their size tells.
    """

    def __init__(self) -> None:
        self._told = False

    def look(self, number: int, diameter: Floats) -> None:
        """Look at the diameters (N,), m, of a frame of such a number; NaN where unknown."""
        known = diameter[np.isfinite(diameter)]
        if self._told or len(known) < ENOUGH:
            return
        usual = float(np.median(known))
        if not SMALL_M <= usual <= LARGE_M:
            self._told = True
            logger.warning(
                "frame %d: half of the diameters of %d mushrooms are %s %.3g mm; where caps are of "
                "another size, positions are as wrong: depth is of another unit "
                "(source.depth_scale), or the calibration of another camera or size of image",
                *(number, len(known), "below" if usual < SMALL_M else "above", 1000 * usual),
            )


def contradictory(
    circles: Circles, locations: Locations, poses: Poses, camera: Camera | None
) -> Bools:
    """Return of which rows (N,) position, size and circle cannot be those of one mushroom.

    Depth of a flying pixel at the centre puts a cap metres away, where its circle is as wide as a
    table and its diameter is not. A length of another unit is alone where one mushroom is in view.

    Raises:
        ValueError: Something lies behind the camera, a distance is not that of its position, or
            most lengths are of another unit.
    """
    _require_in_front(locations.position, "location")
    _require_in_front(poses.apex, "pose")
    _require_distance(locations)
    diameter, way = locations.diameter, lengths(poses.apex - locations.position)
    across = _across(circles, locations, camera)
    _require_unit(diameter, way, across)
    wrong = (diameter > LARGEST_M) | (way > MOST * across) | _differ(diameter, across, MOST)
    return np.asarray(wrong)


def _across(circles: Circles, locations: Locations, camera: Camera | None) -> Floats:
    """Return how wide circles (N,) are where their locations are, m; NaN without calibration."""
    focal = np.nan if camera is None else camera.focal
    return np.asarray(2 * circles.radius * locations.position[:, 2] / focal)


def _require_in_front(points: Floats, what: str) -> None:
    """Raise ValueError where a point (N, 3) is not before the camera."""
    if (row := _first(points[:, 2] <= 0)) is not None:
        x, y, z = points[row]
        raise ValueError(
            f"row {row}: its {what} is at ({x:g}, {y:g}, {z:g}), which is not in front of the "
            "camera; where depth is missing, a location is NaN and its source MISSING"
        )


def _require_distance(locations: Locations) -> None:
    """Raise ValueError where a distance is not that of the position."""
    away = lengths(locations.position)
    if (row := _first(_differ(locations.distance, away))) is not None:
        raise ValueError(
            f"row {row}: its distance is {locations.distance[row]:.3g} m, but its location is "
            f"{away[row]:.3g} m from the camera: {_METRES}"
        )


def _require_unit(diameter: Floats, way: Floats, across: Floats) -> None:
    """Raise ValueError where most diameters, or ways to apexes, are of another unit.

    A unit is wrong in all rows. In one it is a depth that is wrong: the paper's method takes
    position and diameter from different pixels (`contradictory`).
    """
    if (row := _usual(_differ(diameter, across), diameter)) is not None:
        raise ValueError(
            f"row {row}: its diameter is {diameter[row]:.3g} m, but its circle is "
            f"{across[row]:.3g} m wide at its location, and so it is in most rows: {_METRES}"
        )
    if (row := _usual(way > UNIT * across, way)) is not None:
        raise ValueError(
            f"row {row}: the apex of its pose is {way[row]:.3g} m from its location, but its "
            f"circle is {across[row]:.3g} m wide there, and so it is in most rows: {_METRES}"
        )
    if (row := _usual(diameter > LARGEST_M, diameter)) is not None:
        raise ValueError(
            f"row {row}: its diameter is {diameter[row]:.3g} m, and more than {LARGEST_M:g} m in "
            "most rows: are all lengths in metres?"
        )


def _differ(given: Floats, seen: Floats, times: float = UNIT) -> Bools:
    """Return where two lengths (N,) differ, unless told as lengths of different units do."""
    return np.asarray((given > times * seen) | (seen > times * given))


def _usual(wrong: Bools, of: Floats) -> int | None:
    """Return the first row that is wrong, where most known ones (N,) are, and not just one."""
    most = max(1.0, np.isfinite(of).sum() / 2)
    return _first(wrong) if wrong.sum() > most else None


def _first(wrong: Bools) -> int | None:
    """Return the first row (N,) that is wrong."""
    return int(np.argmax(wrong)) if wrong.any() else None
