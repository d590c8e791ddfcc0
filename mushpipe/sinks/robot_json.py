"""Sink `robot-json`: offers picks to robots over TCP; the protocol is docs/robot.md."""

from __future__ import annotations

import logging
import re
import ssl
import time
from collections.abc import Mapping
from importlib.metadata import version
from ipaddress import ip_address
from math import inf
from pathlib import Path
from typing import Any, ClassVar, Literal, Self

from pydantic import Field, PrivateAttr, field_validator, model_validator

from mushpipe import GraphPath, Header, Picks, RunInfo, Sink, Trace
from mushpipe.core.errors import EXIT_INTERRUPTED, EXIT_NO_DEVICE, EXIT_OK, UsageError
from mushpipe.core.paths import SinkFile
from mushpipe.robot.abb import AbbSession
from mushpipe.robot.clock import Clock, Lateness, Placer
from mushpipe.robot.connection import Kind, Limits
from mushpipe.robot.hub import Ending, Hub, Settings
from mushpipe.robot.server import Listener, Opener, Options, RobotServer
from mushpipe.robot.session import JsonSession
from mushpipe.robot.targets import Filter, Workspace
from mushpipe.robot.transcript import Transcript
from mushpipe.sources.realsense_frames import Clock as SensorClock
from mushpipe.sources.realsense_frames import Domain, clock_of

logger = logging.getLogger("mushpipe")
# Stamps further from the host's clock than this are late, or in a clock of their own.
SAME_CLOCK_NS = 2 * 10**9
LATE = 10  # results in a row that are too old when they come: the chain is slow, not the moment


