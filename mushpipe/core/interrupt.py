"""Ctrl-C in the program `mushpipe`: one line and exit code 130, whatever it is doing.

Imported before all else, which takes a moment. Frames that are being processed are finished first,
see `console.interruptible`.
"""

from __future__ import annotations

import os
import signal
import sys
from contextlib import suppress
from typing import Any

from mushpipe.core.errors import EXIT_INTERRUPTED


class _Interrupted(KeyboardInterrupt):
    """Python itself dies of a plain one that has left an `exec` (of a dataclass, say) before."""


def _say(number: int) -> None:
    with suppress(OSError):  # Ctrl-C ends who reads it (`2>&1 | tee`), too
        os.write(2, f"{signal.Signals(number).name}: interrupted\n".encode())


def _leave(number: int, _: Any) -> None:
    _say(number)
    os._exit(EXIT_INTERRUPTED)


def _unwind(number: int, _: Any) -> None:
    _say(number)
    signal.signal(number, _leave)  # native code that calls Python may have swallowed the first
    raise _Interrupted  # closes what is open


def watch_import() -> None:
    """Leave at once while the program is imported and nothing open; do nothing to other ones."""
    program = sys.argv[0].rpartition("/")[2] if sys.argv else ""
    if program == "-m":  # until a module was found: also while the package around it is imported
        program = sys.orig_argv[-len(sys.argv)]
    if program == "mushpipe" and signal.getsignal(signal.SIGINT) is signal.default_int_handler:
        signal.signal(signal.SIGINT, _leave)


def watch() -> None:
    """Close what is open, once the program works."""
    for number, handlers in (
        (signal.SIGINT, (signal.default_int_handler, _leave)),
        (signal.SIGTERM, (signal.SIG_DFL,)),
    ):
        if signal.getsignal(number) in handlers:  # who started us may have asked for none
            signal.signal(number, _unwind)


watch_import()
