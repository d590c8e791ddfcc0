"""A YAML file as plain data plus the place of every key and value in it."""

from __future__ import annotations

import re
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import yaml

from mushpipe.core.errors import GraphError, Problem

Location = tuple[str | int, ...]
MAX_BYTES = 2_000_000
MAX_NODES = 20_000
MAX_DEPTH = 50
# What PyYAML raises on text that is no YAML: an escape like "\UFFFFFFFF" is an OverflowError.
_UNREADABLE = (yaml.YAMLError, RecursionError, ValueError, OverflowError)
# Octal with a plain zero and sexagesimal numbers of YAML 1.1: nobody who writes 010 or 1:20 means 8
# or 80.
_OLD_NUMBER = re.compile(r"[-+]?0[0-9_]|.*:")
_COLLECTIONS = {"map", "seq"}
_SCALARS = {"null", "bool", "int", "float", "str", "timestamp"}


class _Loader(yaml.SafeLoader):
    """Reads 1e-3 and -.1 as numbers, as YAML 1.2 and people do; YAML 1.1 wants 1.0e-3 and -0.1."""


_Loader.add_implicit_resolver(
    "tag:yaml.org,2002:float",
    re.compile(r"[-+]?(\d+(\.\d*)?[eE][-+]?\d+|\.\d+([eE][-+]?\d+)?)$"),
    list("-+.0123456789"),
)


@dataclass
class Document:
    """The data of a graph file; ``keys`` and ``values`` give line and column of each, from 1."""

    file: str
    base: Path
    data: dict[str, Any] = field(default_factory=dict)
    lines: list[str] = field(default_factory=list)
    keys: dict[Location, tuple[int, int]] = field(default_factory=dict)
    values: dict[Location, tuple[int, int]] = field(default_factory=dict)
    overrides: dict[Location, str] = field(default_factory=dict)
    warnings: list[str] = field(default_factory=list)

    def problem(self, at: Location, message: str, hint: str = "", key: bool = False) -> Problem:
        """Place a message at a location, or at the nearest place above it that is in the file."""
        node = at[: 2 if at[:1] in (("stages",), ("sinks",)) else 1]
        if node and at not in self.overrides:  # the command line may be what it does not go with
            below = {key: label for key, label in self.overrides.items() if key[:-1] == node}
            at_fault = (label for key, label in below.items() if at == node or key[-1] == "use")
            labels = ", ".join(dict.fromkeys(at_fault))
            message += f" (with {labels})" if labels else ""
        for end in range(len(at), -1, -1):
            if at[:end] in self.overrides:
                return Problem(self.overrides[at[:end]], 0, 0, message, hint)
            marks = self.keys if key and end == len(at) else self.values
            if at[:end] in marks:
                line, column = marks[at[:end]]
                return Problem(self.file, line, column, message, hint, self._excerpt(line))
        return Problem(self.file, 0, 0, message, hint)

    def _excerpt(self, line: int) -> str:
        return self.lines[line - 1].rstrip() if line <= len(self.lines) else ""

    def from_shell(self, at: Location) -> set[str | int]:
        """Return the keys directly below a location that the command line set."""
        return {path[len(at)] for path in self.overrides if path[: len(at)] == at != path}


def read_document(path: Path, example: str = "mushpipe: 1") -> Document:
    """Read a YAML file, which must hold a mapping; what such a one is like is the `example`.

    Raises:
        GraphError: It is missing, not UTF-8, not YAML, not a mapping, has a key twice, a tag
            other than the plain ones, or is too large, before or after aliases are expanded.
    """
    try:
        with path.open("rb") as file:
            content = file.read(MAX_BYTES + 1)
        if len(content) > MAX_BYTES:
            message = (
                f"it has more than {MAX_BYTES / 1e6:g} MB: expected a mapping such as '{example}'; "
                "a recording is no graph: a graph plays it, with --source"
            )
            raise GraphError([Problem(str(path), 0, 0, message)])
        text = content.decode()
    except FileNotFoundError:
        raise GraphError([Problem(str(path), 0, 0, "there is no such file")]) from None
    except UnicodeDecodeError as error:
        before = error.object[: error.start].split(b"\n")
        message = f"not UTF-8: the byte 0x{error.object[error.start]:02x} ({error.reason})"
        raise GraphError([Problem(str(path), len(before), len(before[-1]) + 1, message)]) from error
    except OSError as error:
        raise GraphError([Problem(str(path), 0, 0, f"cannot be read: {error.strerror}")]) from error
    return parse_document(text, str(path), path.parent, example)


