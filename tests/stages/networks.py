"""Tiny networks in ONNX files, built node by node, so that what they answer is known."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from onnx import TensorProto, helper, numpy_helper, save

IMAGE: list[int | str] = [1, 3, "h", "w"]


def saved(
    path: Path, nodes: list[Any], constants: dict[str, np.ndarray], image: list[int | str] = IMAGE,
    numbers: int = TensorProto.FLOAT, **facts: str,
) -> Path:  # fmt: skip
    """Write a network from `image`, of these numbers, to `found`; `facts` are its metadata."""
    graph = helper.make_graph(
        nodes,
        "tiny",
        [helper.make_tensor_value_info("image", numbers, image)],
        [helper.make_tensor_value_info("found", TensorProto.FLOAT, None)],
        [numpy_helper.from_array(np.asarray(v, np.float32), k) for k, v in constants.items()],
    )
    model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", 17)], ir_version=8)
    helper.set_model_props(model, facts)
    save(model, path)
    return path


def answering(path: Path, answer: np.ndarray, **more: Any) -> Path:
    """Write a network that answers the same to every image."""
    return saved(
        path, [helper.make_node("Identity", ["answer"], ["found"])], {"answer": answer}, **more
    )


def of_brightness(path: Path, weights: np.ndarray, bias: list[float], **more: Any) -> Path:
    """Write a segmenter: logits (1, C, h, w) = weights (C, 3) of each pixel's colour + bias."""
    node = helper.make_node("Conv", ["image", "weights", "bias"], ["found"])
    values = {"weights": np.asarray(weights)[..., None, None], "bias": np.array(bias)}
    return saved(path, [node], values, **more)
