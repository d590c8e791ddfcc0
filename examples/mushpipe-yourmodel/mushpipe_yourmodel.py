"""A network of your own as a plugin: `pip install .`, then `use: yourmodel`.

Where the model is a plain segmenter or a YOLO detector, the stage `onnx` needs no code at all. This
is for everything else: what goes in and what comes out is yours.
"""

from typing import Any

import numpy as np
from pydantic import Field, PrivateAttr

from mushpipe import GraphPath, Mask, Registry, RgbdFrame, Stage, UsageError, hookimpl


class YourModel(Stage):
    """Caps are where your network says so: gray and height below the camera in, a logit out."""

    model: GraphPath = Field(description="the ONNX file: (1, 2, H, W) to (1, 1, H, W)")
    far_m: float = Field(0.6, gt=0, description="what is missing in depth counts as this far, m")
    limit: float = Field(0.0, description="smallest logit of a cap")

    _session: Any = PrivateAttr(None)

    def open(self) -> None:
        """Read the model; a run calls this once, before the first frame."""
        import onnxruntime  # here, so that listing plugins does not load it

        if not self.model.is_file():
            raise UsageError(f"model {self.model}: there is no such file")
        options = onnxruntime.SessionOptions()
        options.intra_op_num_threads = 1
        self._session = onnxruntime.InferenceSession(str(self.model), options)

    def process(self, frame: RgbdFrame) -> Mask:
        """Return where the logit is above the limit."""
        depth = np.nan_to_num(frame.depth_m, nan=self.far_m)
        values = np.stack([frame.gray, depth])[None].astype(np.float32)
        name = self._session.get_inputs()[0].name
        logit = self._session.run(None, {name: values})[0]
        return Mask(logit[0, 0] > self.limit)


@hookimpl
def mushpipe_register(registry: Registry) -> None:
    """Register the stage by name."""
    registry.stage("yourmodel", YourModel)
