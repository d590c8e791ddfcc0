"""Standard streams that whoever started the program closed (``>&-``)."""

from __future__ import annotations

import os
import sys


def open_closed() -> None:
    """Lead closed standard streams to /dev/null.

    Else the next file that is opened takes the number of one, and gets what anybody prints.
    """
    for name, mode in (("stdin", "r"), ("stdout", "w"), ("stderr", "w")):  # as they are numbered
        if getattr(sys, name) is None:
            setattr(sys, name, os.fdopen(os.open(os.devnull, os.O_RDWR), mode))
