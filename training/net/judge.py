"""Judge `cap-net` beside the classic detector, on what trained neither.

`python -m training.net.judge` prints simulated scenes of both shape families by condition, with
`--choosing` those for choices of design, with `--sparse N` beds with few caps or none, with
`--recordings FILE...` recordings that carry their truth, and with `--field FOLDER` labelled real
ones.
"""

from __future__ import annotations

import argparse
from collections import defaultdict
from collections.abc import Iterator
from dataclasses import replace
from itertools import chain
from pathlib import Path

from mushpipe import Circles, RgbdFrame
from mushpipe.stages.cap_net import CapNet
from mushpipe.stages.phase_hough import PhaseHough
from training import judge
from training.field import RANGES, labelled_frames, result
from training.matching import Score, counted
from training.net.scenes import (
    CHOOSING_SEED,
    JUDGING_SEED,
    SPARSE_JUDGING_SEED,
    sparse_cases,
    varied_cases,
)
from training.scenes import JUDGED, Case, choosing_cases, judging_cases, recorded_cases
from training.verifier import RADII, segmentations

OPEN = (8.0, None)  # as graphs/pick.yaml has it: the largest radius is left to what is seen
NET = CapNet(radius_px=OPEN, min_score=0.05, beside_depth=0.8)
CLASSIC = {
    "image": PhaseHough(radius_px=RADII, use_depth=False),
    "depth": PhaseHough(radius_px=RADII),
    "image+net": PhaseHough(radius_px=OPEN, use_depth=False, use_learned=True),
    "depth+net": PhaseHough(radius_px=OPEN, use_learned=True),
}
FITTED = {  # down to a low score, for `cap-fit` to decide; at last without depth
    "fitted": PhaseHough(radius_px=RADII, min_score=judge.LEAST),
    "fitted+net": PhaseHough(radius_px=OPEN, min_score=judge.LEAST, use_learned=True),
    "seen+net": PhaseHough(
        radius_px=OPEN, min_score=judge.LEAST, use_depth=False, use_learned=True
    ),
}

EACH, VARIED = 3, 16  # frames of a row per shape family, and of `varied`
TABLES = 4  # times as many frames of a table, which holds few caps


def scenes(cache: Path, choosing: bool, each: int, varied: int) -> Iterator[Case]:
    """Yield the frames to judge on, so many per row and family, or those for choices of design."""
    if choosing:
        return chain(choosing_cases(cache), varied_cases(cache, CHOOSING_SEED, "a", 60))
    return chain(judging_cases(cache, each, TABLES), varied_cases(cache, JUDGING_SEED, "b", varied))


def simulated(models: list[Path], cases: Iterator[Case], peers: bool) -> str:
    """Return the table of all models; with `peers`, of the classic detector too."""
    nets = {path.stem: CapNet(radius_px=RADII, model=path) for path in models}
    scores: dict[tuple[str, str], Score] = defaultdict(Score)
    for case in cases:
        counts = counted(case.truth, *RADII)
        for name, net in nets.items():
            scores[case.condition, name].add(net.process(case.frame)[1], case.truth, counts)
        if peers:
            flat = (*segmentations(case.frame)[0], None)
            for name, stage in (CLASSIC | FITTED).items():
                frame = case.frame if stage.use_depth else replace(case.frame, depth=None)
                ready = (frame, *NET.process(frame)) if stage.use_learned else flat
                circles = stage.process(*ready)
                circles = judge.kept(frame, circles, ready[2]) if name in FITTED else circles
                scores[case.condition, name].add(circles, case.truth, counts)
    return judge.table(scores, [*nets, *((*CLASSIC, *FITTED) if peers else ())])


def both(frame: RgbdFrame, depth: bool, beside_depth: float = 0.8) -> Circles:
    """Return the circles of network and classic detector, as graphs/pick.yaml has them."""
    net = CapNet(radius_px=OPEN, min_score=0.05, beside_depth=beside_depth)
    frame = frame if depth else replace(frame, depth=None)
    stage = PhaseHough(radius_px=OPEN, min_score=judge.LEAST, use_learned=True)
    mask, learned = net.process(frame)
    return judge.kept(frame, stage.process(frame, mask, learned), learned)


def real(model: Path, folder: Path) -> Iterator[str]:
    """Yield lines per labelled frame of the recordings in a folder: the network, and both."""
    for path in sorted(folder.glob("*.mcap")):
        radius = next(v for k, v in RANGES.items() if path.stem.startswith(k))["radius_px"]
        net = CapNet(radius_px=radius or (15, 90), model=model)
        for frame, *wanted in labelled_frames(path):
            name = f"{path.stem:18} #{frame.header.sequence}"
            yield f"{name} cap-net      {result(net.process(frame)[1], *wanted)}"
            yield f"{name} both, colour {result(both(frame, False), *wanted)}"
            if frame.depth is not None:
                yield f"{name} both, depth  {result(both(frame, True), *wanted)}"


def main() -> None:
    """Read the command line."""
    parser = argparse.ArgumentParser(description=__doc__)
    shipped = Path("mushpipe/stages/cap_net.onnx")
    parser.add_argument("--cache", type=Path, default=Path("out/scenes"), help="rendered frames")
    parser.add_argument("--models", type=Path, nargs="+", default=[shipped])
    parser.add_argument("--peers", action="store_true", help="the classic detector as well")
    parser.add_argument("--each", type=int, default=EACH, help="frames of a row per shape family")
    parser.add_argument("--varied", type=int, default=VARIED, help="how many varied frames")
    others = parser.add_mutually_exclusive_group()
    others.add_argument("--choosing", action="store_true", help="the frames for choices of design")
    others.add_argument("--only", choices=JUDGED, help="one row instead of all")
    others.add_argument("--sparse", type=int, help="so many beds with few caps or none, instead")
    others.add_argument("--field", type=Path, help="labelled real recordings instead")
    others.add_argument("--recordings", type=Path, nargs="+", help="with truth, instead")
    arguments = parser.parse_args()
    if arguments.field:
        for line in real(arguments.models[0], arguments.field):
            print(line)
    else:
        cases = scenes(arguments.cache, arguments.choosing, arguments.each, arguments.varied)
        if arguments.only:
            cases = judging_cases(arguments.cache, arguments.each, TABLES, [arguments.only])
        if arguments.sparse:
            cases = sparse_cases(arguments.cache, SPARSE_JUDGING_SEED, "b", arguments.sparse)
        if arguments.recordings:
            cases = chain.from_iterable(map(recorded_cases, arguments.recordings))
        print(simulated(arguments.models, cases, arguments.peers))


if __name__ == "__main__":
    main()
