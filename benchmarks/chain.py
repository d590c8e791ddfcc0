"""The whole chain beside the plain script: accuracy and time of both on the same frames.

    python benchmarks/chain.py                      # the recordings that come along
    python benchmarks/chain.py --seeds 900 901      # fresh simulated beds, both shape families

`benchmarks/naive.py` is the paper's method on scikit-image, OpenCV and Open3D; `baisa2022.yaml` is
that method in this project's stages, `classic.yaml` and `pick.yaml` what the project offers in its
place, without and with a network. Time is that of all stages on the first frame of a recording,
alone on the machine, median over the recordings; of chains below a second the median of 15 passes.
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
import tempfile
from pathlib import Path
from statistics import median

from growth import measure

ROOT = Path(__file__).resolve().parents[1]
GRAPHS = {
    "plain script": ROOT / "benchmarks/naive.yaml",
    "baisa2022.yaml": ROOT / "graphs/baisa2022.yaml",
    "classic.yaml": ROOT / "graphs/classic.yaml",
    "pick.yaml": ROOT / "graphs/pick.yaml",
}
CLI = [sys.executable, "-m", "mushpipe"]
RECORDINGS = ("first-bed", "dense", "tilted", "brown", "harsh-light", "sparse")
SLOW_MS = 1000
COLUMNS = {
    "f": "F",
    "precision": "precision",
    "recall": "recall",
    "center_median_px": "centre px",
    "diameter_bias_mm": "diameter bias mm",
    "diameter_std_mm": "std mm",
    "axis_mean_deg": "axis deg",
}


def simulated(seeds: list[int], frames: int, folder: Path) -> list[Path]:
    """Record beds of seeds that nothing was made with, of both families of shapes."""
    made = []
    for seed in seeds:
        for shapes in ("a", "b"):
            path = folder / f"seed-{seed}-{shapes}.mcap"
            settings = [f"source.seed={seed}", f"source.shape_family={shapes}"]
            options = [part for setting in settings for part in ("--set", setting)]
            command = [*CLI, "record", "--source", "synthetic", "-o", str(path)]
            subprocess.run([*command, "--frames", str(frames), *options], check=True)
            made.append(path)
    return made


def judged(graph: Path, recordings: list[Path], frames: int) -> dict[str, float]:
    """Return the figures of a graph, those in ``COLUMNS`` and ``ms``."""
    command = [*CLI, "eval", str(graph), *map(str, recordings)]
    options = ["--frames", str(frames), "--resamples", "0", "--format", "json"]
    run = subprocess.run([*command, *options], check=False, capture_output=True, text=True)
    if run.returncode:
        raise SystemExit(run.stderr)
    whole = json.loads(run.stdout)["alternatives"][0]
    values = whole["overall"]["metrics"]
    figures = {name: values[name]["value"] for name in COLUMNS}
    return figures | {"ms": median(milliseconds(graph, path) for path in recordings)}


def milliseconds(graph: Path, recording: Path) -> float:
    """Return the time of all stages on the first frame of a recording, ms."""
    once = measure(graph, [recording], 1)[0]["all stages"]
    return once if once > SLOW_MS else measure(graph, [recording], 15)[0]["all stages"]


def main() -> None:
    """Run the chains and print a table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--frames", type=int, default=2, help="of each recording")
    parser.add_argument("--seeds", type=int, nargs="*", default=[], help="fresh beds instead")
    arguments = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        recordings = [ROOT / f"recordings/{name}.mcap" for name in RECORDINGS]
        if arguments.seeds:
            recordings = simulated(arguments.seeds, arguments.frames, Path(folder))
        print("| chain |", " | ".join(COLUMNS.values()), "| ms/frame | times as fast |")
        print("|" + "---|" * (len(COLUMNS) + 3))
        slowest = 0.0
        for name, graph in GRAPHS.items():
            figures = judged(graph, recordings, arguments.frames)
            slowest = slowest or figures["ms"]
            cells = [f"{figures[column]:.3g}" for column in (*COLUMNS, "ms")]
            print(
                f"| {name} |", " | ".join(cells), f"| {slowest / figures['ms']:.0f} |", flush=True
            )


if __name__ == "__main__":
    main()
