"""Finding plugins: entry points, the hook, files, and everything that can be wrong with them."""

import sys
from importlib.metadata import EntryPoint
from pathlib import Path

import pytest

from mushpipe import Stage
from mushpipe.core.errors import DependencyError, GraphError, PluginError
from mushpipe.core.plugins import Registry, load_registry, register
from tests.core.lab import Both, Frames, Invert, Lab, Threshold, cli

HEADER = "import mushpipe\nfrom mushpipe import Mask, Registry, RgbdFrame, Stage\n"
GOOD = (
    HEADER
    + """
class Nothing(Stage):
    def process(self, frame: RgbdFrame) -> Mask:
        return Mask(frame.gray > 2)

@mushpipe.hookimpl
def mushpipe_register(registry: Registry) -> None:
    registry.stage("nothing", Nothing)
"""
)


def install(folder: Path, package: str, code: str, version: str = "1.2") -> None:
    """Lay a package and its metadata into a folder as pip would."""
    (folder / package).mkdir()
    (folder / package / "__init__.py").write_text(code)
    info = folder / f"{package}-{version}.dist-info"
    info.mkdir()
    (info / "METADATA").write_text(f"Metadata-Version: 2.1\nName: {package}\nVersion: {version}\n")
    (info / "entry_points.txt").write_text(f"[mushpipe]\nplugins = {package}\n")


@pytest.fixture
def site(tmp_path, monkeypatch):
    """A folder on the path to install packages into; what was imported from it is forgotten."""
    folder = tmp_path / "site"
    folder.mkdir()
    monkeypatch.syspath_prepend(folder)
    before = set(sys.modules)
    yield folder
    for name in set(sys.modules) - before:
        if str(folder) in str(getattr(sys.modules[name], "__file__", None)):
            del sys.modules[name]


def find(registry: Registry, use: str, base: Path = Path()) -> type:
    return registry.find("stage", use, base)


def test_an_installed_package_is_found_beside_the_builtin_ones(site):
    install(site, "fungus", GOOD)
    registry = load_registry()
    assert registry.broken == []
    assert find(registry, "nothing").__module__ == "fungus"
    (entry,) = registry.entries["stage", "nothing"]
    assert (entry.distribution, entry.version) == ("fungus", "1.2")
    assert {"otsu", "hough", "picks"} < set(registry.names("stage"))


def test_what_a_package_prints_on_import_is_no_output(site, capsys):
    """It would stand before the first byte of `record -o -`, or within JSON."""
    install(site, "fungus", "print('hello')\n" + GOOD.replace("Nothing)", "'fungus.more:Late')"))
    (site / "fungus" / "more.py").write_text("print('late')\nfrom fungus import Nothing as Late")
    find(load_registry(), "nothing")
    assert capsys.readouterr() == ("", "hello\nlate\n")


def test_builtin_plugins_are_not_imported_before_they_are_used():
    registry = load_registry()
    (entry,) = registry.entries["stage", "otsu"]
    assert entry.target == "mushpipe.stages.otsu:Otsu"
    assert find(registry, "otsu").__name__ == "Otsu"


BROKEN = {
    "import error": (
        "import no_such_library\n",
        "ModuleNotFoundError: No module named 'no_such_library'",
    ),
    "any exception": ("1 / 0\n", "ZeroDivisionError: division by zero"),
    "it wants to leave": ("raise SystemExit('bye')\n", "SystemExit: bye"),
    "syntax": ("def\n", "SyntaxError: invalid syntax"),
    "misspelt hook": (
        GOOD.replace("def mushpipe_register", "def mushpipe_registr"),
        "PluginValidationError: unknown hook 'mushpipe_registr' in plugin",
    ),
    "wrong arguments": (
        GOOD.replace("registry: Registry", "everything"),
        "PluginValidationError: Plugin 'fungus' for hook 'mushpipe_register'",
    ),
    "no decorator": (
        GOOD.replace("@mushpipe.hookimpl", ""),
        "PluginError: it registers nothing: is @mushpipe.hookimpl missing?",
    ),
    "a hook that fails": (
        GOOD.replace('registry.stage("nothing", Nothing)', "registry.stages()"),
        "AttributeError: 'Registry' object has no attribute 'stages'",
    ),
}


