from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from onnx import TensorProto, helper
from pydantic import ValidationError

from mushpipe import RgbdFrame
from mushpipe.core.errors import UsageError
from mushpipe.stages.onnx_model import Onnx
from mushpipe.stages.onnx_model import discs as drawn
from tests.stages.networks import answering, of_brightness, saved
from tests.stages.scenes import HEADER, discs, frame_of

CIRCLES = [(40.0, 40.0, 15.0), (100.0, 70.0, 20.0)]
BRIGHT = [[40 / 3] * 3], [-20.0]  # logit 20 at white, -20 at black


def test_logits_of_one_channel_become_mask_and_pieces(tmp_path: Path) -> None:
    image = discs(CIRCLES, 0.9, 0.1)
    stage = Onnx(model=of_brightness(tmp_path / "m.onnx", *BRIGHT), output="logits")
    mask, circles = stage.process(frame_of(image))
    assert np.array_equal(mask.foreground, np.rint(image * 255) / 255 >= 0.5)
    found = np.column_stack([circles.center, circles.radius])
    assert found[np.argsort(found[:, 0])] == pytest.approx(np.array(CIRCLES), abs=0.2)
    assert (circles.score > 0.9).all()


def test_the_likelier_of_three_classes_is_taken(tmp_path: Path) -> None:
    color = np.zeros((32, 64, 3), np.uint8)
    color[:, :20, 0], color[:, 20:40, 1], color[:, 40:, 2] = 255, 255, 255
    model = of_brightness(tmp_path / "m.onnx", 9 * np.eye(3), [0.0] * 3)
    for wanted in range(3):
        stage = Onnx(model=model, output="logits", class_id=wanted)
        mask, _ = stage.process(RgbdFrame(HEADER, color))
        assert np.array_equal(mask.foreground, color[..., wanted] > 0)
        swapped = stage.model_copy(update={"order": "bgr", "class_id": 2 - wanted})
        assert np.array_equal(
            swapped.process(RgbdFrame(HEADER, color))[0].foreground, mask.foreground
        )


def test_a_fixed_input_is_letterboxed_and_taken_back(tmp_path: Path) -> None:
    image = discs(CIRCLES, 0.9, 0.1)
    path = of_brightness(tmp_path / "m.onnx", *BRIGHT, image=[1, 3, 320, 320])
    mask, _ = Onnx(model=path, output="logits").process(frame_of(image))
    assert (mask.foreground != (image > 0.5)).mean() < 0.01


