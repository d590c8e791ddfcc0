from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import yaml
from pydantic import ValidationError
from typer.testing import CliRunner

from mushpipe import RgbdFrame
from mushpipe.cli import app
from mushpipe.core.errors import InputError, UsageError
from mushpipe.core.recorder import RecordingWriter
from mushpipe.evaluate.calibrate import fit_correction
from mushpipe.evaluate.metrics import Value
from mushpipe.evaluate.plane import PlaneRow, judge_planes, measure_plane, plane_values, window_of
from mushpipe.sources.mcap import McapSource
from mushpipe.stages.depth_correct import DepthCorrect
from tests.evaluate.scenes import frame
from tests.io.bags import color_at, rgbd, write_bag


def plane(folder: Path, distance: float, offset: float, sigma: float, seed: int = 0) -> Path:
    """A recording of three frames of a plane in units of 1/8 mm."""
    path = folder / f"plane-{distance}.mcap"
    writer = RecordingWriter(path, {})
    rng = np.random.default_rng(seed)
    for i in range(3):
        depth = distance + offset + rng.normal(0, sigma, (480, 640))
        frame_ = frame(i, depth=np.rint(depth / 0.000125).astype(np.uint16))
        writer.frame(RgbdFrame(**{**vars(frame_), "color": frame_.color}))
    writer.close()
    return path


def test_values_by_hand() -> None:
    window = np.full((31, 31), 500.0)
    window[0, :] = np.nan
    window[1, 0] = 503.0
    window[1, 1] = 497.0
    values = plane_values(window, 0.498)
    assert values["mean_mm"] == pytest.approx(500)
    assert values["offset_mm"] == pytest.approx(2)
    assert values["range_mm"] == pytest.approx(6)
    assert values["std_mm"] == pytest.approx(np.sqrt(18 / 930))
    assert values["valid"] == pytest.approx(30 / 31)


def test_a_slanted_plane_is_flat_about_itself() -> None:
    v, u = np.mgrid[:31, :31]
    values = plane_values(500 + 0.1 * u - 0.2 * v, 0.5)
    assert values["std_mm"] > 1
    assert values["flat_std_mm"] == pytest.approx(0, abs=1e-9)


def test_without_depth_nothing_is_known() -> None:
    values = plane_values(np.full((31, 31), np.nan), 0.5)
    assert values.pop("valid") == 0
    assert all(map(np.isnan, values.values()))


def test_the_window_is_central() -> None:
    depth = np.zeros((41, 61), np.float32)
    depth[20, 30] = 1
    window = window_of(depth)
    assert window.shape == (31, 31)
    assert window[15, 15] == 1000
    assert window_of(np.zeros((31, 40), np.float32)).shape == (31, 31)
    with pytest.raises(InputError, match="smaller"):
        window_of(np.zeros((30, 40), np.float32))


def test_a_recording_gives_what_was_put_in(tmp_path: Path) -> None:
    row = measure_plane(plane(tmp_path, 0.51, 0.0028, 0.0011), 0.51)
    assert row.frames == 3
    assert row.values["offset_mm"].value == pytest.approx(2.8, abs=0.1)
    assert row.values["std_mm"].value == pytest.approx(1.1, abs=0.1)
    offset = row.values["offset_mm"]
    assert offset.low <= offset.value <= offset.high


def test_one_distance_for_all_or_one_each(tmp_path: Path) -> None:
    files = [plane(tmp_path, 0.51, 0.003, 0.001), plane(tmp_path, 0.59, 0.003, 0.001)]
    rows, outcomes, code = judge_planes(files, "0.51,0.59", ["offset_mm<=5"], 50, 0)
    assert [round(row.values["offset_mm"].value) for row in rows] == [3, 3]
    assert (len(outcomes), code) == (2, 0)
    _, outcomes, code = judge_planes(files, "0.51", ["offset_mm<=5"], 50, 0)
    assert code == 3
    assert [(name, o.kept) for name, o in outcomes] == [
        (files[0].stem, True),
        (files[1].stem, False),
    ]
    with pytest.raises(UsageError, match="one distance"):
        judge_planes(files, "0.51,0.6,0.7", [], 0, 0)
    with pytest.raises(UsageError, match="expected metres"):
        judge_planes(files, "51cm", [], 0, 0)
    with pytest.raises(UsageError, match="did you mean 'offset_mm'"):
        judge_planes(files, "0.51", ["offset<1"], 0, 0)


