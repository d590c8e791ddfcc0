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
        self.path = path
        self._sizes: Mapping[str, int] = {}  # of free dimensions that the session is for
        self._session = self._opened()
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
            self._fit(image.shape)
            found = self._session.run([output], {name: image})[0]
        except Exception as error:
            raise UsageError(
                f"model {self.path} expects {name} {list(self.inputs[name])} and got "
                f"{list(image.shape)}: {str(error).splitlines()[0]}"
            ) from error
        return np.asarray(found)

    def _fit(self, shape: tuple[int, ...]) -> None:
        """Read the network again for images of another shape, which makes it faster.

        ONNX Runtime adds into a convolution only what it knows beforehand to be of the same size.
        """
        free = next(iter(self.inputs.values()))
        pairs = {(dim, n) for dim, n in zip(free, shape, strict=False) if isinstance(dim, str)}
        sizes = dict(pairs)
        sizes = sizes if len(sizes) == len(pairs) else {}  # one name for two sizes
        if sizes != self._sizes:
            self._sizes = sizes
            self._session = self._opened()

    def _opened(self) -> Any:
        """Return a session for the sizes."""
        runtime = import_onnxruntime()
        options = runtime.SessionOptions()
        options.intra_op_num_threads = options.inter_op_num_threads = 1
        options.log_severity_level = 3
        for dim, size in self._sizes.items():
            options.add_free_dimension_override_by_name(dim, size)
        try:
            return runtime.InferenceSession(
                str(self.path), options, providers=["CPUExecutionProvider"]
            )
        except Exception as error:  # ONNX Runtime has a class of its own for every cause
            reason = str(error).splitlines()[0]
            raise UsageError(f"model {self.path}: ONNX Runtime cannot load it: {reason}") from error


def _shapes(values: Sequence[Any]) -> dict[str, tuple[Any, ...]]:
    return {value.name: tuple(value.shape) for value in values}
