"""Rerun's viewer and server as processes of their own, and whether one answers."""

from __future__ import annotations

import os
import signal
import socket
import subprocess
import sys
import time
from contextlib import suppress
from urllib.parse import urlsplit

from mushpipe.core.errors import DependencyError, UsageError

PORT = 9876  # the SDK's own default
PATIENCE_S = 20.0


def has_display() -> bool:
    """Return whether a viewer can open a window here."""
    return sys.platform != "linux" or bool({"DISPLAY", "WAYLAND_DISPLAY"} & os.environ.keys())


def reached_at(host: str) -> str:
    """Return the address at which this machine reaches what listens on `host`."""
    return "127.0.0.1" if host in ("0.0.0.0", "::") else host


def proxy_at(host: str, port: int) -> str:
    """Return what viewers of this machine are told to fetch what listens on `host` from."""
    reached = reached_at(host)
    return f"rerun+http://{f'[{reached}]' if ':' in reached else reached}:{port}/proxy"


def answers(host: str, port: int) -> bool:
    """Return whether something listens there."""
    try:
        socket.create_connection((host, port), timeout=2).close()
    except OSError:
        return False
    return True


def check_reachable(url: str) -> None:
    """Raise UsageError where no viewer can be sent to at `url`."""
    parts = urlsplit(url)
    if not url.startswith("rerun") or not parts.hostname:
        raise UsageError(f"connect: '{url}' is not like rerun+http://127.0.0.1:{PORT}/proxy")
    if not answers(parts.hostname, parts.port or PORT):
        raise UsageError(f"connect: no viewer answers at {parts.hostname}:{parts.port or PORT}")


def start(host: str, port: int, *arguments: str) -> subprocess.Popen[bytes]:
    """Start Rerun as a process of its own: the SDK's own servers always listen on 0.0.0.0.

    Raises:
        UsageError: The port is taken.
        DependencyError: It does not come up.
    """
    if answers(reached_at(host), port):
        raise UsageError(f"port {port} is taken: choose another, or end what listens there")
    server = subprocess.Popen(
        [sys.executable, "-m", "rerun", "--bind", host, "--port", str(port), *arguments],
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
        start_new_session=True,  # Ctrl-C is for the run, which then ends the server
    )
    deadline = time.monotonic() + PATIENCE_S
    while not answers(reached_at(host), port):
        if server.poll() is not None or time.monotonic() > deadline:
            with suppress(ProcessLookupError):  # it may have ended by itself
                os.killpg(server.pid, signal.SIGKILL)
            raise DependencyError(
                f"Rerun does not start on {host}:{port}: is {host} (host) an address of this "
                "machine?"
            )
        time.sleep(0.05)
    return server