def test_a_recording_without_depth_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "flat.mcap"
    writer = RecordingWriter(path, {})
    writer.frame(frame(0))
    writer.close()
    with pytest.raises(InputError, match="no depth"):
        measure_plane(path, 0.5)


def test_of_several_cameras_a_recording_of_one_is_asked_for(tmp_path: Path) -> None:
    """Topics are chosen by --set, which neither `eval --plane` nor `calibrate depth` takes."""
    bag = write_bag(tmp_path, [color_at(0, topic="/a/color"), color_at(0, topic="/b/color")])
    with pytest.raises(InputError) as caught:
        measure_plane(bag, 0.5)
    assert str(caught.value).endswith(
        "choose with --set source.color_topic=/a/color or --set source.color_topic=/b/color of "
        f"'mushpipe record --source {bag} -o NEW.mcap', and measure that one"
    )


def test_images_smaller_than_the_window_are_named(tmp_path: Path) -> None:
    bag = write_bag(tmp_path, rgbd(range(1)))
    with pytest.raises(InputError) as caught:
        measure_plane(bag, 0.5)
    assert str(caught.value).startswith(f"{bag}: the depth image is smaller than the window of 31x")


def test_command(tmp_path: Path) -> None:
    path = plane(tmp_path, 0.51, 0.0028, 0.001)
    result = CliRunner().invoke(app, ["eval", "--plane", "0.51", str(path)])
    assert result.exit_code == 0
    assert "offset mm" in result.stdout
    assert "2.8" in result.stdout


def test_a_missed_threshold_names_its_recording(tmp_path: Path) -> None:
    files = [plane(tmp_path, 0.51, 0.003, 0.001), plane(tmp_path, 0.59, 0.003, 0.002)]
    command = ["eval", "--plane", "0.51,0.59", "--threshold", "std_mm<=1.5", *map(str, files)]
    result = CliRunner().invoke(app, command)
    assert result.exit_code == 3
    (missed,) = (line for line in result.stdout.splitlines() if line.endswith("missed"))
    assert missed.startswith(f"std_mm<=1.5 {files[1].stem} ")
    data = json.loads(CliRunner().invoke(app, [*command, "--format", "json"]).stdout)
    assert [t["label"] for t in data["thresholds"]] == [file.stem for file in files]


def test_a_calibration_takes_off_what_was_put_in(tmp_path: Path) -> None:
    """Planes whose error is 2 mm + 1.5 mm/m z come out where they are."""
    distances = (0.4, 0.6, 0.8)
    files = [
        plane(tmp_path, z, (0.002 + 0.0015 * z) / (1 - 0.0015), 0.0005, seed=i)
        for i, z in enumerate(distances)
    ]
    options = ["--plane", "0.4,0.6,0.8", "--order", "1", "-o", str(tmp_path / "depth.yaml")]
    result = CliRunner().invoke(app, ["calibrate", "depth", *map(str, files), *options])
    assert result.exit_code == 0, result.output
    assert "offset mm" in result.stdout
    stage = DepthCorrect(calibration=tmp_path / "depth.yaml")
    stage.open()
    for file, distance in zip(files, distances, strict=True):
        for one in McapSource(path=file).frames():
            middle = stage.process(one).depth_m[200:280, 280:360]
            assert middle.mean() == pytest.approx(distance, abs=5e-5)


def test_a_calibration_needs_more_distances_than_its_order(tmp_path: Path) -> None:
    row = measure_plane(plane(tmp_path, 0.51, 0.003, 0.001), 0.51, resamples=0)
    found = fit_correction([row], 0)
    assert found.coefficients == pytest.approx([3, 0, 0], abs=0.1)
    assert found.left == pytest.approx([0])
    with pytest.raises(UsageError, match=r"its depth says 0\.513 m, --plane 51 m"):
        measure_plane(plane(tmp_path, 0.51, 0.003, 0.001), 51.0, resamples=0)
    with pytest.raises(UsageError, match="--order 1 needs 2 distances, there are 1"):
        fit_correction([row, row], 1)


