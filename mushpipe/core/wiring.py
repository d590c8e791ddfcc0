"""Who feeds whom: an input takes the nearest producer of its type above it in the file.

An optional input beside another one of its type is left open, unless the graph or a setting asks
for it: the nearest goes to the other, and which of those farther up is meant cannot be known.
"""

from __future__ import annotations

from collections.abc import Set
from contextlib import suppress

from mushpipe.core.columns import Columns
from mushpipe.core.document import Document, Location
from mushpipe.core.errors import MushpipeError, Problem, suggest
from mushpipe.core.plan import Link, Node
from mushpipe.core.plugins import Registry
from mushpipe.core.ports import Port, ports_of
from mushpipe.core.tables import Circles, Locations, Poses
from mushpipe.core.types import Trace

_SHARE = "plugins share a type that they import from one package, or define in one file"


def wire(
    document: Document, registry: Registry, nodes: list[Node], unknown: Set[str]
) -> list[Problem]:
    """Fill the links of all nodes, given source first, then stages, then sinks, in file order.

    Of stages that are `unknown`, by their names, nobody can say what they produce: what may come
    from them is no fault.

    A stage of whose outputs nobody takes one becomes a warning of the document, and so do an input
    that is left open though a stage above needs one of that name, and locations or poses that are
    of other circles than those they come together with.
    """
    problems = _check_names(document, nodes)
    for position, node in enumerate(nodes):
        above = [other for other in nodes[:position] if other.kind != "sink"]
        misspelt = node.asked.keys() - {port.name for port in node.ports.inputs}
        for name in sorted(misspelt):
            at = (*_place(node), "inputs", name)
            hint = suggest(name, [port.name for port in node.ports.inputs])
            problems.append(document.problem(at, f"'{node.use}' has no input '{name}'", hint, True))
        for port in node.ports.inputs:
            if port.type is Trace and node.kind == "sink":
                if port.name in node.asked:
                    at = (*_place(node), "inputs", port.name)
                    message = f"'{port.name}' of '{node.use}' is everything that all stages found"
                    problems.append(document.problem(at, message, "leave it out", key=True))
                continue
            problem = _connect(document, registry, node, port, above, nodes, unknown)
            problems += [problem] if problem else []
    if not problems:
        _warn_unused(document, nodes)
        _warn_open(document, nodes)
        _warn_mixed(document, nodes)
    return problems


def _connect(
    document: Document,
    registry: Registry,
    node: Node,
    port: Port,
    above: list[Node],
    nodes: list[Node],
    unknown: Set[str],
) -> Problem | None:
    wanted = node.asked.get(port.name)
    link = _nearest(port, wanted, above)
    if link and (wanted or not _is_second(port, node)):
        node.links[port.name] = link
        return None
    if wanted in unknown or (unknown and wanted is None):
        return None
    at = _place(node)
    if wanted is not None:
        message = _why_not(node, port, wanted, above, nodes)
        return document.problem((*at, "inputs", port.name), message)
    try:
        if not port.required and port.name not in node.plugin.required_inputs():
            return None
    except Exception as error:  # of a plugin
        message = f"'{node.use}': its required_inputs() failed: {type(error).__name__}: {error}"
        return document.problem(at, message, key=True)
    if link:
        node.links[port.name] = link
        return None
    message = f"nothing above '{node.name}' produces the {port.type.__name__} of its '{port.name}'"
    hint = _namesake(port, above) or _who_produces(registry, port)
    return document.problem(at, message, hint, key=True)


def _is_second(port: Port, node: Node) -> bool:
    """Whether an input is optional, and the nearest of its type goes to another one."""
    if port.required:
        return False
    alike = [other for other in node.ports.inputs if other.type is port.type]
    named = [other for other in alike if other.required or other.name in node.asked]
    return port is not (named or alike)[0]


def _nearest(port: Port, wanted: str | None, above: list[Node]) -> Link | None:
    for other in reversed(above):
        if wanted in (None, other.name):
            for index, produced in enumerate(other.ports.outputs):
                if issubclass(produced, port.type):
                    return Link(other.name, index)
    return None


def _check_names(document: Document, nodes: list[Node]) -> list[Problem]:
    """Return which tables have the name of another's, under whose schema they would be recorded."""
    problems = []
    made: dict[str, tuple[type, str]] = {}
    for node in nodes:
        for kind in node.ports.outputs:
            first, maker = made.setdefault(kind.__name__, (kind, node.name))
            if kind is not first and issubclass(kind, Columns):
                message = f"the {kind.__name__} of '{node.name}' is another type than '{maker}' has"
                problems.append(document.problem(_place(node), message, _SHARE, key=True))
    return problems


