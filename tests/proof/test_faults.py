"""Whole runs on inputs that are damaged, out of order, or that end in mid-sentence."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from mushpipe import RgbdFrame, Sink, Trace
from mushpipe.core.document import parse_document, read_document
from mushpipe.core.graph import compile_document
from mushpipe.core.plugins import load_registry
from mushpipe.core.recorder import RecordingWriter
from mushpipe.core.recording import RecordingReader
from mushpipe.core.report import RunReport
from mushpipe.core.run import run
from mushpipe.proof.compare import compare
from mushpipe.sources.mcap import McapSource
from tests.cli.shell import MAIN

ROOT = Path(__file__).parents[2]
PICK = ROOT / "graphs/pick.yaml"
FIRST_BED = ROOT / "recordings/first-bed.mcap"
ENVIRONMENT = {**os.environ, "PYTHONPATH": os.pathsep.join([str(ROOT), *sys.path])}


class Keep(Sink):
    """Keeps what it is given."""

    def consume(self, trace: Trace) -> None:
        KEPT.append(trace)


KEPT: list[Trace] = []
CHEAP = """
mushpipe: 1
source: {use: mcap, path: PATH}
stages:
  segment: {use: otsu}
  open:    {use: opening, size: 10}
sinks:
  keep: {use: keep}