@pytest.mark.parametrize(("code", "reason"), BROKEN.values(), ids=BROKEN)
def test_a_broken_package_stops_no_other_and_is_quoted(site, code, reason):
    install(site, "aaa", GOOD.replace('"nothing"', '"first"'))
    install(site, "fungus", code)
    install(site, "zzz", GOOD.replace('"nothing"', '"last"'))
    registry = load_registry()
    (broken,) = registry.broken
    assert (broken.name, broken.distribution, broken.version) == ("plugins", "fungus", "1.2")
    assert broken.reason.startswith(reason)
    assert ("; expected mushpipe_register" in broken.reason) is ("unknown hook" in reason)
    assert find(registry, "first")
    assert find(registry, "last")
    with pytest.raises(PluginError) as caught:
        find(registry, "anything")
    assert str(caught.value).endswith(
        f"\n    it may belong to fungus 1.2, which failed to load: {broken.reason}"
    )


def test_an_entry_point_that_names_the_function_is_told_to_name_the_module(site):
    install(site, "fungus", GOOD)
    (file,) = site.glob("fungus-*/entry_points.txt")
    file.write_text(f"{file.read_text().strip()}:mushpipe_register\n")
    (broken,) = load_registry().broken
    cure = "its entry point must name the module, fungus, not fungus:mushpipe_register"
    assert broken.reason.startswith(f"PluginError: it registers nothing: {cure}")


def test_the_program_quotes_a_broken_package_where_a_graph_asks_for_its_name(
    site, tmp_path, monkeypatch, capsys
):
    install(site, "fungus", "1 / 0\n")
    graph = tmp_path / "graph.yaml"
    graph.write_text("mushpipe: 1\nsource: {use: synthetic}\nstages: {a: {use: fungify-all}}\n")
    assert cli(monkeypatch, "validate", graph) == 2
    error = capsys.readouterr().err
    assert error.startswith(f"error: {graph}:3:19: unknown stage 'fungify-all'; known: ")
    reason = "which failed to load: ZeroDivisionError: division by zero (__init__.py, line 1)\n"
    assert f"it may belong to fungus 1.2, {reason}" in error


def test_a_broken_object_as_entry_point_stops_no_other(site):
    # The entry point may name any object with the hook, not only a module.
    hooks = (
        "class Hooks:\n    @mushpipe.hookimpl\n    def mushpipe_x(self): ...\n\nhooks = Hooks()\n"
    )
    install(site, "aaa", HEADER + hooks)
    info = site / "aaa-1.2.dist-info" / "entry_points.txt"
    info.write_text("[mushpipe]\nplugins = aaa:hooks\n")
    install(site, "zzz", GOOD)
    registry = load_registry()
    assert [broken.distribution for broken in registry.broken] == ["aaa"]
    assert find(registry, "nothing")


@pytest.mark.parametrize(
    ("wanted", "found"),
    [
        (None, {"one", "two"}),
        ("", set()),
        ("aaa", {"one"}),
        ("aaa,bbb", {"one", "two"}),
        ("aaa, bbb", {"one", "two"}),
        ("no-such", set()),
    ],
)
def test_the_environment_narrows_the_packages(site, monkeypatch, wanted, found):
    install(site, "aaa", GOOD.replace('"nothing"', '"one"'))
    install(site, "bbb", GOOD.replace('"nothing"', '"two"'))
    if wanted is not None:
        monkeypatch.setenv("MUSHPIPE_PLUGINS", wanted)
    names = set(load_registry().names("stage"))
    assert names & {"one", "two"} == found
    assert "otsu" in names


@pytest.mark.parametrize("wanted", ["my-plugin", "my_plugin", "My.Plugin"])
def test_a_package_is_meant_however_its_name_is_written(site, monkeypatch, wanted):
    install(site, "my_plugin", GOOD.replace('"nothing"', '"one"'))
    monkeypatch.setenv("MUSHPIPE_PLUGINS", wanted)
    assert "one" in load_registry().names("stage")


@pytest.mark.parametrize("use", ["My_Fungus:nothing", "my-fungus:nothing", "my.fungus:nothing"])
def test_whose_plugin_is_meant_may_be_written_as_pip_takes_it(site, use):
    install(site, "My_Fungus", GOOD)
    assert find(load_registry(), use).__module__ == "My_Fungus"


@pytest.mark.parametrize("wanted", ["no-such-thing", ""])
def test_an_unknown_name_may_be_left_out_by_the_environment(site, monkeypatch, wanted):
    monkeypatch.setenv("MUSHPIPE_PLUGINS", wanted)
    with pytest.raises(PluginError, match=f"only plugins of MUSHPIPE_PLUGINS={wanted} are"):
        load_registry().find("stage", "nothing-here", Path())


def test_a_package_that_is_not_there_is_told_of(site, monkeypatch, caplog):
    monkeypatch.setenv("MUSHPIPE_PLUGINS", "aaaa")
    load_registry()
    assert "MUSHPIPE_PLUGINS: no plugins are installed by aaaa" in caplog.text


