"""Folders of image files, written by OpenCV."""

from __future__ import annotations

import re
from dataclasses import fields
from itertools import pairwise
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from PIL import Image
from pydantic import ValidationError

from mushpipe import InputError, RgbdFrame, UsageError
from mushpipe.core.document import read_document
from mushpipe.core.graph import compile_document
from mushpipe.core.plugins import load_registry
from mushpipe.core.run import run
from mushpipe.evaluate.results import read_results
from mushpipe.sources.folder import ImagesSource, _natural
from mushpipe.sources.mcap import McapSource

ROOT = Path(__file__).parents[2]
SIZE = (24, 32)


def write(path: Path, value: float, dtype: Any = np.uint8, channels: int = 3) -> None:
    path.parent.mkdir(exist_ok=True)
    shape = SIZE if channels == 1 else (*SIZE, channels)
    assert cv2.imwrite(str(path), np.full(shape, value, dtype))


def source(folder: Path, **settings: Any) -> ImagesSource:
    found = ImagesSource(path=folder, **settings)
    found.open()
    return found


def played(folder: Path, **settings: Any) -> list[RgbdFrame]:
    return list(source(folder, **settings).frames())


def test_a_single_image_is_played_by_its_name(tmp_path: Path) -> None:
    photo = tmp_path / "IMG 7.JPG"
    write(photo, 90)
    write(tmp_path / "other.png", 30)
    graph = read_document(ROOT / "graphs/pick.yaml")
    plugin = compile_document(graph, load_registry(), source=str(photo)).source.plugin
    assert isinstance(plugin, ImagesSource)
    assert (plugin.name(), plugin.files()) == ("IMG 7", (photo,))
    (frame,) = played(photo)
    assert frame.color.mean() == pytest.approx(90, abs=2)
    with pytest.raises(UsageError, match="a single image has no depth: give its folder"):
        source(photo, depth="*.png", depth_scale=0.001)


def test_a_recording_as_image_files_gives_the_same_picks(tmp_path: Path) -> None:
    recording = ROOT / "recordings/dense.mcap"
    frames = []
    for k, frame in zip(range(2), McapSource(path=recording).frames(), strict=False):
        cv2.imwrite(str(tmp_path / f"rgb_{k}.png"), frame.color[..., ::-1])
        cv2.imwrite(str(tmp_path / f"depth_{k}.png"), frame.depth)
        frames.append(frame)
    camera = frames[0].camera
    assert camera is not None
    settings = {
        "path": str(tmp_path),
        "color": "rgb_*.png",
        "depth": "depth_*.png",
        "depth_scale": frames[0].depth_scale,
        "camera": {name: getattr(camera, name) for name in ("fx", "fy", "cx", "cy")},
    }
    picks = []
    for name, given_source in (
        ("files", {"use": "images", **settings}),
        ("mcap", {"use": "mcap", "path": str(recording), "max_frames": 2}),
    ):
        document = read_document(ROOT / "graphs/pick.yaml")
        document.data["source"] = given_source
        document.data["sinks"] = {"log": {"use": "mcap", "path": str(tmp_path / f"{name}.mcap")}}
        assert run(compile_document(document, load_registry())).exit_code == 0
        picks.append(read_results(tmp_path / f"{name}.mcap"))
    assert len(picks[0].frames) == len(picks[1].frames) == 2
    for (_, files), (_, played_again) in zip(picks[0].frames, picks[1].frames, strict=True):
        assert len(files) > 100
        for column in fields(files):
            ours, theirs = (getattr(each, column.name) for each in (files, played_again))
            np.testing.assert_array_equal(ours, theirs)


def test_partners_have_the_same_in_place_of_the_star(tmp_path: Path) -> None:
    for k in (10, 9, 2):
        write(tmp_path / f"rgb/{k}.jpg", 3 * k)
    for k in (9, 10, 11):
        write(tmp_path / f"depth/{k}.png", 1000 + k, np.uint16, 1)
    stage = source(tmp_path, color="rgb/*.jpg", depth="depth/*.png", depth_scale=0.0005)
    frames = list(stage.frames())
    assert [int(frame.color.mean()) for frame in frames] == [6, 27, 30]
    assert [None if f.depth is None else int(f.depth[0, 0]) for f in frames] == [None, 1009, 1010]
    assert frames[1].depth_m[0, 0] == pytest.approx(0.5045)
    assert [frame.header.sequence for frame in frames] == [0, 1, 2]
    assert [frame.header.stamp_ns for frame in frames] == [0, 33_333_333, 66_666_667]
    assert stage.counts() == {
        "colour images without a depth image": 1,
        "depth images without a colour image": 1,
    }


