"""The docs: output as the commands print it, a page per plugin, and code that runs."""

from __future__ import annotations

import re
import runpy
import shlex
from pathlib import Path

import cv2
import numpy as np
import pytest
import yaml
from typer.testing import CliRunner

from mushpipe.builtin import mushpipe_register
from mushpipe.cli import app
from mushpipe.core.document import read_document
from mushpipe.core.graph import compile_document
from mushpipe.core.plugins import Registry, load_registry
from mushpipe.core.run import run
from mushpipe.core.stage import Kind
from mushpipe.info import settings_rows
from tests.docs.consoles import BLOCK, PAGES, renewed

HOOKS = runpy.run_path("docs/hooks.py")


class Names(Registry):
    """Takes down what is registered."""

    def __init__(self) -> None:
        self.seen: list[tuple[Kind, str]] = []

    def source(self, name: str, plugin: object) -> None:
        self.seen.append(("source", name))

    def stage(self, name: str, plugin: object) -> None:
        self.seen.append(("stage", name))

    def sink(self, name: str, plugin: object) -> None:
        self.seen.append(("sink", name))


@pytest.mark.parametrize("page", PAGES, ids=lambda p: p.name)
def test_output_in_the_docs_is_what_the_commands_print(page: Path) -> None:
    text = page.read_text()
    assert renewed(text) == text, "python -m tests.docs.consoles renews it"


def test_there_is_output_to_compare() -> None:
    assert sum(len(BLOCK.findall(page.read_text())) for page in PAGES) >= 5
    # A block that the pattern misses would never be compared.
    assert sum(page.read_text().count("```console") for page in PAGES) == sum(
        len(BLOCK.findall(page.read_text())) for page in PAGES
    )


def test_every_builtin_plugin_has_a_page_with_all_its_settings() -> None:
    names = Names()
    mushpipe_register(names)
    registry = load_registry()
    pages = HOOKS["pages"](registry)
    assert len(names.seen) >= 18
    assert set(pages) == {"reference/index.md", *(HOOKS["place"](*seen) for seen in names.seen)}
    for kind, name in names.seen:
        page = pages[HOOKS["place"](kind, name)]
        plugin = registry.find(kind, f"mushpipe:{name}", Path.cwd())
        assert plugin.__doc__
        assert plugin.__doc__.splitlines()[0] in page
        for row in settings_rows(plugin):
            assert f"`{row[0]}`" in page
        assert f"({kind}-{name}.md)" in pages["reference/index.md"]


def test_the_graph_and_the_segmenter_of_the_docs_work(tmp_path: Path) -> None:
    recording = Path("recordings/first-bed.mcap").absolute()
    tutorial, reference = (Path(f"docs/{n}.md").read_text() for n in ("tutorial", "graph"))
    (segmenter,) = re.findall(r"```python\n(.*?)```", tutorial, re.DOTALL)
    (tmp_path / "mine.py").write_text(segmenter)
    graph = yaml.safe_load(re.findall(r"```yaml\n(.*?)```", reference, re.DOTALL)[0])
    graph["source"]["path"] = str(recording)
    graph["stages"]["segment"] = {"use": "./mine.py:Bright", "share": 0.6}
    (tmp_path / "graph.yaml").write_text(yaml.safe_dump(graph, sort_keys=False))
    plan = compile_document(read_document(tmp_path / "graph.yaml"), load_registry())
    assert not plan.warnings
    assert type(plan.stages[0].plugin).__name__ == "Bright"


def test_the_plugins_of_the_docs_work(tmp_path: Path) -> None:
    page = Path("docs/plugins.md").read_text()
    blocks = re.findall(r"```python\n(.*?)```", page, re.DOTALL)
    assert Path("examples/mine.py").read_text().endswith(blocks[0])
    (tmp_path / "mine.py").write_text("\n".join(blocks))
    (tmp_path / "shots").mkdir()
    picture = np.zeros((60, 80, 3), np.uint8)
    cv2.circle(picture, (30, 20), 9, (255, 255, 255), -1)
    for number in range(2):
        cv2.imwrite(str(tmp_path / f"shots/{number}.png"), picture)
    (tmp_path / "graph.yaml").write_text("""
mushpipe: 1
source: {use: ./mine.py:Pictures, folder: shots}
stages:
  segment: {use: otsu}
  blobs: {use: ./mine.py:Blobs}
  ripe: {use: ./mine.py:Ripe}
sinks:
  count: {use: ./mine.py:Counts, path: "{recording}.txt"}
  log: {use: mcap, path: log.mcap}
""")
    plan = compile_document(read_document(tmp_path / "graph.yaml"), load_registry())
    assert run(plan).error is None
    assert (tmp_path / "shots.txt").read_text() == "0,1\n1,1\n"
    mine = runpy.run_path(str(tmp_path / "mine.py"))
    assert len(mine["circles"]) > 1
    (first, _) = mine["rows"](tmp_path / "log.mcap", "/mushpipe/ripe")
    assert (first["share"], first["grade"]) == ([None], [""])
    tests = [name for name in mine if name.startswith("test_")]
    assert len(tests) == 2
    for name in tests:
        mine[name]()


def test_changed_settings_in_the_docs_are_accepted(tmp_path: Path) -> None:
    """Commands with `--set` compile, but for those on files or devices of the reader."""
    runs = [
        shlex.split(line, comments=True)[1:]
        for page in PAGES
        for line in re.findall(r"^mushpipe run graphs.*--set.*", page.read_text(), re.MULTILINE)
    ]
    tried = [run for run in runs if "--source" not in run and run[1] != "graphs/live.yaml"]
    assert len(tried) >= 5
    (segmenter,) = re.findall(
        r"```python\n(.*?)```", Path("docs/tutorial.md").read_text(), re.DOTALL
    )
    (tmp_path / "mine.py").write_text(segmenter)
    for command in tried:
        arguments = [word.replace("./mine.py", str(tmp_path / "mine.py")) for word in command[1:]]
        result = CliRunner().invoke(app, ["validate", *arguments])
        assert result.exit_code == 0, (command, result.exception)


def test_links_to_files_of_the_repository_lead_somewhere() -> None:
    for page in PAGES:
        for target in re.findall(r"\]\(([^)#\s]+)", page.read_text()):
            if not target.startswith(("http", "reference/")):
                assert (page.parent / target).exists(), f"{page}: {target}"


def test_the_modules_that_the_page_on_the_paper_names_exist() -> None:
    named = re.findall(r"`((?:stages|core|evaluate)/\w+\.py)", Path("docs/paper.md").read_text())
    assert len(named) > 10
    assert not [name for name in named if not (Path("mushpipe") / name).exists()]