def parse_document(text: str, file: str, base: Path, example: str = "mushpipe: 1") -> Document:
    """Parse YAML text; see `read_document`."""
    document = Document(file, base, lines=text.splitlines())
    try:
        root = yaml.compose(text, Loader=_Loader)
    except yaml.MarkedYAMLError as error:
        mark = error.problem_mark or error.context_mark
        line, column = (mark.line + 1, mark.column + 1) if mark else (0, 0)
        excerpt = document._excerpt(line) if line else ""
        problem = error.problem or error.context or ""
        whole = f"{error.context}, {problem}" if problem.startswith("but ") else problem
        message = f"not valid YAML: {whole}"
        raise GraphError([Problem(file, line, column, message, "", excerpt)]) from error
    except _UNREADABLE as error:
        reason = "it is nested too deeply" if isinstance(error, RecursionError) else error
        line = column = 0
        if isinstance(error, yaml.reader.ReaderError):
            before = text[: error.position].split("\n")
            line, column = len(before), len(before[-1]) + 1
            reason = f"the character #x{ord(text[error.position]):04x} cannot stand in YAML"
        raise GraphError([Problem(file, line, column, f"not valid YAML: {reason}")]) from error
    builder = _Builder(document)
    data = builder.build(root, ()) if root else None
    if not builder.problems and not isinstance(data, dict):
        builder.problems.append(Problem(file, 1, 1, f"expected a mapping such as '{example}'"))
    if builder.problems or not isinstance(data, dict):
        raise GraphError(builder.problems)
    document.data = data
    return document


def parse_value(text: str, label: str) -> Any:
    """Return the data that a YAML value means; text that is no YAML stands for itself.

    Raises:
        GraphError: It is YAML, but not plain data; the label says where it comes from.
    """
    if text == "-":  # a list of nothing in YAML; who types it means standard output
        return text
    try:
        root = yaml.compose(text, Loader=_Loader)
    except _UNREADABLE:
        return text
    builder = _Builder(Document(label, Path()))
    value = builder.build(root, ()) if root else None
    if builder.problems:
        raise GraphError(Problem(label, 0, 0, problem.message) for problem in builder.problems)
    return value


class _Builder:
    """Turns a tree of YAML nodes into data, noting places and collecting problems."""

    def __init__(self, document: Document) -> None:
        self.document = document
        self.problems: list[Problem] = []
        self.nodes = 0
        self.loader = yaml.SafeLoader("")

    def build(self, node: yaml.Node, at: Location) -> Any:
        self.document.values[at] = (node.start_mark.line + 1, node.start_mark.column + 1)
        self.nodes += 1
        if self.nodes > MAX_NODES or len(at) > MAX_DEPTH:
            if self.nodes >= 0:
                deep = len(at) > MAX_DEPTH
                self._object(
                    at, "nested too deeply" if deep else "too large after its aliases are expanded"
                )
            self.nodes = -(10**9)  # said once; unwind without building more
            return None
        if self.nodes < 0:
            return None
        tag = node.tag.removeprefix("tag:yaml.org,2002:")
        if tag not in (_SCALARS if isinstance(node, yaml.ScalarNode) else _COLLECTIONS):
            self._object(at, f"the tag '{node.tag}' is not allowed: plain values only")
            return None
        if isinstance(node, yaml.MappingNode):
            return dict(self._pairs(node, at))
        if isinstance(node, yaml.SequenceNode):
            return [self.build(item, (*at, i)) for i, item in enumerate(node.value)]
        return self._scalar(node, tag, at)

    def _pairs(self, node: yaml.MappingNode, at: Location) -> Iterator[tuple[str, Any]]:
        for key_node, value_node in node.value:
            key = key_node.value if isinstance(key_node, yaml.ScalarNode) else "?"
            place = (*at, key)
            mark = (key_node.start_mark.line + 1, key_node.start_mark.column + 1)
            if key_node.tag.endswith(":merge"):
                text, hint = "a merge key (<<) is not known here", "write the settings out"
            elif first := self.document.keys.get(place):
                text, hint = f"the key '{key}' stands twice", f"it stands first in line {first[0]}"
            else:
                self.document.keys[place] = mark
                yield key, self.build(value_node, place)
                continue
            excerpt = self.document._excerpt(mark[0])
            self.problems.append(Problem(self.document.file, *mark, text, hint, excerpt))

    def _scalar(self, node: yaml.Node, tag: str, at: Location) -> Any:
        if tag == "timestamp":
            return node.value
        try:
            value = self.loader.construct_object(node)
            if tag in ("int", "float") and _OLD_NUMBER.match(node.value):
                text = f"'{node.value}' is {value} in YAML: write that number, or quotes around it"
                self._object(at, text)
            return value
        except (ValueError, LookupError, yaml.YAMLError):
            self._object(at, f"not a valid {tag}: '{node.value}'")
            return None

    def _object(self, at: Location, message: str) -> None:
        self.problems.append(self.document.problem(at, message))