def test_two_plugins_of_one_name_must_be_told_apart(site, monkeypatch, capsys):
    install(site, "aaa", GOOD)
    install(site, "bbb", GOOD, version="3.4")
    registry = load_registry()
    with pytest.raises(PluginError) as caught:
        find(registry, "nothing")
    assert str(caught.value) == (
        "stage 'nothing' is provided by aaa 1.2 and bbb 3.4; write 'aaa:nothing' or 'bbb:nothing'"
    )
    assert caught.value.exit_code == 2
    graph = site / "graph.yaml"
    graph.write_text("mushpipe: 1\nsource: {use: synthetic}\nstages: {a: {use: nothing}}\n")
    assert cli(monkeypatch, "validate", graph) == 2
    assert f"error: {graph}:3:19: {caught.value}\n" in capsys.readouterr().err
    assert cli(monkeypatch, "validate", graph, "--set", "a.use=bbb:nothing") == 0
    assert find(registry, "aaa:nothing").__module__ == "aaa"
    assert find(registry, "bbb:nothing").__module__ == "bbb"


@pytest.mark.parametrize(
    ("name", "target"), [("bad name!", "a:A"), ("pf:x", "a:A"), ("x", 5), ("x", "a.A")]
)
def test_a_registration_that_no_graph_could_use_is_refused(name: str, target: object):
    with pytest.raises(PluginError, match="expected a name of letters"):
        Registry().stage(name, target)  # type: ignore[arg-type]


def test_a_package_that_registers_a_name_twice_is_told_of_and_no_choice_is_offered():
    registry = Registry()
    registry.stage("twice", "a:A")
    registry.stage("twice", "a:B")
    with pytest.raises(PluginError, match=r"by this process and this process; register it there"):
        find(registry, "twice")


def test_a_package_may_name_its_module_once_per_stage(site):
    install(site, "fungus", GOOD)
    points = site / "fungus-1.2.dist-info" / "entry_points.txt"
    points.write_text("[mushpipe]\nnothing = fungus\nsomething = fungus\n")
    registry = load_registry()
    assert registry.broken == []
    assert find(registry, "nothing").__module__ == "fungus"


def test_an_entry_point_without_a_distribution():
    registry = Registry()
    register(registry, [EntryPoint("builtin", "mushpipe.builtin", "mushpipe")])
    assert registry.entries["stage", "otsu"][0].distribution == "an unknown package"


@pytest.mark.parametrize(
    ("target", "message"),
    [
        ("no_such.module:X", "cannot be imported: ModuleNotFoundError: No module named 'no_such'"),
        ("mushpipe.builtin:X", "cannot be imported: AttributeError: module 'mushpipe.builtin' has"),
        ("mushpipe.builtin:Registry", "stage 'x' of this process: Registry is not a Stage, Source"),
        ("mushpipe.builtin:hookimpl", "is not a Stage, Source or Sink class"),
        (Frames, "stage 'x' of this process is a source, not a stage"),
    ],
)
def test_a_registered_name_whose_class_is_unusable(target, message):
    registry = Registry()
    registry.stage("x", target)
    with pytest.raises(PluginError) as caught:
        find(registry, "x")
    assert message in str(caught.value)


def test_a_missing_system_library_is_told_as_it_is(site):
    error = "from mushpipe.core.errors import DependencyError\nraise DependencyError('libGL')\n"
    (site / "needy.py").write_text(error)
    registry = Registry()
    registry.stage("x", "needy:X")
    with pytest.raises(DependencyError, match=r"^libGL$"):
        find(registry, "x")


@pytest.mark.parametrize("kind", ["stage", "source", "sink"])
def test_a_name_of_another_kind_is_named(kind):
    registry = Registry()
    registry.stage("s", Threshold)
    registry.source("t", Frames)
    for use, own in (("s", "stage"), ("t", "source")):
        if own != kind:
            with pytest.raises(PluginError, match=f"^'{use}' is a {own}, not a {kind}$"):
                registry.find(kind, use, Path())


FILE = HEADER + "class Mine(Stage):\n    def process(self, frame: RgbdFrame) -> Mask:\n"
FILE += "        return Mask(frame.color[..., 0] > 1)\n"


def test_a_stage_in_a_file_beside_the_graph(lab: Lab):
    (lab.folder / "mine.py").write_text(FILE)
    plan = lab.compile(lab.chain("./mine.py:Mine", "measure"))
    assert plan.stages[0].use == f"{lab.folder}/mine.py:Mine"
    assert lab.run(lab.chain("./mine.py:Mine", "measure")).processed == 3
    assert [trace.outputs["b"][0].center[0, 1] for trace in lab.seen] == [0, 0, 48]


