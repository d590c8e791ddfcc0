"""``--set a.b=value``: changing a graph from the command line."""

from __future__ import annotations

from typing import Any

from mushpipe.core.document import Document, Location, parse_value
from mushpipe.core.errors import GraphError, Problem, suggest

_WITH_PARTS = ("source", "stages", "sinks")
_TOP = ("seed", "on_error", "max_failures", *_WITH_PARTS)


def apply_override(document: Document, text: str, label: str = "") -> list[Problem]:
    """Change the document as ``path=value`` says; return what is wrong with it.

    The value is YAML. A path whose first part is no key of the graph file begins with the name
    of a stage or sink: ``segment.mu=0.2`` is ``stages.segment.mu=0.2``. The label says in
    messages where the change comes from.
    """
    label = label or f"--set {text}"
    if (fault := encoding_fault(text)) is not None:
        return [Problem(label, 0, 0, fault)]
    path, equals, value_text = text.partition("=")
    if not equals:
        return [Problem(label, 0, 0, "expected a.b=value")]
    try:
        value = parse_value(value_text, label)
    except GraphError as error:
        return error.problems
    at, message = _locate(document, path.strip())
    if message:
        return [Problem(label, 0, 0, message)]
    target: Any = document.data
    for depth, key in enumerate(at[:-1]):
        target = target.setdefault(key, {})
        if not isinstance(target, dict):
            return [Problem(label, 0, 0, f"'{'.'.join(map(str, at[: depth + 1]))}' has no parts")]
    before = target.get(at[-1])
    if (option := _set_by_option(document, at, label)) and before not in (None, value):
        return [Problem(label, 0, 0, f"{option} sets this to {before}: give one of them")]
    target[at[-1]] = value
    for marks in (document.keys, document.values):  # what the file says there no longer holds
        for place in [each for each in marks if each[: len(at)] == at]:
            del marks[place]
    document.overrides[at] = label
    return []


def _set_by_option(document: Document, at: Location, label: str) -> str:
    """Return the option that set the same before.

    Of two `--set` the last one counts, and `--source` brings a source whose settings may change.
    """
    before = document.overrides.get(at, "")
    return "" if before == label or before.startswith(("--set ", "--source ")) else before


def encoding_fault(text: str) -> str | None:
    """Say that a text of the command line is not UTF-8, as graphs and recordings are."""
    try:
        text.encode()
    except UnicodeEncodeError:
        return "this is not UTF-8: give the file another name"
    return None


def _locate(document: Document, path: str) -> tuple[Location, str]:
    """Return the place a dotted path means, or a message why there is none."""
    head, *rest = path.split(".")
    sections = {
        name: section for section in ("sinks", "stages") for name in _names(document, section)
    }
    if head in ("stages", "sinks"):
        names = _names(document, head)
        if not rest or rest[0] not in names:
            name = rest[0] if rest else ""
            return (), f"there is no '{name}' in {head}; {suggest(name, names)}"
        head, *rest = rest
        sections = dict.fromkeys(names, sections[head])
    elif head in _TOP:
        if head == "source" and not rest:
            return (), "say which setting of the source: source.path=..., or use --source"
        return (head, *rest), ""
    if head not in sections:
        known = suggest(head, [*sections, *(_WITH_PARTS if rest else _TOP)])
        swap = "NAME.use=... gives a stage or sink of the graph another plugin; "
        return (), f"unknown path '{path}'; {swap if rest == ['use'] else ''}{known}"
    if not rest:
        return (), f"say which setting of '{head}': {head}.use=... for example"
    return (sections[head], head, *rest), ""


def _names(document: Document, section: str) -> list[str]:
    entries = document.data.get(section)
    return list(entries) if isinstance(entries, dict) else []
