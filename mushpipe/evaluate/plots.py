"""The plots of a report, as inline SVG that takes its ink from the page around it."""

from __future__ import annotations

import io
import re
from collections.abc import Callable
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from mushpipe.core.arrays import Floats, Rows
from mushpipe.evaluate.events import Events, Kind
from mushpipe.evaluate.metrics import angle_deg, quantities_of, stated_errors

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

INK = "#010203"  # stands for the colour of the page's text
BLUE, ORANGE = "#3b82c4", "#d9822b"
NARROW, WIDE = 5.2, 10.4  # inches; what is wide takes the whole row of the page
MOST_BINS, FEWEST = 8, 12  # bins of a plot, and values in each
STYLE = {
    "svg.fonttype": "none",
    "svg.hashsalt": "mushpipe",
    "font.size": 8.5,
    "text.color": INK,
    "axes.labelcolor": INK,
    "axes.edgecolor": INK,
    "axes.linewidth": 0.6,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.titlesize": 8.5,
    "xtick.color": INK,
    "ytick.color": INK,
    "xtick.major.width": 0.6,
    "ytick.major.width": 0.6,
    "legend.frameon": False,
}


class Plot(NamedTuple):
    """A plot with what to say under it; ``wide`` takes the whole row."""

    title: str
    caption: str
    svg: str
    wide: bool = False


def plots_of(events: Events, prefix: str) -> list[Plot]:
    """Return the plots that the events have data for.

    Args:
        events: What happened.
        prefix: Makes the ids within the SVG unique on a page.
    """
    import matplotlib as mpl

    result = []
    with mpl.rc_context(STYLE):
        for number, (draw, title, caption) in enumerate(_PLOTS):
            if (figure := draw(events)) is not None:
                svg = _svg(figure, f"{prefix}{number}-")
                result.append(Plot(title, caption, svg, figure.get_figwidth() > NARROW))
    return result


def _svg(figure: Figure, prefix: str) -> str:
    buffer = io.StringIO()
    figure.savefig(buffer, format="svg", transparent=True, metadata={"Date": None})
    text = buffer.getvalue()
    text = re.sub(r"<metadata>.*?</metadata>", "", text[text.index("<svg") :], flags=re.DOTALL)
    text = re.sub(r'\b(id="|url\(#|href="#)', rf"\g<1>{prefix}", text)
    text = re.sub(r' (width|height)="[\d.]+pt"', "", text, count=2)
    # The text is set in the page's own font.
    return re.sub(r"font: ([\d.]+px) [^;\"]*", r"font-size: \1", text).replace(INK, "currentColor")


def _axes(
    columns: int = 1, rows: int = 1, width: float = NARROW, height: float = 3.1
) -> tuple[Figure, list[Axes]]:
    from matplotlib.figure import Figure

    figure = Figure(figsize=(width, height), layout="constrained")
    return figure, list(np.ravel(figure.subplots(rows, columns)))


def wilson(successes: NDArray[Any], trials: NDArray[Any]) -> tuple[Floats, Floats]:
    """Return the 95 % interval of shares (Wilson 1927)."""
    z = 1.96
    share = successes / trials
    middle = (share + z**2 / (2 * trials)) / (1 + z**2 / trials)
    half = z * np.sqrt(share * (1 - share) / trials + z**2 / (4 * trials**2)) / (1 + z**2 / trials)
    return middle - half, middle + half


