"""The verbs of `mushpipe robot`: try out a connection, replay a complaint."""

from __future__ import annotations

import json
import sys
import time
from dataclasses import dataclass
from enum import StrEnum
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from mushpipe.core.errors import InputError
from mushpipe.options import file_argument, file_option, finite

if TYPE_CHECKING:
    import ssl

    from mushpipe.robot.client import RobotClient

app = typer.Typer(help="Talk to the robot socket, as a robot would.", no_args_is_help=True)
AddressArgument = Annotated[str, typer.Argument(help="host:port of a sink robot-json")]


class Mode(StrEnum):
    """How targets come."""

    request = "request"
    stream = "stream"


class Outcome(StrEnum):
    """What an acknowledgement may say."""

    accepted = "accepted"
    rejected = "rejected"
    done = "done"
    failed = "failed"


@dataclass
class _Talk:
    """What `mushpipe robot client` was asked for, and how many messages it has shown so far."""

    mode: Mode
    asked: dict[str, int]
    every: float
    ack: list[Outcome]
    raw: bool
    count: int
    shown: int = 0

    def over(self) -> bool:
        """Whether all messages were shown; a count of 0 is for ever."""
        return 0 < self.count <= self.shown


class _NobodyReads(Exception):  # noqa: N818 - no fault: `| head`
    """Our own output was closed, which is no trouble of the connection."""


def _out(text: str) -> None:
    try:
        sys.stdout.write(text + "\n")
        sys.stdout.flush()
    except BrokenPipeError as error:
        raise _NobodyReads from error


def _note(text: str) -> None:
    sys.stderr.write(text + "\n")


def _split(address: str) -> tuple[str, int]:
    host, colon, port = address.rpartition(":")
    if not (colon and host and port.isdecimal() and 0 < int(port) < 65536):
        raise typer.BadParameter(f"'{address}' is not host:port, with a port from 1 to 65535")
    host = host.removeprefix("[").removesuffix("]")
    if host.endswith(":"):  # of ::1, whose end was taken for a port
        raise typer.BadParameter(f"'{address}' is IPv6 without a port: write [{address}]:5005")
    try:
        host.encode("idna")
    except UnicodeError:  # two dots in a row, more than 63 letters between two
        raise typer.BadParameter(f"'{host}' cannot be the name of a host") from None
    return host, int(port)


@app.command()
def client(
    address: AddressArgument = "127.0.0.1:5005",
    mode: Annotated[Mode, typer.Option(help="ask, or be sent every result")] = Mode.request,
    count: Annotated[int, typer.Option(help="messages to show; 0 is for ever", min=0)] = 0,
    most: Annotated[
        int | None, typer.Option("--max", help="targets to ask for, default 10", min=1, max=1000)
    ] = None,
    max_age_ms: Annotated[int | None, typer.Option(help="refuse what is older", min=1)] = None,
    every: Annotated[
        float, typer.Option(help="seconds between requests", min=0, max=9, callback=finite)
    ] = 1.0,
    ack: Annotated[
        list[Outcome] | None, typer.Option(help="say this of the best target; may be repeated")
    ] = None,
    accept_replay: Annotated[
        bool, typer.Option("--accept-replay", help="take targets of a recording")
    ] = False,
    name: Annotated[str, typer.Option(help="what to call ourselves")] = "",
    token_file: Annotated[Path | None, file_option("file with the server's token")] = None,
    tls_ca: Annotated[Path | None, file_option("speak TLS; trust this PEM")] = None,
    raw: Annotated[bool, typer.Option("--raw", help="print the lines as they come")] = False,
) -> None:
    """Print targets and acknowledge them, reconnecting when the server goes away."""
    from mushpipe.robot.client import RobotClient

    host, port = _split(address)
    if mode is Mode.stream and (most is not None or max_age_ms is not None):
        raise typer.BadParameter("--max and --max-age-ms go with --mode request")
    hello: dict[str, Any] = {"accept_replay": accept_replay, "name": name}
    if token_file is not None:
        hello["token"] = _token(token_file)
    if tls_ca is not None:
        hello["tls"] = _trust(tls_ca)
    asked = {"max": 10 if most is None else most}
    asked |= {} if max_age_ms is None else {"max_age_ms": max_age_ms}
    talk = _Talk(mode, asked, every, ack or [], raw, count)
    told = ""
    while not talk.over():
        try:
            with RobotClient(host, port, mode, **hello) as connection:
                told = ""
                _converse(connection, talk)
        except _NobodyReads as error:
            raise BrokenPipeError from error
        except PermissionError as error:
            _note(f"refused: {error}")
            raise typer.Exit(1) from None
        except OSError as error:
            if told != str(error):  # once, and not each second until somebody starts the server
                _note(f"{address}: {error}; trying again")
            told = str(error)
            time.sleep(1.0)


