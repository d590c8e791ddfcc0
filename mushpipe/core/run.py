"""Running a plan: frame by frame, in order, with a balance that must close."""

from __future__ import annotations

import logging
import threading
import time
from collections.abc import Callable
from contextlib import ExitStack
from pathlib import Path
from typing import Any

from mushpipe.core.capsule import write_capsule
from mushpipe.core.chain import Chain, Passage, Turnstile, cores_shared, sink_inputs
from mushpipe.core.edges import (
    SinkThread,
    SourceThread,
    failure,
    interruptible_opening,
    named,
    opened,
    plain,
)
from mushpipe.core.errors import InputError, MushpipeError, StageError
from mushpipe.core.files import files_of, files_read, recording_of
from mushpipe.core.manifest import build_manifest
from mushpipe.core.overwriting import spare_files
from mushpipe.core.plan import Node, Plan
from mushpipe.core.report import Durations, RunReport
from mushpipe.core.stage import RunInfo, Sink, Source
from mushpipe.core.types import RgbdFrame

logger = logging.getLogger("mushpipe")
Progress = Callable[[RunReport], None]
SOURCE_PATIENCE_S = 5.0
# A third one made picks older and no more of them, on two cores.
FRAMES_AT_ONCE = 2


def run(
    plan: Plan,
    stop: threading.Event | None = None,
    progress: Progress | None = None,
    capsules: Path | None = None,
) -> RunReport:
    """Run a plan to the end of its source.

    Args:
        plan: What to run; it is not changed, every run works on fresh copies.
        stop: Set it to end after the frame in work; the report then says ``interrupted``.
        progress: Called after every frame.
        capsules: Folder for failure capsules; None writes none.

    Returns:
        The report; a failure is in its ``error``, never raised.
    """
    runner = _Runner(plan.fresh(), stop or threading.Event(), progress, capsules)
    try:
        runner.run()
    except MushpipeError as error:
        if runner.report.error is not None:  # the first is the one to report
            logger.warning("%s", error)
        runner.report.error = runner.report.error or error
    runner.report.elapsed_s = time.monotonic() - runner.started
    return runner.report


