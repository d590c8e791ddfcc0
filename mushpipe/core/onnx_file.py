"""Networks in ONNX files, run by ONNX Runtime on one thread; the only module that knows it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mushpipe.core.errors import UsageError
from mushpipe.core.libraries import import_onnxruntime


class OnnxFile:
    """A network read from a file.

    One thread and the default optimisations: the same input gives the same bytes.

    Attributes:
        path: The file.
        inputs: Name -> shape; a free dimension is not an int.
        outputs: The same.
        metadata: What its maker wrote into it.

    Raises:
        UsageError: The file is missing or is no ONNX model that this ONNX Runtime can run.
        DependencyError: ONNX Runtime is not installed.
    """

    def __init__(self, path: Path) -> None:
        if not path.is_file():
            raise UsageError(f"model {path}: there is no such file")
        runtime = import_onnxruntime()
        options = runtime.SessionOptions()
        options.intra_op_num_threads = options.inter_op_num_threads = 1
        options.log_severity_level = 3
        try:
            self._session = runtime.InferenceSession(
                str(path), options, providers=["CPUExecutionProvider"]
            )
        except Exception as error:  # ONNX Runtime has a class of its own for every cause
            reason = str(error).splitlines()[0]
            raise UsageError(f"model {path}: ONNX Runtime cannot load it: {reason}") from error
        self.path = path
        self.inputs = _shapes(self._session.get_inputs())
        self.outputs = _shapes(self._session.get_outputs())
        self.metadata: Mapping[str, str] = self._session.get_modelmeta().custom_metadata_map

    def __call__(self, image: NDArray[np.float32], output: str) -> NDArray[Any]:
        """Return one output for an image (1, C, H, W) as the only input.

        Raises:
            UsageError: The network refuses the image.
        """
        name = next(iter(self.inputs))
        try:
            found = self._session.run([output], {name: image})[0]
        except Exception as error:
            raise UsageError(
                f"model {self.path} expects {name} {list(self.inputs[name])} and got "
                f"{list(image.shape)}: {str(error).splitlines()[0]}"
            ) from error
        return np.asarray(found)


def _shapes(values: Sequence[Any]) -> dict[str, tuple[Any, ...]]:
    return {value.name: tuple(value.shape) for value in values}
