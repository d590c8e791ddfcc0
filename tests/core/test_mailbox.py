"""The hand-over between threads: order, blocking, loss, and a balance that always closes."""

import threading

import pytest
from hypothesis import given
from hypothesis import strategies as st

from mushpipe.core.mailbox import Mailbox
from tests.core.lab import PATIENCE_S


def in_thread(function, *arguments) -> threading.Thread:
    thread = threading.Thread(target=function, args=arguments, daemon=True)
    thread.start()
    return thread


def ended(thread: threading.Thread) -> bool:
    thread.join(PATIENCE_S)
    return not thread.is_alive()


def test_items_come_out_in_the_order_they_went_in():
    box = Mailbox(3)
    assert all(box.put(i) for i in range(3))
    assert [box.get() for _ in range(3)] == [0, 1, 2]


def test_the_latest_replaces_what_waits():
    box = Mailbox(1, latest=True)
    assert all(box.put(i) for i in range(5))
    assert (box.get(), box.dropped, box.waiting) == (4, 4, 0)


def test_an_empty_box_gives_none_when_the_time_is_up():
    assert Mailbox(1).get(timeout=0) is None


def test_a_closed_box_gives_what_waits_and_then_none():
    box = Mailbox(2)
    box.put(1)
    box.close()
    assert not box.put(2)
    assert not box.finished
    assert (box.get(), box.get()) == (1, None)
    assert box.finished
    assert box.accepted == 1


def test_a_full_box_blocks_until_there_is_room():
    box, order = Mailbox(1), []
    box.put(0)
    writer = in_thread(lambda: order.append(box.put(1)))
    assert (box.get(), box.get()) == (0, 1)
    assert ended(writer)
    assert order == [True]
    assert box.dropped == 0


def test_closing_frees_a_blocked_put():
    box, result = Mailbox(1), []
    box.put(0)
    writer = in_thread(lambda: result.append(box.put(1)))
    box.close()
    assert ended(writer)
    assert result == [False]
    assert (box.accepted, box.waiting) == (1, 1)


def test_closing_frees_a_blocked_get():
    box, result = Mailbox(1), []
    reader = in_thread(lambda: result.append(box.get()))
    box.close()
    assert ended(reader)
    assert result == [None]


steps = st.lists(st.sampled_from(["put", "get", "close"]), max_size=60)


@given(steps, st.integers(1, 4), st.booleans())
def test_the_box_behaves_like_a_list(steps, capacity, latest):
    box, model, closed, dropped = Mailbox(capacity, latest), [], False, 0
    for number, step in enumerate(steps):
        if step == "put" and (latest or closed or len(model) < capacity):
            assert box.put(number) is not closed
            if not closed:
                model.append(number)
                dropped += len(model) > capacity
                model = model[-capacity:]
        elif step == "get":
            assert box.get(timeout=0) == (model.pop(0) if model else None)
        elif step == "close":
            box.close()
            closed = True
        assert (box.waiting, box.dropped) == (len(model), dropped)
        assert box.accepted == box.taken + box.dropped + box.waiting
        assert box.finished == (closed and not model)


@pytest.mark.parametrize("latest", [False, True])
def test_the_balance_closes_with_many_threads(latest):
    box, taken, start = Mailbox(2, latest), [], threading.Barrier(5)

    def write(base: int) -> None:
        start.wait(PATIENCE_S)
        for i in range(200):
            box.put(base + i)

    def read() -> None:
        start.wait(PATIENCE_S)
        while (item := box.get()) is not None:
            taken.append(item)

    writers = [in_thread(write, base) for base in (0, 1000, 2000)]
    readers = [in_thread(read) for _ in range(2)]
    assert all(map(ended, writers))
    box.close()
    assert all(map(ended, readers))
    assert box.accepted == 600 == len(taken) + box.dropped
    assert len(set(taken)) == len(taken)
    assert latest or box.dropped == 0