def test_a_file_is_loaded_once_so_that_its_types_agree(lab: Lab):
    (lab.folder / "mine.py").write_text(FILE)
    assert find(lab.registry, "mine.py:Mine", lab.folder) is find(
        lab.registry, f"{lab.folder}/mine.py:Mine"
    )


@pytest.mark.parametrize(
    ("code", "use", "message"),
    [
        (None, "mine.py:Mine", "there is no file {file}"),
        (FILE, "mine.py:Mein", "{file} has no class 'Mein'; did you mean 'Mine'?"),
        (FILE, "mine.py", "'mine.py' says no class: write 'mine.py:CLASS'; it has Mine"),
        ("", "mine.py:Mine", "{file} has no class 'Mine'; none is known here"),
        ("1 / 0", "mine.py:X", "{file} cannot be imported: ZeroDivisionError: division by zero"),
        ("exit(3)", "mine.py:X", "{file} cannot be imported: SystemExit: 3"),
        ("X = 5", "mine.py:X", "mine.py:X: 5 is not a Stage, Source or Sink class"),
        (FILE, "mine.py:Mask", "mine.py:Mask: Mask is not a Stage, Source or Sink"),
    ],
)
def test_a_file_that_cannot_be_used(lab: Lab, code, use, message):
    path = lab.folder / "mine.py"
    if code is not None:
        path.write_text(code)
    text = lab.faults(f"mushpipe: 1\nsource: {{use: frames}}\nstages:\n  a: {{use: {use}}}\n")
    assert text.startswith("graph.yaml:4:12: " + message.format(file=path))


@pytest.mark.parametrize(
    ("code", "line"),
    [
        (HEADER + "class X(Stage):\n    sizes = []\n", HEADER.count("\n") + 1),  # pydantic raises
        ("def size():\n    return 1 / 0\n\nX = size()\n", 2),
        ("\nimport no_such_module\n", 2),
        ("\n\ndef\n", 3),
    ],
)
def test_a_file_that_cannot_be_imported_is_told_with_the_line(lab: Lab, code: str, line: int):
    (lab.folder / "mine.py").write_text(code)
    with pytest.raises(PluginError) as caught:
        find(lab.registry, "mine.py:X", lab.folder)
    assert str(caught.value).endswith(f" (mine.py, line {line})")


def test_a_file_with_a_plugin_of_another_kind(lab: Lab):
    (lab.folder / "mine.py").write_text(FILE)
    with pytest.raises(PluginError, match=r"^mine\.py:Mine is a stage, not a source$"):
        lab.registry.find("source", "mine.py:Mine", lab.folder)


def test_the_command_line_means_files_by_the_shells_folder(lab: Lab, monkeypatch):
    shell = lab.folder / "shell"
    shell.mkdir()
    (shell / "mine.py").write_text(FILE)
    monkeypatch.chdir(shell)
    plan = lab.compile(lab.chain("threshold"), "a.use=mine.py:Mine")
    assert plan.stages[0].use == f"{shell}/mine.py:Mine"


def test_names_are_sorted_and_by_kind():
    registry = Registry()
    for name, cls in (("b", Both), ("a", Invert)):
        registry.stage(name, cls)
    registry.source("c", Frames)
    assert registry.names("stage") == ["a", "b"]
    assert registry.names("source") == ["c"]
    assert registry.names("sink") == []
    assert issubclass(find(registry, "a"), Stage)


MISTAKES = {
    "state in a setting": (
        "class Mine(Stage):\n    level: int = 3\n    def process(self, frame: RgbdFrame) -> Mask:\n"
        "        self.level = 5\n        return Mask(frame.color[..., 0] > 1)\n",
        "AttributeError: 'level' cannot be set: settings are frozen; keep state in a private",
    ),
    "no annotation": (
        "class Mine(Stage):\n    level = 3\n",
        "PydanticUserError: A non-annotated attribute was detected: `level = 3`",
    ),
    "not a frame": (
        "class Mine(Source):\n    def frames(self):\n        yield 5\n",
        "failed: TypeError: it yielded int, expected RgbdFrame",
    ),
    "no frames": ("class Mine(Source):\n    pass\n", "Mine has no method 'frames'"),
}


@pytest.mark.parametrize(("code", "message"), MISTAKES.values(), ids=MISTAKES)
def test_mistakes_of_a_plugins_author_are_explained(lab: Lab, code: str, message: str):
    (lab.folder / "mine.py").write_text(HEADER + "from mushpipe import Source\n" + code)
    source = "mine.py:Mine" if "Source" in code else "frames"
    try:
        text = str(
            lab.run(
                lab.chain("mine.py:Mine", source=source)
                if source == "frames"
                else lab.chain("threshold", source=source)
            ).error
        )
    except GraphError as error:
        text = str(error)
    assert message in text
    assert "errors.pydantic.dev" not in text
