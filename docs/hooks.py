"""mkdocs hook: a page per built-in plugin, made from its docstring, ports and settings."""

from __future__ import annotations

import inspect
from pathlib import Path
from typing import Any

from mushpipe.core.plugins import Registry, load_registry
from mushpipe.core.ports import ports_of
from mushpipe.core.stage import Kind, Plugin
from mushpipe.info import KINDS, settings_rows

TITLES = {"source": "Sources", "stage": "Stages", "sink": "Sinks"}


def on_files(files: Any, config: Any) -> Any:
    """Add the generated pages to the site."""
    from mkdocs.structure.files import File

    for place, text in pages(load_registry()).items():
        files.append(File.generated(config, place, content=text))
    return files


def pages(registry: Registry) -> dict[str, str]:
    """Return the text of every page by its place in the docs."""
    found = {place(kind, name): _page(registry, kind, name) for kind, name in builtins(registry)}
    return {"reference/index.md": _index(registry), **found}


def builtins(registry: Registry) -> list[tuple[Kind, str]]:
    """Return kind and name of every built-in plugin."""
    return [
        (kind, name)
        for kind in KINDS
        for name in registry.names(kind)
        if any(entry.distribution == "mushpipe" for entry in registry.entries[kind, name])
    ]


def place(kind: Kind, name: str) -> str:
    """Return where the page of a plugin stands in the docs."""
    return f"reference/{kind}-{name}.md"


def _find(registry: Registry, kind: Kind, name: str) -> type[Plugin]:
    return registry.find(kind, f"mushpipe:{name}", Path.cwd())


def _index(registry: Registry) -> str:
    lines = ["# Built-in plugins", "", "Made from the plugins themselves.", ""]
    for kind in KINDS:
        lines += [f"## {TITLES[kind]}", "", "| use | |", "|---|---|"]
        for other, name in builtins(registry):
            if other == kind:
                first = (inspect.getdoc(_find(registry, kind, name)) or "").splitlines()[0]
                lines.append(f"| [`{name}`]({kind}-{name}.md) | {first} |")
        lines.append("")
    return "\n".join(lines)


def _page(registry: Registry, kind: Kind, name: str) -> str:
    plugin = _find(registry, kind, name)
    ports = ports_of(plugin)
    inputs = [
        f"| `{port.name}` | {port.type.__name__} | {'' if port.required else 'optional'} |"
        for port in ports.inputs
    ]
    lines = [f"# {kind} `{name}`", "", inspect.getdoc(plugin) or "", ""]
    if inputs:
        lines += ["| input | type | |", "|---|---|---|", *inputs, ""]
    if ports.outputs:
        names = ", ".join(output.__name__ for output in ports.outputs)
        lines += [f"Output: {names}", ""]
    rows = settings_rows(plugin)
    if rows:
        lines += ["| setting | type | default | meaning |", "|---|---|---|---|"]
        lines += [f"| {' | '.join(_cells(row))} |" for row in rows]
    lines += ["", f"`{plugin.__module__}`"]
    return "\n".join(lines) + "\n"


def _cells(row: tuple[str, ...]) -> list[str]:
    name, kind, default, meaning = (text.replace("|", "\\|") for text in row)
    return [f"`{name}`", kind, f"`{default}`" if default else "", meaning]
