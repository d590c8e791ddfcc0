"""Frames that follow one another through the stages: order, overlap, and failures out of turn."""

import gc
import random
import sys
import threading
import time

import cv2
import pytest

from mushpipe import Circles, Mask, RgbdFrame, Stage
from mushpipe.core.chain import Turnstile
from tests.core.lab import Lab, circles, soon


def test_a_turnstile_lets_in_by_ticket_one_at_a_time() -> None:
    turnstile, inside, order = Turnstile(), threading.Lock(), []

    def pass_through(ticket: int) -> None:
        with turnstile.turn(ticket):
            assert inside.acquire(blocking=False)
            order.append(ticket)
            inside.release()

    tickets = list(range(40))
    random.Random(1).shuffle(tickets)
    threads = [threading.Thread(target=pass_through, args=(t,)) for t in tickets]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert order == sorted(tickets)


def test_a_frame_enters_a_stage_while_the_one_before_it_is_in_the_next(lab: Lab) -> None:
    second_came = threading.Event()

    class First(Stage):
        def process(self, frame: RgbdFrame) -> Mask:
            if frame.header.sequence == 1:
                second_came.set()
            return Mask(frame.color[..., 0] > 0)

    class Second(Stage):
        def process(self, frame: RgbdFrame, mask: Mask) -> Circles:
            if frame.header.sequence == 0:
                soon(second_came)
            return circles(1)

    report = lab.run(lab.chain(First, Second), "source.count=3")
    assert (report.processed, report.error) == (3, None)


def test_each_stage_sees_all_frames_in_order_and_one_at_a_time(lab: Lab) -> None:
    calls: dict[str, list[int]] = {"a": [], "b": []}
    busy = {"a": threading.Lock(), "b": threading.Lock()}

    def called(name: str, frame: RgbdFrame) -> None:
        assert busy[name].acquire(blocking=False)
        calls[name].append(frame.header.sequence)
        time.sleep(random.random() / 1000)
        busy[name].release()

    class First(Stage):
        def process(self, frame: RgbdFrame) -> Mask:
            called("a", frame)
            return Mask(frame.color[..., 0] > 0)

    class Second(Stage):
        def process(self, frame: RgbdFrame, mask: Mask) -> Circles:
            called("b", frame)
            return circles(1)

    report = lab.run(lab.chain(First, Second), "source.count=50")
    assert report.processed == 50
    assert calls == {"a": list(range(50)), "b": list(range(50))}
    assert [trace.frame.header.sequence for trace in lab.seen] == list(range(50))


def test_a_reentrant_stage_has_two_frames_in_it_and_the_next_stage_sees_them_in_order(
    lab: Lab,
) -> None:
    both, calls = threading.Barrier(2, timeout=20), []

    class Meets(Stage):
        reentrant = True

        def process(self, frame: RgbdFrame) -> Mask:
            both.wait()  # breaks where one of two frames is kept out
            time.sleep(0.003 * (frame.header.sequence % 2 == 0))  # the later one is done first
            return Mask(frame.color[..., 0] > 0)

    class After(Stage):
        def process(self, frame: RgbdFrame, mask: Mask) -> Circles:
            calls.append(frame.header.sequence)
            return circles(1)

    report = lab.run(lab.chain(Meets, After), "source.count=10")
    assert (report.processed, report.error) == (10, None)
    assert calls == list(range(10))
    assert [trace.frame.header.sequence for trace in lab.seen] == calls


def test_frames_leave_in_order_where_the_last_stage_is_reentrant(lab: Lab) -> None:
    class Last(Stage):
        reentrant = True

        def process(self, frame: RgbdFrame) -> Circles:
            time.sleep(random.random() / 500)
            return circles(1)

    assert lab.run(lab.chain(Last), "source.count=30").processed == 30
    assert [trace.frame.header.sequence for trace in lab.seen] == list(range(30))


def test_a_later_frame_that_fails_first_does_not_count_before_its_turn(lab: Lab, tmp_path) -> None:
    later_failed = threading.Event()

    class First(Stage):
        def process(self, frame: RgbdFrame) -> Mask:
            if frame.header.sequence == 3:
                later_failed.set()
                raise RuntimeError("the later one")
            return Mask(frame.color[..., 0] > 0)

    class Second(Stage):
        def process(self, frame: RgbdFrame, mask: Mask) -> Circles:
            if frame.header.sequence == 2:
                soon(later_failed)
                raise RuntimeError("the earlier one")
            return circles(1)

    report = lab.run(lab.chain(First, Second), "source.count=9", capsules=tmp_path)
    assert str(report.error).endswith("failed on frame 2: RuntimeError: the earlier one")
    assert (report.processed, report.failed) == (2, 1)
    assert report.balanced()
    assert [path.name for path in tmp_path.iterdir()] == ["failure-frames-b-2.mcap"]


@pytest.mark.parametrize("at", range(4))
def test_a_stage_that_exits_fails_like_any_other_on_any_thread(lab: Lab, at: int) -> None:
    class Leaves(Stage):
        def process(self, frame: RgbdFrame) -> Circles:
            if frame.header.sequence == at:
                raise SystemExit(7)
            return circles(1)

    report = lab.run(lab.chain("threshold", Leaves), "source.count=50")
    assert (report.exit_code, report.processed, report.failed) == (1, at, 1)
    assert report.balanced()
    assert f"failed on frame {at}: SystemExit: 7" in str(report.error)


def test_what_a_run_sets_for_its_threads_is_put_back(lab: Lab) -> None:
    seen = []

    class Looks(Stage):
        def process(self, frame: RgbdFrame) -> Circles:
            seen.append((sys.getswitchinterval(), cv2.getNumThreads()))
            return circles(1)

    before = sys.getswitchinterval(), cv2.getNumThreads()
    lab.run(lab.chain(Looks))
    assert seen[0] == (pytest.approx(5e-4), 1)
    assert (sys.getswitchinterval(), cv2.getNumThreads()) == before


def test_the_collector_leaves_alone_what_was_made_before_the_first_frame(lab: Lab) -> None:
    seen: list[bool] = []
    old: list[object] = [[]]  # not a constant: the collector tracks it

    class Looks(Stage):
        def process(self, frame: RgbdFrame) -> Mask:
            seen.append(any(each is old for each in gc.get_objects()))
            return Mask(frame.color[..., 0] > 0)

    assert any(each is old for each in gc.get_objects())
    lab.run(lab.chain(Looks), "source.count=2")
    assert seen == [False, False]
    assert any(each is old for each in gc.get_objects())
