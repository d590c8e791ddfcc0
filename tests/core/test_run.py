"""The loop: order, fresh state, checks of what stages return, and the balance of frames."""

import itertools
import json
import sys
import threading
from dataclasses import replace
from functools import cached_property
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pytest
from pydantic import PrivateAttr

from mushpipe import Circles, InputError, Mask, Poses, RgbdFrame, Sink, Stage
from mushpipe.core.run import run
from tests.core.lab import Both, Dice, Frames, Lab, circles, cli, make_frame


def counts(report) -> tuple[int, int, int, int]:
    return report.frames_in, report.processed, report.dropped, report.failed


def test_every_frame_goes_through_all_stages_in_order(lab: Lab):
    report = lab.run(lab.chain("threshold", "invert"), "source.count=20")
    assert counts(report) == (20, 20, 0, 0)
    assert (report.exit_code, report.error) == (0, None)
    assert [trace.frame.header.sequence for trace in lab.seen] == list(range(20))
    assert list(lab.seen[0].outputs) == ["source", "a", "b"]
    assert list(lab.seen[0].durations_ns) == ["a", "b"]
    assert report.durations["a"].count == 20
    assert vars(report.sinks["out"]) == {"handed": 20, "consumed": 20, "dropped": 0, "failed": 0}


def test_a_source_without_frames_is_no_run(lab: Lab):
    report = lab.run(lab.chain("threshold"), "source.count=0")
    assert counts(report) == (0, 0, 0, 0)
    assert report.exit_code == 4
    assert str(report.error) == "source 'frames' gave no frame: there is nothing to run on"


def test_max_frames_ends_the_run_and_closes_the_source(lab: Lab):
    closed = []

    class Endless(Frames):
        def frames(self):
            try:
                for i in range(10**9):
                    yield make_frame(i)
            finally:
                closed.append(True)

    lab.registry.source("endless", Endless)
    report = lab.run(lab.chain("threshold", source="endless"), "source.max_frames=4")
    assert counts(report) == (4, 4, 0, 0)
    assert closed == [True]


@pytest.mark.parametrize("method", ["interrupt", "counts"])
def test_a_source_that_fails_at_the_end_costs_no_sink_its_frames(lab: Lab, method: str):
    """As that of a driver which is stopped already."""

    def gone(self: Any) -> Any:
        raise OSError("device gone")

    lab.registry.source("going", type("Going", (Frames,), {method: gone}))
    report = lab.run(lab.chain("threshold", source="going"))
    text = f"source 'source' (going) failed in {method}(): OSError: device gone (run -v says where)"
    assert str(report.error) == text
    assert counts(report) == (3, 3, 0, 0)
    assert [trace.frame.header.sequence for trace in lab.seen] == [0, 1, 2]
    assert report.sinks["out"].consumed == 3


def test_what_a_source_says_of_itself_may_hold_numbers_of_numpy(lab: Lab):
    class Said(Frames):
        def describe(self) -> dict[str, Any]:
            return {"serial": np.int64(4), "matrix": np.eye(2), "file": Path("a")}

        def counts(self) -> dict[str, int]:
            return {"lost": np.uint8(3)}

    lab.registry.source("said", Said)
    report = lab.run(lab.chain("threshold", source="said"))
    assert report.error is None
    known = {"serial": 4, "matrix": [[1, 0], [0, 1]], "file": "a"}
    assert json.loads(json.dumps([report.device, report.source])) == [known, {"lost": 3}]


def test_each_run_has_fresh_state(lab: Lab):
    class Counter(Stage):
        # A lock cannot be copied, and a stage may well have one.
        _lock: object = PrivateAttr(default_factory=threading.Lock)
        _count: int = PrivateAttr(0)

        def process(self, frame: RgbdFrame) -> Circles:
            self._count += 1
            return circles(self._count)

    plan = lab.compile(lab.chain(Counter))
    for _ in range(2):
        assert run(plan).error is None
    assert [trace.outputs["a"][0].radius[0] for trace in lab.seen] == [1, 2, 3] * 2


