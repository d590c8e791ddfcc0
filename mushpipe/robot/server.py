"""The server: one thread, one selector, a handful of clients."""

from __future__ import annotations

import errno
import logging
import selectors
import socket
import ssl
import threading
import time
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass, field

from mushpipe.core.errors import UsageError
from mushpipe.robot.connection import SEND_BUFFER, Connection, Limits, Observer
from mushpipe.robot.hub import Ending, Hub
from mushpipe.robot.messages import Refusal
from mushpipe.robot.session import Session

logger = logging.getLogger("mushpipe")
TICK_S = 0.25
THROTTLED_S = 0.01
GOODBYE_S = 0.5
# Where there is no room, who has not said hello for so long gives his place to the next one.
SILENT_S = 1.0
Opener = Callable[[Hub, int], Session]


@dataclass(frozen=True)
class Listener:
    """An address to listen on, and which protocol is spoken there."""

    host: str
    port: int
    session: Opener


@dataclass(frozen=True)
class Options:
    """How the server treats its clients."""

    listeners: Sequence[Listener]
    limits: Limits = field(default_factory=Limits)
    max_clients: int = 8
    tls: ssl.SSLContext | None = None


class RobotServer:
    """Serves a hub to robots until `stop`.

    Raises:
        UsageError: An address cannot be listened on.
    """

    def __init__(self, hub: Hub, options: Options, observe: Observer) -> None:
        self.hub = hub
        self._options = options
        self._observe = observe
        self._number = 0
        self._clients: dict[int, Connection] = {}
        self._selector = selectors.DefaultSelector()
        self._stopping: Ending | None = None
        self._error: Exception | None = None
        self._inner, self._outer = socket.socketpair()
        for end in (self._inner, self._outer):
            end.setblocking(False)
        self._selector.register(self._inner, selectors.EVENT_READ, None)
        self._sockets: list[socket.socket] = []
        try:
            for listener in options.listeners:
                self._listen(listener)
        except BaseException:
            self._release()
            raise
        self.ports = tuple(sock.getsockname()[1] for sock in self._sockets)  # as its listeners
        self._thread = threading.Thread(target=self._run, name="mushpipe-robot", daemon=True)

    def _listen(self, listener: Listener) -> None:
        family = socket.AF_INET6 if ":" in listener.host else socket.AF_INET
        sock = socket.socket(family, socket.SOCK_STREAM)
        self._sockets.append(sock)
        try:
            # A restarted server takes over its port at once; a second server does not.
            sock.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            sock.bind((listener.host, listener.port))
            sock.listen(16)
        except OSError as error:
            where = f"{listener.host}:{listener.port}"
            raise UsageError(
                f"cannot listen on {where}: {error.strerror or error}; choose another port or "
                "address for the robots, or end the program that has this one"
            ) from error
        sock.setblocking(False)
        self._selector.register(sock, selectors.EVENT_READ, listener)

    def start(self) -> None:
        """Begin to serve."""
        self._thread.start()

    def wake(self) -> None:
        """Have the server look at the hub now; never waits."""
        if self._error is not None:
            raise RuntimeError(f"the robot server died: {self._error}") from self._error
        self._poke()

    def _poke(self) -> None:
        with suppress(OSError):  # full: it is about to wake anyway; closed: it is about to end
            self._outer.send(b"w")

    def stop(self, reason: Ending = "end") -> None:
        """Tell every client, close every socket, and wait for the thread, 2 s at most."""
        self._stopping = self._stopping or reason
        if self._thread.is_alive():
            self._poke()
            self._thread.join(4 * GOODBYE_S)
        elif self._thread.ident is None:
            self._release()

    def _run(self) -> None:
        try:
            while self._stopping is None:
                self._turn(self._patience())
            self._say_goodbye()
        except Exception as error:  # must reach the run, which otherwise believes robots are served
            logger.exception("the robot server died")
            self._error = error
        finally:
            self._release()

    def _patience(self) -> float:
        if any(client.busy for client in self._clients.values()):
            return 0.0
        throttled = any(client.throttled for client in self._clients.values())
        return THROTTLED_S if throttled else TICK_S

    def _turn(self, patience: float) -> None:
        """Wait for something to happen, then serve everybody."""
        for key, _ in self._selector.select(patience):
            if key.fileobj is self._inner:
                with suppress(BlockingIOError):
                    self._inner.recv(4096)
            elif isinstance(key.data, Listener):
                self._accept(key.fileobj, key.data)  # type: ignore[arg-type]
        self.hub.tick(self.hub.clock.monotonic())
        for client in list(self._clients.values()):
            self._serve(client)

    def _accept(self, listening: socket.socket, listener: Listener) -> None:
        try:
            sock, address = listening.accept()
        except OSError as error:  # it went away before we looked: the others go on
            if error.errno in (errno.EMFILE, errno.ENFILE):
                time.sleep(THROTTLED_S)  # it stays ready, and select would return at once
            return
        self._number += 1
        number = self._number
        try:
            sock.setblocking(False)
            sock.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
            # A deep buffer would hold old lines for a client that reads slowly: the kernel is to
            # take no more than it can send on at once.
            sock.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, SEND_BUFFER)
            if hasattr(socket, "TCP_NOTSENT_LOWAT"):  # on Linux and macOS
                sock.setsockopt(socket.IPPROTO_TCP, socket.TCP_NOTSENT_LOWAT, 1)
            if self._options.tls is not None:
                sock = self._options.tls.wrap_socket(
                    sock, server_side=True, do_handshake_on_connect=False
                )
        except OSError:
            sock.close()
            return
        self._observe("event", number, f"connected: {address[0]}:{address[1]}".encode())
        session = listener.session(self.hub, number)
        client = Connection(
            sock, session, number, self._options.limits, self._observe, self.hub.clock
        )
        if len(self._clients) >= self._options.max_clients:
            away = self._silent() or client
            self._turn_away(away)
            if away is client:
                return
            self._unregister(away)
            del self._clients[away.number]
        self._clients[number] = client
        self._selector.register(sock, selectors.EVENT_READ, client)

    def _silent(self) -> Connection | None:
        """Return the client that has waited longest with its hello, and is to make room."""
        now = self.hub.clock.monotonic()
        slow = [c for c in self._clients.values() if c.silent_s(now) > SILENT_S]
        return max(slow, key=lambda c: c.silent_s(now), default=None)

    def _turn_away(self, client: Connection) -> None:
        now = self.hub.clock.monotonic()
        text = f"{self._options.max_clients} clients are served already"
        line = client.session.refuse(Refusal("too_many_clients", text, fatal=True), now)
        with suppress(OSError):
            client.sock.send(line.data)
            self._observe("tx", client.number, line.data)
        client.abort("turned away", reset=False)

    def _serve(self, client: Connection) -> None:
        try:
            client.serve()
        except Exception:  # a fault met with one client must not cost the others theirs
            logger.exception("robot client %d: internal error; it is disconnected", client.number)
            client.abort("internal error")
        if client.gone:
            self._unregister(client)
            self._clients.pop(client.number, None)
            return
        events = selectors.EVENT_READ if client.wants_input else 0
        events |= selectors.EVENT_WRITE if client.wants_output else 0
        self._watch(client, events)

    def _watch(self, client: Connection, events: int) -> None:
        """Have the selector wait for just these; none at all while a client is throttled."""
        key = self._selector.get_map().get(client.sock)
        if key is None:
            if events:
                self._selector.register(client.sock, events, client)
        elif not events:
            self._selector.unregister(client.sock)
        elif key.events != events:
            self._selector.modify(client.sock, events, client)

    def _unregister(self, client: Connection) -> None:
        # The socket may be closed already; the selector then still finds it by itself.
        with suppress(KeyError, ValueError):
            self._selector.unregister(client.sock)

    def _say_goodbye(self) -> None:
        self.hub.ending = self._stopping
        for sock in self._sockets:
            self._selector.unregister(sock)
            sock.close()
        for client in self._clients.values():
            client.session.leave(self._stopping or "end")
        until = time.monotonic() + GOODBYE_S
        while self._clients and time.monotonic() < until:
            self._turn(0.02)

    def _release(self) -> None:
        for client in self._clients.values():
            client.abort("the server ended")
        for sock in (*self._sockets, self._inner, self._outer):
            sock.close()
        self._selector.close()
