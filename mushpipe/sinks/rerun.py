"""Sink `rerun`: every step of the pipeline in the Rerun viewer or an .rrd file."""

from __future__ import annotations

import logging
import os
import re
import shutil
import signal
import subprocess
from collections import deque
from io import FileIO
from ipaddress import ip_address
from pathlib import Path
from typing import Any, ClassVar, Literal

from pydantic import Field, PrivateAttr, field_validator, model_validator

from mushpipe import Header, RunInfo, Sink, Trace
from mushpipe.core.errors import DependencyError, UsageError
from mushpipe.core.overwriting import opened_alone
from mushpipe.core.paths import SinkFile
from mushpipe.core.recorder import RecordingError
from mushpipe.core.transform import Transform, base_of
from mushpipe.sinks.rerun_memory import Remembering
from mushpipe.sinks.rerun_pace import Pace
from mushpipe.sinks.rerun_server import (
    PATIENCE_S,
    PORT,
    answers,
    check_reachable,
    has_display,
    proxy_at,
    start,
)

logger = logging.getLogger("mushpipe")
LIVE_IMAGE_HZ = 5.0
SLOWEST_HZ = 1e-6  # once in eleven days
# On a full disk the SDK's writer dies, and whoever waits for it hangs (0.41), even at the end of
# the program. So the sink ends before that.
ROOM_BYTES = 64_000_000
_MEMORY = re.compile(r"\d+(\.\d+)? ?[kMGT]i?B|(100|\d?\d)%")  # as Rerun reads it


