"""Write an int8 variant of an exported `cap-net`: `python -m training.net.quantize IN OUT`.

Static quantisation in QDQ form, calibrated on validation frames of the simulator. The head keeps
float32: a logit or the logarithm of a radius in 256 steps is too coarse.
"""

from __future__ import annotations

import argparse
from collections.abc import Iterator
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import cv2
import onnx
from onnxruntime.quantization import CalibrationDataReader, QuantFormat, QuantType, quantize_static
from onnxruntime.quantization.shape_inference import quant_pre_process

from training.net.scenes import VALIDATION_SEED, pictures


class Frames(CalibrationDataReader):
    """Validation frames, as the stage hands them to the network."""

    def __init__(self, cache: Path, count: int) -> None:
        self._frames: Iterator[Any] = pictures(VALIDATION_SEED, count, cache)

    def get_next(self) -> dict[str, Any] | None:
        """Return the next frame, None after the last."""
        picture = next(self._frames, None)
        return None if picture is None else {"image": cv2.dnn.blobFromImage(picture.color, 1 / 255)}


def quantize(path: Path, out: Path, cache: Path, count: int) -> None:
    """Write the int8 variant of a model, with its metadata."""
    model = onnx.load(path)
    last = [node for node in model.graph.node if node.op_type == "Conv"][-2:]
    with TemporaryDirectory() as folder:
        ready = Path(folder) / "ready.onnx"
        quant_pre_process(path, ready, skip_symbolic_shape=True)
        names = {node.name for node in last}
        quantize_static(
            ready, out, Frames(cache, count), quant_format=QuantFormat.QDQ, per_channel=True,
            activation_type=QuantType.QUInt8, weight_type=QuantType.QInt8,
            nodes_to_exclude=sorted(names),
        )  # fmt: skip
    result = onnx.load(out)
    onnx.helper.set_model_props(result, {p.key: p.value for p in model.metadata_props})
    onnx.save(result, out)


def main() -> None:
    """Read the command line."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("model", type=Path)
    parser.add_argument("out", type=Path)
    parser.add_argument("--cache", type=Path, default=Path("out/net"), help="rendered frames")
    parser.add_argument("--frames", type=int, default=16)
    arguments = parser.parse_args()
    quantize(arguments.model, arguments.out, arguments.cache, arguments.frames)


if __name__ == "__main__":
    main()
