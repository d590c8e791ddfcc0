"""The plots of a report, as inline SVG that takes its ink from the page around it."""

from __future__ import annotations

import io
import re
from collections.abc import Callable
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from mushpipe.core.tables import Floats
from mushpipe.evaluate.events import Events, Kind
from mushpipe.evaluate.metrics import angle_deg, quantities_of, stated_errors

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

INK = "#010203"  # stands for the colour of the page's text
BLUE, ORANGE = "#3b82c4", "#d9822b"
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

    makers: list[Callable[[Events], tuple[Figure | None, str, str, bool]]] = [
        _by_radius,
        _reliability,
        _against_tilt,
        _histograms,
        _calibration,
    ]
    result = []
    with mpl.rc_context(STYLE):
        for number, make in enumerate(makers):
            figure, title, caption, wide = make(events)
            if figure is not None:
                result.append(Plot(title, caption, _svg(figure, f"{prefix}{number}-"), wide))
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
    columns: int = 1, rows: int = 1, size: tuple[float, float] = (5.2, 3.1)
) -> tuple[Figure, list[Axes]]:
    from matplotlib.figure import Figure

    figure = Figure(figsize=size, layout="constrained")
    return figure, list(np.ravel(figure.subplots(rows, columns)))


def wilson(successes: NDArray[Any], trials: NDArray[Any]) -> tuple[Floats, Floats]:
    """Return the 95 % interval of shares (Wilson 1927)."""
    z = 1.96
    share = successes / trials
    middle = (share + z**2 / (2 * trials)) / (1 + z**2 / trials)
    half = z * np.sqrt(share * (1 - share) / trials + z**2 / (4 * trials**2)) / (1 + z**2 / trials)
    return middle - half, middle + half


