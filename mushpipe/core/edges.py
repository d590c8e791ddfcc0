"""The threads at the edges of a run: one reads ahead from the source, one feeds each sink."""

from __future__ import annotations

import json
import logging
import math
import threading
import time
from collections.abc import Iterable, Iterator
from contextlib import contextmanager, nullcontext, suppress
from itertools import islice
from typing import Any

from mushpipe.core.doubts import judged
from mushpipe.core.errors import MushpipeError, StageError
from mushpipe.core.mailbox import Mailbox
from mushpipe.core.plan import Node
from mushpipe.core.plugins import prints_aside
from mushpipe.core.recorder import RecordingError
from mushpipe.core.report import Durations, SinkReport
from mushpipe.core.stage import ReplaySource, RunInfo, Sink, Source, Stage
from mushpipe.core.types import RgbdFrame

logger = logging.getLogger("mushpipe")
READ_AHEAD = 2
SINK_QUEUE = 4
LEAP_NS = 60 * 10**9

# as numpy says it: to what is written into an array, and to what changes one in place
_READ_ONLY = ("assignment destination is read-only", "output array is read-only")


def failure(node: Node, sequence: int | None, error: BaseException, method: str = "") -> StageError:
    """Say which plugin failed on which frame or where, keeping the exit code of a known error."""
    at = f" in {method}()" if method else "" if sequence is None else f" on frame {sequence}"
    known = isinstance(error, MushpipeError)
    text = str(error) if known else f"{type(error).__name__}: {error}"
    if isinstance(error, ValueError) and str(error) in _READ_ONLY:
        text += "; frames and tables belong to all stages: copy an array before changing it"
    code = error.exit_code if isinstance(error, MushpipeError) else 1
    if sequence is None and not known:  # else a capsule is kept, and -v told of beside it
        text += " (run -v says where)"
    if not known:
        logger.debug("where %s '%s' failed:", node.kind, node.name, exc_info=error)
    return StageError(f"{node.kind} '{node.name}' ({node.use}) failed{at}: {text}", code)


@contextmanager
def named(node: Node, method: str) -> Iterator[None]:
    """Say which plugin's method an error outside of a frame comes from."""
    try:
        yield
    except MushpipeError:
        raise
    except (Exception, SystemExit) as error:
        raise failure(node, None, error, method) from error


def plain(value: object) -> Any:
    """Return what a plugin says of itself as data of JSON; numbers of numpy become plain ones."""
    return json.loads(json.dumps(value, default=lambda v: getattr(v, "tolist", v.__str__)()))


def limited(frames: Iterator[RgbdFrame], source: Source) -> Iterator[RgbdFrame]:
    """Yield frames up to the source's ``max_frames`` and ``max_seconds``."""
    end_ns: float = math.inf
    for frame in islice(frames, source.max_frames):
        if source.max_seconds is not None and end_ns == math.inf:
            end_ns = frame.header.stamp_ns + round(source.max_seconds * 1e9)
        if frame.header.stamp_ns >= end_ns:
            return
        yield frame


def paced(frames: Iterator[RgbdFrame], speed: float, stop: threading.Event) -> Iterator[RgbdFrame]:
    """Yield frames at their recorded pace times ``speed``; 0 does not wait.

    Where stamps go back, or leap by more than `LEAP_NS`, they are another clock's, and the pace
    goes on from there.
    """
    first, last_ns = (0, 0.0), -math.inf
    for frame in frames:
        stamp_ns = frame.header.stamp_ns
        if not 0 <= stamp_ns - last_ns <= LEAP_NS:
            first = stamp_ns, time.monotonic()
            if speed and last_ns > -math.inf:
                text = "stamps leap by %.0f s at frame %d, which is not waited for"
                logger.warning(text, (stamp_ns - last_ns) / 1e9, frame.header.sequence)
        elif speed:
            due = first[1] + (stamp_ns - first[0]) / 1e9 / speed
            wait_s = min(max(0.0, due - time.monotonic()), threading.TIMEOUT_MAX)
            if stop.wait(wait_s):
                return
        last_ns = stamp_ns
        yield frame


def timed(frames: Iterator[RgbdFrame], durations: Durations) -> Iterator[RgbdFrame]:
    """Yield frames, noting how long the source takes for each."""
    begin = time.perf_counter_ns()
    for frame in frames:
        if not isinstance(frame, RgbdFrame):
            raise TypeError(f"it yielded {type(frame).__name__}, expected RgbdFrame")
        durations.add(time.perf_counter_ns() - begin)
        yield frame
        begin = time.perf_counter_ns()


