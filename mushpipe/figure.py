"""The figures of Baisa & Al-Diri 2022, drawn from a frame of any result recording."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from string import ascii_lowercase
from typing import TYPE_CHECKING, Any, NamedTuple, TypeVar

import numpy as np
from numpy.typing import NDArray

from mushpipe.core.arrays import Bools, Floats, Singles
from mushpipe.core.errors import UsageError
from mushpipe.core.tables import Circles, Locations
from mushpipe.core.types import Mask, RgbdFrame, Trace

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

T = TypeVar("T")
GREEN, RED, BLUE = "#28c840", "#e02020", "#1440e0"
PANEL_IN = 4.6  # width of an image
DPI = 150
FONT = 6  # points


class Panel(NamedTuple):
    """One image of a figure: its title, its pixels and what is drawn over them."""

    title: str
    image: NDArray[Any]
    draw: Callable[[Axes], None] = lambda _: None


def draw_stages(trace: Trace) -> Figure:
    """Draw original, initial contour, segmentation, opening, and circles with '+' centres.

    Raises:
        UsageError: The frame has no circles.
    """
    color, circles = trace.frame.color, _last(trace, Circles)
    panels = [Panel("original", color)]
    masks = dict(trace.of(Mask))
    first = next(iter(masks.values()), None)
    if first is not None and first.initial is not None:
        initial = first.initial
        panels.append(Panel("initial contour", color, lambda axes: _contour(axes, initial)))
    panels += [Panel(f"mask of {name}", mask.foreground) for name, mask in masks.items()]
    panels.append(Panel("circles", color, lambda axes: _rings(axes, circles, cross=True)))
    return _lay_out(panels, columns=3)


def draw_localization(trace: Trace) -> Figure:
    """Draw depth (blue) and distance (red), m, as recorded at the centres and as located.

    The left image shows NaN where the centre has no depth, the right one what stands in for it,
    and depth as stages corrected it.

    Raises:
        UsageError: The frame has no depth, no circles or no locations.
    """
    circles, locations = located(trace)
    frame = trace.frame
    depth_m = depth_m_of(frame)
    height, width = depth_m.shape
    u, v = np.rint(circles.center).astype(int).T
    depth = depth_m[np.clip(v, 0, height - 1), np.clip(u, 0, width - 1)].astype(np.float64)
    distance = np.full(len(circles), np.nan)
    if frame.camera is not None:
        points = frame.camera.deproject(circles.center, depth)
        distance = np.linalg.norm(points, axis=1)
    pairs = (
        ("recorded: depth (blue) and distance (red) at the centres, m", depth, distance),
        ("located: an estimate where there is none", locations.position[:, 2], locations.distance),
    )
    panels = [
        Panel(title, frame.color, partial(_pairs, circles=circles, depth=z, distance=d))
        for title, z, d in pairs
    ]
    return _lay_out(panels, columns=2, scale=1.7)


def draw_diameter(trace: Trace) -> Figure:
    """Draw the diameters, mm, at the centres of the circles.

    Raises:
        UsageError: The frame has no circles or no locations.
    """
    circles, locations = located(trace)

    def draw(axes: Axes) -> None:
        _rings(axes, circles)
        for (x, y), diameter in zip(circles.center, 1e3 * locations.diameter, strict=True):
            _text(axes, x, y, f"{diameter:.0f}" if np.isfinite(diameter) else "NaN", RED)

    return _lay_out([Panel("diameter, mm", trace.frame.color, draw)], columns=1, scale=1.9)


KINDS: dict[str, Callable[[Trace], Figure]] = {
    "stages": draw_stages,
    "localization": draw_localization,
    "diameter": draw_diameter,
}


def _last(trace: Trace, kind: type[T]) -> T:
    found = [value for _, value in trace.of(kind)]
    if not found:
        raise UsageError(
            f"frame {trace.frame.header.sequence} has no {kind.__name__}: the graph that wrote the "
            "results has no stage that makes them, the frame failed, or the file breaks off there "
            "(mushpipe info tells)"
        )
    return found[-1]


def depth_m_of(frame: RgbdFrame) -> Singles:
    """Return its depth in metres; raise UsageError where it has none."""
    if frame.depth is None:
        raise UsageError(f"frame {frame.header.sequence} has no depth to draw")
    return frame.depth_m


def located(trace: Trace) -> tuple[Circles, Locations]:
    """Return the last locations with their circles: those of the same stage, or the last above.

    Raises:
        UsageError: The frame has none, or they do not belong together.
    """
    locations = _last(trace, Locations)
    circles = _last(trace, Circles)
    for values in trace.outputs.values():
        own = [value for value in values if isinstance(value, Circles)]
        circles = own[-1] if own else circles
        if any(value is locations for value in values):
            break
    if len(circles) != len(locations):
        raise UsageError(
            f"frame {trace.frame.header.sequence} has {len(locations)} locations, and "
            f"{len(circles)} circles above them: they belong to others"
        )
    return circles, locations


def _lay_out(panels: list[Panel], columns: int, scale: float = 1.0) -> Figure:
    from matplotlib.figure import Figure

    rows = -(-len(panels) // columns)
    height, width = panels[0].image.shape[:2]
    size = PANEL_IN * scale
    figure = Figure(figsize=(columns * size, rows * (size * height / width + 0.3)), dpi=DPI)
    figure.set_layout_engine("constrained", w_pad=0.03, h_pad=0.03)
    places = list(np.ravel(figure.subplots(rows, columns)))
    for number, (axes, panel) in enumerate(zip(places, panels, strict=False)):
        axes.imshow(panel.image, cmap="gray", interpolation="nearest")
        letter = ascii_lowercase[number] if number < len(ascii_lowercase) else number + 1
        label = f"({letter}) " if len(panels) > 1 else ""
        axes.set_title(f"{label}{panel.title}", fontsize=10)
        axes.set_autoscale_on(False)  # a circle over the border makes no panel larger
        panel.draw(axes)
    for axes in places:
        axes.set_axis_off()
    return figure


def _contour(axes: Axes, mask: Bools) -> None:
    # matplotlib draws none of an image with a single row, and warns where there is none
    if min(mask.shape) > 1 and mask.any() and not mask.all():
        axes.contour(mask, levels=[0.5], colors=GREEN, linewidths=0.9)


def _rings(axes: Axes, circles: Circles, cross: bool = False) -> None:
    from matplotlib.collections import EllipseCollection

    size = 2 * circles.radius
    axes.add_collection(
        EllipseCollection(
            size,
            size,
            np.zeros_like(size),
            units="xy",
            offsets=circles.center,
            offset_transform=axes.transData,
            facecolors="none",
            edgecolors=GREEN,
            linewidths=1.1,
        )
    )
    if cross:
        axes.plot(*circles.center.T, "+", color=RED, ms=5, mew=0.9)


def _pairs(axes: Axes, circles: Circles, depth: Floats, distance: Floats) -> None:
    _rings(axes, circles)
    for (x, y), z, d in zip(circles.center, depth, distance, strict=True):
        _text(axes, x, y, _metres(z), BLUE, 0.6 * FONT)
        _text(axes, x, y, _metres(d), RED, -0.6 * FONT)


def _metres(value: float) -> str:
    return f"{value:.3f}" if np.isfinite(value) else "NaN"


def _text(axes: Axes, x: float, y: float, text: str, color: str, above: float = 0.0) -> None:
    """Write at a pixel, or so many points above it: the font knows no pixels of the image."""
    from matplotlib.patheffects import withStroke

    outline = [withStroke(linewidth=1.6, foreground="white")]
    # the centre of a circle over the border may lie beyond it
    (left, right), (low, high) = axes.get_xlim(), axes.get_ylim()[::-1]
    x, y = min(max(x, left), right), min(max(y, low), high)
    axes.annotate(
        text, (x, y), (0, above), textcoords="offset points", color=color, fontsize=FONT,
        ha="center", va="center", path_effects=outline,
    )  # fmt: skip