def bins_of(x: Floats, most: int = 8, fewest: int = 12) -> Floats:
    """Return edges of bins with about as many values in each, at least ``fewest``."""
    count = int(np.clip(len(x) // fewest, 1, most))
    return np.unique(np.quantile(x, np.linspace(0, 1, count + 1)))


def _by_radius(events: Events) -> tuple[Figure | None, str, str, bool]:
    title = "Precision and recall by radius"
    caption = "Precision by the detected radius, recall by the true one; bars are 95 % (Wilson)."
    found = events.kind == Kind.FOUND
    radii = np.concatenate([events.true_radius, events.radius])
    radii = radii[np.isfinite(radii)]
    if not len(radii):
        return None, title, caption, False
    edges = bins_of(radii)
    figure, (axes,) = _axes()
    for name, kind, radius, color, shift in (
        ("precision", Kind.MISSED, events.radius, BLUE, -0.06),
        ("recall", Kind.FALSE, events.true_radius, ORANGE, 0.06),
    ):
        rows = events.kind != kind
        bins = np.clip(np.digitize(radius[rows], edges) - 1, 0, max(0, len(edges) - 2))
        size = max(1, len(edges) - 1)
        trials = np.bincount(bins, minlength=size).astype(np.float64)
        hits = np.bincount(bins, weights=found[rows].astype(np.float64), minlength=size)
        some = trials > 0
        trials, hits = trials[some], hits[some]
        middle = ((edges[:-1] + edges[1:]) / 2 if len(edges) > 1 else edges)[some]
        step = float(np.ptp(edges)) / size if len(edges) > 1 else 1.0
        share, (low, high) = hits / trials, wilson(hits, trials)
        bars = np.maximum([share - low, high - share], 0)
        axes.errorbar(
            middle + shift * step, share, bars, fmt="o-", ms=4, lw=1.2, color=color, label=name
        )
    axes.set(xlabel="radius, px", ylim=(-0.03, 1.03))
    axes.grid(axis="y", color=INK, alpha=0.12, lw=0.6)
    axes.legend(loc="lower right", ncols=2)
    return figure, title, caption, False


def _against_tilt(events: Events) -> tuple[Figure | None, str, str, bool]:
    title = "Axis error against true tilt"
    caption = (
        "Each mushroom, and the median per bin; on the dashed line lies the answer “upright”. "
        "What lies beyond the top stands on it."
    )
    error = quantities_of(events)["axis"]
    tilt = angle_deg(events.up, events.true_axis)
    known = np.isfinite(error) & np.isfinite(tilt)
    if not known.any():
        return None, title, caption, False
    error, tilt = error[known], tilt[known]
    figure, (axes,) = _axes()
    top = max(float(np.quantile(error, 0.99)) * 1.15, 1.0)
    shown = np.minimum(error, top)
    axes.plot(tilt, shown, "o", ms=2.6, mew=0, alpha=0.45, color=BLUE, clip_on=False)
    edges = bins_of(tilt)
    if len(edges) > 1:
        bins = np.clip(np.digitize(tilt, edges) - 1, 0, len(edges) - 2)
        medians = [np.median(error[bins == b]) for b in range(len(edges) - 1)]
        axes.plot((edges[:-1] + edges[1:]) / 2, medians, "o-", ms=4, color=ORANGE, label="median")
    end = float(tilt.max())
    axes.plot([0, end], [0, end], "--", lw=0.9, color=INK, alpha=0.5, label="upright")
    axes.set(xlabel="true tilt, degrees", ylabel="axis error, degrees", xlim=(0, None))
    axes.set_ylim(0, top)
    axes.legend(loc="upper right", ncols=2)
    return figure, title, caption, False


_HISTOGRAMS = {
    "center": "centre, px",
    "radius": "radius, px",
    "surface_z": "surface dZ, mm",
    "apex": "apex, mm",
    "diameter": "diameter, mm",
    "axis": "axis, degrees",
}


def _histograms(events: Events) -> tuple[Figure | None, str, str, bool]:
    title = "Errors of the mushrooms found"
    caption = (
        "Detected minus true; the line is the median. The outermost bins hold what lies beyond."
    )
    quantities = quantities_of(events)
    known = {
        label: quantities[name][np.isfinite(quantities[name])]
        for name, label in _HISTOGRAMS.items()
    }
    known = {label: x for label, x in known.items() if len(x)}
    if not known:
        return None, title, caption, True
    columns = min(3, len(known))
    rows = -(-len(known) // columns)
    figure, panels = _axes(columns, rows, (10.4, 2.1 * rows + 0.2))
    for axes, (label, x) in zip(panels, known.items(), strict=False):
        low, high = np.quantile(x, [0.005, 0.995])
        low, high = (min(low, 0.0) - 1e-9, high + 1e-9) if (x >= 0).all() else (low, high)
        axes.hist(np.clip(x, low, high), bins=32, color=BLUE, alpha=0.8)
        axes.axvline(float(np.median(x)), color=ORANGE, lw=1.4)
        axes.set_xlabel(label)
        axes.yaxis.set_major_locator(_whole())
    for axes in panels[len(known) :]:
        axes.set_visible(False)
    return figure, title, caption, True


def _reliability(events: Events) -> tuple[Figure | None, str, str, bool]:
    title = "Reliability of the score"
    caption = (
        "Detections grouped by score: mean score and share that is right; bars are 95 % (Wilson). "
        "On the dashed line a score is the probability of being right."
    )
    stated = np.isfinite(events.score)
    if not stated.any():
        return None, title, caption, False
    score, right = events.score[stated], events.kind[stated] == Kind.FOUND
    edges = bins_of(score)
    bins = np.clip(np.digitize(score, edges) - 1, 0, max(0, len(edges) - 2))
    trials = np.bincount(bins)
    used = trials > 0
    trials = trials[used]
    mean = np.bincount(bins, weights=score)[used] / trials
    hits = np.bincount(bins, weights=right)[used]
    share, (low, high) = hits / trials, wilson(hits, trials)
    figure, (axes,) = _axes()
    axes.plot([0, 1], [0, 1], "--", lw=0.9, color=INK, alpha=0.5)
    bars = np.maximum(0, [share - low, high - share])
    axes.errorbar(mean, share, bars, fmt="o-", ms=4, lw=1.2, color=BLUE)
    axes.set(xlim=(0, 1), ylim=(0, 1.02), xlabel="score", ylabel="share that is right")
    return figure, title, caption, False


def _whole() -> Any:
    from matplotlib.ticker import MaxNLocator

    return MaxNLocator(4, integer=True)


def _calibration(events: Events) -> tuple[Figure | None, str, str, bool]:
    title = "Stated against true uncertainty"
    caption = (
        "Mushrooms grouped by the sigma stated for them: root mean square of sigma and of the "
        "error. On the dashed line a sigma is true; above it, it is too small."
    )
    groups = _stated(events)
    if not groups:
        return None, title, caption, True
    figure, panels = _axes(len(groups), 1, (10.4 if len(groups) > 1 else 5.2, 2.9))
    for axes, (label, (sigma, square, z2)) in zip(panels, groups.items(), strict=True):
        edges = bins_of(sigma)
        bins = np.clip(np.digitize(sigma, edges) - 1, 0, max(0, len(edges) - 2))
        used = np.unique(bins)
        stated = np.array([np.sqrt(np.mean(sigma[bins == b] ** 2)) for b in used])
        real = np.array([np.sqrt(np.mean(square[bins == b])) for b in used])
        end = 1.15 * float(max(stated.max(), real.max()))
        axes.plot([0, end], [0, end], "--", lw=0.9, color=INK, alpha=0.5)
        axes.plot(stated, real, "o-", ms=4, lw=1.2, color=BLUE)
        axes.set(xlim=(0, end), ylim=(0, end), xlabel=f"stated sigma: {label}")
        axes.set_title(f"mean z² = {z2.mean():.2f}", loc="left")
    panels[0].set_ylabel("root mean square error")
    return figure, title, caption, len(groups) > 1


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
