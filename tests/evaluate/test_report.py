"""`mushpipe eval --report`."""

from __future__ import annotations

import re
from html.parser import HTMLParser
from pathlib import Path
from typing import Any

import numpy as np

from tests.evaluate.scenes import (
    bed,
    picks_of,
    write_results,
)
from tests.evaluate.test_command import judged, metrics, run


class Page(HTMLParser):
    """Collects what a page refers to, and whether its tags close."""

    VOID = ("meta", "image", "circle", "line", "path", "use", "rect", "br")

    def __init__(self) -> None:
        super().__init__()
        self.references: list[str] = []
        self.tags: list[str] = []
        self.seen: list[str] = []
        self.ids: list[str] = []

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.seen.append(tag)
        for name, value in attrs:
            if name in ("src", "href", "xlink:href", "srcset", "data", "action"):
                self.references.append(value or "")
            if name == "id":
                self.ids.append(value or "")
        if tag != "meta":
            self.tags.append(tag)

    def handle_startendtag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.handle_starttag(tag, attrs)
        self.handle_endtag(tag)

    def handle_endtag(self, tag: str) -> None:
        assert self.tags.pop() == tag


def test_report_is_one_page_of_its_own(graph: Path, tmp_path: Path) -> None:
    report = tmp_path / "report"
    matrix = "detect.radius_px=[8,45],[8,20]"
    arguments = (graph, "--recordings", tmp_path / "bed.mcap", "--matrix", matrix)
    result = run(*arguments, "--report", report)
    assert result.exit_code == 0
    assert [path.name for path in report.iterdir()] == ["index.html"]
    text = (report / "index.html").read_text()
    page = Page()
    page.feed(text)
    assert not page.tags
    assert page.references
    assert all(ref.startswith(("data:image/", "#")) for ref in page.references)
    assert not {"script", "link", "iframe", "object"} & set(page.seen)
    assert not re.search(r"@import|url\((?!#)", text)
    assert len(set(page.ids)) == len(page.ids)
    targets = {ref[1:] for ref in page.references if ref.startswith("#")}
    assert targets <= set(page.ids)
    assert "prefers-color-scheme: dark" in text
    assert "Reliability of the score" in text
    assert str(tmp_path) not in text


def test_report_of_nothing_found(tmp_path: Path, truths: dict[int, Any]) -> None:
    nothing = {i: picks_of(truth.take(slice(0, 0))) for i, truth in truths.items()}
    results = write_results(tmp_path / "r.mcap", nothing, truths)
    assert run(results, "--report", tmp_path / "report").exit_code == 0
    text = (tmp_path / "report" / "index.html").read_text()
    assert text.count("20 missed, 0 false") == 3


def test_report_of_a_frame_with_nothing_in_it(tmp_path: Path) -> None:
    empty = bed(0).take(slice(0, 0))
    results = write_results(tmp_path / "r.mcap", {0: picks_of(empty)}, {0: empty})
    assert run(results, "--report", tmp_path / "report").exit_code == 0
    assert np.isnan(float(metrics(judged(results))["f"] or "nan"))
