"""Sources and the edges of a run: opening and closing, failures, pace."""

import threading
from dataclasses import replace

import pytest

from mushpipe import Header, InputError, RgbdFrame, Sink, Stage
from mushpipe.core.edges import limited, paced
from tests.core.lab import Frames, Lab, make_frame, soon


def test_open_in_order_and_close_in_reverse(lab: Lab):
    report = lab.run(recorded(lab, calls := []))
    assert report.exit_code == 0
    assert calls[:4] == ["open source", "open stage", "open sink", "finish sink"]
    assert calls[4:] == ["close sink", "close stage", "close source"]


@pytest.mark.parametrize(
    ("where", "calls"),
    [
        ("source", ["open source", "close source"]),
        ("stage", ["open source", "open stage", "close stage", "close source"]),
        (
            "sink",
            ["open source", "open stage", "open sink", "close sink", "close stage", "close source"],
        ),
    ],
)
def test_what_failed_to_open_is_closed_too_and_nothing_runs(lab: Lab, where, calls):
    seen: list[str] = []
    report = lab.run(recorded(lab, seen, f"open {where}"))
    assert seen == calls
    assert str(report.error).endswith(
        f"failed in open(): OSError: open {where} (run -v says where)"
    )
    assert (report.exit_code, report.processed) == (1, 0)


def test_a_source_that_gives_no_frames_is_told_of(lab: Lab):
    class Nothing(Frames):
        def frames(self):
            list(super().frames())

    lab.registry.source("nothing", Nothing)
    report = lab.run(lab.chain("threshold", source="nothing"))
    assert "its frames() gave None, expected frames, as by yield" in str(report.error)
    assert report.balanced()


def test_seconds_end_before_the_frame_that_begins_the_next_one_to_the_nanosecond():
    source = Frames(max_seconds=1.0)
    for start_ns in range(1_700_000_000_123_456_000, 1_700_000_000_123_456_400):
        headers = [Header(start_ns + k * 10**8, k, "camera") for k in range(12)]
        frames = (make_frame(header=header) for header in headers)
        assert len(list(limited(frames, source))) == 10


@pytest.mark.parametrize("where", ["source", "stage", "sink"])
def test_a_close_that_fails_stops_no_other(lab: Lab, where):
    seen: list[str] = []
    report = lab.run(recorded(lab, seen, f"close {where}"))
    assert seen[-3:] == ["close sink", "close stage", "close source"]
    assert str(report.error).endswith(
        f"failed in close(): OSError: close {where} (run -v says where)"
    )
    assert (report.exit_code, report.processed) == (1, 3)


@pytest.mark.parametrize("error", [OSError, SystemExit])
def test_a_sink_that_fails_to_finish(lab: Lab, error):
    seen: list[str] = []
    report = lab.run(recorded(lab, seen, "finish sink", error=error))
    reason = f"{error.__name__}: finish sink (run -v says where)"
    assert str(report.error) == f"sink 'out' (rec-sink) failed in finish(): {reason}"
    assert seen[-3:] == ["close sink", "close stage", "close source"]


def test_leaving_in_close_does_not_hide_why_nothing_was_opened(lab: Lab):
    report = lab.run(recorded(lab, [], "open sink", "close stage", error=SystemExit))
    assert "failed in open(): SystemExit: open sink" in str(report.error)


def recorded(lab: Lab, calls: list[str], *fails: str, error: type[BaseException] = OSError) -> str:
    """A graph whose plugins note how they are called; the named calls fail."""

    def note(what: str) -> None:
        calls.append(what)
        if what in fails:
            raise error(what)

    class RecSource(Frames):
        def open(self) -> None:
            note("open source")

        def close(self) -> None:
            note("close source")

    class RecStage(Stage):
        def open(self) -> None:
            note("open stage")

        def process(self, frame: RgbdFrame) -> RgbdFrame:
            return frame

        def close(self) -> None:
            note("close stage")

    class RecSink(Sink):
        def open(self, run) -> None:
            assert run.recording == "recsource"
            note("open sink")

        def consume(self, frame: RgbdFrame) -> None: ...

        def finish(self, summary) -> None:
            note("finish sink")

        def close(self) -> None:
            note("close sink")

    lab.registry.source("rec-source", RecSource)
    lab.registry.sink("rec-sink", RecSink)
    return lab.chain(RecStage, source="rec-source").replace("collect", "rec-sink")