def row_of(measured_m: float, error_mm: float) -> PlaneRow:
    """Of an even plane that is measured there, with an error."""
    values = {"mean_mm": 1e3 * measured_m, "offset_mm": error_mm, "flat_std_mm": 1.0}
    known = {name: Value(value, np.nan, np.nan, 3) for name, value in values.items()}
    return PlaneRow(f"at {measured_m}", measured_m - error_mm / 1e3, 3, known)


def test_a_correction_is_a_polynomial_of_what_is_measured() -> None:
    rows = [row_of(z, 2 - 1.5 * z + 0.8 * z**2) for z in (0.4, 0.5, 0.7, 1.0)]
    found = fit_correction(rows, 2)
    assert found.coefficients == pytest.approx([2, -1.5, 0.8])
    assert found.left == pytest.approx([0] * 4, abs=1e-9)
    told = yaml.safe_load(found.fragment())
    assert told == {"offset_mm": 2, "slope_mm_per_m": -1.5, "curve_mm_per_m2": 0.8}


def test_a_plane_without_depth_in_the_middle_corrects_nothing() -> None:
    seen = row_of(0.5, 1.0)
    unknown = dict.fromkeys(seen.values, Value(np.nan, np.nan, np.nan, 0))
    with pytest.raises(InputError, match=r"at 0\.5: there is no depth in the middle"):
        fit_correction([seen, replace(seen, values=unknown)], 0)


def test_a_correction_says_what_it_leaves() -> None:
    rows = [row_of(z, error) for z, error in ((0.4, 1.0), (0.5, 2.0), (0.6, 6.0))]
    found = fit_correction(rows, 0)
    assert found.coefficients == pytest.approx([3, 0, 0])
    assert found.left == pytest.approx([-2, -1, 3])
    assert "# at 0.6: 594.0 mm, error +6.000 mm, left over +3.000 mm\n" in found.fragment()


def test_distances_that_are_not_those_of_the_planes_are_refused(tmp_path: Path) -> None:
    files = [plane(tmp_path, 0.51, 0.003, 0.001), plane(tmp_path, 0.59, 0.003, 0.001)]
    for text, order in (("0.59,0.51", 1), ("0.59,0.51", 0), ("0.51", 0)):
        rows, _, _ = judge_planes(files, text, [], 0, 0)
        with pytest.raises(UsageError, match="are the distances those of the recordings"):
            fit_correction(rows, order)
    for text in ("nan,0.5", "-0.51,0.59", "510,590"):
        with pytest.raises(UsageError, match="distances in metres, above 0 and below 100"):
            judge_planes(files, text, [], 0, 0)


def test_options_that_planes_do_not_look_at_are_refused(tmp_path: Path) -> None:
    options = ["--frames", "20", "--report", str(tmp_path / "page")]
    result = CliRunner().invoke(app, ["eval", "--plane", "0.51", str(tmp_path), *options])
    assert "--plane does not go with --frames, --report" in str(result.exception)
    assert not (tmp_path / "page").exists()


def test_a_heap_is_no_plane(tmp_path: Path) -> None:
    row = measure_plane(plane(tmp_path, 0.51, 0.003, 0.02), 0.51, resamples=0)
    with pytest.raises(InputError, match="is no plane, depth departs from one by 2"):
        fit_correction([row], 0)


def test_a_calibration_that_is_none_is_refused(tmp_path: Path) -> None:
    for text, fault in (
        ("offset: 3\n", "offset: Extra inputs are not permitted$"),
        ("offset_mm: far\n", "offset_mm: Input should be a valid number"),
        ("calibration: x.yaml\n", "it names another file$"),
        ("[3, 0, 0]\n", "expected a mapping such as 'offset_mm: 2.85'$"),
    ):
        (tmp_path / "bad.yaml").write_text(text)
        with pytest.raises(InputError, match=rf"bad\.yaml: no calibration of depth: .*{fault}"):
            DepthCorrect(calibration=tmp_path / "bad.yaml").open()
    with pytest.raises(InputError, match="there is no such file"):
        DepthCorrect(calibration=tmp_path / "none.yaml").open()
    with pytest.raises(ValidationError, match="either here or in the file"):
        DepthCorrect(calibration=tmp_path / "bad.yaml", offset_mm=1)
