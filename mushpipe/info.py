"""What recordings hold and what plugins do, as text and as plain data."""

from __future__ import annotations

import inspect
import json
from pathlib import Path
from typing import Any

from mushpipe.core.errors import PluginError, suggest
from mushpipe.core.plugins import Registry, class_in_file, in_file
from mushpipe.core.ports import ports_of
from mushpipe.core.recording import MANIFEST, RecordingReader
from mushpipe.core.schema import settings_schema
from mushpipe.core.stage import Kind, Plugin, kind_of

KINDS: tuple[Kind, ...] = ("source", "stage", "sink")


def describe(path: Path) -> dict[str, Any]:
    """Read a recording to its end and describe it; ``damage`` is empty where it is whole.

    Raises:
        UsageError: There is no such file.
        InputError: It is empty, or not MCAP at all.
    """
    reader = RecordingReader(path)
    index = reader.index()
    readable = dict.fromkeys(index.channels, 0)
    for raw in reader.messages():
        readable[raw.channel.topic] = readable.get(raw.channel.topic, 0) + 1
    return {
        "file": str(path),
        "bytes": path.stat().st_size,
        "start_ns": index.start_ns,
        "duration_s": (index.end_ns - index.start_ns) / 1e9,
        "topics": [
            {"topic": topic, "schema": index.schema_name(topic), "messages": count}
            for topic, count in sorted(readable.items())
        ],
        "attachments": index.attachments,
        "results_of": index.metadata.get(MANIFEST, {}).get("json", ""),
        "damage": reader.damage,
        "unchecked": reader.unchecked,
    }


def render(content: dict[str, Any]) -> str:
    """Return `describe`'s data as text."""
    lines = [
        f"{content['file']}: {content['bytes'] / 1e6:.2f} MB, {content['duration_s']:.3f} s",
        *_columns([(t["topic"], t["schema"], str(t["messages"])) for t in content["topics"]]),
    ]
    lines += [f"attachment {name}" for name in content["attachments"]]
    if content["unchecked"]:
        lines.append("without checksums: bytes that changed since it was recorded show nowhere")
    lines += [f"damaged: {text}" for text in content["damage"]]
    return "\n".join(lines)


def _columns(rows: list[tuple[str, ...]], indent: str = "  ") -> list[str]:
    widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
    return [
        (indent + "  ".join(c.ljust(w) for c, w in zip(row, widths, strict=True))).rstrip()
        for row in rows
    ]


def plugin_rows(registry: Registry) -> list[dict[str, str]]:
    """Return one row per registered plugin and per broken one."""
    rows = [
        {
            "kind": kind,
            "name": name,
            "from": f"{entry.distribution} {entry.version}".strip(),
            "problem": "the name is taken twice" if len(registry.entries[kind, name]) > 1 else "",
        }
        for kind in KINDS
        for name in registry.names(kind)
        for entry in registry.entries[kind, name]
    ]
    rows += [
        {
            "kind": "broken",
            "name": broken.name,
            "from": f"{broken.distribution} {broken.version}".strip(),
            "problem": broken.reason,
        }
        for broken in registry.broken
    ]
    return rows


def render_plugins(rows: list[dict[str, str]]) -> str:
    """Return the rows as a table."""
    heading = ("kind", "name", "from", "problem")
    return "\n".join(_columns([heading, *(tuple(row.values()) for row in rows)], ""))


def describe_plugin(registry: Registry, name: str) -> str:
    """Return help, ports and settings of every plugin of that name.

    Raises:
        PluginError: There is none.
    """
    if in_file(name):
        plugin = class_in_file(name, Path.cwd())
        classes = [(kind_of(plugin), plugin)]
    else:
        bare = name.rpartition(":")[2]
        kinds = [kind for kind in KINDS if (kind, bare) in registry.entries]
        classes = [(kind, registry.find(kind, name, Path.cwd())) for kind in kinds]
    found = [_describe_class(kind, name, plugin) for kind, plugin in classes]
    if not found:
        known = sorted({n for kind in KINDS for n in registry.names(kind)})
        text = f"there is no plugin '{name}'; {suggest(name, known)}"
        raise PluginError(text + registry.not_loaded())
    return "\n\n".join(found)


def _describe_class(kind: Kind, name: str, plugin: type[Plugin]) -> str:
    ports = ports_of(plugin)
    inputs = [
        f"{port.name}: {port.type.__name__}{'' if port.required else ' (optional)'}"
        for port in ports.inputs
    ]
    outputs = [output.__name__ for output in ports.outputs]
    about = inspect.cleandoc(plugin.__doc__ or "no description")  # not that of its base
    lines = [f"{kind} {name}", "", about, ""]
    lines.append(f"inputs   {', '.join(inputs) or 'none'}")
    lines.append(f"outputs  {', '.join(outputs) or 'none'}")
    rows = settings_rows(plugin)
    if rows:
        lines += ["", *_columns([("setting", "type", "default", "meaning"), *rows], "")]
    return "\n".join(lines)


def settings_rows(plugin: type[Plugin]) -> list[tuple[str, ...]]:
    """Return name, type, default and meaning of each setting of a plugin."""
    return _settings(settings_schema(plugin))


def _settings(schema: dict[str, Any], prefix: str = "") -> list[tuple[str, ...]]:
    """Return the rows of a JSON Schema; a group's own settings follow it."""
    rows: list[tuple[str, ...]] = []
    for key, field in schema.get("properties", {}).items():
        group = schema.get("$defs", {}).get(field.get("$ref", "").rpartition("/")[2])
        if group and "enum" in group:
            field, group = {**group, **field}, None
        default = json.dumps(field["default"]) if "default" in field and not group else ""
        if key in schema.get("required", ()):
            default = "required"
        rows.append((prefix + key, _type(field), default, field.get("description", "")))
        if group:
            rows += _settings({**group, "$defs": schema["$defs"]}, f"{prefix}{key}.")
    return rows


_BOUNDS = {"minimum": ">=", "exclusiveMinimum": ">", "maximum": "<=", "exclusiveMaximum": "<"}


def _type(schema: dict[str, Any]) -> str:
    """Say in a few words what a JSON Schema allows."""
    if "enum" in schema:
        return " | ".join(map(str, schema["enum"]))
    if "anyOf" in schema:
        return " | ".join(_type(option) for option in schema["anyOf"])
    if "prefixItems" in schema:
        return f"[{', '.join(_type(item) for item in schema['prefixItems'])}]"
    if schema.get("type") == "array" and schema.get("items"):
        return f"list of {_type(schema['items'])}"
    if "$ref" in schema:
        return str(schema["$ref"].rpartition("/")[2])
    bounds = [f" {sign} {schema[key]:g}" for key, sign in _BOUNDS.items() if key in schema]
    return str(schema.get("format", schema.get("type", "any"))) + "".join(bounds)