@pytest.mark.parametrize("folder", ["./rgb/", "rgb//", "rgb/./"])
def test_names_may_be_spelt_as_a_shell_spells_them(folder: str, tmp_path: Path) -> None:
    """`aa2` and `bb1` were cut to 2 and 1, which is another order."""
    for k, name in enumerate(("aa2", "bb1")):
        write(tmp_path / f"rgb/{name}.png", k)
        write(tmp_path / f"depth/{name}.png", 1000 + k, np.uint16, 1)
    names = {"color": f"{folder}*.png", "depth": "./depth/*.png"}
    frames = played(tmp_path, **names, depth_scale=0.001)
    assert [int(frame.color.mean()) for frame in frames] == [0, 1]
    assert [None if f.depth is None else int(f.depth[0, 0]) for f in frames] == [1000, 1001]


def test_channels_are_red_green_blue_and_float_depth_is_taken_as_it_is(tmp_path: Path) -> None:
    image = np.zeros((*SIZE, 3), np.uint8)
    image[..., 2] = 200  # OpenCV's red
    cv2.imwrite(str(tmp_path / "a_color.png"), image)
    write(tmp_path / "a_depth.tiff", 0.47, np.float32, 1)
    (frame,) = played(tmp_path, color="*_color.png", depth="*_depth.tiff", depth_scale=1.0)
    assert frame.color[0, 0].tolist() == [200, 0, 0]
    assert frame.depth_m[0, 0] == pytest.approx(0.47)


def test_any_name_will_do_where_there_is_colour_alone(tmp_path: Path) -> None:
    write(tmp_path / "b.PNG", 2)
    write(tmp_path / "a [1].jpeg", 1)
    (tmp_path / "labels.json").write_text("{}")
    assert [int(frame.color.mean()) for frame in played(tmp_path)] == [1, 2]


def test_a_picture_is_turned_as_viewers_turn_it_but_not_beside_depth(tmp_path: Path) -> None:
    pixels = np.zeros((*SIZE, 3), np.uint8)
    pixels[:8] = 200
    exif = Image.Exif()
    exif[0x0112] = 3  # held upside down
    Image.fromarray(pixels).save(tmp_path / "c0.jpg", exif=exif, quality=95)
    write(tmp_path / "d0.png", 400, np.uint16, 1)
    (alone,) = played(tmp_path, color="c*.jpg")
    (beside,) = played(tmp_path, color="c*.jpg", depth="d*.png", depth_scale=0.001)
    assert alone.color[-1, 0, 0] > 150 > 50 > alone.color[0, 0, 0]
    assert beside.color[0, 0, 0] > 150 > 50 > beside.color[-1, 0, 0]


def test_hidden_files_are_no_images(tmp_path: Path) -> None:
    """A Mac leaves `._7.png`, which is no image, beside 7.png on foreign disks."""
    write(tmp_path / "7.png", 7)
    (tmp_path / "._7.png").write_bytes(b"\x00\x05\x16\x07" + bytes(78))
    stage = source(tmp_path)
    assert [int(frame.color.mean()) for frame in stage.frames()] == [7]
    assert stage.files() == (tmp_path / "7.png",)


def test_a_folder_as_the_source_is_one_of_images(tmp_path: Path) -> None:
    write(tmp_path / "0.png", 1)
    document = read_document(ROOT / "graphs/pick.yaml")
    plan = compile_document(document, load_registry(), [], str(tmp_path))
    assert plan.source.use == "images"
    assert plan.source.plugin.path == tmp_path


