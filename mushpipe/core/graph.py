"""A graph file compiled to a checked `Plan`, with every fault of the file reported at once."""

from __future__ import annotations

import json
import re
from collections.abc import Iterable
from contextlib import suppress
from pathlib import Path
from typing import Any, Literal

from pydantic import BaseModel, ConfigDict, Field, ValidationError, field_validator

from mushpipe.core.document import Document, Location
from mushpipe.core.errors import GraphError, PluginError, Problem, UsageError, suggest
from mushpipe.core.faults import faults_of
from mushpipe.core.files import files_of
from mushpipe.core.overrides import apply_override, encoding_fault
from mushpipe.core.overwriting import clashes
from mushpipe.core.paths import IMAGES, from_home, real
from mushpipe.core.plan import Node, Plan
from mushpipe.core.plugins import Registry, in_file
from mushpipe.core.ports import OF_SOURCE, ports_of
from mushpipe.core.settings import WORDS, default_paths, read_settings, settings_of, writing_fault
from mushpipe.core.stage import Kind, Plugin, RunInfo, Source
from mushpipe.core.transform import Transform
from mushpipe.core.wire import BASE_TOPIC, RESULT_PREFIX, TIMING_TOPIC, TOTAL
from mushpipe.core.wiring import wire

_NAME = re.compile(r"[A-Za-z][A-Za-z0-9_-]*")
# settings of a source that may hold for one recording and not for the next
_OF_A_RECORDING = ("camera", "depth_scale", "start", "end")


class GraphFile(BaseModel):
    """The keys of a graph file."""

    model_config = ConfigDict(extra="forbid")

    mushpipe: Literal[1] = Field(description="version of the graph format")
    description: str = Field("", description="what the graph is for")
    seed: int = Field(0, ge=0, description="seed of every stage that wants randomness")
    on_error: Literal["fail", "skip"] | None = Field(
        None, description="when a stage fails: end the run (default in replay) or skip (live)"
    )
    max_failures: int = Field(10, ge=1, description="end a skipping run after so many in a row")
    source: dict[str, Any] = Field(description="where frames come from")
    stages: dict[str, dict[str, Any]] = Field({}, description="what happens to them, in order")
    sinks: dict[str, dict[str, Any]] = Field({}, description="where results go")

    @field_validator("mushpipe", mode="before")
    @classmethod
    def _is_read_here(cls, value: Any) -> Any:
        if type(value) is not int or value != 1:  # YAML's yes equals 1
            raise ValueError("expected 1, the version that this program reads")
        return value


def compile_document(
    document: Document,
    registry: Registry,
    overrides: Iterable[str | tuple[str, str]] = (),
    source: str | None = None,
) -> Plan:
    """Compile a parsed graph.

    Args:
        document: The parsed file; overrides are worked into it.
        registry: The plugins it may use.
        overrides: ``a.b=value`` texts, each alone or with the label that messages call it by.
        source: A recording or the name of a source plugin, put in place of the graph's own.

    Raises:
        GraphError: With every problem found.
    """
    problems: list[Problem] = []
    if {"graph", "graph_file"} <= document.data.keys():  # of which every setting would be unknown
        manifest = "a run's manifest, and no graph: save what stands in it under 'graph'"
        raise GraphError([Problem(document.file, 0, 0, manifest)])
    if source is not None:
        if (fault := encoding_fault(source)) is not None:
            raise GraphError([Problem(f"--source {source}", 0, 0, fault)])
        _replace_source(document, source, registry)
    for item in overrides:
        text, label = (item, "") if isinstance(item, str) else item
        problems += apply_override(document, text, label)
    head, entries = _head(document, problems), _entries(document)
    problems += _check_names(document, entries)
    nodes = {
        kind: [_node(document, registry, kind, at, entry, problems) for at, entry in group]
        for kind, group in entries.items()
    }
    complete = [node for group in nodes.values() for node in group if node is not None]
    if nodes["source"] and _shaped(document):
        unknown = {
            str(at[-1])
            for kind in ("source", "stage")
            for (at, _), node in zip(entries[kind], nodes[kind], strict=True)
            if node is None
        }
        problems += wire(document, registry, complete, unknown)
    if not problems:
        problems += _check_files(document, complete)
    if problems or head is None:
        raise GraphError(problems)
    return Plan(
        file=document.file,
        source=complete[0],
        stages=tuple(node for node in complete if node.kind == "stage"),
        sinks=tuple(node for node in complete if node.kind == "sink"),
        seed=head.seed,
        on_error=head.on_error,
        max_failures=head.max_failures,
        overrides=tuple(dict.fromkeys(document.overrides.values())),
        warnings=tuple(document.warnings),
    )