def test_what_a_plugin_remembers_of_the_time_before_a_run_is_none_of_it(lab: Lab):
    class Remembers(Stage):
        @cached_property
        def lock(self) -> Any:
            return threading.Lock()

        def required_inputs(self) -> frozenset[str]:
            return frozenset() if self.lock else frozenset({"poses"})

        def process(self, frame: RgbdFrame, poses: Poses | None) -> Mask:
            return Mask(frame.gray > 0)

    assert lab.run(lab.chain(Remembers)).error is None


def test_a_settings_list_is_not_shared_between_runs(lab: Lab):
    class Eats(Stage):
        left: list[int] = [1, 2, 3]  # noqa: RUF012 - pydantic copies it

        def process(self, frame: RgbdFrame) -> Circles:
            return circles(self.left.pop())

    plan = lab.compile(lab.chain(Eats, extra="seed: 1").replace("own-a", "own-a, left: [1, 2, 3]"))
    for _ in range(2):
        assert run(plan).error is None
    assert plan.stages[0].plugin.left == [1, 2, 3]


def rolls(lab: Lab, text: str, *overrides: str) -> list[float]:
    lab.seen.clear()
    lab.run(text, *overrides)
    name = "d" if "d: {use: dice}" in text else "a"
    return [float(trace.outputs[name][0].radius[0]) for trace in lab.seen]


def test_randomness_depends_on_seed_stage_and_frame_alone(lab: Lab):
    text = lab.chain("dice")
    first = rolls(lab, text)
    assert len(set(first)) == 3
    assert rolls(lab, text) == first
    assert not set(rolls(lab, text, "seed=1")) & set(first)
    assert rolls(lab, lab.chain("dice", "dice", "threshold")) == first
    assert not set(rolls(lab, lab.chain("threshold", "both", Dice, "dice"))) & set(first)


def test_randomness_is_the_same_for_the_same_frame_wherever_it_comes(lab: Lab):
    class Late(Frames):
        def frames(self):
            yield make_frame(2)

    lab.registry.source("late", Late)
    assert rolls(lab, lab.chain("dice", source="late")) == rolls(lab, lab.chain("dice"))[2:]


def test_the_random_generator_may_have_any_name(lab: Lab):
    class Roll(Stage):
        def process(self, frame: RgbdFrame, chance: np.random.Generator) -> Circles:
            return circles(1 + chance.random())

    assert rolls(lab, lab.chain(Roll)) == rolls(lab, lab.chain("dice"))


class Pair(NamedTuple):
    level: int
    row: int


def test_an_output_may_be_a_tuple_of_its_own_type(lab: Lab):
    class Find(Stage):
        def process(self, frame: RgbdFrame) -> Pair:
            return Pair(int(frame.color[0, 0, 0]), 5)

    assert lab.run(lab.chain(Find)).error is None
    assert [trace.outputs["a"] for trace in lab.seen] == [(Pair(level, 5),) for level in range(3)]


class Writes(Stage):
    def process(self, frame: RgbdFrame) -> Mask:
        frame.color[0, 0] = 7
        return Mask(frame.color[..., 0] > 0)


class WritesMask(Stage):
    def process(self, mask: Mask) -> Mask:
        np.logical_not(mask.foreground, out=mask.foreground)
        return mask


class Forgets(Stage):
    def process(self, frame: RgbdFrame) -> Mask:
        """Return nothing."""


class ReturnsAnother(Stage):
    def process(self, frame: RgbdFrame) -> tuple[Mask, Circles]:
        return circles(1), Mask(frame.gray > 0)


class ReturnsTwo(Stage):
    def process(self, frame: RgbdFrame) -> Mask:
        return Mask(frame.gray > 0), circles(1)


class ReturnsArray(Stage):
    def process(self, frame: RgbdFrame) -> Mask:
        return frame.gray > 0


class Crop(Stage):
    def process(self, frame: RgbdFrame) -> RgbdFrame:
        return RgbdFrame(frame.header, frame.color[:, :4])


class SmallMask(Stage):
    def process(self, frame: RgbdFrame) -> Mask:
        return Mask(np.zeros((3, 4), bool))


class BadCircle(Stage):
    def process(self, frame: RgbdFrame) -> Circles:
        return circles(3, -1)


_COPY = "frames and tables belong to all stages: copy an array before changing it"