"""


def played(graph: Path, *overrides: str, source: Path | None = None) -> RunReport:
    KEPT.clear()
    plan = compile_document(
        read_document(graph), load_registry(), overrides, str(source) if source else None
    )
    return run(plan)


@pytest.fixture(scope="module")
def frames() -> list[RgbdFrame]:
    return list(McapSource(path=FIRST_BED).frames())


def recorded(path: Path, frames: list[RgbdFrame]) -> Path:
    writer = RecordingWriter(path, {})
    for frame in frames:
        writer.frame(replace(frame, attached={}))
    writer.close()
    return path


def damaged(data: bytes, rng: np.random.Generator) -> bytes:
    """Cut, flip, blank, repeat or drop some bytes."""
    at, size = int(rng.integers(8, len(data))), int(2 ** rng.uniform(0, 16))
    piece = data[at : at + size]
    match rng.integers(5):
        case 0:
            return data[:at]
        case 1:
            flipped = bytearray(data)
            flipped[at] ^= int(rng.integers(1, 256))
            return bytes(flipped)
        case 2:
            return data[:at] + bytes(len(piece)) + data[at + size :]
        case 3:
            return data[:at] + piece + data[at:]
        case _:
            return data[:at] + data[at + size :]


def check_damaged(whole: list[RgbdFrame], folder: Path, seeds: range) -> None:
    """Whatever comes out is bit for bit what was recorded, and what is lost is told."""
    by_stamp = {frame.header.stamp_ns: frame for frame in whole}
    data = recorded(folder / "whole.mcap", whole).read_bytes()
    path = folder / "damaged.mcap"
    document = parse_document(CHEAP.replace("PATH", str(path)), "cheap.yaml", folder)
    registry = load_registry()
    registry.sink("keep", Keep)
    for seed in seeds:
        path.write_bytes(damaged(data, np.random.default_rng(seed)))
        KEPT.clear()
        report = run(compile_document(document, registry))
        assert report.balanced(), seed
        assert report.exit_code in (0, 4), (seed, report.error)
        assert report.processed == len(KEPT)
        depths = 0
        for trace in KEPT:
            truth = by_stamp[trace.frame.header.stamp_ns]
            assert np.array_equal(trace.frame.color, truth.color), seed
            if trace.frame.depth is not None:
                depths += 1
                assert np.array_equal(trace.frame.depth, truth.depth), seed
        if report.exit_code == 0:
            assert len(KEPT) == depths == len(whole), seed
        elif KEPT:
            assert f"{len(KEPT)} frames could be read" in str(report.error), seed


def test_damaged_recordings(frames: list[RgbdFrame], tmp_path: Path) -> None:
    check_damaged(frames[:4], tmp_path, range(40))


@pytest.mark.slow
def test_a_thousand_damaged_recordings(frames: list[RgbdFrame], tmp_path: Path) -> None:
    check_damaged(frames[:4], tmp_path, range(1000, 2000))


def stamped(frame: RgbdFrame, number: int, stamp_ns: int) -> RgbdFrame:
    return replace(frame, header=replace(frame.header, stamp_ns=stamp_ns, sequence=number))


def disturbed(frames: list[RgbdFrame], how: str) -> list[RgbdFrame]:
    t, period = frames[0].header.stamp_ns, 33_333_333
    stamps = {
        "back": [0, 1, -100, 3, 4],
        "double": [0, 1, 1, 1, 2],
        "gap": [0, 1, 10**7, 10**7 + 1, 10**7 + 2],
    }.get(how, range(5))
    made = [stamped(frames[0], i, t + k * period) for i, k in enumerate(stamps)]
    # the host's clock goes on whatever the camera's does
    made = [
        replace(f, header=replace(f.header, arrival_ns=t + i * period)) for i, f in enumerate(made)
    ]
    if how == "depth stops":
        made = [*made[:2], *(replace(f, depth=None) for f in made[2:])]
    return made


@pytest.mark.parametrize("how", ["back", "double", "gap", "depth stops"])
def test_the_best_chain_takes_disturbed_frames(
    frames: list[RgbdFrame], tmp_path: Path, how: str
) -> None:
    given = disturbed(frames, how)
    path = recorded(tmp_path / "disturbed.mcap", given)
    log = tmp_path / "log.mcap"
    report = played(PICK, f"log.path={log}", source=path)
    assert report.balanced()
    assert report.processed + sum(report.source.values()) >= len({f.header.stamp_ns for f in given})
    assert report.exit_code in (0, 4), report.error
    for picks in picks_in(log):
        known = np.array([p is not None for p in picks["distance"]])
        missing = np.array(picks["source"]) == 0
        assert np.array_equal(known, ~missing)
        if how == "depth stops" and picks["sequence"] >= 2:
            assert missing.all()


def picks_in(log: Path) -> Iterator[dict[str, Any]]:
    import orjson

    reader = RecordingReader(log)
    for raw in reader.messages({"/mushpipe/pick"}):
        yield orjson.loads(raw.message.data)


def test_a_full_disk_ends_the_run_in_words(tmp_path: Path) -> None:
    report = played(PICK, "log.path=/dev/full", source=FIRST_BED)
    assert report.exit_code == 1
    assert "/dev/full" in str(report.error)
    assert "No space left on device" in str(report.error)
    assert report.balanced()


def start(log: Path, *options: str, **environment: str) -> subprocess.Popen[bytes]:
    command = [*MAIN, "run", str(PICK), "--set", f"log.path={log}", *options]
    return subprocess.Popen(
        command, env={**ENVIRONMENT, **environment}, stderr=subprocess.PIPE, cwd=log.parent
    )


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(6))
def test_what_was_finished_survives_a_kill(tmp_path: Path, seed: int) -> None:
    log = tmp_path / "log.mcap"
    with start(log, "--loop", "0") as child:
        until = time.monotonic() + 120
        while not (log.exists() and log.stat().st_size > 2_000_000) and time.monotonic() < until:
            time.sleep(0.01)
        time.sleep(np.random.default_rng(seed).uniform(0, 1))
        child.send_signal(signal.SIGKILL)
    found = list(picks_in(log))
    assert len(found) > 0
    assert [picks["sequence"] for picks in found] == list(range(len(found)))


@pytest.mark.parametrize(
    "environment",
    [
        {"PYTHONHASHSEED": "1"},
        {"OMP_NUM_THREADS": "1", "NUMBA_NUM_THREADS": "1", "OPENCV_FOR_THREADS_NUM": "1"},
    ],
    ids=["hash seed", "threads"],
)
def test_the_same_results_whatever_the_process_is_like(
    tmp_path: Path, environment: dict[str, str]
) -> None:
    here, there = tmp_path / "here.mcap", tmp_path / "there.mcap"
    with start(there, "--frames", "3", **environment) as child:
        report = played(PICK, f"log.path={here}", "source.max_frames=3", source=FIRST_BED)
        assert report.error is None
        child.communicate()
        assert child.returncode == 0
    found = compare(here, there)
    assert found.differences == []
    assert "/mushpipe/pick" in found.topics