def _head(document: Document, problems: list[Problem]) -> GraphFile | None:
    try:
        return GraphFile.model_validate_json(json.dumps(document.data), strict=True)
    except ValidationError as error:
        problems += faults_of(document, (), error, GraphFile)
        return None


def _entries(document: Document) -> dict[Kind, list[tuple[Location, dict[str, Any]]]]:
    """Return what the file says of each plugin, as far as it is in a shape to be checked."""

    def named(key: str) -> list[tuple[Location, dict[str, Any]]]:
        section = document.data.get(key)
        items = section.items() if isinstance(section, dict) else ()
        return [((key, name), entry) for name, entry in items if isinstance(entry, dict)]

    source = document.data.get("source")
    return {
        "source": [(("source",), source)] if isinstance(source, dict) else [],
        "stage": named("stages"),
        "sink": named("sinks"),
    }


def _shaped(document: Document) -> bool:
    """Return whether every stage can be checked: those below may need what it makes."""
    stages = document.data.get("stages", {})
    return isinstance(stages, dict) and all(isinstance(each, dict) for each in stages.values())


def _replace_source(document: Document, source: str, registry: Registry) -> None:
    if not source:
        raise UsageError("--source is empty: expected a recording, a folder, or a source's name")
    label = f"--source {source}"
    source = str(from_home(source)) if source.startswith("~") else source
    name = source.rpartition(":")[2]  # which may say whose it is
    is_name = ("source", name) in registry.entries and not Path(source).is_file()
    given = {"use": "mcap", "path": source}
    if source == "-":
        given = {"use": "stream"}
    elif is_name or in_file(source):
        given = {"use": source}
    elif source.lower().endswith(".bag"):
        given = {"use": "realsense", "file": source}
    elif Path(source).is_dir() or Path(source).suffix.lower() in IMAGES:
        given = {"use": "images", "path": source}
    elif not (Path(source).exists() or Path(source).suffix):
        hint = suggest(source, registry.names("source"))
        document.warnings.append(f"'{source}' is neither a file nor a source; {hint}")
    old = document.data.get("source")
    if isinstance(old, dict) and old.get("use") == given["use"]:
        given = {**old, **given}
        if kept := [name for name in _OF_A_RECORDING if name in old]:
            names = ", ".join(kept)
            document.warnings.append(f"--source keeps the graph's {names}; --set changes that")
    document.data["source"] = given
    document.overrides[("source",)] = label
    for key in ("use", "path", "file"):
        if key in given:
            document.overrides[("source", key)] = label


def _check_names(
    document: Document, entries: dict[Kind, list[tuple[Location, dict[str, Any]]]]
) -> list[Problem]:
    problems = []
    stages = {str(at[-1]) for at, _ in entries["stage"]}
    for at, _ in (*entries["stage"], *entries["sink"]):
        name, message = str(at[-1]), ""
        if not _NAME.fullmatch(name):
            message = f"'{name}' is no name: letters, digits, - and _, beginning with a letter"
        elif name in GraphFile.model_fields:
            message = f"'{name}' is a key of the graph file and cannot name a stage or sink"
        elif at[0] == "stages" and RESULT_PREFIX + name in (TIMING_TOPIC, BASE_TOPIC):
            message = f"'{name}' cannot name a stage: its results would stand where others do"
        elif at[0] == "stages" and name == TOTAL:
            message = f"'{name}' cannot name a stage: so is the time of all of them called"
        elif at[0] == "sinks" and name in stages:
            message = f"a stage is called '{name}' already"
        if message:
            problems.append(document.problem(at, message, key=True))
    return problems


