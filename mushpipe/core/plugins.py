"""Finding plugins: one entry-point group, one pluggy hook, each loaded in its own guard."""

from __future__ import annotations

import importlib
import importlib.util
import logging
import os
import re
import sys
import traceback
import zlib
from collections import defaultdict
from collections.abc import Iterable, Iterator
from contextlib import contextmanager, redirect_stdout
from dataclasses import dataclass, field
from importlib.abc import Loader
from importlib.machinery import ModuleSpec
from importlib.metadata import EntryPoint, entry_points
from pathlib import Path
from types import ModuleType
from typing import Any, cast

import pluggy
from pluggy import PluginValidationError

from mushpipe.core.errors import DependencyError, PluginError, suggest
from mushpipe.core.paths import from_home, real
from mushpipe.core.stage import Kind, Plugin, require_kind

logger = logging.getLogger("mushpipe")

GROUP = "mushpipe"
_MORE = "\n\nFor further information visit"  # pydantic's pages, in each of its errors
# files that stand in a traceback before those of a plugin that is imported
_LOADERS = ("<frozen ", __file__, *importlib.__path__, *pluggy.__path__)
hookspec = pluggy.HookspecMarker(GROUP)
hookimpl = pluggy.HookimplMarker(GROUP)


class _Hooks:
    @hookspec
    def mushpipe_register(self, registry: Registry) -> None:
        """Register plugins by calling ``registry.stage(name, target)`` and its siblings."""


@contextmanager
def prints_aside() -> Iterator[None]:
    """Send what plugins print to stderr: standard output is for results, a recording maybe."""
    with redirect_stdout(sys.stderr):
        yield


@dataclass(frozen=True)
class Entry:
    """A registered name. ``target`` is the class or ``"package.module:Class"``."""

    kind: Kind
    name: str
    target: type[Plugin] | str
    distribution: str
    version: str

    def load(self) -> type[Plugin]:
        """Import the class.

        Raises:
            PluginError: It cannot be imported, or is of another kind.
            DependencyError: It needs a library that this system lacks.
        """
        where = f"{self.kind} '{self.name}' of {self.distribution} {self.version}".strip()
        try:
            plugin = _import(self.target) if isinstance(self.target, str) else self.target
        except DependencyError:
            raise
        except (Exception, SystemExit) as error:
            raise PluginError(f"{where} cannot be imported: {_brief(error)}") from error
        require_kind(plugin, self.kind, where)
        return plugin


@dataclass(frozen=True)
class Broken:
    """An entry point that failed to load, with the reason."""

    name: str
    distribution: str
    version: str
    reason: str


@dataclass
class Registry:
    """The names a graph may use, and what failed while collecting them."""

    entries: dict[tuple[Kind, str], list[Entry]] = field(default_factory=lambda: defaultdict(list))
    broken: list[Broken] = field(default_factory=list)
    _owner: tuple[str, str] = ("this process", "")

    def stage(self, name: str, target: type[Plugin] | str) -> None:
        """Register a stage; a ``"package.module:Class"`` is imported when a graph uses it."""
        self._add("stage", name, target)

    def source(self, name: str, target: type[Plugin] | str) -> None:
        """Register a source."""
        self._add("source", name, target)

    def sink(self, name: str, target: type[Plugin] | str) -> None:
        """Register a sink."""
        self._add("sink", name, target)

    def _add(self, kind: Kind, name: str, target: type[Plugin] | str) -> None:
        placed = isinstance(target, type) or (isinstance(target, str) and ":" in target)
        if not placed or not re.fullmatch(r"[\w-]+", name):
            raise PluginError(
                f"{kind} {name!r} is registered as {target!r}: expected a name of letters, digits, "
                "_ and -, and a class or 'package.module:Class'"
            )
        self.entries[kind, name].append(Entry(kind, name, target, *self._owner))

    def names(self, kind: Kind) -> list[str]:
        """Return the registered names of one kind, sorted."""
        return sorted(name for k, name in self.entries if k == kind)

    def find(self, kind: Kind, use: str, base: Path) -> type[Plugin]:
        """Return the class that ``use`` names.

        Args:
            kind: What is looked for.
            use: A registered name, ``distribution:name``, or ``path/to/file.py:Class``.
            base: Folder that a relative file path starts from.

        Raises:
            PluginError: Unknown, ambiguous, broken or of the wrong kind.
        """
        if in_file(use):
            plugin = class_in_file(use, base)
            require_kind(plugin, kind, use)
            return plugin
        distribution, _, name = use.rpartition(":")
        found = [
            entry
            for entry in self.entries.get((kind, name), [])
            if _normal(distribution) in ("", _normal(entry.distribution))
        ]
        if len(found) == 1:
            return found[0].load()
        if found:
            by = " and ".join(f"{e.distribution} {e.version}".strip() for e in found)
            choice = sorted({f"'{e.distribution}:{name}'" for e in found})
            cure = f"write {' or '.join(choice)}" if len(choice) > 1 else "register it there once"
            raise PluginError(f"{kind} '{name}' is provided by {by}; {cure}")
        raise PluginError(self._unknown(kind, use))

    def _unknown(self, kind: Kind, use: str) -> str:
        text = f"unknown {kind} '{use}'; {suggest(use, self.names(kind))}"
        for other in ("stage", "source", "sink"):
            if (other, use) in self.entries:
                text = f"'{use}' is a {other}, not a {kind}"
        return text + self.not_loaded()

    def not_loaded(self) -> str:
        """Return lines on why a name may be unknown: packages that failed or were left out."""
        lines = [
            f"it may belong to {b.distribution} {b.version}, which failed to load: {b.reason}"
            for b in self.broken
        ]
        if (narrowed := os.environ.get("MUSHPIPE_PLUGINS")) is not None:  # "" leaves out all
            lines = [f"only plugins of MUSHPIPE_PLUGINS={narrowed} are loaded", *lines]
        return "".join(f"\n    {line}" for line in lines)


