"""What pydantic finds wrong with settings, as problems with a place in the graph file."""

from __future__ import annotations

import json
from typing import get_args

from pydantic import BaseModel, ValidationError

from mushpipe.core.document import Document, Location
from mushpipe.core.errors import Problem, suggest
from mushpipe.core.settings import settings_of


def faults_of(
    document: Document, at: Location, error: ValidationError, model: type[BaseModel], use: str = ""
) -> list[Problem]:
    """Turn pydantic's errors into problems with places and suggestions."""
    problems = []
    of = f" of '{use}'" if use else ""
    for item in error.errors():
        unknown, loc = item["type"] == "extra_forbidden", item["loc"]
        if not unknown:  # where a setting may be of several types, pydantic's names for them
            loc = tuple(part for part in loc if "[" not in str(part))
        path, place = (*at, *loc), ".".join(map(str, loc))
        name = str(loc[-1]) if loc else ""
        if unknown:
            what = f"unknown setting '{name}'{of}"
            hint = suggest(name, known) if (known := _known(model, loc[:-1])) else ""
            problems.append(document.problem(path, what, hint, True))
        elif item["type"] == "missing":
            text = f"setting '{place}'{of} is missing"
            if isinstance(last := path[-1], int):  # of a list
                text = f"{place.rpartition('.')[0]}{of}: value {last + 1} is missing"
            problems.append(document.problem(path[:-1], text))
        else:
            what = place + of if place else f"'{use}'"
            given = f", got {json.dumps(item['input'], default=str)}" if place else ""
            message = item["msg"].removeprefix("Value error, ")
            if item["type"] == "dict_type" and not use:
                message = _expected(path)
            if item["type"] in ("list_type", "tuple_type"):  # of which pydantic says "array"
                message = "expected a list in brackets, such as [a, b]"
            if item["type"].startswith("byte_size"):
                message = "expected a size with its unit, such as 500MB or 2GB"
            if item["type"] == "json_invalid":  # half a character: "\ud800", or of a name
                what = what if use else "the graph"
                message = "a text in it is not UTF-8: give the file another name"
            problems.append(document.problem(path, f"{what}: {message}{given}"))
    return problems


def _expected(path: Location) -> str:
    """Return what a graph has at a place where it has no mapping."""
    if len(path) == 1 and path[0] in ("stages", "sinks"):
        return "expected names with their settings, such as 'segment: {use: otsu}', and no list"
    return "expected settings in braces, such as {use: otsu}"


def _known(model: type[BaseModel], place: Location) -> list[str]:
    """Return the names of the settings at a place in a model, none where it is no group."""
    for part in place:
        field = model.model_fields.get(settings_of(model).get(str(part), ""))
        kinds = (field.annotation, *get_args(field.annotation)) if field else ()
        groups = [k for k in kinds if isinstance(k, type) and issubclass(k, BaseModel)]
        if len(groups) != 1:
            return []
        model = groups[0]
    return list(settings_of(model))