def test_a_missing_device_keeps_its_message_and_exit_code(lab: Lab):
    from mushpipe.core.errors import DeviceError

    class Camera(Frames):
        def open(self) -> None:
            raise DeviceError("no camera is plugged in")

    lab.registry.source("camera", Camera)
    report = lab.run(lab.chain("threshold", source="camera"))
    assert (str(report.error), report.exit_code) == ("no camera is plugged in", 5)


def source_that(lab: Lab, frames) -> str:
    class Own(Frames):
        def frames(self):
            return frames()

    lab.registry.source("own", Own)
    return lab.chain("threshold", source="own")


def good_then(error: BaseException | None):
    yield make_frame(0)
    yield make_frame(1)
    if error:
        raise error


def test_a_damaged_recording_ends_with_4_after_all_good_frames(lab: Lab):
    text = source_that(lab, lambda: good_then(InputError("bed.mcap is damaged: 2 frames")))
    report = lab.run(text)
    assert (report.processed, report.exit_code) == (2, 4)
    assert str(report.error) == "bed.mcap is damaged: 2 frames"
    assert len(lab.seen) == 2
    assert report.balanced()


@pytest.mark.parametrize("error", [OSError("unplugged"), SystemExit("bye")])
def test_a_source_that_fails_is_named(lab: Lab, error):
    report = lab.run(source_that(lab, lambda: good_then(error)))
    reason = f"{type(error).__name__}: {error}"
    assert str(report.error) == f"source 'source' (own) failed: {reason} (run -v says where)"
    assert (report.processed, report.exit_code) == (2, 1)


def test_a_source_that_cannot_say_whether_it_is_live_is_named(lab: Lab):
    class Unsure(Frames):
        @property
        def live(self) -> bool:
            raise OSError("unplugged")

    lab.registry.source("unsure", Unsure)
    report = lab.run(lab.chain("threshold", source="unsure"))
    assert "source 'source' (unsure) failed in live(): OSError: unplugged" in str(report.error)


def test_a_source_that_fails_before_its_first_frame_does_not_hang(lab: Lab):
    def frames():
        raise InputError("no camera")

    report = lab.run(source_that(lab, frames))
    assert (str(report.error), report.exit_code, report.read) == ("no camera", 4, 0)


def test_a_source_may_give_any_iterator(lab: Lab):
    report = lab.run(source_that(lab, lambda: iter([make_frame(0), make_frame(1)])))
    assert (report.processed, report.exit_code) == (2, 0)


def test_a_source_that_yields_something_else(lab: Lab):
    report = lab.run(source_that(lab, lambda: iter([7])))
    assert str(report.error).startswith("source 'source' (own) failed: ")
    assert report.exit_code == 1


def test_a_source_that_fails_to_close_does_not_hang(lab: Lab):
    def frames():
        try:
            yield from good_then(None)
        finally:
            raise OSError("stuck")

    report = lab.run(source_that(lab, frames), "source.max_frames=1")
    assert str(report.error) == "source 'source' (own) failed: OSError: stuck (run -v says where)"
    assert report.processed == 1


@pytest.mark.parametrize("method", ["name", "files"])
def test_a_source_that_cannot_describe_itself(lab: Lab, method):
    def fails(self):
        raise OSError("no idea")

    lab.registry.source("vague", type("Vague", (Frames,), {method: fails}))
    report = lab.run(lab.chain("threshold", source="vague"))
    text = f"source 'source' (vague) failed in {method}(): OSError: no idea (run -v says where)"
    assert str(report.error) == text