def edges_of(x: Floats) -> Floats:
    """Return edges of bins with about as many values in each."""
    count = int(np.clip(len(x) // FEWEST, 1, MOST_BINS))
    return np.unique(np.quantile(x, np.linspace(0, 1, count + 1)))


def bins_of(x: Floats, edges: Floats) -> Rows:
    """Return the bin (N,) of each value; what lies beyond the edges is in the outermost ones."""
    return np.clip(np.digitize(x, edges) - 1, 0, max(0, len(edges) - 2))


def _draw_shares(axes: Axes, x: Floats, hits: Any, trials: Any, **style: Any) -> None:
    share, (low, high) = hits / trials, wilson(hits, trials)
    bars = np.maximum([share - low, high - share], 0)
    axes.errorbar(x, share, bars, fmt="o-", ms=4, lw=1.2, **style)


def _draw_diagonal(axes: Axes, end: float, **style: Any) -> None:
    axes.plot([0, end], [0, end], "--", lw=0.9, color=INK, alpha=0.5, **style)


def _by_radius(events: Events) -> Figure | None:
    found = events.kind == Kind.FOUND
    radii = np.concatenate([events.true_radius, events.radius])
    radii = radii[np.isfinite(radii)]
    if not len(radii):
        return None
    edges = edges_of(radii)
    figure, (axes,) = _axes()
    for name, kind, radius, color, shift in (
        ("precision", Kind.MISSED, events.radius, BLUE, -0.06),
        ("recall", Kind.FALSE, events.true_radius, ORANGE, 0.06),
    ):
        rows = events.kind != kind
        bins = bins_of(radius[rows], edges)
        size = max(1, len(edges) - 1)
        trials = np.bincount(bins, minlength=size).astype(np.float64)
        hits = np.bincount(bins, weights=found[rows].astype(np.float64), minlength=size)
        some = trials > 0
        trials, hits = trials[some], hits[some]
        middle = ((edges[:-1] + edges[1:]) / 2 if len(edges) > 1 else edges)[some]
        step = float(np.ptp(edges)) / size if len(edges) > 1 else 1.0
        _draw_shares(axes, middle + shift * step, hits, trials, color=color, label=name)
    axes.set(xlabel="radius, px", ylim=(-0.03, 1.03))
    axes.grid(axis="y", color=INK, alpha=0.12, lw=0.6)
    axes.legend(loc="lower right", ncols=2)
    return figure


def _against_tilt(events: Events) -> Figure | None:
    error = quantities_of(events)["axis"]
    tilt = angle_deg(events.up, events.true_axis)
    known = np.isfinite(error) & np.isfinite(tilt)
    if not known.any():
        return None
    error, tilt = error[known], tilt[known]
    figure, (axes,) = _axes()
    top = max(float(np.quantile(error, 0.99)) * 1.15, 1.0)
    shown = np.minimum(error, top)
    axes.plot(tilt, shown, "o", ms=2.6, mew=0, alpha=0.45, color=BLUE, clip_on=False)
    edges = edges_of(tilt)
    if len(edges) > 1:
        bins = bins_of(tilt, edges)
        medians = [np.median(error[bins == b]) for b in range(len(edges) - 1)]
        axes.plot((edges[:-1] + edges[1:]) / 2, medians, "o-", ms=4, color=ORANGE, label="median")
    _draw_diagonal(axes, float(tilt.max()), label="upright")
    axes.set(xlabel="true tilt, degrees", ylabel="axis error, degrees", xlim=(0, None))
    axes.set_ylim(0, top)
    axes.legend(loc="upper right", ncols=2)
    return figure


_HISTOGRAMS = {
    "center": "centre, px",
    "radius": "radius, px",
    "surface_z": "surface dZ, mm",
    "apex": "apex, mm",
    "diameter": "diameter, mm",
    "axis": "axis, degrees",
}


def _histograms(events: Events) -> Figure | None:
    from matplotlib.ticker import MaxNLocator

    quantities = quantities_of(events)
    known = {
        label: quantities[name][np.isfinite(quantities[name])]
        for name, label in _HISTOGRAMS.items()
    }
    known = {label: x for label, x in known.items() if len(x)}
    if not known:
        return None
    columns = min(3, len(known))
    rows = -(-len(known) // columns)
    figure, panels = _axes(columns, rows, WIDE, 2.1 * rows + 0.2)
    for axes, (label, x) in zip(panels, known.items(), strict=False):
        low, high = np.quantile(x, [0.005, 0.995])
        low = min(low, 0.0) if (x >= 0).all() else low
        ends = low - 1e-9, high + 1e-9  # also where errors differ by rounding alone
        axes.hist(np.clip(x, *ends), bins=32, range=ends, color=BLUE, alpha=0.8)
        axes.axvline(float(np.median(x)), color=ORANGE, lw=1.4)
        axes.set_xlabel(label)
        axes.yaxis.set_major_locator(MaxNLocator(4, integer=True))
    for axes in panels[len(known) :]:
        axes.set_visible(False)
    return figure


def _reliability(events: Events) -> Figure | None:
    stated = np.isfinite(events.score)
    if not stated.any():
        return None
    score, right = events.score[stated], events.kind[stated] == Kind.FOUND
    bins = bins_of(score, edges_of(score))
    trials = np.bincount(bins)
    used = trials > 0
    trials = trials[used]
    mean = np.bincount(bins, weights=score)[used] / trials
    hits = np.bincount(bins, weights=right)[used]
    figure, (axes,) = _axes()
    _draw_diagonal(axes, 1)
    _draw_shares(axes, mean, hits, trials, color=BLUE)
    axes.set(xlim=(0, 1), ylim=(0, 1.02), xlabel="score", ylabel="share that is right")
    return figure


def _calibration(events: Events) -> Figure | None:
    groups = _stated(events)
    if not groups:
        return None
    figure, panels = _axes(len(groups), 1, WIDE if len(groups) > 1 else NARROW, 2.9)
    for axes, (label, (sigma, square, z2)) in zip(panels, groups.items(), strict=True):
        bins = bins_of(sigma, edges_of(sigma))
        used = np.unique(bins)
        stated = np.array([np.sqrt(np.mean(sigma[bins == b] ** 2)) for b in used])
        real = np.array([np.sqrt(np.mean(square[bins == b])) for b in used])
        end = 1.15 * float(max(stated.max(), real.max()))
        _draw_diagonal(axes, end)
        axes.plot(stated, real, "o-", ms=4, lw=1.2, color=BLUE)
        axes.set(xlim=(0, end), ylim=(0, end), xlabel=f"stated sigma: {label}")
        axes.set_title(f"mean z² = {z2.mean():.2f}", loc="left")
    panels[0].set_ylabel("root mean square error")
    return figure


def _stated(events: Events) -> dict[str, tuple[Floats, Floats, Floats]]:
    """Return sigmas, squared errors and squared z-scores of position, diameter and tilt.

    Of a position sigma and error are those of one axis, root mean squares over the three.
    """
    quantities, errors = quantities_of(events), stated_errors(events)
    result = {}
    for name, unit, scale in (
        ("position", "mm", 1e3),
        ("diameter", "mm", 1e3),
        ("tilt", "degrees", np.degrees(1)),
    ):
        sigma, error = getattr(events, f"sigma_{name}"), errors[name]
        if sigma.ndim == 1:
            sigma, error = sigma[:, None], error[:, None]
        z2 = quantities[f"z2_{name}"]
        known = np.isfinite(z2)
        if known.any():
            root = scale * np.sqrt((sigma[known] ** 2).mean(axis=1))
            square = ((scale * error[known]) ** 2).mean(axis=1)
            result[f"{name}, {unit}"] = (root, square, z2[known])
    return result


_PLOTS: tuple[tuple[Callable[[Events], Figure | None], str, str], ...] = (
    (
        _by_radius,
        "Precision and recall by radius",
        "Precision by the detected radius, recall by the true one; bars are 95 % (Wilson).",
    ),
    (
        _reliability,
        "Reliability of the score",
        "Detections grouped by score: mean score and share that is right; bars are 95 % (Wilson). "
        "On the dashed line a score is the probability of being right.",
    ),
    (
        _against_tilt,
        "Axis error against true tilt",
        "Each mushroom, and the median per bin; on the dashed line lies the answer “upright”. "
        "What lies beyond the top stands on it.",
    ),
    (
        _histograms,
        "Errors of the mushrooms found",
        "Detected minus true; the line is the median. The outermost bins hold what lies beyond.",
    ),
    (
        _calibration,
        "Stated against true uncertainty",
        "Mushrooms grouped by the sigma stated for them: root mean square of sigma and of the "
        "error. On the dashed line a sigma is true; above it, it is too small.",
    ),
)
