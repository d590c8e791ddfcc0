"""How the cost of the chain grows with mushrooms and with pixels: table, exponent, plot.

    python benchmarks/growth.py -o docs/images/growth.png

Beds are simulated with a seed of their own, 400 mushrooms being the most that one bed holds; the
camera of n times the pixels sees the same bed. Rendering takes minutes, once.
The exponent is the slope of log(time) over log(size): 1 is linear.
"""

from __future__ import annotations

import argparse
from pathlib import Path
from statistics import median
from typing import cast

import matplotlib as mpl
import numpy as np

from mushpipe import RgbdFrame, Source, Stage
from mushpipe.core.chain import Chain, cores_shared
from mushpipe.core.document import read_document
from mushpipe.core.graph import compile_document
from mushpipe.core.plugins import load_registry
from mushpipe.core.recorder import RecordingWriter
from mushpipe.proof.bench import machine
from mushpipe.sources.synthetic import SyntheticSource

mpl.use("Agg")
GRAPH = Path(__file__).resolve().parents[1] / "graphs/pick.yaml"
SEED = 4711
COUNTS = (10, 40, 150, 400)
SIZES = ((320, 240), (640, 480), (1280, 960), (1920, 1080))


def recording(folder: Path, **scene: int) -> Path:
    """Return a recording of one frame of a scene, rendered unless it is there already."""
    path = folder / f"{'-'.join(f'{name}{value}' for name, value in scene.items())}.mcap"
    if not path.exists():
        part = path.with_suffix(".part")
        writer = RecordingWriter(part, {})
        writer.frame(next(SyntheticSource(seed=SEED, **scene).frames()))
        writer.close()
        part.rename(path)
    return path


def measure(graph: Path, paths: list[Path], frames: int) -> list[dict[str, float]]:
    """Return the median time of each stage on the first frame of each recording, ms.

    They take turns, so that an hour in which the processor is slow is slow for all.
    """
    chains = [opened(graph, path) for path in paths]
    times: list[list[dict[str, int]]] = [[] for _ in paths]
    with cores_shared():
        for turn in range(frames):
            for (chain, frame), mine in zip(chains, times, strict=True):
                chain.passed(frame, 2 * turn)  # brings what it needs back into the caches
                mine.append(chain.passed(frame, 2 * turn + 1).durations_ns)
    return list(map(medians, times))


def opened(graph: Path, path: Path) -> tuple[Chain, RgbdFrame]:
    """Return the stages of a graph, ready, and the first frame of a recording."""
    plan = compile_document(read_document(graph), load_registry(), source=str(path)).fresh()
    for node in plan.stages:
        cast(Stage, node.plugin).open()
    return Chain(plan), next(cast(Source, plan.source.plugin).frames())


def medians(times: list[dict[str, int]]) -> dict[str, float]:
    """Return the median of the times of each stage, and of all together, ms."""
    each = {name: median(row[name] for row in times) / 1e6 for name in times[0]}
    return {**each, "all stages": median(sum(row.values()) for row in times) / 1e6}


def exponent(sizes: list[float], times: list[float]) -> float:
    """Return the slope of the two largest sizes in log-log."""
    (a, b), (s, t) = sizes[-2:], times[-2:]
    return float(np.log(t / s) / np.log(b / a)) if s and t else float("nan")


def table(title: str, sizes: list[float], rows: list[dict[str, float]]) -> None:
    """Print a table, a row per node."""
    print(f"\n| {title} |", " | ".join(f"{size:g}" for size in sizes), "| exponent |")
    print("|---|" + "---|" * (len(sizes) + 1))
    for name in rows[0]:
        times = [row[name] for row in rows]
        cells = [f"{time:.2f}" for time in times]
        print(f"| {name} |", " | ".join(cells), f"| {exponent(sizes, times):.2f} |")


def main() -> None:
    """Measure, print and draw."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("-o", "--out", type=Path, default=Path("growth.png"))
    parser.add_argument("--frames", type=int, default=30, help="runs of each scene")
    parser.add_argument("--scenes", type=Path, default=Path("out/growth"), help="rendered frames")
    arguments = parser.parse_args()
    print(f"{machine()}; seed {SEED}; ms per frame, median of {arguments.frames}")
    from matplotlib import pyplot

    figure, axes = pyplot.subplots(1, 2, figsize=(11, 4.5), sharey=True, layout="constrained")
    folder = arguments.scenes
    folder.mkdir(parents=True, exist_ok=True)
    counts = [recording(folder, count=count) for count in COUNTS]
    sizes = [recording(folder, width=w, height=h) for w, h in SIZES]
    by_count, by_size = (measure(GRAPH, paths, arguments.frames) for paths in (counts, sizes))
    pixels = [w * h / 1e6 for w, h in SIZES]
    for axis, title, along, rows in (
        (axes[0], "mushrooms in view", list(map(float, COUNTS)), by_count),
        (axes[1], "megapixels", pixels, by_size),
    ):
        table(title, along, rows)
        for node in rows[0]:
            bold = 2.5 if node == "all stages" else 1
            axis.loglog(along, [row[node] for row in rows], "o-", linewidth=bold, label=node)
        axis.set_xlabel(title)
        axis.grid(True, which="both", alpha=0.3)
    axes[0].set_ylabel("ms per frame")
    names = axes[0].get_legend_handles_labels()
    figure.legend(*names, loc="outside right center", fontsize="small")
    figure.savefig(arguments.out, dpi=70)


if __name__ == "__main__":
    main()