def test_what_a_source_lost_is_reported(lab: Lab):
    class Lossy(Frames):
        def counts(self):
            return {"images without depth": 2}

    lab.registry.source("lossy", Lossy)
    report = lab.run(lab.chain("threshold", source="lossy"))
    assert report.summary()["source"] == {"images without depth": 2}


def test_a_source_that_hangs_is_left_behind(lab: Lab, monkeypatch):
    monkeypatch.setattr("mushpipe.core.run.SOURCE_PATIENCE_S", 0.01)
    release, stop = threading.Event(), threading.Event()

    def frames():
        yield make_frame(0)
        soon(release)

    report = lab.run(source_that(lab, frames), stop=stop, progress=lambda _: stop.set())
    release.set()
    assert (report.processed, report.exit_code) == (1, 130)


class FakeStop:
    """Stands in for the stop event: notes the waits, and stops after some of them."""

    def __init__(self, after: int = 99) -> None:
        self.waits: list[float] = []
        self.after = after

    def wait(self, timeout: float) -> bool:
        self.waits.append(timeout)
        return len(self.waits) > self.after


@pytest.mark.parametrize(("speed", "waits"), [(1, [0.1, 0.2]), (2, [0.05, 0.1]), (0.5, [0.2, 0.4])])
def test_pace_follows_the_stamps(monkeypatch, speed, waits):
    monkeypatch.setattr("mushpipe.core.edges.time.monotonic", lambda: 100.0)
    stop = FakeStop()
    frames = list(paced((make_frame(i) for i in range(3)), speed, stop))
    assert len(frames) == 3
    assert stop.waits == pytest.approx(waits)


def test_pace_does_not_wait_for_the_past_or_at_speed_zero(monkeypatch):
    clock = iter([100.0, 105.0])
    monkeypatch.setattr("mushpipe.core.edges.time.monotonic", lambda: next(clock))
    stop = FakeStop()
    assert len(list(paced(iter([make_frame(0), make_frame(1)]), 1, stop))) == 2
    assert stop.waits == [0.0]
    monkeypatch.setattr("mushpipe.core.edges.time.monotonic", lambda: 0.0)
    stop = FakeStop()
    assert len(list(paced(iter([make_frame(0), make_frame(1)]), 0, stop))) == 2
    assert stop.waits == []


def test_a_leap_of_the_stamps_is_not_waited_for(monkeypatch, caplog):
    """From the clock since boot to that since 1970, and an hour back."""
    monkeypatch.setattr("mushpipe.core.edges.time.monotonic", lambda: 100.0)
    seconds = [5.0, 5.5, 1.7e9, 1.7e9 + 0.25, 1.7e9 - 3600, 1.7e9 - 3599]
    headers = [Header(round(at * 1e9), k, "camera") for k, at in enumerate(seconds)]
    stop = FakeStop()
    given = (replace(make_frame(0), header=header) for header in headers)
    assert [frame.header for frame in paced(given, 1, stop)] == headers
    assert stop.waits == pytest.approx([0.5, 0.25, 1.0])
    assert "leap by -3600 s at frame 4, which is not waited for" in caplog.text


def test_pace_stops_while_it_waits():
    stop = FakeStop(after=1)
    assert len(list(paced((make_frame(i) for i in range(9)), 1e9, stop))) == 2


def test_a_pace_may_be_slower_than_a_clock_can_count():
    stop = threading.Event()
    threading.Timer(0.05, stop.set).start()
    assert len(list(paced((make_frame(i) for i in range(3)), 1e-300, stop))) == 1


def test_a_replay_at_a_pace_gives_the_same_frames(lab: Lab):
    lab.run(lab.chain("threshold"), "source.speed=1000000000.0")
    assert [trace.frame.header.sequence for trace in lab.seen] == [0, 1, 2]
