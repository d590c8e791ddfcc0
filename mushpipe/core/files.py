"""Which files a run reads and writes, as its plugins tell."""

from __future__ import annotations

from pathlib import Path

from mushpipe.core.edges import named
from mushpipe.core.errors import PluginError
from mushpipe.core.plan import Node, Plan
from mushpipe.core.plugins import in_file
from mushpipe.core.stage import RunInfo, Sink, Source


class _Planned(RunInfo):
    """A run that has not begun: files are named, and no folder is made for them."""

    def path(self, template: Path) -> Path:
        """Fill ``{recording}`` into a path."""
        return self.filled(template)


def files_read(plan: Plan) -> tuple[Path, ...]:
    """Return what a run reads: its graph, what its source plays, models, and plugins in files.

    Raises:
        StageError: The source's ``files`` failed.
        PluginError: It gave no paths.
    """
    graph = Path(plan.file)
    uses = (node.use for node in plan.nodes if in_file(node.use))
    code = (graph.parent / use.rpartition(":")[0] for use in uses)
    settings = (node.plugin.path_settings(written=False) for node in plan.nodes)
    given = (path for paths in settings for path in paths.values())
    inside = (path for node in plan.nodes for path in node.read)
    return (graph, *code, *given, *inside, *files_of(plan.source))


def files_of(node: Node, run: RunInfo | None = None) -> tuple[Path, ...]:
    """Return the files that a source reads, or that a sink writes in a run; touches nothing.

    Raises:
        StageError: The plugin's ``files`` failed.
        PluginError: It gave no paths.
    """
    plugin = node.plugin
    found: object = ()
    with named(node, "files"):
        if isinstance(plugin, Source):
            found = plugin.files()
        elif isinstance(plugin, Sink) and run is not None:
            found = plugin.files(_Planned(**vars(run)))
    if not isinstance(found, tuple | list) or not all(isinstance(path, Path) for path in found):
        raise PluginError(
            f"{node.kind} '{node.name}' ({node.use}): its files() gave {found!r}, expected a "
            "tuple of paths"
        )
    return tuple(found)


def recording_of(node: Node) -> str:
    """Return the name of what a source plays, for file names.

    Raises:
        StageError: The source's ``name`` failed.
        PluginError: It gave no text.
    """
    found: object = ""
    with named(node, "name"):
        if isinstance(node.plugin, Source):
            found = node.plugin.name()
    if not isinstance(found, str):
        raise PluginError(
            f"{node.kind} '{node.name}' ({node.use}): its name() gave {found!r}, expected text"
        )
    return found