FAILURES = {
    "writes into the frame": (Writes, f"ValueError: assignment destination is read-only; {_COPY}"),
    "writes into the mask": (WritesMask, f"ValueError: output array is read-only; {_COPY}"),
    "returns nothing": (
        Forgets,
        "TypeError: it returned (NoneType), declared is (Mask); is a `return` missing?",
    ),
    "returns an array": (
        ReturnsArray,
        "TypeError: it returned (ndarray), declared is (Mask)",
    ),
    "returns another order": (
        ReturnsAnother,
        "TypeError: it returned (Circles, Mask), declared is (Mask, Circles)",
    ),
    "returns too much": (
        ReturnsTwo,
        "TypeError: it returned (Mask, Circles), declared is (Mask)",
    ),
    "a frame of another size": (Crop, "ValueError: its new frame is 4x6, the frame 8x6"),
    "a mask of another size": (SmallMask, "ValueError: its mask is 4x3, the frame 8x6"),
    "a value that cannot be": (
        BadCircle,
        "ValueError: Circles: the radius must be positive (row 1)",
    ),
}


@pytest.mark.parametrize(("stage", "message"), FAILURES.values(), ids=FAILURES)
def test_a_failing_stage_is_named_with_its_frame_and_reason(lab: Lab, stage, message):
    report = lab.run(lab.chain("threshold", stage))
    assert str(report.error) == f"stage 'b' (own-b) failed on frame 0: {message}"
    assert report.exit_code == 1
    assert counts(report) == (1, 0, 0, 1)


@pytest.mark.parametrize("method", ["open", "close"])
def test_a_stage_that_leaves_as_a_program_does_fails(lab: Lab, method: str):
    """With 0, as scripts end, nothing was run and the program ended as if all were fine."""
    leaving = {method: lambda self: sys.exit(0)}
    report = lab.run(lab.chain(type("Leaves", (Both,), leaving)))
    text = f"stage 'a' (own-a) failed in {method}(): SystemExit: 0 (run -v says where)"
    assert str(report.error) == text
    assert report.exit_code == 1


def test_a_filter_that_is_a_frame_late_fails(lab: Lab):
    """Robots would have what is found in the older image as of now."""

    class Late(Stage):
        _last: RgbdFrame | None = PrivateAttr(None)

        def process(self, frame: RgbdFrame) -> RgbdFrame:
            older, self._last = self._last or frame, frame
            return older

    report = lab.run(lab.chain(Late, "threshold"))
    assert "'a' (own-a) failed on frame 1: ValueError: its new frame has stamp" in str(report.error)
    assert counts(report)[3] == 1


def test_a_filter_may_give_its_frame_another_frame_id(lab: Lab):
    class Rectified(Stage):
        def process(self, frame: RgbdFrame) -> RgbdFrame:
            return replace(frame, header=replace(frame.header, frame_id="rectified"))

    assert lab.run(lab.chain(Rectified, "threshold")).error is None


def test_the_program_ends_with_1_where_a_stage_fails(lab: Lab, monkeypatch, capsys):
    monkeypatch.chdir(lab.folder)
    monkeypatch.setattr("mushpipe.core.plugins.load_registry", lambda: lab.registry)
    (lab.folder / "graph.yaml").write_text(lab.chain(Forgets))
    assert cli(monkeypatch, "run", "graph.yaml") == 1
    error = capsys.readouterr().err
    assert "1 frames in = 0 processed + 0 dropped + 1 failed" in error
    assert "error: stage 'a' (own-a) failed on frame 0: TypeError: it returned" in error


def test_a_replay_ends_at_the_first_failure(lab: Lab):
    text = lab.chain("fussy").replace("fussy", "fussy, on: [2]")
    report = lab.run(text, "source.count=9")
    assert counts(report) == (3, 2, 0, 1)
    assert report.balanced()


def test_skipping_goes_on_and_counts(lab: Lab, caplog):
    text = lab.chain("fussy", extra="on_error: skip").replace("fussy", "fussy, on: [1, 3]")
    report = lab.run(text, "source.count=5")
    assert counts(report) == (5, 3, 0, 2)
    assert report.exit_code == 0
    assert [trace.frame.header.sequence for trace in lab.seen] == [0, 2, 4]
    assert caplog.messages[0] == (
        "stage 'a' (fussy) failed on frame 1: RuntimeError: I do not like it; the frame is skipped"
    )


