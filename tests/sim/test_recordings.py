"""The committed recordings are what their table makes."""

from itertools import islice
from pathlib import Path

import numpy as np
import pytest

from mushpipe.core.errors import UsageError
from mushpipe.core.recording import RecordingReader
from mushpipe.core.truth import TRUTH_TOPIC, Truth
from mushpipe.core.wire import decode_table
from mushpipe.sim.recordings import definitions, regenerate
from mushpipe.sources.mcap import McapSource

FOLDER = Path(__file__).parents[2] / "recordings"
TABLE = FOLDER / "recordings.yaml"


def truths(path: Path) -> list[Truth]:
    messages = RecordingReader(path).messages({TRUTH_TOPIC})
    return [decode_table(raw.schema.name, raw.message.data).table for raw in messages]


def test_table_files_and_readme_agree():
    names = list(definitions(TABLE))
    assert sorted(p.stem for p in FOLDER.glob("*.mcap")) == sorted(names)
    readme = (FOLDER / "README.md").read_text()
    for name, definition in definitions(TABLE).items():
        assert f"`{name}.mcap`" in readme
        assert f"| {definition.source().seed} |" in readme
    assert sum(p.stat().st_size for p in FOLDER.glob("*.mcap")) < 20e6
    assert (FOLDER / "first-bed.mcap").stat().st_size < 3e6


def test_a_recording_is_regenerated_alike():
    """Equal on the machine that made it; elsewhere within the tolerance the README states."""
    name = "gaps"
    source = definitions(TABLE)[name].source()
    stored = list(McapSource(path=FOLDER / f"{name}.mcap").frames())
    made = list(islice(source.frames(), source.max_frames))
    assert len(stored) == len(made) == 5
    for old, new in zip(stored, made, strict=True):
        assert old.header.stamp_ns == new.header.stamp_ns
        assert (old.depth is None) == (new.depth is None)
        assert np.abs(old.color.astype(int) - new.color).mean() < 2
        if old.depth is not None and new.depth is not None:
            assert (np.abs(old.depth.astype(int) - new.depth) <= 1).mean() > 0.999
            assert old.depth_scale == new.depth_scale
    for old_truth, frame in zip(truths(FOLDER / f"{name}.mcap"), made, strict=True):
        new_truth = frame.attached[TRUTH_TOPIC]
        np.testing.assert_array_equal(old_truth.id, new_truth.id)
        np.testing.assert_allclose(old_truth.center, new_truth.center, atol=1e-3)
        np.testing.assert_allclose(old_truth.apex, new_truth.apex, atol=1e-6)


def test_writing_twice_gives_the_same_bytes_which_are_those_of_the_source(tmp_path):
    table = tmp_path / "recordings.yaml"
    table.write_text(
        "tiny: {purpose: a test, settings: {width: 96, height: 72, count: 5, max_frames: 2}}\n"
    )
    (path,) = regenerate([], table)
    first = path.read_bytes()
    made = list(islice(definitions(table)["tiny"].source().frames(), 2))
    stored = list(McapSource(path=path).frames())
    assert len(stored) == len(truths(path)) == 2
    for old, new in zip(stored, made, strict=True):
        np.testing.assert_array_equal(old.depth, new.depth)
        assert np.abs(old.color.astype(int) - new.color).mean() < 3  # JPEG
    regenerate(["tiny"], table)
    assert path.read_bytes() == first
    with pytest.raises(UsageError, match="did you mean 'tiny'"):
        regenerate(["tinny"], table)


@pytest.mark.parametrize("name", ["plane-51", "plane-59", "plane-72", "plane-79"])
def test_the_planes_show_the_papers_depth_error(name):
    path = FOLDER / f"{name}.mcap"
    distance = definitions(TABLE)[name].source().distance
    for frame in McapSource(path=path).frames():
        window = frame.depth_m[224:255, 304:335] - distance
        assert 0.002 < np.nanmean(window) < 0.0038
        assert 0.0006 < np.nanstd(window) < 0.0016


def test_the_table_is_missed_outside_of_the_project(tmp_path: Path) -> None:
    with pytest.raises(UsageError, match=r"run this in the project's folder"):
        definitions(tmp_path / "recordings.yaml")