class _Runner:
    def __init__(
        self, plan: Plan, stop: threading.Event, progress: Progress | None, capsules: Path | None
    ) -> None:
        self.plan = plan
        self.stop = stop
        self.progress = progress
        self.capsules = capsules
        self.report = RunReport(durations={node.name: Durations() for node in plan.nodes})
        self.chain = Chain(plan)
        self.reader: SourceThread
        self.feeders: list[SinkThread] = []
        self.entrance, self.exit = threading.Lock(), Turnstile()
        self.taken = 0  # frames, and so the next ticket
        self.over = False  # what is still on its way then is late
        self.late = 0
        self.failure: BaseException | None = None
        self.failures_in_a_row = 0
        self.last_failed: StageError | None = None
        self.tolerance = 1
        self.started = time.monotonic()
        self.saved: set[str] = set()  # nodes with a failure capsule

    def run(self) -> None:
        source = self.plan.source.plugin
        if not isinstance(source, Source):
            raise TypeError("the plan's source is not a Source")
        with named(self.plan.source, "files"):
            self.report.manifest = build_manifest(self.plan)
        with ExitStack() as stack:
            with interruptible_opening(source, self.stop):
                stack.enter_context(opened(self.plan.source))
            durations = self.report.durations[self.plan.source.name]
            with named(self.plan.source, "live"):
                self.reader = SourceThread(self.plan.source, source, threading.Event(), durations)
            info = self._begin(source)
            written = {node.name: files_of(node, info) for node in self.plan.sinks}
            spare_files(files_read(self.plan), written)
            # Who writes a file empties it: not before all that may fail without has opened.
            sinks = sorted(self.plan.sinks, key=lambda node: bool(written[node.name]))
            for node in (*self.plan.stages, *sinks):
                stack.enter_context(opened(node, info))
            self.report.files = tuple(path for paths in written.values() for path in paths)
            self.report.opened = True
            self.started = time.monotonic()  # what opening took is no part of the frames' pace
            self.feeders = [self._sink_thread(node) for node in self.plan.sinks]
            stack.enter_context(cores_shared())
            try:
                self._loop()
            except StageError as error:
                self.report.error = error
            finally:
                self._wind_up(source)
            self._finish()

    def _begin(self, source: Source) -> RunInfo:
        """Return what the sinks are told, now that the source is open."""
        on_error = self.plan.on_error or ("fail" if self.plan.replay() else "skip")
        self.tolerance = self.plan.max_failures if on_error == "skip" else 1
        with named(self.plan.source, "describe"):
            device = self.report.device = plain(source.describe())
            manifest = {**self.report.manifest, **({"device": device} if device else {})}
            name, read = recording_of(self.plan.source), lambda: self.reader.box.accepted
            return RunInfo(name, manifest, source.live, read)

    def _finish(self) -> None:
        """Tell the sinks how the run went; the first error of the run stays the one reported."""
        for feeder in self.feeders:
            plugin = feeder.node.plugin
            if not isinstance(plugin, Sink) or feeder.error is not None:
                continue
            try:
                plugin.finish(self.report.summary())
            except (Exception, SystemExit) as error:
                failed = failure(feeder.node, None, error, "finish")
                self.report.error = self.report.error or failed
                logger.warning("%s", failed)

    def _sink_thread(self, node: Node) -> SinkThread:
        durations = self.report.durations[node.name]
        return SinkThread(node, self.plan.delivery(node) == "latest", self.tolerance, durations)

    def _loop(self) -> None:
        """Take frames through the stages on several threads, until they end or one fails."""
        for edge in (self.reader, *self.feeders):
            edge.start()
        others = [
            threading.Thread(target=self._work, name="mushpipe-stages", daemon=True)
            for _ in range(FRAMES_AT_ONCE - 1)
        ]
        for other in others:
            other.start()
        self._work()
        for other in others:
            other.join()
        self.report.interrupted = self.stop.is_set()
        if self.failure is not None:
            raise self.failure

    def _work(self) -> None:
        try:
            while (taken := self._take()) is not None:
                frame, left_ns, ticket = taken
                passage = self.chain.passed(frame, ticket)
                with self.exit.turn(ticket):
                    try:
                        self._deliver(passage, left_ns)
                    except BaseException:  # before the turn ends: the next frame must not follow
                        self.over = True
                        raise
        except BaseException as error:  # an interrupt, say: nobody may wait for this thread
            self.failure = self.failure or error
            self.over = True
            self.chain.close()
            self.exit.open()

    def _at_end(self) -> bool:
        return self.over or self.stop.is_set() or any(feeder.error for feeder in self.feeders)

    def _take(self) -> tuple[RgbdFrame, int, int] | None:
        """Return the next frame, when it left the source, and its ticket; None at the end."""
        with self.entrance:
            # Only now: a frame that waits at the first stage would grow old there.
            self.chain.await_first(self.taken)
            while not (self.reader.box.finished or self._at_end()):
                if (item := self.reader.box.get(timeout=0.1)) is not None:
                    self.taken += 1
                    return *item, self.taken - 1
        return None

    def _deliver(self, passage: Passage, left_ns: int) -> None:
        """Count a frame and hand it to the sinks; one that comes after the end only waited."""
        if self.over:
            self.late += 1
            return
        for name, duration in passage.durations_ns.items():
            self.report.durations[name].add(duration)
        self.report.widen_span(passage.frame.header)
        if passage.failed is not None:
            self._count_failure(passage.frame, *passage.failed)
        else:
            self.failures_in_a_row = 0
            self.report.processed += 1
            self.report.found.add(passage.outputs)
            if passage.durations_ns:  # a recorder has no stages whose time could be told
                self.report.frame.add(sum(passage.durations_ns.values()))
            self.report.latency.add(time.perf_counter_ns() - left_ns)
            trace = passage.trace(left_ns)
            for feeder in self.feeders:
                feeder.box.put((passage.frame, sink_inputs(feeder.node, trace)))
        self._count_read()
        if self.progress:
            self.progress(self.report)
        self.over = self._at_end()

    def _count_read(self) -> None:
        self.report.read, self.report.dropped = self.reader.box.accepted, self.reader.box.dropped

    def _count_failure(self, frame: RgbdFrame, node: Node, error: BaseException) -> None:
        """Count a frame on which a stage failed; raise StageError where that ends the run."""
        failed = failure(node, frame.header.sequence, error)
        if not isinstance(error, MushpipeError):
            self._save_capsule(node, frame, failed)
        self.report.failed += 1
        self.last_failed = failed
        self.failures_in_a_row += 1
        if self.failures_in_a_row >= self.tolerance:
            many = f" ({self.failures_in_a_row} frames in a row)" if self.tolerance > 1 else ""
            raise StageError(f"{failed}{many}", failed.exit_code) from error
        logger.warning("%s; the frame is skipped", failed)

    def _wind_up(self, source: Source) -> None:
        """Stop the threads, let the sinks finish what they were handed, and settle the counts."""
        self.reader.stop.set()
        self.reader.box.close()
        self._ask(source, "interrupt")
        for feeder in self.feeders:
            feeder.box.close()
        for edge in (self.reader, *self.feeders):
            if edge.is_alive():
                # A sink finishes what it was handed; a source may hang in a device.
                edge.join(SOURCE_PATIENCE_S if edge is self.reader else None)
        self._count_read()
        self.report.waiting = self.reader.box.waiting + self.late
        self.report.elapsed_s = time.monotonic() - self.started
        self.report.source = self._ask(source, "counts") or {}
        for feeder in self.feeders:
            self.report.sinks[feeder.node.name] = feeder.report()
            if feeder.error is not None:
                self.report.error = self.report.error or feeder.error
                if feeder.failed_frame is not None:
                    self._save_capsule(feeder.node, feeder.failed_frame, feeder.error)
        self.report.error = self.report.error or self.reader.error
        nothing = not (self.report.error or self.report.processed)
        if nothing and (last := self.last_failed):
            text = f"none of {self.report.failed} frames could be processed; the last: {last}"
            self.report.error = StageError(text, last.exit_code)
        elif nothing and not (self.report.read or self.report.interrupted):
            text = f"source '{self.plan.source.use}' gave no frame: there is nothing to run on"
            self.report.error = InputError(text)

    def _ask(self, source: Source, method: str) -> Any:
        """Call a method of the source; where that fails, the sinks still get to their end."""
        try:
            with named(self.plan.source, method):
                return plain(getattr(source, method)())
        except MushpipeError as error:
            self.report.error = self.report.error or error

    def _save_capsule(self, node: Node, frame: RgbdFrame, error: Exception) -> None:
        if self.capsules is None or node.name in self.saved:
            return
        self.saved.add(node.name)
        try:
            path = write_capsule(self.capsules, self.plan, node, frame, str(error))
        except Exception as trouble:  # the failure of the stage is the one to report
            logger.warning("the failing frame could not be saved: %s", trouble)
        else:
            self.report.capsules.append(str(path))
