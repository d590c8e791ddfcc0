"""JSON Schema of the graph file for this installation, so that editors complete and check it."""

from __future__ import annotations

from typing import Any

from pydantic.json_schema import GenerateJsonSchema, JsonSchemaValue

from mushpipe.core.errors import MushpipeError
from mushpipe.core.graph import GraphFile
from mushpipe.core.plugins import Registry
from mushpipe.core.stage import Kind, Plugin


def graph_schema(registry: Registry) -> dict[str, Any]:
    """Return the schema: per plugin, ``use`` selects the settings that may stand beside it."""
    schema = GraphFile.model_json_schema()
    properties = schema["properties"]
    definitions: dict[str, Any] = {}
    properties["source"] |= _one_of(registry, "source", definitions)
    properties["stages"]["additionalProperties"] = _one_of(registry, "stage", definitions)
    properties["sinks"]["additionalProperties"] = _one_of(registry, "sink", definitions)
    return {
        **schema,
        "$schema": "https://json-schema.org/draft/2020-12/schema",
        "$defs": definitions,
    }


class _Lenient(GenerateJsonSchema):
    """Lets a setting be anything where JSON has no word for its type."""

    ignored_warning_kinds = {"skipped-choice", "non-serializable-default"}  # noqa: RUF012

    def handle_invalid_for_json_schema(self, *_: Any) -> JsonSchemaValue:
        return {}


def settings_schema(plugin: type[Plugin], template: str = "#/$defs/{model}") -> dict[str, Any]:
    """Return the schema of a plugin's settings; the template is that of references in it."""
    return plugin.model_json_schema(ref_template=template, schema_generator=_Lenient)


def _one_of(registry: Registry, kind: Kind, definitions: dict[str, Any]) -> dict[str, Any]:
    """A chain of if/then on ``use``: editors complete it better than oneOf."""
    rules, names = [], []
    for name in registry.names(kind):
        try:
            plugin = registry.entries[kind, name][0].load()
        except MushpipeError:
            continue
        names.append(name)
        own = settings_schema(plugin, f"#/$defs/{kind}.{name}.{{model}}")
        for model, definition in own.pop("$defs", {}).items():
            definitions[f"{kind}.{name}.{model}"] = definition
        own["properties"] = {"use": {"const": name}, "inputs": {"type": "object"}} | own.get(
            "properties", {}
        )
        if kind == "sink":
            own["properties"]["delivery"] = {"enum": ["every", "latest"]}
        condition = {"properties": {"use": {"const": name}}, "required": ["use"]}
        rules.append({"if": condition, "then": own})
    use = {"type": "string", "anyOf": [{"enum": names}, {"pattern": r"\.py:|:"}]}
    return {
        "type": "object",
        "required": ["use"],
        "properties": {"use": use},
        "additionalProperties": True,
        "allOf": rules,
    }