def _namesake(port: Port, above: list[Node]) -> str:
    """Return a hint where another type has the name of one that is missing."""
    for node in above:
        if any(kind.__name__ == port.type.__name__ for kind in node.ports.outputs):
            return f"'{node.name}' has another type of that name: {_SHARE}"
    return ""


def _place(node: Node) -> Location:
    return ("source",) if node.kind == "source" else (f"{node.kind}s", node.name)


def _why_not(node: Node, port: Port, wanted: str, above: list[Node], nodes: list[Node]) -> str:
    kind = port.type.__name__
    names = [other.name for other in above]
    if wanted in names:
        return f"'{wanted}' does not produce {kind}"
    if wanted == node.name:
        return f"a cycle: '{wanted}' feeds itself"
    below = {other.name: other for other in nodes if other.kind == "stage"}
    if wanted in below:
        feeds = node.name in _ancestors(below[wanted], nodes)
        cycle = f"a cycle: {node.name} -> {wanted} -> {node.name}; " if feeds else ""
        return f"{cycle}'{wanted}' stands below '{node.name}': the order of stages is the data flow"
    return f"there is no stage '{wanted}'; {suggest(wanted, names)}"


def _ancestors(node: Node, nodes: list[Node]) -> set[str]:
    """Return the names of all nodes that can feed a node, by the types of their outputs."""
    found: set[str] = set()
    above = nodes[: nodes.index(node)]
    for port in node.ports.inputs:
        if link := _nearest(port, node.asked.get(port.name), above):
            producer = next(other for other in above if other.name == link.producer)
            found |= {producer.name} | _ancestors(producer, nodes)
    return found


def _who_produces(registry: Registry, port: Port) -> str:
    """Return a hint that names the stages producing a type; only asked when one is missing."""
    able = []
    for name in registry.names("stage"):
        entries = registry.entries["stage", name]
        for entry in entries:
            try:
                outputs = ports_of(entry.load()).outputs
            except MushpipeError:
                continue
            use = name if len(entries) == 1 else f"{entry.distribution}:{name}"
            able += [use] if any(issubclass(t, port.type) for t in outputs) else []
    return f"stages that produce {port.type.__name__}: {', '.join(able) or 'none installed'}"


def _warn_unused(document: Document, nodes: list[Node]) -> None:
    if any(port.type is Trace for node in nodes for port in node.ports.inputs):
        return
    used = {link.producer for node in nodes for link in node.links.values()}
    for node in nodes:
        if node.kind == "stage" and node.name not in used:
            document.warnings.append(f"nobody takes what '{node.name}' produces")


def _warn_open(document: Document, nodes: list[Node]) -> None:
    taken: dict[tuple[str, type], tuple[str, str]] = {}
    for node in nodes:
        for port in node.ports.inputs:
            key = (port.name, port.type)
            if port.name in node.links:
                if _needs(node, port):
                    taken[key] = node.name, node.links[port.name].producer
            elif key in taken:
                other, producer = taken[key]
                document.warnings.append(
                    f"'{node.name}' goes without '{port.name}', which '{other}' takes from "
                    f"'{producer}': 'inputs: {{{port.name}: {producer}}}' gives it that as well"
                )


def _needs(node: Node, port: Port) -> bool:
    """Whether a node uses an input, and does not only get it because it is at hand."""
    with suppress(Exception):  # of a plugin; it is told of where the input is missing
        return port.required or port.name in {*node.asked, *node.plugin.required_inputs()}
    return False


def _warn_mixed(document: Document, nodes: list[Node]) -> None:
    named = {node.name: node for node in nodes}
    for node in nodes:
        circles = _source_of(node, Circles)
        for kind in (Locations, Poses):
            maker = _source_of(node, kind)
            seen = maker and _source_of(named[maker], Circles)
            if circles and seen and circles not in (maker, seen):
                document.warnings.append(
                    f"'{node.name}' takes the circles of '{circles}', and from '{maker}' the "
                    f"{kind.__name__.lower()} of those of '{seen}': their rows may differ"
                )


def _source_of(node: Node, kind: type) -> str | None:
    """Return the producer of an input of a type."""
    ports = [port.name for port in node.ports.inputs if port.type is kind]
    links = [node.links[name] for name in ports if name in node.links]
    return links[0].producer if links else None
