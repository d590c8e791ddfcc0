"""Settings as the data of a graph file: what they are called there, read, and written out again."""

from __future__ import annotations

import json
from collections.abc import Collection, Mapping
from pathlib import Path
from typing import Any

from pydantic import AliasChoices, BaseModel, ValidationError

from mushpipe.core.stage import Plugin

WORDS = ("use", "inputs", "delivery")
"""What stands beside the settings of a node in a graph."""


def settings_of(model: type[BaseModel]) -> dict[str, str]:
    """Return the names that settings have in a graph file, each with its attribute of the model."""
    names: dict[str, str] = {}
    config = model.model_config
    both = config.get("populate_by_name") or config.get("validate_by_name")
    for attribute, field in model.model_fields.items():
        alias = field.validation_alias
        known = alias.choices if isinstance(alias, AliasChoices) else [alias]
        names |= {name: attribute for name in known if isinstance(name, str)}
        if both or alias is None:
            names[attribute] = attribute
    return names


def default_paths(plugin: type[Plugin], settings: Mapping[str, Any]) -> dict[str, str]:
    """Return the paths that settings are by default, as a graph file would state them.

    Only what is stated there is made relative to it.
    """
    attributes = settings_of(plugin)
    given = {attributes.get(name) for name in settings}
    names = {attribute: name for name, attribute in attributes.items()}
    return {
        names.get(attribute, attribute): str(field.default)
        for attribute, field in plugin.model_fields.items()
        if attribute not in given and _is_path(field.default, field.annotation)
    }


def _is_path(default: Any, annotation: Any) -> bool:
    return isinstance(default, Path) or (isinstance(default, str) and annotation is Path)


def read_settings(
    plugin: type[Plugin], settings: Mapping[str, Any], base: Path, from_shell: Collection[str | int]
) -> Plugin:
    """Return a plugin with the settings of a graph file in a folder.

    Raises:
        ValidationError: They are not as the plugin declares them.
    """
    # validators know a setting by its attribute
    shell = {known for name, known in settings_of(plugin).items() if name in from_shell}
    context = {"base": base, "from_shell": shell}
    return plugin.model_validate_json(json.dumps(settings), strict=True, context=context)


def written_settings(plugin: Plugin) -> dict[str, Any]:
    """Return every setting as plain data, from which `read_settings` makes the same plugin."""
    return plugin.model_dump(mode="json", by_alias=True, round_trip=True)


def told(error: Exception) -> str:
    """Return an error in one line, the first of pydantic's with its place: ``frame: Field ...``."""
    if not isinstance(error, ValidationError):
        return str(error)
    first = error.errors()[0]
    place, message = ".".join(map(str, first["loc"])), first["msg"].removeprefix("Value error, ")
    return f"{place}: {message}" if place else message


def writing_fault(plugin: Plugin) -> str:
    """Say why the settings, written out, would not be the same when read; nothing if they would.

    Manifests and failure capsules hold graphs that are written out.
    """
    try:
        written = written_settings(plugin)
        again = read_settings(type(plugin), written, Path(), ())
        rewritten = written_settings(again)
    except ValidationError as error:
        first = error.errors()[0]
        if first["type"] == "extra_forbidden":
            name = ".".join(map(str, first["loc"]))
            return f"'{name}' is a name for writing alone; an 'alias' is one for both"
        return f"{told(error)}, got {first['input']!r}"
    except Exception as error:  # of types that are no data, and of a plugin's own serializers
        return str(error)
    changed = [name for name, value in written.items() if rewritten.get(name) != value]
    if changed and dict(plugin) != dict(again):  # sets are the same in any order
        name = changed[0]
        return f"{name} is {written[name]!r} when written, and then read as {rewritten[name]!r}"
    return ""
