"""Load on the robot socket: 30 results a second of 150 targets to 8 clients, one of them stuck.

    python benchmarks/robot.py                 # 60 s
    python benchmarks/robot.py --duration 10 --transcript

Measures on loopback the time from handing picks to the sink until the last healthy client has the
whole line, heartbeats that were late, and results that a healthy client did not get.
"""

from __future__ import annotations

import argparse
import json
import platform
import resource
import select
import selectors
import socket
import subprocess
import sys
import tempfile
import threading
import time
from importlib.metadata import version
from pathlib import Path
from typing import Any, cast

import numpy as np

from mushpipe import Header, Picks, RgbdFrame, RunInfo, Trace
from mushpipe.core.geometry import quaternion_from_axis
from mushpipe.proof.bench import peak_mb
from mushpipe.robot.targets import Filter
from mushpipe.sinks.robot_json import RobotJsonSink

HELLO = b'{"op":"hello","version":"1.0","mode":"stream"}\n'
LATE_HEARTBEAT_S = 1.5
RECEIVE_BUFFER = 1 << 16


def random_picks(count: int, rng: np.random.Generator) -> Picks:
    """Return picks with every field set, as a pipeline with poses makes them."""
    axis = rng.normal(size=(count, 3)) * 0.2 + [0, 0, -1]
    axis /= np.linalg.norm(axis, axis=1, keepdims=True)
    return Picks(
        id=np.arange(count),
        center=rng.uniform(0, 480, (count, 2)),
        radius=rng.uniform(8, 38, count),
        position=rng.uniform(-0.2, 0.5, (count, 3)),
        surface=rng.uniform(-0.2, 0.5, (count, 3)),
        distance=rng.uniform(0.4, 0.5, count),
        diameter=rng.uniform(0.02, 0.06, count),
        quaternion=quaternion_from_axis(axis),
        axis=axis,
        score=rng.uniform(0, 1, count),
        sigma_position=rng.uniform(0, 0.002, (count, 3)),
        sigma_diameter=rng.uniform(0, 0.002, count),
        sigma_tilt=rng.uniform(0, 0.1, count),
        source=np.ones(count, np.uint8),
        flags=np.zeros(count, np.uint32),
        frame_id="camera_color_optical_frame",
    )


def listen(port: int, count: int) -> None:
    """Be the healthy clients: note when each line was whole; print it all at the end."""
    selector = selectors.DefaultSelector()
    targets: list[dict[int, float]] = [{} for _ in range(count)]
    heartbeats: list[list[float]] = [[] for _ in range(count)]
    held = [b""] * count
    for i in range(count):
        sock = socket.create_connection(("127.0.0.1", port))
        sock.sendall(HELLO)
        selector.register(sock, selectors.EVENT_READ, i)
    last_word = time.monotonic()
    while selector.get_map():
        for key, _ in selector.select(1.0):
            sock, i = cast(socket.socket, key.fileobj), key.data
            data = sock.recv(1 << 20)
            now = time.monotonic()
            if not data:
                selector.unregister(sock)
                continue
            *lines, held[i] = (held[i] + data).split(b"\n")
            for line in lines:
                if line.startswith(b'{"op":"targets"'):
                    targets[i][int(line[:80].split(b'"seq":')[1].split(b",")[0])] = now
                elif line.startswith(b'{"op":"heartbeat"'):
                    heartbeats[i].append(now)
        if time.monotonic() - last_word > 1:
            last_word = time.monotonic()
            for key in selector.get_map().values():
                key.fileobj.send(b'{"op":"heartbeat"}\n')  # type: ignore[union-attr]
    sys.stdout.write(json.dumps({"targets": targets, "heartbeats": heartbeats}))


class Stuck(threading.Thread):
    """A client that never reads, and comes back whenever it was cut off."""

    def __init__(self, port: int) -> None:
        super().__init__(daemon=True)
        self.port = port
        self.connections = 0
        self.done = threading.Event()

    def run(self) -> None:
        """Be stuck until told to end."""
        while not self.done.is_set():
            with socket.socket() as sock:
                # else the kernel reads in its place, for seconds
                sock.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, RECEIVE_BUFFER)
                sock.connect(("127.0.0.1", self.port))
                sock.sendall(HELLO)
                self.connections += 1
                poll = select.poll()
                poll.register(sock, select.POLLRDHUP)
                while not self.done.is_set() and not poll.poll(200):
                    pass


