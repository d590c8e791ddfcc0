"""Fast producers and slow or failing consumers: what is dropped, what waits, what ends a run."""

import threading
from collections.abc import Iterator
from typing import ClassVar

import pytest

from mushpipe import Circles, InputError, RgbdFrame, Sink, Source, Stage
from mushpipe.core.errors import EXIT_DAMAGED
from mushpipe.core.recorder import RecordingError
from tests.core.lab import Lab, held, make_frame, soon

FULL = OSError("disk full")


def test_of_two_waiting_live_frames_the_newest_wins(lab: Lab):
    entered, release = threading.Event(), threading.Event()

    def frames():
        yield make_frame(0)
        soon(entered)
        yield make_frame(1)
        yield make_frame(2)
        release.set()

    lab.live(frames)
    report = lab.run(lab.chain(held(entered, release), source="live"))
    assert [trace.frame.header.sequence for trace in lab.seen] == [0, 2]
    assert (report.frames_in, report.processed, report.dropped) == (3, 2, 1)
    assert report.balanced()
    assert report.exit_code == 0


class Gate:
    """A live source of n frames, each waiting for the one before; a sink held until the last."""

    def __init__(self, lab: Lab, n: int, delivery: str) -> None:
        processed, entered, all_done = (
            threading.Semaphore(0),
            threading.Event(),
            threading.Event(),
        )
        self.seen: list[int] = []
        seen, preferred = self.seen, delivery

        def frames():
            for i in range(n):
                yield make_frame(i)
                processed.acquire(timeout=20)
                soon(entered)

        class Viewer(Sink):
            delivery: ClassVar = preferred

            def consume(self, frame: RgbdFrame) -> None:
                entered.set()
                soon(all_done)
                seen.append(frame.header.sequence)

        def progress(report) -> None:
            if report.processed == n:
                all_done.set()
            processed.release()

        lab.live(frames)
        lab.registry.sink("viewer", Viewer)
        self.progress = progress


@pytest.mark.parametrize(
    ("delivery", "entry", "shown"),
    [
        ("latest", "viewer", [0, 3]),
        ("every", "viewer", [0, 1, 2, 3]),
        ("latest", "viewer, delivery: every", [0, 1, 2, 3]),
        ("every", "viewer, delivery: latest", [0, 3]),
    ],
)
def test_a_slow_sink_of_a_live_run(lab: Lab, delivery, entry, shown):
    gate = Gate(lab, 4, delivery)
    text = lab.chain("threshold", source="live").replace("collect", entry)
    report = lab.run(text, progress=gate.progress)
    assert gate.seen == shown
    sink = report.sinks["out"]
    assert (sink.handed, sink.consumed, sink.dropped) == (4, len(shown), 4 - len(shown))
    assert report.balanced()


def test_a_slow_sink_of_a_replay_sees_every_frame(lab: Lab):
    ahead, seen = threading.Event(), []

    class Slow(Sink):
        delivery: ClassVar = "latest"

        def consume(self, frame: RgbdFrame) -> None:
            soon(ahead)
            seen.append(frame.header.sequence)

    class Signal(Stage):
        def process(self, frame: RgbdFrame) -> RgbdFrame:
            if frame.header.sequence == 3:
                ahead.set()
            return frame

    lab.registry.sink("slow", Slow)
    report = lab.run(lab.chain(Signal).replace("collect", "slow"), "source.count=30")
    assert seen == list(range(30))
    assert report.sinks["out"].dropped == 0


def failing_sink(lab: Lab, *sequences: int, error: BaseException = FULL) -> str:
    class Picky(Sink):
        def consume(self, frame: RgbdFrame, circles: Circles) -> None:
            if frame.header.sequence in sequences:
                raise error

    lab.registry.sink("picky", Picky)
    return lab.chain("fussy").replace("collect", "picky")


def test_a_failing_sink_ends_a_replay(lab: Lab, tmp_path):
    report = lab.run(failing_sink(lab, 1), "source.count=1000", capsules=tmp_path)
    assert str(report.error) == "sink 'out' (picky) failed on frame 1: OSError: disk full"
    assert report.exit_code == 1
    assert report.processed < 1000
    assert report.balanced()
    assert report.capsules == [str(tmp_path / "failure-frames-out-1.mcap")]


def test_a_sink_that_wants_to_leave_does_not_hang_the_run(lab: Lab):
    report = lab.run(failing_sink(lab, 1, error=SystemExit("bye")), "source.count=1000")
    assert str(report.error) == "sink 'out' (picky) failed on frame 1: SystemExit: bye"


SKIP = "\non_error: skip\nmax_failures: 3"


def test_a_skipping_run_forgives_a_sink(lab: Lab, caplog):
    report = lab.run(failing_sink(lab, 1, 2, 4) + SKIP, "source.count=6")
    assert vars(report.sinks["out"]) == {"handed": 6, "consumed": 3, "dropped": 0, "failed": 3}
    assert report.exit_code == 0
    assert "failed on frame 4: OSError: disk full; the sink goes on" in caplog.text


def test_a_file_that_takes_no_more_ends_a_skipping_run_at_once(lab: Lab, caplog):
    sink = failing_sink(lab, 1, error=RecordingError("no space left"))
    report = lab.run(sink + SKIP, "source.count=1000")
    assert report.sinks["out"].failed == 1
    assert report.balanced()
    assert str(report.error) == "sink 'out' (picky) failed on frame 1: no space left"
    assert "goes on" not in caplog.text


def test_a_sink_that_took_nothing_has_failed(lab: Lab):
    report = lab.run(failing_sink(lab, 0, 1) + SKIP, "source.count=2")
    assert report.balanced()
    assert str(report.error) == "sink 'out' (picky) failed on frame 1: OSError: disk full"


def test_the_first_error_is_reported_though_closing_fails_as_well(lab: Lab, caplog):
    class Full(Sink):
        def consume(self, frame: RgbdFrame, circles: Circles) -> None: ...

        def close(self) -> None:
            raise FULL

    class Damaged(Source):
        def frames(self) -> Iterator[RgbdFrame]:
            yield make_frame(0)
            raise InputError("the first")

    lab.registry.sink("full", Full)
    lab.registry.source("damaged", Damaged)
    report = lab.run(lab.chain("fussy", source="damaged").replace("collect", "full"))
    assert "the first" in str(report.error)
    assert report.exit_code == EXIT_DAMAGED
    assert "disk full" in caplog.text


def test_too_many_failures_of_a_sink_in_a_row_end_a_skipping_run(lab: Lab):
    report = lab.run(failing_sink(lab, 1, 2, 3) + SKIP, "source.count=9")
    assert report.balanced()
    assert str(report.error) == "sink 'out' (picky) failed on frame 3: OSError: disk full"
