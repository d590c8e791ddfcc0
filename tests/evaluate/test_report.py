"""`mushpipe eval --report`."""

from __future__ import annotations

import base64
import re
from dataclasses import replace
from html.parser import HTMLParser
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from mushpipe.core.errors import EXIT_DIFFERS
from mushpipe.evaluate.events import events_of, judge
from mushpipe.evaluate.plots import _against_tilt, _histograms, _stated
from mushpipe.evaluate.results import of_picks
from mushpipe.evaluate.truth import FrameTruth
from tests.evaluate.scenes import (
    FRAME,
    bed,
    frame,
    header,
    picks_of,
    write_recording,
    write_results,
)
from tests.evaluate.test_command import judged, manifest_of, metrics, run
from tests.evaluate.test_metrics import turned


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


@pytest.mark.parametrize("false", [0, 1, 3])
def test_of_a_bed_with_nothing_in_it_the_false_ones_tell_and_no_f(
    tmp_path: Path, false: int
) -> None:
    empty, given = bed(0).take(slice(0, 0)), picks_of(bed(0).take(slice(0, false)))
    results = write_results(tmp_path / "r.mcap", {0: given}, {0: empty})
    shown = run(results, "--report", tmp_path / "report")
    assert shown.exit_code == 0
    row = next(line.split() for line in shown.stdout.splitlines() if line.startswith("r "))
    assert row[:6] == ["r", "1", "0", "0", str(false), "0"]
    assert row[6:9] == ["0.000" if false else "-", "-", "-"]
    content = judged(results)
    assert (metrics(content)["f"], metrics(content)["recall"]) == (None, None)
    assert content["alternatives"][0]["overall"]["false"] == false
    assert f"F -: 0 missed, {false} false" in (tmp_path / "report/index.html").read_text()
    assert run(results, "--threshold", "f>=0").exit_code == EXIT_DIFFERS


def test_what_is_false_on_an_empty_bed_counts_in_the_whole(tmp_path: Path) -> None:
    """19 of 20 found, and 3 false ones on a bed with nothing in it."""
    full, empty = bed(0), bed(1).take(slice(0, 0))
    answers = {0: picks_of(full.take(slice(0, 19))), 1: picks_of(bed(1).take(slice(0, 3)))}
    results = write_results(tmp_path / "r.mcap", answers, {0: full, 1: empty})
    values = metrics(judged(results))
    assert values["f"] == pytest.approx(2 * 19 / (2 * 19 + 1 + 3))
    assert values["precision"] == pytest.approx(19 / 22)


def test_the_worst_empty_bed_is_the_one_with_most_that_is_false(tmp_path: Path) -> None:
    empty = bed(0).take(slice(0, 0))
    answers = {i: picks_of(bed(0).take(slice(0, false))) for i, false in enumerate([1, 0, 3, 2])}
    results = write_results(tmp_path / "r.mcap", answers, dict.fromkeys(answers, empty))
    run(results, "--report", tmp_path / "report")
    text = (tmp_path / "report/index.html").read_text()
    assert re.findall(r"F -: 0 missed, (\d) false", text) == ["3", "2", "1", "0"]


def test_a_worst_frame_is_shown_on_its_own_image(tmp_path: Path) -> None:
    """Two recordings of one name, whose frames have the same stamps."""
    paths, shown = [], {}
    for number, folder in enumerate(("a", "b")):
        (tmp_path / folder).mkdir()
        truth = bed(number, rows=1 + 3 * number)
        recording = write_recording(tmp_path / folder / "bed.mcap", {0: truth})
        manifest = manifest_of(recording, "bed.mcap")
        found = {0: picks_of(truth.take(np.arange(3)))}
        results = tmp_path / folder / "results.mcap"
        paths.append(write_results(results, found, {0: truth}, manifest=manifest))
        shown[f"results-{number}"] = frame(0, truth).color
    assert run(*paths, "--report", tmp_path / "report").exit_code == 0
    text = (tmp_path / "report" / "index.html").read_text()
    panels = re.findall(r'href="data:image/jpeg;base64,([^"]+)".*?</b> ([^,]+),', text)
    assert {name for _, name in panels} == set(shown)
    for data, name in panels:
        pixels = cv2.imdecode(np.frombuffer(base64.b64decode(data), np.uint8), cv2.IMREAD_COLOR)
        assert np.abs(pixels[..., ::-1] - shown[name].astype(float)).mean() < 5


def test_the_plot_of_sigmas_shows_the_error_itself() -> None:
    """Where the sigmas of x, y and z differ, z-scores times the mean sigma are no error."""
    truth = bed(3)
    error = np.random.default_rng(1).choice([-0.001, 0.001], (len(truth), 3))
    picks = picks_of(truth, position=error)
    sigma = np.tile([0.0002, 0.0002, 0.001], (len(truth), 1))
    picks = replace(picks, sigma_position=sigma)
    known = FrameTruth(truth, frame_id=FRAME)
    events = events_of([judge("bed", ("index", 0), known, header(0), of_picks(picks))])
    (root, square, z2) = _stated(events)["position, mm"]
    np.testing.assert_allclose(square, 1, rtol=1e-6)
    np.testing.assert_allclose(root, np.sqrt((0.04 + 0.04 + 1) / 3))
    np.testing.assert_allclose(z2, (25 + 25 + 1) / 3, rtol=1e-6)


def test_errors_that_differ_by_rounding_alone_have_a_histogram() -> None:
    truth = bed(5)
    axis = turned(truth.axis, 0.05, np.random.default_rng(0))
    found = of_picks(picks_of(truth, axis=axis))
    known = FrameTruth(truth, frame_id=FRAME)
    figure = _histograms(events_of([judge("bed", ("index", 0), known, header(0), found)]))
    assert figure is not None
    shown = {axes.get_xlabel(): axes.containers[0] for axes in figure.axes if axes.containers}
    assert sum(bar.get_height() for bar in shown["axis, degrees"]) == len(truth)


def test_an_axis_that_is_flipped_is_in_the_plot_of_axis_errors() -> None:
    verdicts = []
    for number in range(20):
        truth = bed(number)
        axis = truth.axis.copy()
        if number == 0:
            axis[0] = -axis[0]  # one of 400
        found = of_picks(picks_of(truth, axis=axis))
        at = header(number)
        known = FrameTruth(truth, frame_id=FRAME)
        verdicts.append(judge("bed", ("stamp_ns", at.stamp_ns), known, at, found))
    figure = _against_tilt(events_of(verdicts))
    assert figure is not None
    (axes,) = figure.axes
    error = np.asarray(axes.lines[0].get_ydata())
    assert len(error) == 400
    assert error.max() == axes.get_ylim()[1] > 0.5