def load_registry() -> Registry:
    """Collect the plugins of all installed distributions.

    ``MUSHPIPE_PLUGINS`` (a comma list of distributions, or empty) narrows them; the built-in ones
    are always there.
    """
    registry = Registry()
    found = sorted(entry_points(group=GROUP), key=lambda e: (_owner(e)[0] != GROUP, _owner(e)))
    wanted = os.environ.get("MUSHPIPE_PLUGINS")
    if wanted is not None:
        keep = {GROUP, *(_normal(name.strip()) for name in wanted.split(","))}
        found = [point for point in found if _normal(_owner(point)[0]) in keep]
        unknown = keep - {"", *(_normal(_owner(point)[0]) for point in found)}
        if unknown:
            names = ", ".join(sorted(unknown))
            logger.warning("MUSHPIPE_PLUGINS: no plugins are installed by %s", names)
    register(registry, found)
    return registry


def _normal(distribution: str) -> str:
    """Return the name by which a distribution is known, however it is written (PEP 503)."""
    return re.sub(r"[-_.]+", "-", distribution).lower()


def register(registry: Registry, points: Iterable[EntryPoint]) -> None:
    """Load entry points into the registry; a failure becomes a row of ``registry.broken``."""
    manager = pluggy.PluginManager(GROUP)
    manager.add_hookspecs(_Hooks)
    for point in {(_owner(p), p.value): p for p in points}.values():  # each module once
        distribution, version = registry._owner = _owner(point)
        before = sum(map(len, registry.entries.values()))
        module = None
        try:
            with prints_aside():
                module = point.load()
                manager.register(module)
                manager.check_pending()
                others = manager.get_plugins() - {module}
                manager.subset_hook_caller("mushpipe_register", others)(registry=registry)
            if sum(map(len, registry.entries.values())) == before:
                cure = f"its entry point must name the module, {point.module}, not {point.value}"
                cure = "is @mushpipe.hookimpl missing?" if isinstance(module, ModuleType) else cure
                raise PluginError(f"it registers nothing: {cure}")
        except (Exception, SystemExit) as error:
            registry.broken.append(Broken(point.name, distribution, version, _brief(error)))
            if module is not None and manager.is_registered(module):
                manager.unregister(module)  # else its fault would be found again with the next one


def _owner(point: EntryPoint) -> tuple[str, str]:
    return (point.dist.name, point.dist.version) if point.dist else ("an unknown package", "")


def _brief(error: BaseException) -> str:
    misspelt = isinstance(error, PluginValidationError) and "unknown hook" in str(error)
    hint = "; expected mushpipe_register" if misspelt else ""
    return f"{type(error).__name__}: {str(error).partition(_MORE)[0]}{hint}{_place(error)}"


def _place(error: BaseException) -> str:
    """Return the line of the plugin's own module at which an error came up, as Python writes it."""
    if isinstance(error, SyntaxError):  # it names its line itself
        return ""
    steps = traceback.extract_tb(error.__traceback__)
    files = [(Path(step.filename), step.lineno) for step in steps]
    files = [each for each in files if not str(each[0]).startswith(_LOADERS)]
    # what it calls in other packages is not where it has to be changed
    own = [each for each in files if each[0].parent == files[0][0].parent]
    return f" ({own[-1][0].name}, line {own[-1][1]})" if own else ""


def _import(target: str) -> Any:
    module, _, name = target.partition(":")
    with prints_aside():
        return getattr(importlib.import_module(module), name)


def in_file(use: str) -> bool:
    """Whether a text names a plugin by its file."""
    return ".py:" in use or use.endswith(".py")


def class_in_file(use: str, base: Path) -> type[Plugin]:
    """Return the class that ``path/to/file.py:Class`` names.

    Raises:
        PluginError: There is no such file or class, or it cannot be imported.
    """
    path_text, _, name = use.rpartition(":") if ".py:" in use else (use, "", "")
    try:
        path = real(base / from_home(path_text))
        str(path).encode()
    except ValueError as error:  # of a NUL; and what is not UTF-8 cannot stand in a manifest
        raise PluginError(f"{use!r} cannot be the name of a file: {error}") from error
    module = _module_of_file(path)
    if not name:
        known = ", ".join(_classes(module)) or "none"
        raise PluginError(f"'{use}' says no class: write '{path_text}:CLASS'; it has {known}")
    plugin = getattr(module, name, None)
    if plugin is None:
        raise PluginError(f"{path} has no class '{name}'; {suggest(name, _classes(module))}")
    return plugin  # type: ignore[no-any-return]


def _classes(module: ModuleType) -> list[str]:
    """Return the names of the classes that a module defines itself."""
    values = vars(module).items()
    return [n for n, v in values if isinstance(v, type) and v.__module__ == module.__name__]


def _module_of_file(path: Path) -> ModuleType:
    # Loaded once per process: two stages of one file must share the types it defines.
    module_name = f"mushpipe_file_{zlib.crc32(str(path).encode()):08x}_{path.stem}"
    if module_name in sys.modules:
        return sys.modules[module_name]
    if not path.is_file():
        raise PluginError(f"there is no file {path}")
    spec = importlib.util.spec_from_file_location(module_name, path)
    module = importlib.util.module_from_spec(cast(ModuleSpec, spec))
    sys.modules[module_name] = module
    try:
        with prints_aside():
            cast(Loader, cast(ModuleSpec, spec).loader).exec_module(module)
    except (Exception, SystemExit) as error:
        del sys.modules[module_name]
        raise PluginError(f"{path} cannot be imported: {_brief(error)}") from error
    return module