@given(st.lists(st.tuples(st.text("ab0123456789", max_size=4), st.integers(0, 999)), unique=True))
def test_numbers_in_names_count_by_their_value(names: list[tuple[str, int]]) -> None:
    """Whatever stands around them."""
    stems = sorted({f"x{text}-{number}" for text, number in names}, key=_natural)
    for a, b in pairwise(stems):
        (p, m), (q, n) = (each.rsplit("-", 1) for each in (a, b))
        assert p != q or int(m) <= int(n)


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        (
            {"color": "rgb/*.jpg"},
            "no image is named rgb/*.jpg (source.color); there is *.png (1), ",
        ),
        (
            {"color": "c*.png", "depth": "d/*.png", "depth_scale": 1},
            "no depth image belongs to a colour image: `*` stands for '0' in the first colour",
        ),
        (
            {"color": "c*.png", "depth": "c*.png", "depth_scale": 1},
            "no colour is left: every image named c*.png (source.color) is a depth image, named c*",
        ),
    ],
)
def test_what_is_not_there_is_told_with_what_is(
    tmp_path: Path, settings: dict[str, Any], message: str
) -> None:
    write(tmp_path / "c0.png", 1)
    write(tmp_path / "d/d0.png", 1, np.uint16, 1)
    with pytest.raises(InputError, match=re.escape(message)):
        source(tmp_path, **settings)
    with pytest.raises(UsageError, match="there is no such folder, and no such image"):
        source(tmp_path / "nowhere")
    write(tmp_path / "c0.jpg", 1)
    with pytest.raises(InputError, match=r"c0\.jpg and c0\.png are one image to '\*'"):
        source(tmp_path)


@pytest.mark.parametrize(
    ("dtype", "channels", "size", "message"),
    [
        (np.uint8, 1, SIZE, "depth is uint8, expected uint16 or float32"),
        (np.uint16, 3, SIZE, "depth has shape"),
        (np.uint16, 1, (12, 16), "depth has shape .* depth must be aligned"),
    ],
)
def test_what_is_no_depth_is_refused_by_name(
    tmp_path: Path, dtype: Any, channels: int, size: tuple[int, int], message: str
) -> None:
    write(tmp_path / "c0.png", 1)
    shape = size if channels == 1 else (*size, channels)
    cv2.imwrite(str(tmp_path / "d0.png"), np.ones(shape, dtype))
    with pytest.raises(InputError, match=rf"c0\.png and .*d0\.png: {message}"):
        played(tmp_path, color="c*.png", depth="d*.png", depth_scale=0.001)


def test_depth_is_no_colour_and_a_damaged_file_no_image(
    tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    write(tmp_path / "0.png", 400, np.uint16, 1)
    with pytest.raises(InputError, match=r"0\.png: 16 bits a channel, expected 8; where it is"):
        played(tmp_path)
    (tmp_path / "0.png").write_bytes(b"")
    with pytest.raises(InputError, match=r"0\.png: it is empty"):
        played(tmp_path)
    (tmp_path / "0.png").write_bytes(b"no image")
    with pytest.raises(InputError, match=r"0\.png: it is no image, or damaged"):
        played(tmp_path)
    (tmp_path / "0.png").unlink()
    write(tmp_path / "0.tiff", 0.4, np.float32, 1)
    with pytest.raises(InputError, match=r"0\.tiff: 32 bits a channel, expected 8; where it is"):
        played(tmp_path)
    assert capfd.readouterr().err == ""  # OpenCV says nothing of its own


def test_a_file_of_several_images_is_refused(tmp_path: Path) -> None:
    pages = [np.full((*SIZE, 3), value, np.uint8) for value in (10, 20)]
    assert cv2.imwritemulti(str(tmp_path / "0.tiff"), pages)
    with pytest.raises(InputError, match=r"0\.tiff: it holds several images: make a file of each"):
        played(tmp_path)


def test_a_camera_holds_for_images_of_one_size(tmp_path: Path) -> None:
    write(tmp_path / "0.png", 1)
    cv2.imwrite(str(tmp_path / "1.png"), np.zeros((12, 16, 3), np.uint8))
    assert len(played(tmp_path)) == 2
    given = {"fx": 40, "fy": 40, "cx": 15.5, "cy": 11.5}
    with pytest.raises(InputError, match=r"1\.png: the image is 16x12, the first one 32x24"):
        played(tmp_path, camera=given)
    with pytest.raises(
        InputError, match=r"0\.png: the principal point of source.camera, \(15.5, 24"
    ):
        played(tmp_path, camera={**given, "cy": 24})


def test_depth_needs_its_unit_and_names_one_star(tmp_path: Path) -> None:
    with pytest.raises(ValidationError, match="with depth, set depth_scale"):
        ImagesSource(path=tmp_path, depth="*.png")
    for names in ("rgb.png", "*/*.png"):
        with pytest.raises(ValidationError, match="expected one"):
            ImagesSource(path=tmp_path, color=names)
    with pytest.raises(ValidationError, match="expected names as seen from the folder"):
        ImagesSource(path=tmp_path, color=f"{tmp_path}/rgb/*.png")
