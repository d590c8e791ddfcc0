"""A graph as a picture in text: Mermaid for Markdown, DOT for Graphviz."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

from mushpipe.core.plan import Node, Plan
from mushpipe.core.plugins import in_file
from mushpipe.core.stage import Sink
from mushpipe.core.types import Trace

_SHAPES = {"source": ("([", "])"), "stage": ("[", "]"), "sink": ("[/", "/]")}
_EVERYTHING = "everything"
_DOT_SHAPES = {"source": "oval", "stage": "box", "sink": "parallelogram"}


def _edges(plan: Plan) -> Iterator[tuple[str, str, str]]:
    """Yield (producer, consumer, type); a sink that takes everything hangs below the last stage."""
    types = {node.name: node.ports.outputs for node in plan.nodes}
    for node in plan.nodes:
        for link in node.links.values():
            yield link.producer, node.name, types[link.producer][link.output].__name__
        if any(port.type is Trace for port in node.ports.inputs):
            yield (plan.source, *plan.stages)[-1].name, node.name, _EVERYTHING


def _text(node: Node) -> tuple[str, str]:
    """Return a node's name, and what it is; a sink with its delivery under a camera.

    Whether the source is one shows when it is open.
    """
    delivery = f", {node.delivery or node.plugin.delivery}" if isinstance(node.plugin, Sink) else ""
    use = Path(node.use).name if in_file(node.use) else node.use  # alike in every folder
    return node.name, f"{use}{delivery}"


def mermaid(plan: Plan) -> str:
    """Return a Mermaid flowchart, edges labelled with port types."""
    ids = {node.name: f"n{i}" for i, node in enumerate(plan.nodes)}
    lines = ["flowchart TD"]
    for node in plan.nodes:
        begin, end = _SHAPES[node.kind]
        name, detail = _text(node)
        lines.append(f'  {ids[node.name]}{begin}"{name}<br/><small>{detail}</small>"{end}')
    for producer, consumer, label in _edges(plan):
        arrow = f"{'-.->' if label == _EVERYTHING else '-->'}|{label}|"
        lines.append(f"  {ids[producer]} {arrow} {ids[consumer]}")
    return "\n".join(lines)


def dot(plan: Plan) -> str:
    """Return a Graphviz digraph, edges labelled with port types."""
    lines = ["digraph mushpipe {"]
    for node in plan.nodes:
        name, detail = _text(node)
        label = f"{name}\\n{detail}".replace('"', '\\"')
        lines.append(f'  "{name}" [shape={_DOT_SHAPES[node.kind]}, label="{label}"];')
    for producer, consumer, label in _edges(plan):
        style = f'label="{label}"{", style=dashed" if label == _EVERYTHING else ""}'
        lines.append(f'  "{producer}" -> "{consumer}" [{style}];')
    return "\n".join([*lines, "}"])
