"""Networks in ONNX files, run by ONNX Runtime on one thread; the only module that knows it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mushpipe.core.arrays import Singles
from mushpipe.core.errors import UsageError
from mushpipe.core.libraries import import_onnxruntime
from mushpipe.core.paths import require_model

_FLOATS = {
    "tensor(float)": np.float32,
    "tensor(float16)": np.float16,
    "tensor(double)": np.float64,
}
Sizes = tuple[tuple[str, int], ...]  # of free dimensions, by their names


class OnnxFile:
    """A network read from a file.

    One thread and the default optimisations: the same input gives the same bytes.

    Attributes:
        path: The file.
        inputs: Name -> shape; a free dimension is not an int.
        outputs: The same.
        metadata: What its maker wrote into it.

    Raises:
        UsageError: The file is missing, is no ONNX model that this ONNX Runtime can run, or takes
            no floats.
        DependencyError: ONNX Runtime is not installed.
    """

    def __init__(self, path: Path) -> None:
        require_model(path)
        self.path = path
        # Frames with and without depth may differ in their sizes, and be looked at in several.
        self._session = lru_cache(maxsize=6)(self._opened)
        session = self._session(())
        self.inputs = _shapes(session.get_inputs())
        self.outputs = _shapes(session.get_outputs())
        kind = session.get_inputs()[0].type if self.inputs else ""
        if kind not in _FLOATS:
            raise UsageError(f"model {path}: its input is {kind or 'missing'}, expected floats")
        self._float = _FLOATS[kind]
        self.metadata: Mapping[str, str] = session.get_modelmeta().custom_metadata_map

    def __call__(self, image: Singles, output: str) -> NDArray[Any]:
        """Return one output for an image (1, C, H, W) as the only input.

        Raises:
            UsageError: The network refuses the image.
        """
        name = next(iter(self.inputs))
        given = {name: image.astype(self._float, copy=False)}
        try:
            found = self._session(self._sizes(image.shape)).run([output], given)[0]
        except Exception as error:
            raise UsageError(
                f"model {self.path} expects {name} {list(self.inputs[name])} and got "
                f"{list(image.shape)}: {str(error).splitlines()[0]}"
            ) from error
        return np.asarray(found)

    def _sizes(self, shape: tuple[int, ...]) -> Sizes:
        """Return what the free dimensions are for images of a shape."""
        free = next(iter(self.inputs.values()))
        pairs = [pair for pair in zip(free, shape, strict=False) if isinstance(pair[0], str)]
        sizes = dict(pairs)
        one_each = all(sizes[name] == size for name, size in pairs)
        return tuple(sizes.items()) if one_each else ()

    def _opened(self, sizes: Sizes) -> Any:
        """Return a session for images whose free dimensions are known, which is faster.

        ONNX Runtime adds into a convolution only what it knows beforehand to be of the same size.
        """
        runtime = import_onnxruntime()
        options = runtime.SessionOptions()
        options.intra_op_num_threads = options.inter_op_num_threads = 1
        options.log_severity_level = 3
        for dim, size in sizes:
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