def _converse(connection: RobotClient, talk: _Talk) -> None:
    """Hold one conversation, and count the messages that are shown."""
    _note(f"connected: {connection.hello['software']}")
    while not talk.over():
        if talk.mode is Mode.stream:
            message = connection.receive()
            if message["op"] == "heartbeat":
                connection.ping()
            elif message["op"] == "pong":
                continue
        else:
            message = connection.ask("get_targets", **talk.asked)
        _show(message, talk.raw)
        if connection.too_late(message):
            _note(f"{connection.late_ms:.0f} ms late on the way: no longer valid")
            message["targets"] = []
        talk.shown += message["op"] != "heartbeat"
        if message["op"] == "bye":
            raise ConnectionError(f"the server says bye: {message['reason']}")
        for outcome in talk.ack if message.get("targets") else []:
            target = message["targets"][0]["id"]
            _show(connection.ask("ack", target=target, result=outcome.value), talk.raw)
        if talk.mode is Mode.request and not talk.over():
            time.sleep(talk.every)


def _token(path: Path) -> str:
    try:
        token = path.read_text().strip()
    except (OSError, UnicodeDecodeError) as error:
        why = getattr(error, "strerror", None) or "it is no text"
        raise typer.BadParameter(f"--token-file {path}: {why}") from error
    if not token:
        raise typer.BadParameter(f"--token-file {path}: there is no token in it")
    return token


def _trust(path: Path) -> ssl.SSLContext:
    import ssl

    try:
        return ssl.create_default_context(cafile=path)
    except OSError as error:
        why = error.strerror or "it holds no certificate in PEM"
        raise typer.BadParameter(f"--tls-ca {path}: {why}") from error


def _show(message: dict[str, Any], raw: bool) -> None:
    if raw:
        _out(json.dumps(message))
        return
    mark = " REPLAY" if message.get("replay") else ""
    if message["op"] != "targets":
        keys = ("state", "code", "message", "target", "result", "effect", "reason", "age_ms")
        known = " ".join(f"{key}={message[key]}" for key in keys if message.get(key) is not None)
        _out(f"{message['op']}{mark} {known}")
        return
    held = ", ".join(f"{n} {reason}" for reason, n in message["withheld"].items() if n)
    _out(
        f"targets{mark} seq={message['seq']} age={message['age_ms']} ms frame={message['frame']} "
        f"count={message['count']}{' of more' if message['more'] else ''}"
        f"{f', withheld: {held}' if held else ''}"
    )
    for target in message["targets"]:
        place = " ".join(f"{1000 * value:8.1f}" for value in target["position"])
        size = "?" if target["diameter"] is None else f"{1000 * target['diameter']:.1f}"
        flags = ",".join(target["flags"])
        _out(f"  {target['id']:>6} {place} mm  d {size} mm  score {target['score']:.2f}  {flags}")


@app.command()
def replay(
    file: Annotated[Path, file_argument("transcript written by a sink robot-json")],
    connect: Annotated[
        str | None, typer.Option(help="host:port of a server: play the client to it")
    ] = None,
    listen: Annotated[
        int | None,
        typer.Option(help="port on loopback: play the server to one client", min=0, max=65535),
    ] = None,
    client: Annotated[int | None, typer.Option(help="whose lines; default the first's")] = None,
    accept_replay: Annotated[
        bool, typer.Option("--accept-replay", help="with --connect: take a recording's targets")
    ] = False,
    token_file: Annotated[
        Path | None, file_option("with --connect: file with the server's token")
    ] = None,
) -> None:
    """Play a recorded transcript against a server or a client, printing every line.

    To a client every message says that it is a replay. Ends with 4 where the file is damaged.
    """
    from mushpipe.robot.replay import as_client, as_server, lines_of

    def show(sign: str, text: bytes) -> None:
        _out(f"{sign} {text.decode(errors='backslashreplace')}")

    def listening(port: int) -> None:
        _note(f"listening on 127.0.0.1:{port}")

    if (connect is None) == (listen is None):
        raise typer.BadParameter("give either --connect or --listen")
    if listen is not None and (accept_replay or token_file):
        raise typer.BadParameter("--accept-replay and --token-file go with --connect")
    lines, damage = lines_of(file, client)
    try:
        if connect is not None:
            hello: dict[str, Any] = {"accept_replay": True} if accept_replay else {}
            hello |= {} if token_file is None else {"token": _token(token_file)}
            as_client(lines, *_split(connect), show, hello)
        else:
            as_server(lines, listen or 0, show, listening)
    except _NobodyReads as error:
        raise BrokenPipeError from error
    except OSError as error:
        _note(f"{connect or f'127.0.0.1:{listen}'}: {error}")
        raise typer.Exit(1) from None
    if damage:
        raise InputError(
            f"{file} is damaged: {'; '.join(damage)}; the {len(lines)} lines that could be read "
            "were played"
        )