def _check_files(document: Document, nodes: list[Node]) -> list[Problem]:
    """Return which sinks would write over what is read, or over one another's file.

    Other ways to one file are found by a run.
    """
    problems: list[Problem] = []
    streams = [node.name for node in nodes if node.plugin.streams()]
    for name in streams[1:]:
        message = f"sink '{name}' would write to standard output beside sink '{streams[0]}'"
        problems.append(document.problem(("sinks", name), message, key=True))
    files: dict[str, tuple[Path, ...]] = {}
    for node in nodes:
        with suppress(Exception):  # of a plugin, whose fault a run tells of
            files[node.name] = files_of(node, RunInfo("{recording}", {}))
    read = files.pop(nodes[0].name, ())
    for name, harm in clashes(read, files):
        problems.append(document.problem(("sinks", name), f"sink '{name}' {harm}", key=True))
    return problems


def _node(
    document: Document,
    registry: Registry,
    kind: Kind,
    at: Location,
    entry: dict[str, Any],
    problems: list[Problem],
) -> Node | None:
    settings = {k: v for k, v in entry.items() if k not in WORDS}
    use, inputs, delivery = entry.get("use"), entry.get("inputs", {}), entry.get("delivery")
    if not isinstance(use, str):
        together = any(key.startswith("use:") for key in entry)
        hint = "a space after the colon, as in 'use: name'" if together else ""
        problems.append(document.problem(at, f"needs 'use': the name of a {kind}", hint, key=True))
        return None
    if not isinstance(inputs, dict) or not all(isinstance(v, str) for v in inputs.values()):
        problems.append(document.problem((*at, "inputs"), "expected {parameter: stage name}"))
        inputs = {}
    if delivery not in ((None, "every", "latest") if kind == "sink" else (None,)):
        message = "expected 'every' or 'latest', on a sink"
        problems.append(document.problem((*at, "delivery"), message))
    base = Path.cwd() if (*at, "use") in document.overrides else document.base
    try:
        plugin_class = registry.find(kind, use, base)
        ports = ports_of(plugin_class)
    except PluginError as error:
        problems.append(document.problem((*at, "use"), str(error)))
        # every source gives the same: what is below it can be looked at without
        return Node("source", kind, use, Source(), OF_SOURCE) if kind == "source" else None
    if (*at, "use") in document.overrides:
        settings = _drop_foreign(document, at, use, plugin_class, settings)
        inputs = {k: v for k, v in inputs.items() if k in {port.name for port in ports.inputs}}
    try:
        settings = {**default_paths(plugin_class, settings), **settings}
        shell = document.from_shell(at)
        plugin = read_settings(plugin_class, settings, document.base.absolute(), shell)
    except ValidationError as error:
        problems += faults_of(document, at, error, plugin_class, use)
        # never run, but its ports say whether it is wired
        return Node(str(at[-1]), kind, use, Plugin(), ports, dict(inputs), delivery)
    if fault := writing_fault(plugin):
        message = f"the settings of '{use}' cannot be written into a graph and read again: {fault}"
        problems.append(document.problem((*at, "use"), message))
    if in_file(use):
        use = str(real(base / from_home(use)))
    attributes = settings_of(plugin_class)
    meant = {key: getattr(plugin, attributes.get(key, key), None) for key in settings}
    paths = {key: str(settings[key]) for key, value in meant.items() if isinstance(value, Path)}
    read = tuple(
        (Path.cwd() if key in shell else document.base) / from_home(settings[key])
        for key, value in meant.items()
        if isinstance(value, Transform) and isinstance(settings[key], str)
    )
    return Node(str(at[-1]), kind, use, plugin, ports, dict(inputs), delivery, {}, paths, read)


def _drop_foreign(
    document: Document, at: Location, use: str, plugin: type[Plugin], settings: dict[str, Any]
) -> dict[str, Any]:
    """Drop the settings a swapped-in plugin does not know, unless the command line set them."""
    foreign = settings.keys() - settings_of(plugin).keys() - document.from_shell(at)
    for key in sorted(foreign):
        document.warnings.append(f"{at[-1]}: '{use}' has no setting '{key}'; it is dropped")
    return {key: value for key, value in settings.items() if key not in foreign}
