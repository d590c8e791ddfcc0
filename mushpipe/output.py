"""The option `--format` of the verbs, apart from them so that none needs what another imports."""

from __future__ import annotations

from enum import StrEnum
from typing import Annotated

import typer


class Output(StrEnum):
    """How a verb prints what it found."""

    text = "text"
    json = "json"


OutputOption = Annotated[Output, typer.Option("--format")]