class RobotJsonSink(Sink):
    """Offers picks to robots as JSON lines over TCP, or as short lines for ABB controllers.

    It is a server on the loopback address unless told otherwise. Nothing older than `max_age_ms`
    is ever sent, and nothing whose depth is a guess. A recording is served only with `replay`, and
    then every message says so.
    """

    delivery: ClassVar[Literal["every", "latest"]] = "latest"

    port: int = Field(5005, ge=0, le=65535, description="TCP port; 0 takes a free one")
    bind: str = Field(
        "127.0.0.1", description="address to listen on; any but loopback needs a token or TLS"
    )
    format: Literal["json", "abb"] = Field("json", description="what is spoken on `port`")
    abb_port: int | None = Field(
        None, ge=0, le=65535, description="speak the lines for ABB on this port as well"
    )
    max_age_ms: float = Field(500, gt=0, le=10_000, description="nothing older is ever sent")
    sensor_latency_ms: float = Field(
        0, ge=0, le=1000, description="time from exposure to the stamp, added to every age"
    )
    stall_ms: float = Field(
        1000, ge=100, le=1500, description="without a result for so long, robots are told"
    )
    allow_estimated: bool = Field(False, description="send targets whose depth is a guess")
    workspace: Workspace | None = Field(
        None, description="box in the picks' frame; nothing outside is sent"
    )
    max_targets: int = Field(200, ge=1, le=1000, description="the first so many are sent")
    claim_s: float = Field(
        60, gt=0, le=3600, description="an accepted target comes back after so long without a word"
    )
    replay: bool = Field(False, description="serve recordings; every message says that it is one")
    max_clients: int = Field(8, ge=1, le=64, description="more are turned away")
    lines_per_s: float = Field(200, ge=10, le=100_000, description="a client that says more waits")
    token_file: GraphPath | None = Field(
        None, description="file with the clients' secret: 16 to 40 of A-Z a-z 0-9 _ . ~ -"
    )
    tls_cert: GraphPath | None = Field(None, description="certificate chain, PEM; turns TLS on")
    tls_key: GraphPath | None = Field(None, description="private key, PEM; in tls_cert if not set")
    tls_client_ca: GraphPath | None = Field(
        None, description="clients must show a certificate signed by this one, PEM"
    )
    transcript: SinkFile | None = Field(
        None, description="MCAP file for every line out and in; {recording} is the input's name"
    )

    _clock: Clock = PrivateAttr(default_factory=Clock)
    _placer: Placer | None = PrivateAttr(None)
    _lateness: Lateness = PrivateAttr(default_factory=Lateness)
    _filter: Filter | None = PrivateAttr(None)
    _server: RobotServer | None = PrivateAttr(None)
    _transcript: Transcript | None = PrivateAttr(None)
    _ending: Ending = PrivateAttr("failed")
    _live: bool = PrivateAttr(False)
    _late: int = PrivateAttr(0)
    _warned: set[str] = PrivateAttr(default_factory=set)

    @field_validator("bind")
    @classmethod
    def _address(cls, value: str) -> str:
        try:
            ip_address(value)
        except ValueError:
            raise ValueError(
                f"'{value}' is not an IP address; this computer is 127.0.0.1, all of its "
                "networks are 0.0.0.0"
            ) from None
        return value

    @model_validator(mode="after")
    def _consistent(self) -> Self:
        if self.abb_port == self.port != 0:
            raise ValueError(f"port and abb_port are both {self.port}: each needs its own")
        if self.tls_cert is None and (self.tls_key or self.tls_client_ca):
            raise ValueError("TLS needs 'tls_cert'")
        return self

    def files(self, run: RunInfo) -> tuple[Path, ...]:
        """Return the transcript."""
        return (run.path(self.transcript),) if self.transcript else ()

    def open(self, run: RunInfo) -> None:
        """Begin to listen.

        Raises:
            UsageError: The source is a recording and `replay` is not set, the address is open to
                the network without token or TLS, or cannot be listened on.
        """
        if not run.live and not self.replay:
            raise UsageError(
                "the source plays a recording, which a robot would take for the bed before it; "
                "set 'replay: true' to serve it, marked as a recording"
            )
        token = self._token()
        tls = self._tls()
        if not _is_loopback(self.bind) and not (token or tls):
            raise UsageError(
                f"'bind: {self.bind}' is open to the network: set 'token_file', or 'tls_cert'"
            )
        self._live = run.live
        self._placer = Placer(self._clock)
        self._filter = Filter(self.allow_estimated, self.workspace)
        hub = Hub(self._settings(run.live, token), self._clock, run.frames_read)
        options = Options(
            self._listeners(), Limits(lines_per_s=self.lines_per_s), self.max_clients, tls
        )
        # Listening comes first: what cannot begin must not empty the transcript of another run.
        self._server = RobotServer(hub, options, self._observe)
        if self.transcript:
            self._transcript = Transcript(run.path(self.transcript), self._clock, token)
        self._server.start()
        ports = " and ".join(map(str, self._server.ports))
        kind = "live" if run.live else "a recording, marked as such"
        logger.info("robots are served at %s, port %s: %s", self.bind, ports, kind)
        if _count(run.manifest) > 1:
            logger.warning(
                "what robots at port %s accept is offered at the graph's other sink robot-json all "
                "the same: serve robots that share a bed by one sink, with abb_port if need be",
                ports,
            )

    def _observe(self, kind: Kind, client: int, text: bytes) -> None:
        if self._transcript is not None:
            self._transcript.observe(kind, client, text)

    def _settings(self, live: bool, token: str) -> Settings:
        return Settings(
            max_age_s=self.max_age_ms / 1000,
            stall_s=self.stall_ms / 1000,
            claim_s=self.claim_s,
            max_targets=self.max_targets,
            replay=not live,
            token=token,
            software=f"mushpipe {version('mushpipe')}",
        )

    def _listeners(self) -> tuple[Listener, ...]:
        first: Opener = AbbSession if self.format == "abb" else JsonSession
        lines = () if self.abb_port is None else (Listener(self.bind, self.abb_port, AbbSession),)
        return (Listener(self.bind, self.port, first), *lines)

    def _token(self) -> str:
        if self.token_file is None:
            return ""
        try:
            token = self.token_file.read_text().strip()
        except (OSError, UnicodeDecodeError) as error:
            raise UsageError(f"{self.token_file}: cannot be read: {error}") from error
        if not re.fullmatch(r"[A-Za-z0-9_.~-]{16,40}", token):
            raise UsageError(
                f"{self.token_file}: a token has 16 to 40 characters of A-Z a-z 0-9 _ . ~ -"
            )
        return token

    def _tls(self) -> ssl.SSLContext | None:
        if self.tls_cert is None:
            return None
        try:
            context = ssl.create_default_context(ssl.Purpose.CLIENT_AUTH)
            context.load_cert_chain(self.tls_cert, self.tls_key)
            if self.tls_client_ca:
                context.load_verify_locations(self.tls_client_ca)
                context.verify_mode = ssl.CERT_REQUIRED
        except OSError as error:
            raise UsageError(f"TLS cannot be set up with {self.tls_cert}: {error}") from error
        return context

    def consume(self, picks: Picks, trace: Trace) -> None:
        """Offer one frame's picks in place of the last one's; never waits for a robot."""
        if self._server is None or self._filter is None:
            raise RuntimeError("the sink is not open")
        header = trace.frame.header
        choice, taken = self._filter(picks), self._taken(trace)
        self._server.hub.publish(choice, header.sequence, header.stamp_ns, taken)
        self._server.wake()
        self._watch(1000 * (self._clock.monotonic() - taken), 1000 * _spent_s(trace))

    def _watch(self, age_ms: float, spent_ms: float) -> None:
        """Say it, once, where results are regularly too old to be sent."""
        self._late = self._late + 1 if self.max_age_ms < age_ms < inf else 0
        if self._late == LATE:
            self._warn(
                "results are %.0f ms old when they come, %.0f ms of it since they left the source, "
                "and 'max_age_ms' is %g: robots get nothing; the stages are too slow, or frames "
                "come late (a slow link), or a clock was set or runs behind",
                *(age_ms, spent_ms, self.max_age_ms),
            )

    def _taken(self, trace: Trace) -> float:
        """Return the monotonic time a frame was taken at, s; minus infinity where unknown.

        Of a recording only the time since it was played can be told, and that is its age.
        """
        header, played = trace.frame.header, self._clock.monotonic() - _spent_s(trace)
        if not self._live or self._placer is None:
            return played
        sensor = clock_of(trace.frame)
        own_ms = header.stamp_ns / 1e6 if sensor is None else float(sensor.time_ms[0])
        late = self._lateness.of(own_ms, header.stamp_ns, played)
        shared = _is_of_host(header, sensor)
        stamp_ns = min(header.stamp_ns, header.arrival_ns) if shared else header.arrival_ns
        placed = self._placer.place(stamp_ns)
        if placed is None:
            self._warn("the camera's time stamps are not of this host: robots get nothing")
            return -inf
        if not shared or late < inf:
            played -= late  # also where a stamp can be placed: the clock it is of may run ahead
        if not shared and self.max_age_ms < 1000 * late < inf:
            self._warn("frames come later than the quickest did, by more than 'max_age_ms'")
        return min(placed, played) - self.sensor_latency_ms / 1000

    def _warn(self, text: str, *numbers: float) -> None:
        """Say it once, whatever the numbers."""
        if text not in self._warned:
            self._warned.add(text)
            logger.warning(text, *numbers)

    def finish(self, summary: Mapping[str, Any]) -> None:
        """Note how the run ended, for the robots' last word."""
        code = summary.get("exit_code")
        endings: dict[Any, Ending] = {
            EXIT_OK: "end",
            EXIT_INTERRUPTED: "end",
            EXIT_NO_DEVICE: "no_camera",
        }
        self._ending = endings.get(code, "failed")

    def close(self) -> None:
        """Take leave of the robots, and say what they were not told of."""
        if self._filter is not None and (withheld := self._filter.summary()):
            logger.warning(withheld)
        self._filter = None
        if self._server is not None:
            self._server.stop(self._ending)
            self._server = None
        if self._transcript is not None:
            self._transcript.close()
            self._transcript = None


def _spent_s(trace: Trace) -> float:
    """Return the time since a frame left its source, s; 0 where that is not known."""
    return 0.0 if trace.left_ns is None else (time.perf_counter_ns() - trace.left_ns) / 1e9


def _is_of_host(header: Header, sensor: SensorClock | None) -> bool:
    """Return whether a frame's stamp is on the clock on which it arrived."""
    if sensor is not None:
        return bool(sensor.domain[0] != Domain.HARDWARE)
    return 0 <= header.arrival_ns - header.stamp_ns <= SAME_CLOCK_NS


def _count(manifest: Mapping[str, Any]) -> int:
    """Return how many sinks like this one a run has; each keeps a ledger of its own."""
    sinks = manifest.get("graph", {}).get("sinks", {}).values()
    return sum(sink["use"].rpartition(":")[-1] == "robot-json" for sink in sinks)


def _is_loopback(address: str) -> bool:
    return ip_address(address).is_loopback