@contextmanager
def interruptible_opening(source: Source, stop: threading.Event) -> Iterator[None]:
    """Interrupt a source that waits in its ``open``, when the run is to stop."""
    opened = threading.Event()

    def watch() -> None:
        while not opened.wait(0.1):
            if stop.is_set():
                source.interrupt()
                return

    watcher = threading.Thread(target=watch, name="mushpipe-opening", daemon=True)
    watcher.start()
    try:
        yield
    finally:
        opened.set()
        watcher.join()


@contextmanager
def opened(node: Node, info: RunInfo | None = None) -> Iterator[None]:
    """Open a node for a run, and close it on leaving, whether or not that worked."""
    plugin = node.plugin
    try:
        # a sink may open standard output itself
        aside = nullcontext() if node.kind == "sink" else prints_aside()
        with named(node, "open"), aside:
            if isinstance(plugin, Stage | Source):
                plugin.open()
            elif isinstance(plugin, Sink) and info is not None:
                plugin.open(info)
        yield
    except BaseException:
        with suppress(Exception, SystemExit):  # the first error is the one to report
            plugin.close()
        raise
    with named(node, "close"):
        plugin.close()


class SourceThread(threading.Thread):
    """Reads ahead; ``error`` holds what ended the source early."""

    def __init__(
        self, node: Node, source: Source, stop: threading.Event, durations: Durations
    ) -> None:
        super().__init__(name="mushpipe-source", daemon=True)
        self.node = node
        self.source = source
        self.stop = stop
        self.durations = durations
        self.error: MushpipeError | None = None
        # frames, each with the time at which it left the source, ns of time.perf_counter_ns
        self.box: Mailbox[tuple[RgbdFrame, int]] = (
            Mailbox(1, latest=True) if source.live else Mailbox(READ_AHEAD)
        )

    def run(self) -> None:
        """Hand over frames until the source ends, fails, or the run stops."""
        try:
            self._read()
        except MushpipeError as error:
            self.error = error
        except (Exception, SystemExit) as error:
            self.error = failure(self.node, None, error)
        finally:
            self.box.close()

    def _read(self) -> None:
        speed = self.source.speed if isinstance(self.source, ReplaySource) else 0.0
        frames = self.source.frames()
        if not isinstance(frames, Iterable):
            raise TypeError(f"its frames() gave {frames!r}, expected frames, as by yield")
        timed_frames = timed(frames, self.durations)
        try:
            steady = paced(timed_frames, speed, self.stop)
            seen = judged(steady, self.source.name(), self.source.live)
            for frame in limited(seen, self.source):
                if self.stop.is_set() or not self.box.put((frame, time.perf_counter_ns())):
                    break
        finally:
            if hasattr(frames, "close"):
                frames.close()


class SinkThread(threading.Thread):
    """Feeds one sink in order; with ``tolerant`` a failing frame is counted and the next tried.

    Not where a recording cannot be written: nothing that follows could be read.
    """

    def __init__(self, node: Node, latest: bool, tolerant: int, durations: Durations) -> None:
        super().__init__(name=f"mushpipe-{node.name}", daemon=True)
        self.node = node
        self.tolerant = tolerant
        self.durations = durations
        self.error: MushpipeError | None = None
        self.failed_frame: RgbdFrame | None = None
        self.consumed = self.failed = 0
        self.box: Mailbox[tuple[RgbdFrame, dict[str, Any]]] = Mailbox(
            1 if latest else SINK_QUEUE, latest
        )

    def run(self) -> None:
        """Consume until the box is closed and empty, or too many frames in a row failed."""
        in_a_row, last = 0, None
        consume = getattr(self.node.plugin, "consume")  # noqa: B009 - checked by ports_of
        while (item := self.box.get()) is not None:
            frame, inputs = item
            try:
                begin = time.perf_counter_ns()
                consume(**inputs)
                self.durations.add(time.perf_counter_ns() - begin)
                self.consumed += 1
                in_a_row = 0
            except (Exception, SystemExit) as error:
                self.failed += 1
                in_a_row += 1
                last = failure(self.node, frame.header.sequence, error)
                if in_a_row >= self.tolerant or isinstance(error, RecordingError):
                    self.error = last
                    if not isinstance(error, MushpipeError):  # not a full disk, for instance
                        self.failed_frame = frame
                    self.box.close()
                    return
                logger.warning("%s; the sink goes on with the next frame", last)
        if not self.consumed:
            self.error = last

    def report(self) -> SinkReport:
        """Return the sink's balance; frames left in its box by a failure count as dropped."""
        box = self.box
        return SinkReport(box.accepted, self.consumed, box.dropped + box.waiting, self.failed)
