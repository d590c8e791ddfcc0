"""What authors of plugins test with: a stage held to its rules, a graph played frame by frame."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any, ClassVar, Self

import numpy as np
import pytest
from pydantic import PrivateAttr, field_validator, model_validator

from mushpipe import Circles, Mask, MushpipeError, RgbdFrame, Stage
from mushpipe.core.errors import GraphError, PluginError, StageError
from mushpipe.core.recorder import RecordingWriter
from mushpipe.testing import check_stage, replay
from tests.core.lab import Both, Brighten, Dice, Measure, Threshold, circles, make_frame

FRAME = make_frame(5)
MASK = Mask(np.ones((6, 8), bool))
RECORDING = Path("recordings/first-bed.mcap")


def test_a_stage_that_keeps_the_rules_gives_its_outputs() -> None:
    (mask,) = check_stage(Threshold(level=6), frame=FRAME)
    assert not mask.foreground.any()
    (measured,) = check_stage(Measure(), frame=FRAME, mask=MASK)
    assert measured.center.tolist() == [[5, 48]]
    assert [type(output) for output in check_stage(Both(), frame=FRAME)] == [Mask, Circles]
    (brighter,) = check_stage(Brighten(), frame=FRAME)
    assert (brighter.color == 105).all()
    assert len(check_stage(Dice(), frame=FRAME)) == 1


class Tries(Stage):
    """Finds as many circles as it has found before, since the first of all copies."""

    seen: ClassVar[list[int]] = []

    def process(self, frame: RgbdFrame) -> Circles:
        self.seen.append(1)
        return circles(*self.seen)


class Random(Stage):
    def process(self, frame: RgbdFrame) -> RgbdFrame:
        noise = np.random.default_rng().integers(0, 256, frame.color.shape)
        return RgbdFrame(frame.header, noise.astype(np.uint8))


class Writes(Stage):
    def process(self, frame: RgbdFrame) -> Mask:
        frame.color[:] = 0
        return Mask(frame.gray > 0)


class Half(Stage):
    def process(self, frame: RgbdFrame) -> Mask:
        return Mask(frame.gray[::2, ::2] > 0)


class Late(Stage):
    def process(self, frame: RgbdFrame) -> RgbdFrame:
        return make_frame(frame.header.sequence + 1)


class Nothing(Stage):
    def process(self, frame: RgbdFrame) -> Mask:  # type: ignore[empty-body]
        pass


class Doubled(Stage):
    share: float = 0.25

    @field_validator("share")
    @classmethod
    def _doubled(cls, value: float) -> float:
        return 2 * value

    def process(self, frame: RgbdFrame) -> Mask:
        return Mask(frame.gray > self.share)


class Validated(Stage):
    """State that a validator sets is lost on the copy that runs."""

    _level: float | None = PrivateAttr(None)

    @model_validator(mode="after")
    def _set(self) -> Self:
        self._level = 0.5
        return self

    def process(self, frame: RgbdFrame) -> Mask:
        return Mask(frame.gray > self._level)


class Opened(Stage):
    _levels: list[float] = PrivateAttr(default_factory=list)

    def open(self) -> None:
        self._levels.append(0.5)

    def process(self, frame: RgbdFrame) -> Mask:
        (level,) = self._levels
        return Mask(frame.gray > level)


def test_state_that_opening_sets_up_is_a_copys_own() -> None:
    assert len(check_stage(Opened(), frame=FRAME)) == 1


@pytest.mark.parametrize(
    ("stage", "kind", "told"),
    [
        (Tries(), PluginError, "a second copy returned another Circles"),
        (Random(), PluginError, "a second copy returned another RgbdFrame"),
        (Doubled(share=0.1), PluginError, "share is 0.2 when written, and then read as 0.4"),
        (Writes(), StageError, "failed on frame 5.*belong to all stages"),
        (Half(), StageError, "its mask is 4x3, the frame 8x6"),
        (Late(), StageError, "make it by dataclasses.replace"),
        (Nothing(), StageError, "is a `return` missing"),
        (Validated(), StageError, "NoneType"),
    ],
    ids=lambda value: type(value).__name__,
)
def test_a_rule_that_is_broken_is_named(stage: Stage, kind: type[MushpipeError], told: str) -> None:
    with pytest.raises(kind, match=told):
        check_stage(stage, frame=FRAME)


@pytest.mark.parametrize(
    ("inputs", "told"),
    [
        ({"frame": FRAME}, "input 'mask' is Mask, got NoneType"),
        ({"frame": FRAME, "mask": FRAME}, "input 'mask' is Mask, got RgbdFrame"),
        ({"frame": FRAME, "mask": MASK, "masks": MASK}, "it has no input 'masks'"),
    ],
)
def test_inputs_that_it_does_not_take_are_refused(inputs: dict[str, Any], told: str) -> None:
    with pytest.raises(PluginError, match=told):
        check_stage(Measure(), **inputs)


def graph_of(folder: Path, recording: Path, stages: str) -> Path:
    path = folder / "graph.yaml"
    path.write_text(
        f"mushpipe: 1\nsource: {{use: mcap, path: {recording.absolute()}}}\nstages: {stages}\n"
        "sinks: {log: {use: mcap, path: log.mcap}}\n"
    )
    return path


def test_a_graph_is_played_without_its_sinks(tmp_path: Path) -> None:
    graph = graph_of(tmp_path, RECORDING, "{segment: {use: otsu}, detect: {use: hough}}")
    some, few = (
        [trace.outputs["detect"][0] for trace in replay(graph, None, "source.max_frames=2", *more)]
        for more in ([], ["detect.radius_px=[30, 45]"])
    )
    assert len(some) == len(few) == 2
    assert all(len(a) > len(b) for a, b in zip(some, few, strict=True))
    (first, _) = replay(graph, RECORDING, "source.max_frames=2")
    assert first.outputs["segment"][0].foreground.any()
    assert [*tmp_path.iterdir()] == [graph]


def test_of_a_damaged_recording_what_it_holds_comes_first(tmp_path: Path) -> None:
    damaged = tmp_path / "damaged.mcap"
    writer = RecordingWriter(damaged, {})
    for k in range(200):
        noise = np.random.default_rng(k).integers(0, 256, (48, 64, 3))
        writer.frame(make_frame(k, color=noise.astype(np.uint8)))
    writer.close()
    damaged.write_bytes(damaged.read_bytes()[:-400_000])
    played = replay(graph_of(tmp_path, damaged, "{segment: {use: otsu}}"))
    seen: list[int] = []
    with pytest.raises(MushpipeError) as caught:
        seen.extend(trace.frame.header.sequence for trace in played)
    assert caught.value.exit_code == 4
    assert seen == [*range(len(seen))]
    assert 0 < len(seen) < 200


def test_faults_of_a_graph_come_before_its_frames_and_those_of_a_stage_with_them(
    tmp_path: Path,
) -> None:
    with pytest.raises(GraphError, match="otzu"):
        replay(graph_of(tmp_path, RECORDING, "{segment: {use: otzu}}"))
    (tmp_path / "mine.py").write_text(
        "from mushpipe import Mask, RgbdFrame, Stage\n"
        "class Fussy(Stage):\n"
        "    def process(self, frame: RgbdFrame) -> Mask:\n"
        "        raise RuntimeError('I do not like it')\n"
    )
    graph = graph_of(tmp_path, RECORDING, "{segment: {use: './mine.py:Fussy'}}")
    played: Iterator[Any] = replay(graph)
    with pytest.raises(StageError, match=r"segment.* failed on frame 0: .*I do not like it"):
        next(played)