@pytest.mark.parametrize("image", [[1, 3, "h", "w"], ["n", 3, "side", "side"]])
def test_images_of_several_sizes_follow_one_another(tmp_path: Path, image: list[int | str]) -> None:
    """Also where the model's maker gave height and width one name."""
    model = of_brightness(tmp_path / "m.onnx", *BRIGHT, image=image)
    stage = Onnx(model=model, output="logits")
    for height, width in ((32, 64), (64, 64), (96, 32), (32, 64)):
        color = np.zeros((height, width, 3), np.uint8)
        color[: height // 2] = 255
        mask, _ = stage.process(RgbdFrame(HEADER, color))
        assert np.array_equal(mask.foreground, color[..., 0] > 0)


@pytest.mark.parametrize("fixed", [True, False])
def test_an_image_is_enlarged_to_the_size_that_is_asked_for(tmp_path: Path, fixed: bool) -> None:
    """The box that is found covers the image, whose lower edge lies at half of a square input."""
    box = np.array([[160.0, 160.0, 320.0, 160.0, 0.9]])
    shape = [1, 3, 320, 320] if fixed else [1, 3, "h", "w"]
    model = answering(tmp_path / "m.onnx", box.T[None], image=shape)
    color = np.zeros((80, 160, 3), np.uint8)
    stage = Onnx(model=model, output="yolov8", size=(320, 320))
    _, circles = stage.process(RgbdFrame(HEADER, color))
    assert circles.center[0] == pytest.approx([79.5, 39.5])
    assert circles.radius[0] == pytest.approx(np.sqrt(160 * 80) / 2)


def test_the_three_layouts_of_yolo_say_the_same_circles(tmp_path: Path) -> None:
    """A 160 x 100 image in a 320 x 320 input is twice as large, with 60 px of gray above."""
    frame = frame_of(np.zeros((100, 160)), camera=None)
    x, y, r = np.array(CIRCLES).T
    box = np.column_stack([2 * (x + 0.5), 2 * (y + 0.5) + 60, 4 * r, 4 * r])
    other, score = np.full(2, 0.1), np.array([0.8, 0.9])
    corners = np.column_stack([box[:, :2] - box[:, 2:] / 2, box[:, :2] + box[:, 2:] / 2])
    layouts = {
        "yolov5": np.column_stack([box, np.ones(2), other, score]),
        "yolov8": np.column_stack([box, other, score]).T,
        "yolov10": np.column_stack([corners, score, np.ones(2)]),
    }
    for name, answer in layouts.items():
        model = answering(tmp_path / f"{name}.onnx", answer[None], image=[1, 3, 320, 320])
        stage = Onnx(model=model, output=name, class_id=1)
        mask, circles = stage.process(frame)
        found = np.column_stack([circles.center, circles.radius, circles.score])
        wanted = np.column_stack([CIRCLES[::-1], score[::-1]])
        assert found == pytest.approx(wanted, abs=1e-4), name
        assert (mask.foreground != (discs(CIRCLES, 1, 0) > 0.5)[:100, :160]).mean() < 0.01
        with_zero = stage.model_copy(update={"class_id": 0})
        assert len(with_zero.process(frame)[1]) == 0


def test_of_boxes_on_one_cap_the_likeliest_stays(tmp_path: Path) -> None:
    box = np.array([[50, 50, 30, 30, 0.7], [52, 50, 30, 30, 0.9], [50, 50, 30, 30, 0.2]])
    model = answering(tmp_path / "m.onnx", box.T[None], image=[1, 3, 96, 96])
    _, circles = Onnx(model=model, output="yolov8").process(
        frame_of(np.zeros((96, 96)), camera=None)
    )
    assert circles.score == pytest.approx([0.9])


def test_what_cannot_work_is_said_with_the_file(tmp_path: Path) -> None:
    frame = frame_of(np.zeros((96, 96)), camera=None)
    with pytest.raises(UsageError, match=r"gone\.onnx: there is no such file"):
        Onnx(model=tmp_path / "gone.onnx", output="logits").open()
    with pytest.raises(UsageError, match="it is a folder"):
        Onnx(model=tmp_path, output="logits").open()
    text = tmp_path / "text.onnx"
    text.write_text("not a model")
    with pytest.raises(UsageError, match=r"text\.onnx: ONNX Runtime cannot load it"):
        Onnx(model=text, output="logits").open()
    gray = answering(tmp_path / "gray.onnx", np.zeros((1, 4, 4)), image=[1, 1, 8, 8])
    with pytest.raises(UsageError, match=r"expected one image \(1, 3, H, W\)"):
        Onnx(model=gray, output="logits").open()
    boxes = answering(tmp_path / "boxes.onnx", np.zeros((1, 5, 7)))
    with pytest.raises(UsageError, match="has no output 'mask'; it has: found"):
        Onnx(model=boxes, output="logits", tensor="mask").open()
    with pytest.raises(UsageError, match=r"shape \(1, 5, 7\).*expects \(1, N, 6\)"):
        Onnx(model=boxes, output="yolov10").process(frame)
    with pytest.raises(UsageError, match=r"class_id 3 expects \(1, 4 \+ C, N\)"):
        Onnx(model=boxes, output="yolov8", class_id=3).process(frame)


def test_an_answer_that_is_no_detection_is_refused(tmp_path: Path) -> None:
    frame = frame_of(np.zeros((96, 96)), camera=None)
    box = np.array([[50, 50, 30, 30, 0.9]])
    wrong = {
        "five": (box * [1, 1, 1, 1, 6], "scores are 5.4 to 5.4, expected 0 to 1.*expects"),
        "none": (box * [1, 1, 1, 1, np.nan], "values that are no numbers"),
    }
    for name, (answer, text) in wrong.items():
        model = answering(tmp_path / f"{name}.onnx", answer.T[None], image=[1, 3, 96, 96])
        with pytest.raises(UsageError, match=text):
            Onnx(model=model, output="yolov8").process(frame)


def test_boxes_whose_middle_is_not_in_the_image_are_none(tmp_path: Path) -> None:
    boxes = np.array([[50, 50, 30, 30, 0.9], [-500, -500, 30, 30, 0.8], [97, 50, 30, 30, 0.7]])
    model = answering(tmp_path / "m.onnx", boxes.T[None], image=[1, 3, 96, 96])
    _, circles = Onnx(model=model, output="yolov8").process(
        frame_of(np.zeros((96, 96)), camera=None)
    )
    assert circles.score == pytest.approx([0.9])


def test_a_model_that_ends_in_sigmoid_softmax_or_argmax_is_read_as_such(tmp_path: Path) -> None:
    color = np.zeros((32, 64, 3), np.uint8)
    color[:, :20] = 255
    bright, model = color[..., 0] > 0, of_brightness(tmp_path / "m.onnx", [[1 / 3] * 3], [0.0])
    for more in ({"output": "probabilities"}, {"output": "labels", "class_id": 1}):
        mask, circles = Onnx(model=model, **more).process(RgbdFrame(HEADER, color))
        assert np.array_equal(mask.foreground, bright)
        assert circles.score == pytest.approx([1.0])
    with pytest.raises(UsageError, match=r"which logits are not.*'probabilities' or 'labels'"):
        Onnx(model=model, output="logits").process(RgbdFrame(HEADER, color))
    with pytest.raises(ValidationError, match="which label is mushroom"):
        Onnx(model=model, output="labels")


def test_boxes_in_shares_of_the_input_are_read_as_such(tmp_path: Path) -> None:
    frame, box = frame_of(np.zeros((96, 192)), camera=None), np.array([[0.5, 0.5, 0.1, 0.2, 0.9]])
    model = answering(tmp_path / "m.onnx", box.T[None], image=[1, 3, 96, 192])
    _, circles = Onnx(model=model, output="yolov8", normalised=True).process(frame)
    assert circles.center[0] == pytest.approx([95.5, 47.5])
    assert circles.radius[0] == pytest.approx(9.6)
    with pytest.raises(UsageError, match="set `normalised`"):
        Onnx(model=model, output="yolov8").process(frame)
    pixels = answering(tmp_path / "p.onnx", (box * [192, 96, 192, 96, 1]).T[None])
    with pytest.raises(UsageError, match="boxes reach 96, but `normalised`"):
        Onnx(model=pixels, output="yolov8", normalised=True).process(frame)


def test_a_box_far_larger_than_the_image_is_drawn(tmp_path: Path) -> None:
    box = np.array([[48, 48, 3e9, 3e9, 0.9]])
    model = answering(tmp_path / "m.onnx", box.T[None], image=[1, 3, 96, 96])
    mask, circles = Onnx(model=model, output="yolov8").process(
        frame_of(np.zeros((96, 96)), camera=None)
    )
    assert mask.foreground.all()
    assert circles.radius == pytest.approx([1.5e9])


@pytest.mark.parametrize("kind", [TensorProto.FLOAT16, TensorProto.DOUBLE])
def test_images_of_other_floats_are_taken(tmp_path: Path, kind: int) -> None:
    node = helper.make_node("Cast", ["image"], ["found"], to=TensorProto.FLOAT)
    model = saved(tmp_path / "m.onnx", [node], {}, numbers=kind)
    color = np.full((32, 64, 3), 255, np.uint8)
    mask, _ = Onnx(model=model, output="probabilities").process(RgbdFrame(HEADER, color))
    assert mask.foreground.all()


def test_an_input_that_no_image_fits_is_refused_before_a_frame(tmp_path: Path) -> None:
    node = helper.make_node("Cast", ["image"], ["found"], to=TensorProto.FLOAT)
    whole = saved(tmp_path / "whole.onnx", [node], {}, numbers=TensorProto.UINT8)
    with pytest.raises(UsageError, match=r"its input is tensor\(uint8\), expected floats"):
        Onnx(model=whole, output="logits").open()
    eight = answering(tmp_path / "eight.onnx", np.zeros((8, 5, 7)), image=[8, 3, 96, 96])
    with pytest.raises(UsageError, match="expected one image"):
        Onnx(model=eight, output="yolov8").open()
    fixed = answering(tmp_path / "fixed.onnx", np.zeros((1, 5, 7)), image=[1, 3, 96, 128])
    with pytest.raises(UsageError, match="takes images of 128x96 px, which `size` cannot change"):
        Onnx(model=fixed, output="yolov8", size=(96, 96)).open()


@pytest.mark.parametrize("radius", [1.0, 2.3, 5.0, 8.1, 20.0])
def test_discs_are_the_pixels_whose_middle_is_within(radius: float) -> None:
    circles = np.array([(30.4, 20.7, radius), (-2.0, 39.0, 2 * radius), (70.0, 20.0, radius)])
    v, u = np.mgrid[:40, :60]
    within = [(u - x) ** 2 + (v - y) ** 2 <= r * r for x, y, r in circles]
    assert np.array_equal(drawn(circles, (60, 40)), np.any(within, axis=0))