def test_a_skipping_run_that_got_nothing_done_has_failed(lab: Lab):
    text = lab.chain("fussy", extra="on_error: skip").replace("fussy", "fussy, on: [0, 1]")
    report = lab.run(text, "source.count=2")
    assert counts(report) == (2, 0, 0, 2)
    assert str(report.error) == (
        "none of 2 frames could be processed; the last: "
        "stage 'a' (fussy) failed on frame 1: RuntimeError: I do not like it"
    )
    assert report.exit_code == 1


def test_too_many_failures_in_a_row_end_a_skipping_run(lab: Lab):
    text = lab.chain("fussy", extra="on_error: skip\nmax_failures: 3")
    report = lab.run(text.replace("fussy", "fussy, on: [0, 1, 3, 5, 6, 7]"), "source.count=20")
    assert counts(report) == (8, 2, 0, 6)
    assert str(report.error) == (
        "stage 'a' (fussy) failed on frame 7: RuntimeError: I do not like it (3 frames in a row)"
    )
    assert report.exit_code == 1
    assert report.balanced()


@pytest.mark.parametrize(("source", "exit_code"), [("frames", 1), ("live", 0)])
def test_a_replay_fails_and_a_live_run_skips_where_the_graph_does_not_say(
    lab: Lab, source, exit_code
):
    done = threading.Semaphore(0)

    def frames():
        for i in range(4):
            yield make_frame(i)
            done.acquire(timeout=20)

    lab.live(frames)
    text = lab.chain("fussy", source=source).replace("fussy", "fussy, on: [1]")
    report = lab.run(text, progress=lambda _: done.release())
    assert report.exit_code == exit_code


def test_a_known_error_of_a_stage_keeps_its_exit_code(lab: Lab, tmp_path):
    class NeedsDepth(Stage):
        def process(self, frame: RgbdFrame) -> Mask:
            raise InputError("the recording has no depth")

    report = lab.run(lab.chain(NeedsDepth), capsules=tmp_path / "failures")
    message = "stage 'a' (own-a) failed on frame 0: the recording has no depth"
    assert (str(report.error), report.exit_code) == (message, 4)
    assert report.capsules == []


def test_stopping_ends_after_the_frame_in_work(lab: Lab):
    stop = threading.Event()

    def progress(report) -> None:
        if report.processed == 2:
            stop.set()

    report = lab.run(lab.chain("threshold"), "source.count=50", stop=stop, progress=progress)
    assert counts(report) == (2, 2, 0, 0)
    assert (report.interrupted, report.exit_code) == (True, 130)
    assert report.balanced()


def test_a_sink_is_told_how_the_run_went(lab: Lab, monkeypatch):
    told = []

    class Log(Sink):
        def consume(self, frame: RgbdFrame) -> None: ...

        def finish(self, summary) -> None:
            assert summary["elapsed_s"] >= 1
            told.append((summary["exit_code"], summary["frames"]["processed"]))

    lab.registry.sink("log", Log)
    monkeypatch.setattr("mushpipe.core.run.time.monotonic", itertools.count().__next__)
    stop = threading.Event()
    text = lab.chain("threshold").replace("collect", "log")
    lab.run(text, stop=stop, progress=lambda report: stop.set())
    lab.run(text)
    assert told == [(130, 1), (0, 3)]


def test_the_program_ends_with_130_when_interrupted(lab: Lab, monkeypatch):
    import signal

    class Interrupts(Stage):
        def process(self, frame: RgbdFrame) -> Circles:
            if frame.header.sequence == 1:
                signal.raise_signal(signal.SIGINT)
            return circles(1)

    monkeypatch.chdir(lab.folder)
    monkeypatch.setattr("mushpipe.core.plugins.load_registry", lambda: lab.registry)
    (lab.folder / "graph.yaml").write_text(lab.chain(Interrupts))
    assert cli(monkeypatch, "run", "graph.yaml", "--frames", "3") == 130


def test_a_plan_without_a_source_is_a_mistake_of_the_caller(lab: Lab):
    from dataclasses import replace

    plan = lab.compile(lab.chain("threshold"))
    with pytest.raises(TypeError, match="source is not a Source"):
        run(replace(plan, source=plan.stages[0]))