def serve(arguments: argparse.Namespace, folder: str) -> dict[str, Any]:
    """Publish to all clients and return what was measured."""
    sink = RobotJsonSink(
        port=0, transcript=Path(folder) / "robot.mcap" if arguments.transcript else None
    )
    rng = np.random.default_rng(0)
    picks = [random_picks(arguments.targets, rng) for _ in range(8)]
    assert all(len(Filter()(each).targets) == arguments.targets for each in picks)  # none withheld
    handed: dict[int, float] = {}
    consumed: list[float] = []
    sink.open(RunInfo("benchmark", {}, live=True, frames_read=lambda: len(handed)))
    assert sink._server is not None
    port = sink._server.ports[0]
    command = [sys.executable, __file__, "--listen", str(port), str(arguments.clients - 1)]
    stuck = Stuck(port)
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as child:
        stuck.start()
        while len(sink._server._clients) < arguments.clients:
            time.sleep(0.05)
        begin = time.monotonic()
        for number in range(round(arguments.duration * arguments.fps)):
            due = begin + number / arguments.fps
            time.sleep(max(0.0, due - time.monotonic()))
            stamp = time.time_ns()
            header = Header(stamp, number, "camera_color_optical_frame")
            frame = RgbdFrame(header, np.zeros((1, 1, 3), np.uint8))
            handed[number + 1] = time.monotonic()
            sink.consume(picks[number % len(picks)], Trace(frame, {}, {}))
            consumed.append(time.monotonic() - handed[number + 1])
        elapsed = time.monotonic() - begin
        stuck.done.set()
        stuck.join()
        sink.close()
        heard = json.loads(child.communicate()[0])
    return {
        "handed": handed,
        "consumed": consumed,
        "elapsed": elapsed,
        "stuck": stuck.connections,
        **heard,
    }


def report(arguments: argparse.Namespace, found: dict[str, Any]) -> None:
    """Print the figures."""
    handed = {str(seq): moment for seq, moment in found["handed"].items()}
    last = [
        1000 * (max(client[seq] for client in found["targets"]) - moment)
        for seq, moment in handed.items()
        if all(seq in client for client in found["targets"])
    ]
    missed = sum(len(handed) - len(client) for client in found["targets"])
    gaps = [np.diff(beats).max(initial=0) for beats in found["heartbeats"]]
    late = sum(int((np.diff(beats) > LATE_HEARTBEAT_S).sum()) for beats in found["heartbeats"])
    usage = resource.getrusage(resource.RUSAGE_SELF)
    p50, p99 = np.percentile(last, (50, 99))
    consume = np.percentile(1000 * np.array(found["consumed"]), (50, 99, 100))
    lines = [
        f"{len(handed)} results of {arguments.targets} targets in {found['elapsed']:.1f} s to "
        f"{arguments.clients - 1} healthy clients and a stuck one, "
        f"{'with' if arguments.transcript else 'without'} transcript",
        f"pick to the last healthy client's socket: p50 {p50:.2f} ms, p99 {p99:.2f} ms, "
        f"max {max(last):.2f} ms ({len(last)} results)",
        f"consume(): p50 {consume[0]:.2f} ms, p99 {consume[1]:.2f} ms, max {consume[2]:.2f} ms",
        f"heartbeats: {min(map(len, found['heartbeats']))} or more per client, {late} late, "
        f"largest gap {max(gaps):.3f} s",
        f"results missed by healthy clients: {missed}",
        f"the stuck client was cut off and came back {found['stuck'] - 1} times",
        f"CPU {100 * (usage.ru_utime + usage.ru_stime) / found['elapsed']:.0f} % of a core, "
        f"peak memory {peak_mb():.0f} MB",
        f"mushpipe {version('mushpipe')}, python {platform.python_version()}, "
        f"numpy {np.__version__}, orjson {version('orjson')}, {platform.platform()}",
    ]
    sys.stdout.write("\n".join(lines) + "\n")


def main() -> None:
    """Run the benchmark."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else "")
    parser.add_argument("--duration", type=float, default=60, help="seconds")
    parser.add_argument("--fps", type=float, default=30, help="results a second")
    parser.add_argument("--targets", type=int, default=150, help="targets in each")
    parser.add_argument("--clients", type=int, default=8, help="clients, the stuck one included")
    parser.add_argument("--transcript", action="store_true", help="record every line")
    parser.add_argument("--listen", type=int, nargs=2, help=argparse.SUPPRESS)
    arguments = parser.parse_args()
    if arguments.listen:
        listen(*arguments.listen)
        return
    with tempfile.TemporaryDirectory() as folder:
        report(arguments, serve(arguments, folder))


main()