class RerunSink(Sink):
    """Shows what each stage made of a frame: saved to a file, in a viewer, or for viewers to fetch.

    Layers of the image, caps in space, plots and the log stand on two timelines, `frame` and
    `capture` (sensor time). A live run shows a few images per second and the results of all frames,
    and viewers forget the oldest data first, so that memory stays bounded.
    """

    delivery: ClassVar[Literal["every", "latest"]] = "latest"

    save: SinkFile | None = Field(
        None, description=".rrd file to write; {recording} is the name of the input"
    )
    spawn: bool = Field(False, description="open a viewer on this machine's display")
    connect: str | None = Field(
        None, description="viewer to send to: rerun+http://127.0.0.1:9876/proxy"
    )
    serve: int | None = Field(
        None, ge=1, le=65535, description="port on which viewers can fetch the run while it lasts"
    )
    host: str = Field(
        "127.0.0.1", description="address that `serve` listens on; 0.0.0.0 lets everybody in"
    )
    memory: str = Field("1GB", description="what the viewer or server of `spawn` and `serve` keeps")
    image_hz: float | None = Field(
        None,
        ge=SLOWEST_HZ,
        description="most images per second; not set: 5 of a live run, all of a replay",
    )
    result_hz: float | None = Field(
        None,
        ge=SLOWEST_HZ,
        description="most results per second; not set: all. As many as images, and each frame "
        "that is shown is shown whole",
    )
    jpeg_quality: int = Field(85, ge=1, le=100, description="quality of the stored colour images")
    index: bool = Field(
        True,
        description="end the file with an index, for Rerun's tools; until then it takes memory, "
        "some 35 KB a frame, which is too much for hours",
    )
    cloud_step: int = Field(3, ge=1, description="pixels between the points of the cloud")

    _recording: Any = PrivateAttr(None)
    _path: Path | None = PrivateAttr(None)
    _held: FileIO | None = PrivateAttr(None)
    _server: subprocess.Popen[bytes] | None = PrivateAttr(None)
    _notes: _Notes | None = PrivateAttr(None)
    _paces: tuple[Pace, Pace] = PrivateAttr((Pace(None), Pace(None)))  # of images, of results
    _shown: tuple[list[str], float | None, list[str]] | None = PrivateAttr(None)
    _memories: tuple[Remembering, Remembering] | None = PrivateAttr(None)  # images, results
    _last: Header | None = PrivateAttr(None)
    _base: Transform | None = PrivateAttr(None)

    @field_validator("host")
    @classmethod
    def _address(cls, value: str) -> str:
        try:
            ip_address(value)
        except ValueError:
            raise ValueError("expected an IP address of this machine: 127.0.0.1, say") from None
        return value

    @field_validator("memory")
    @classmethod
    def _amount(cls, value: str) -> str:
        if not _MEMORY.fullmatch(value):
            raise ValueError("expected an amount (300MB, 2GB), or a share of all there is (50%)")
        return value

    @model_validator(mode="after")
    def _has_a_target(self) -> RerunSink:
        if not (self.save or self.spawn or self.connect or self.serve):
            raise ValueError("nothing to do: set 'save', 'spawn', 'connect' or 'serve'")
        return self

    def files(self, run: RunInfo) -> tuple[Path, ...]:
        """Return the file it writes."""
        return (run.path(self.save),) if self.save else ()

    def open(self, run: RunInfo) -> None:
        """Open the file and the ways to viewers.

        Raises:
            UsageError: Nobody listens at `connect`, or the file cannot be written.
            RecordingError: The disk is full but for a last reserve.
            DependencyError: There is no display for `spawn`, or the server does not start.
        """
        if not self.index:  # the SDK warns of it, and reads this as it is imported
            os.environ.setdefault("RUST_LOG", "warn,re_log_encoding::rrd::file_sink=error")
        import rerun as rr

        from mushpipe.sinks.rerun_style import log_start, workspace_of

        sinks: list[Any] = []
        if self.save:
            self._path = run.path(self.save)
            self._require_room("nothing is written")
            sinks.append(rr.FileSink(str(self._path), write_footer=self.index))
        sinks += [rr.GrpcSink(url) for url in self._viewers()]
        # An id of its own for every run: those that share one are a single recording to a viewer.
        self._recording = rr.RecordingStream("mushpipe")
        try:
            self._held = opened_alone(self._path) if self._path else None  # set_sinks empties it
            self._recording.set_sinks(*sinks)
        except (OSError, RuntimeError) as error:
            reason = getattr(error, "strerror", None) or error  # without errno and PosixPath(...)
            raise UsageError(f"save: {self.save} cannot be written: {reason}") from error
        self._memories = (Remembering(self._recording), Remembering(self._recording))
        graph, file = run.manifest.get("graph", {}), Path(run.manifest.get("graph_file", ""))
        self._recording.send_recording_name(f"{run.recording} {file.stem}".strip())
        self._base = base_of(graph)
        log_start(self._recording, workspace_of(graph), self._base)
        image_hz = self.image_hz or (LIVE_IMAGE_HZ if run.live else None)
        self._paces = Pace(image_hz), Pace(self.result_hz)
        self._notes = _Notes()
        logger.addHandler(self._notes)

    def _viewers(self) -> list[str]:
        """Return the addresses to send to, after starting what is to be started there."""
        urls = []
        if self.connect is not None:
            check_reachable(self.connect)
            urls.append(self.connect)
        if self.spawn:
            if not has_display():
                raise DependencyError(
                    "there is no display to open a viewer on: set 'save' to a file, or 'serve' to "
                    "a port and look from another machine"
                )
            if not answers("127.0.0.1", PORT):  # a viewer that is open already will do
                start("127.0.0.1", PORT, "--memory-limit", self.memory)
            urls.append(proxy_at("127.0.0.1", PORT))
        if self.serve is not None:
            limit = ("--server-memory-limit", self.memory)
            self._server = start(self.host, self.serve, "--serve-grpc", *limit)
            urls.append(proxy_at(self.host, self.serve))
            logger.info("look at it with: rerun %s", urls[-1])
        return urls

    def _require_room(self, kept: str) -> None:
        folder = self._path and self._path.parent
        if folder and folder.is_dir() and shutil.disk_usage(folder).free < ROOM_BYTES:
            raise RecordingError(
                f"{self._path}: there are less than {ROOM_BYTES // 10**6} MB left on its disk; "
                f"{kept}; make room, or save elsewhere"
            )

    def consume(self, trace: Trace) -> None:
        """Log one frame.

        Raises:
            RecordingError: The disk is full but for a last reserve.
        """
        import rerun as rr

        from mushpipe.sinks import rerun_log

        if self._recording is None or self._memories is None:
            raise RuntimeError("the sink is not open")
        self._require_room("the file ends here and can be opened")
        rec, header, (images, results) = self._recording, trace.frame.header, self._memories
        rerun_log.set_frame(rec, header)
        self._last = header
        image, result = (pace.due(header.stamp_ns) for pace in self._paces)
        stages = self._lay_out(trace) if image or result else []
        if image:
            rerun_log.log_images(images, trace, self.jpeg_quality, self.cloud_step)
            images.settle()
        if result:
            rerun_log.log_results(results, trace, self._base, stages)
            results.settle()
        self._write_notes(rr)

    def _lay_out(self, trace: Trace) -> list[str]:
        """Return the stages in the plot; send the layout when a frame shows more to lay out."""
        from mushpipe.sinks.rerun_layout import layout
        from mushpipe.sinks.rerun_log import distance_of, layers_of
        from mushpipe.sinks.rerun_style import log_layers

        layers, distance, stages = self._shown or ([], None, [])
        if not (layers and distance and stages):
            layers = layers or layers_of(trace)
            distance = distance or distance_of(trace.frame)
            stages = stages or [*trace.durations_ns]
        if self._shown != (layers, distance, stages):
            self._shown = layers, distance, stages
            log_layers(self._recording, layers, stages)
            camera = trace.frame.camera
            spread = camera.width / (2 * camera.fx) if camera else 0.0
            self._recording.send_blueprint(layout(layers, stages, distance, spread))
        return stages

    def _write_notes(self, rr: Any) -> None:
        while self._notes is not None and self._notes.waiting:
            record = self._notes.waiting.popleft()
            level = "WARN" if record.levelname == "WARNING" else record.levelname
            self._recording.log("log", rr.TextLog(record.getMessage(), level=level))

    def close(self) -> None:
        """Finish the file; a viewer that is gone by then is no failure of the run."""
        if self._notes is not None:
            logger.removeHandler(self._notes)
        if self._recording is not None:
            import rerun as rr

            from mushpipe.sinks.rerun_log import set_frame

            if self._last is not None:
                set_frame(self._recording, self._last)  # timelines belong to a thread
            self._write_notes(rr)
            try:
                self._recording.flush(timeout_sec=PATIENCE_S)
            except RuntimeError as error:
                logger.warning("the viewer did not take everything: %s", error)
            self._recording.disconnect()
            self._recording = None
        if self._held is not None:
            self._held.close()
        if self._server is not None:
            os.killpg(self._server.pid, signal.SIGTERM)  # the command starts a child
            self._server.wait()
            self._server = None


class _Notes(logging.Handler):
    """Keeps what is logged until it can be written at a frame."""

    def __init__(self) -> None:
        super().__init__(logging.INFO)
        self.waiting: deque[logging.LogRecord] = deque(maxlen=1000)

    def emit(self, record: logging.LogRecord) -> None:
        self.waiting.append(record)
