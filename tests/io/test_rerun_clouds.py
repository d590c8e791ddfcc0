"""Registrations as .rrd files, read back by Rerun's own reader."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

from mushpipe.cli import app
from mushpipe.core.errors import UsageError
from mushpipe.sinks.rerun_clouds import BLUE, RED, write_clouds
from mushpipe.stages.registration import Alignment
from tests.io.rerun_file import read, unpack, values


def registered(seed: int) -> Alignment:
    rng = np.random.default_rng(seed)
    sample, before, after = (rng.uniform(0.4, 0.5, (n, 3)) for n in (7, 9, 9))
    axis, apex = np.array([0.0, 0.6, -0.8]), np.array([0.01, 0.02, 0.4])
    return Alignment(axis, apex, 0.5, sample, before, after)


def test_clouds_and_axis_of_each_mushroom_are_in_the_file(tmp_path: Path) -> None:
    found = {"pick 7": registered(0), "pick 8": registered(1)}
    write_clouds(tmp_path / "out.rrd", [*found.items()])
    shown = read(tmp_path / "out.rrd")
    for name, alignment in found.items():
        entity = f"/{name}".replace(" ", "\\ ")
        for part, color in (("sample", BLUE), ("before", RED), ("after", RED)):
            (points,) = values(shown, f"{entity}/{part}", "positions")
            np.testing.assert_allclose(points, getattr(alignment, part), atol=1e-7)
            ((packed,),) = values(shown, f"{entity}/{part}", "colors")
            assert unpack(packed) == color
        (origins,) = values(shown, f"{entity}/axis", "origins")
        (vectors,) = values(shown, f"{entity}/axis", "vectors")
        np.testing.assert_allclose(origins, [alignment.apex], atol=1e-7)
        np.testing.assert_allclose(np.cross(vectors[0], alignment.axis), 0, atol=1e-7)
        assert np.dot(vectors[0], alignment.axis) > 0


def test_what_cannot_be_written_is_said(tmp_path: Path) -> None:
    with pytest.raises(UsageError, match="cannot be written"):
        write_clouds(tmp_path / "none" / "out.rrd", [("row 0", registered(0))])


def test_other_figures_are_no_clouds(tmp_path: Path) -> None:
    (tmp_path / "x.mcap").touch()
    command = ["figure", str(tmp_path / "x.mcap"), "-o", str(tmp_path / "x.rrd")]
    wrong = CliRunner().invoke(app, [*command, "--kind", "stages"]).exception
    assert isinstance(wrong, UsageError)
    assert "only --kind pose is drawn in space; mushpipe view" in str(wrong)
    assert not (tmp_path / "x.rrd").exists()
