"""A compiled graph: what runs, in which order, and who feeds whom."""

from __future__ import annotations

from copy import deepcopy
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Literal, NamedTuple

from mushpipe.core.ports import Ports
from mushpipe.core.settings import written_settings
from mushpipe.core.stage import Kind, Plugin, Sink, Source


class Link(NamedTuple):
    """Where an input comes from: the producer's name and which of its outputs."""

    producer: str
    output: int


@dataclass
class Node:
    """A configured plugin in a graph; ``links`` is filled by the wiring.

    ``paths`` are its path settings as the user wrote them; the plugin has them resolved. ``read``
    are files whose content is a setting, as that of a transform may be.
    """

    name: str
    kind: Kind
    use: str
    plugin: Plugin
    ports: Ports
    asked: dict[str, str] = field(default_factory=dict)
    delivery: Literal["every", "latest"] | None = None
    links: dict[str, Link] = field(default_factory=dict)
    paths: dict[str, str] = field(default_factory=dict)
    read: tuple[Path, ...] = ()

    def resolved(self) -> dict[str, Any]:
        """Return the node's entry in a graph file, with every setting written out."""
        entry: dict[str, Any] = {"use": self.use, **written_settings(self.plugin)}
        if self.asked:
            entry["inputs"] = self.asked
        if self.delivery:
            entry["delivery"] = self.delivery
        return entry

    def fresh(self) -> Node:
        """Return a node whose plugin has no state yet."""
        # Built anew, not deep-copied: state may hold what cannot be copied, a lock say.
        kind, plugin = type(self.plugin), self.plugin
        fields = {name: getattr(plugin, name) for name in kind.model_fields}
        settings = deepcopy({**fields, **(plugin.model_extra or {})})
        return replace(self, plugin=kind.model_construct(set(settings), **settings))


@dataclass(frozen=True)
class Plan:
    """A graph that is ready to run."""

    file: str
    source: Node
    stages: tuple[Node, ...]
    sinks: tuple[Node, ...]
    seed: int = 0
    on_error: Literal["fail", "skip"] | None = None
    max_failures: int = 10
    overrides: tuple[str, ...] = ()
    warnings: tuple[str, ...] = ()

    @property
    def nodes(self) -> tuple[Node, ...]:
        """All nodes, in the order in which frames pass them."""
        return (self.source, *self.stages, *self.sinks)

    def into(self, folder: Path) -> Plan:
        """Return a plan whose sinks write into a folder of their own within one."""

        def moved(node: Node) -> Node:
            if not isinstance(node.plugin, Sink):
                return node
            return replace(node, plugin=node.plugin.into(folder / node.name))

        return replace(self, sinks=tuple(map(moved, self.sinks)))

    def fresh(self) -> Plan:
        """Return a plan whose plugins have no state yet."""
        return replace(
            self,
            source=self.source.fresh(),
            stages=tuple(node.fresh() for node in self.stages),
            sinks=tuple(node.fresh() for node in self.sinks),
        )

    def resolved(self) -> dict[str, Any]:
        """Return the graph as the data of a graph file, with every setting written out."""
        return {
            "mushpipe": 1,
            "seed": self.seed,
            "on_error": self.on_error,
            "max_failures": self.max_failures,
            "source": self.source.resolved(),
            "stages": {node.name: node.resolved() for node in self.stages},
            "sinks": {node.name: node.resolved() for node in self.sinks},
        }

    def replay(self) -> bool:
        """Return whether the source can be played again."""
        return not (isinstance(self.source.plugin, Source) and self.source.plugin.live)

    def missing_files(self) -> list[str]:
        """Return, in words, what source and stages are to read and what is not there."""
        return [
            f"{node.name}: there is no file {value} ({name})"
            for node in (self.source, *self.stages)
            for name, value in node.plugin.path_settings(written=False).items()
            if not value.exists()
        ]

    def delivery(self, sink: Node) -> Literal["every", "latest"]:
        """Return how a sink is fed; a replay never drops."""
        if self.replay() or not isinstance(sink.plugin, Sink):
            return "every"
        return sink.delivery or sink.plugin.delivery
