"""A server in a process of its own, to be killed: `python -m tests.robot.serve PORT`."""

from __future__ import annotations

import sys
import threading

from mushpipe.robot.clock import Clock
from mushpipe.robot.hub import Hub, Settings
from mushpipe.robot.server import Listener, Options, RobotServer
from mushpipe.robot.session import JsonSession
from tests.robot.scene import choice


def main() -> None:
    clock = Clock()
    hub = Hub(Settings(), clock)
    options = Options([Listener("127.0.0.1", int(sys.argv[1]), JsonSession)])
    server = RobotServer(hub, options, lambda *_: None)
    server.start()
    sys.stdout.write(f"{server.ports[0]}\n")
    sys.stdout.flush()
    done = threading.Event()
    threading.Thread(target=lambda: (sys.stdin.read(), done.set()), daemon=True).start()
    number = 0
    while not done.wait(0.01):
        number += 1
        hub.publish(choice(), number, clock.wall_ns(), clock.monotonic())
        server.wake()
    server.stop()


main()
